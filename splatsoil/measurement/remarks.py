"""What is allowed in a measurement set but likely not meant, in plain words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np

from splatsoil.measurement.images import turned
from splatsoil.measurement.measurement import Measurement, sees

_NAMED = 4  # frames or images that a remark lists
_FEW_VIEWS = 12
_EARTH = (9.76, 9.84)  # m/s², from the equator's mountains to the poles
_OFF_MIDDLE = 0.25  # of the image: further off its middle a principal point is that of a crop, or in another unit
# Largest forces, by the weight of a cube of soil as wide as the tool: sand takes a tenth to ten of it where the cut is
# a tenth to all of the width deep, clay hundreds where the tool is small. In kN the former are below, in mN above.
_FORCES = (0.03, 1000.0)


@dataclass(frozen=True)
class Remark:
    """Something to know about a set.

    Attributes:
        about: what it concerns: views, video, heights, tool, bed.
        text: one sentence for a person.
    """

    about: str
    text: str


def remarks(measurement: Measurement) -> tuple[Remark, ...]:
    """All remarks on a set that has passed its checks; none is a reason not to go on."""
    assumed = [
        Remark("bed" if field.startswith("bed") else "tool", f"{field} is not given; {value:g} is taken.")
        for field, value in measurement.assumed.items()
    ]
    parts = (
        *(("bed", _on_bed), ("views", _on_views), ("video", _on_video), ("heights", _on_heights)),
        *(("tool", _on_tool), ("tool", _on_force)),
    )
    return (*assumed, *(Remark(about, text) for about, look in parts for text in look(measurement)))


def _on_bed(measurement: Measurement) -> Iterator[str]:
    size = float(np.linalg.norm(measurement.gravity))
    if not _EARTH[0] <= size <= _EARTH[1]:
        yield f"Gravity is {size:g} m/s²; on Earth it is 9.81."


def _on_heights(measurement: Measurement) -> Iterator[str]:
    grids = () if measurement.heights is None else measurement.heights.grids.values()
    if zeros := sum(int(np.sum(grid == 0.0)) for grid in grids):
        yield f"{zeros} heights are exactly 0 m; an unknown height is NaN."


def _on_views(measurement: Measurement) -> Iterator[str]:
    views, bed, n = measurement.views, measurement.bed, len(measurement.views)
    if 0 < n < _FEW_VIEWS:
        yield f"There are only {n} views; the soil's surface gets reliable from about {_FEW_VIEWS} on."
    if blind := [f.path.name for f in views if not sees(f, bed)]:
        yield f"{len(blind)} of {n} views do not show the soil's box: {_some(blind)}."
    if below := [f.path.name for f in views if f.camera.position[2] < bed.lower[2]]:
        yield f"{len(below)} of {n} views are taken from below the bed's floor: {_some(below)}."
    if askew := [f.path.name for f in (*views, *measurement.video) if turned(f.path)]:
        yield f"{len(askew)} images carry an EXIF rotation, which is not applied: {_some(askew)}."
    for name, camera in (*(("", f.camera) for f in views[:1]), *measurement.cameras.items()):
        corners = [[x, y] for x in (0.5, camera.width - 0.5) for y in (0.5, camera.height - 0.5)]
        who = f"camera {name!r}" if name else "the views' camera"
        if np.isnan(camera.rays(corners)[1]).any():
            yield f"The distortion of {who} folds over before the image's corners; is its calibration right?"
        off = np.abs([camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5])
        if off.max() > _OFF_MIDDLE:
            yield (
                f"The principal point of {who} is {camera.cx:g}, {camera.cy:g} in images of {camera.width} x"
                f" {camera.height}; is it in their pixels, from their upper left corner?"
            )


def _on_video(measurement: Measurement) -> Iterator[str]:
    frames, motion, rate = measurement.frames, measurement.tool.motion, measurement.frame_rate
    if len(frames) < 2:
        yield "There are not two frames from number 0 on, which changes are compared between: nothing to compare with."
    if measurement.video and not measurement.pre_roll:
        yield "There is no pre-roll (frames with negative numbers), so the noise cannot be measured."
    for name in measurement.cameras:
        own = [f for f in measurement.video if f.camera_name == name]
        if missing := sorted(set(frames) - {f.frame for f in own}):
            yield f"Camera {name!r} lacks {len(missing)} frames that others have: {_some(missing)}."
        if not any(sees(f, measurement.bed) for f in own):
            yield f"Camera {name!r} does not show the soil's box."
    if beside := [n for n in measurement.height_frames if n >= 0 and n not in frames]:
        yield f"The video lacks {len(beside)} frames that have heights, which are not used: {_some(beside)}."
    if lost := _lost(frames):
        first = list(islice(chain.from_iterable(lost), _NAMED + 1))
        yield f"The video lacks {sum(map(len, lost))} frames in an otherwise even row: {_some(first)}."
    if late := [n for n in frames if not motion.frames[0] <= n <= motion.frames[-1]]:
        yield f"The tool's motion does not cover {len(late)} video frames, where it is taken to rest: {_some(late)}."
    drift = [f for f in measurement.video if abs((f.time or 0.0) - (f.frame or 0) / rate) > 0.5 / rate]
    if drift:
        yield (
            f"{len(drift)} video frames are not where {rate:g} frames a second (tool clock) put them, first frame"
            f" {drift[0].frame} of camera {drift[0].camera_name!r} at {drift[0].time:g} s."
        )


def _on_tool(measurement: Measurement) -> Iterator[str]:
    bed, tool, motion = measurement.bed, measurement.tool, measurement.tool.motion
    if tool.mesh_path is not None and tool.mesh_path.suffix.lower() in (".glb", ".gltf"):
        yield "The tool's mesh is a glTF, which exporters turn so that y is up; its coordinates are taken as they are."
    touching = tool.touches(bed.lower, bed.upper).mean()
    if touching < 0.5:
        yield f"The tool is in the soil's box in only {100.0 * touching:.0f} % of the rows of its motion."
    steps = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
    if (np.abs(motion.quaternions[:, 3]) > np.sqrt(0.5)).all():
        # A half turn about the vertical, or no turn in another order: neither can be ruled out.
        yield "All of the tool's quaternions are large in qz, their last number; is their order x, y, z, w?"
    duration = float(motion.times[-1] - motion.times[0])
    fall = 0.5 * float(np.linalg.norm(measurement.gravity)) * duration**2
    if fall < np.sort(tool.mesh.extents)[1]:
        yield (
            f"The tool's motion takes {duration:g} s, in which soil falls by {1000.0 * fall:.2g} mm, less than the"
            " tool's width: weight hardly acts; is the frame rate in frames a second?"
        )
    speeds = steps / np.diff(motion.times)
    if len(steps) > 4 and speeds.any():
        jumps = np.flatnonzero(speeds > 20.0 * np.median(speeds[speeds > 0.0]))
        if jumps.size:
            i = int(jumps[0])
            frame = int(motion.frames[i + 1])
            yield f"The tool jumps by {1000.0 * steps[i]:.0f} mm before frame {frame}; is a row missing or swapped?"
    gaps = np.flatnonzero(np.diff(motion.frames) > 1)
    if gaps.size:
        first = int(motion.frames[gaps[0]]) + 1
        yield f"The motion skips frames (first {first}); the pose is interpolated there."


def _on_force(measurement: Measurement) -> Iterator[str]:
    force, motion, rate = measurement.tool.force, measurement.tool.motion, measurement.frame_rate
    if force is None:
        return
    off = np.abs(force[:, 1] - force[:, 0] / rate) > 0.5 / rate
    if off.any():
        first = force[int(np.argmax(off))]
        yield (
            f"{int(off.sum())} rows of the tool's force are not where {rate:g} frames a second (tool clock) put them,"
            f" first frame {first[0]:g} at {first[1]:g} s; frames are what counts."
        )
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
    moving = motion.frames[1:][speed > 0.1 * speed.max(initial=0.0)]
    largest = float(np.linalg.norm(force[:, 2:], axis=1).max())
    weight = measurement.bed.density * float(np.linalg.norm(measurement.gravity))
    weight *= float(np.sort(measurement.tool.mesh.extents)[1]) ** 3
    if not np.isin(moving, force[:, 0]).any():
        yield "The tool's force was measured in no frame in which the tool moves; it has no information."
    elif not largest > 0.0:
        yield "The tool's force is 0 throughout; it has no information."
    elif not _FORCES[0] < largest / weight < _FORCES[1]:
        yield (
            f"The tool's force reaches {largest:.2g} N, where a cube of soil as wide as the tool weighs"
            f" {weight:.2g} N; is it in newtons?"
        )


def _lost(frames: tuple[int, ...]) -> list[range]:
    """Numbers that would fill the gaps which are whole multiples of the usual step between frames."""
    steps = np.diff(frames)
    if len(steps) < 3:
        return []
    values, times = np.unique(steps, return_counts=True)
    usual = int(values[times.argmax()])
    gaps = [(n, int(step)) for n, step in zip(frames, steps, strict=False) if step > usual and step % usual == 0]
    return [range(n + usual, n + step, usual) for n, step in gaps]


def _some(names: Sequence[object]) -> str:
    return ", ".join(str(name) for name in names[:_NAMED]) + (" …" if len(names) > _NAMED else "")
