"""What is allowed in a measurement set but likely not meant, in plain words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from splatsoil.measurement.frames import Frame
from splatsoil.measurement.images import is_turned
from splatsoil.measurement.measurement import Measurement, sees

_FEW_VIEWS = 12
# Largest forces, by the weight of a cube of soil as wide as the tool: sand takes a tenth to ten of it where the cut is
# a tenth to all of the width deep, clay hundreds where the tool is small. In kN the former are below, in mN above.
_FORCES = (0.03, 1000.0)


@dataclass(frozen=True)
class Remark:
    """Something to know about a set.

    Attributes:
        about: what it concerns: views, video, tool, bed.
        text: one sentence for a person.
    """

    about: str
    text: str


def remarks(measurement: Measurement) -> tuple[Remark, ...]:
    """All remarks on a set that has passed its checks; none is a reason not to go on."""
    out: list[Remark] = []
    for field, value in measurement.assumed.items():
        out.append(Remark("bed" if field.startswith("bed") else "tool", f"{field} is not given; {value:g} is taken."))
    out += [Remark("views", text) for text in _on_views(measurement)]
    out += [Remark("video", text) for text in _on_video(measurement)]
    out += [Remark("tool", text) for text in (*_on_tool(measurement), *_on_force(measurement))]
    return tuple(out)


def _on_views(measurement: Measurement) -> list[str]:
    out = []
    n = len(measurement.views)
    if n < _FEW_VIEWS:
        out.append(f"There are only {n} views; the soil's surface gets reliable from about {_FEW_VIEWS} on.")
    blind = [f.path.name for f in measurement.views if not sees(f, measurement.bed)]
    if blind:
        out.append(f"{len(blind)} of {n} views do not show the soil's box: {_some(blind)}.")
    below = [f.path.name for f in measurement.views if f.camera.position[2] < measurement.bed.lower[2]]
    if below:
        out.append(f"{len(below)} of {n} views are taken from below the bed's floor: {_some(below)}.")
    turned = [f.path.name for f in (*measurement.views, *measurement.video) if _turned(f)]
    if turned:
        out.append(f"{len(turned)} images carry an EXIF rotation, which is not applied: {_some(turned)}.")
    return out + _on_lenses(measurement)


def _on_lenses(measurement: Measurement) -> list[str]:
    out = []
    for frame in (
        *measurement.views[:1],
        *(measurement.video_frame(n, _first(measurement, n)) for n in measurement.cameras),
    ):
        camera = frame.camera
        corners = np.array([[x, y] for x in (0.5, camera.width - 0.5) for y in (0.5, camera.height - 0.5)])
        if np.isnan(camera.rays(corners)[1]).any():
            who = f"camera {frame.camera_name!r}" if frame.camera_name else "the views' camera"
            out.append(f"The distortion of {who} folds over before the image's corners; is its calibration right?")
    return out


def _on_video(measurement: Measurement) -> list[str]:
    out = []
    cameras, frames = measurement.cameras, measurement.frames
    if not frames:
        out.append("All video frames are pre-roll (negative numbers); there is nothing to compare with.")
    if not measurement.pre_roll:
        out.append("There is no pre-roll (frames with negative numbers), so the noise cannot be measured.")
    for name in cameras:
        own = {f.frame for f in measurement.video if f.camera_name == name}
        missing = [str(n) for n in frames if n not in own]
        if missing:
            out.append(f"Camera {name!r} lacks {len(missing)} frames that others have: {_some(missing)}.")
        if not any(sees(f, measurement.bed) for f in measurement.video if f.camera_name == name):
            out.append(f"Camera {name!r} does not show the soil's box.")
    lost = [str(n) for n in _lost(frames)]
    if lost:
        out.append(f"The video lacks {len(lost)} frames in an otherwise even row: {_some(lost)}.")
    motion = measurement.tool.motion
    late = [str(n) for n in frames if not motion.frames[0] <= n <= motion.frames[-1]]
    if late:
        out.append(
            f"The tool's motion does not cover {len(late)} video frames, where it is taken to rest: {_some(late)}."
        )
    drift = [f for f in measurement.video if _off_clock(f, measurement)]
    if drift:
        first = drift[0]
        out.append(
            f"{len(drift)} video frames are not where {measurement.frame_rate:g} frames a second (tool clock) put"
            f" them, first frame {first.frame} of camera {first.camera_name!r} at {first.time:g} s."
        )
    return out


def _on_tool(measurement: Measurement) -> list[str]:
    out = []
    bed, tool = measurement.bed, measurement.tool
    touching = tool.touches(bed.lower, bed.upper)
    if touching.mean() < 0.5:
        out.append(f"The tool is in the soil's box in only {100.0 * touching.mean():.0f} % of the rows of its motion.")
    steps = np.linalg.norm(np.diff(tool.motion.positions, axis=0), axis=1)
    if steps.size and steps.sum() == 0.0 and not np.abs(np.diff(tool.motion.quaternions, axis=0)).max():
        out.append("The tool never moves.")
    if (np.abs(tool.motion.quaternions[:, 3]) > np.sqrt(0.5)).all():
        # A half turn about the vertical, or no turn in another order: neither can be ruled out.
        out.append("All of the tool's quaternions are large in qz, their last number; is their order x, y, z, w?")
    times = tool.motion.times
    duration = float(times[-1] - times[0])
    fall = 0.5 * float(np.linalg.norm(measurement.gravity)) * duration**2
    if fall < np.sort(tool.mesh.extents)[1]:
        out.append(
            f"The tool's motion takes {duration:g} s, in which soil falls by {1000.0 * fall:.2g} mm, less than the"
            " tool's width: weight hardly acts; is the frame rate in frames a second?"
        )
    if steps.size > 4:
        speeds = steps / np.diff(times)
        typical = float(np.median(speeds[speeds > 0.0])) if (speeds > 0.0).any() else 0.0
        jumps = np.flatnonzero(speeds > 20.0 * typical) if typical else np.empty(0, dtype=int)
        if jumps.size:
            i = int(jumps[0])
            frame = int(tool.motion.frames[i + 1])
            out.append(
                f"The tool jumps by {1000.0 * steps[i]:.0f} mm before frame {frame}; is a row missing or swapped?"
            )
    gaps = np.flatnonzero(np.diff(tool.motion.frames) > 1)
    if gaps.size:
        first = int(tool.motion.frames[gaps[0]]) + 1
        out.append(f"The motion skips frames (first {first}); the pose is interpolated there.")
    return out


def _on_force(measurement: Measurement) -> list[str]:
    force, motion = measurement.tool.force, measurement.tool.motion
    if force is None:
        return []
    out = []
    off = np.abs(force[:, 1] - force[:, 0] / measurement.frame_rate) > 0.5 / measurement.frame_rate
    if off.any():
        first = int(np.argmax(off))
        out.append(
            f"{int(off.sum())} rows of the tool's force are not where {measurement.frame_rate:g} frames a second (tool"
            f" clock) put them, first frame {force[first, 0]:g} at {force[first, 1]:g} s; frames are what counts."
        )
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
    moving = motion.frames[1:][speed > 0.1 * speed.max(initial=0.0)]
    if not np.isin(moving, force[:, 0]).any():
        out.append("The tool's force was measured in no frame in which the tool moves; it tells nothing.")
    elif not (largest := float(np.linalg.norm(force[:, 2:], axis=1).max())) > 0.0:
        out.append("The tool's force is 0 throughout; it tells nothing.")
    else:
        width = float(np.sort(measurement.tool.mesh.extents)[1])
        weight = measurement.bed.density * float(np.linalg.norm(measurement.gravity)) * width**3
        if not _FORCES[0] < largest / weight < _FORCES[1]:
            out.append(
                f"The tool's force reaches {largest:.2g} N, where a cube of soil as wide as the tool weighs"
                f" {weight:.2g} N; is it in newtons?"
            )
    return out


def _lost(frames: tuple[int, ...]) -> list[int]:
    """Numbers that would fill the gaps which are whole multiples of the usual step between frames."""
    steps = np.diff(frames)
    if len(steps) < 3:
        return []
    usual = int(np.bincount(steps).argmax())
    gaps = [(n, int(step)) for n, step in zip(frames, steps, strict=False) if step > usual and step % usual == 0]
    return [n + k for n, step in gaps for k in range(usual, step, usual)]


def _off_clock(frame: Frame, measurement: Measurement) -> bool:
    """Whether a video frame's time is more than half a frame off its number."""
    assert frame.frame is not None and frame.time is not None
    return abs(frame.time - frame.frame / measurement.frame_rate) > 0.5 / measurement.frame_rate


def _first(measurement: Measurement, camera: str) -> int:
    return min(f.frame for f in measurement.video if f.camera_name == camera and f.frame is not None)


def _turned(frame: Frame) -> bool:
    with Image.open(frame.path) as image:
        return is_turned(image)


def _some(names: list[str], most: int = 4) -> str:
    return ", ".join(names[:most]) + (" …" if len(names) > most else "")
