"""Stages of the tool's motion and regions of the bed, as labels of features."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.arrays import FloatArray
from splatsoil.experiment.features import Site
from splatsoil.measurement import Measurement
from splatsoil.reconstruction.height_field import HeightField

UNDISTURBED = "undisturbed"
"""Region that the tool does not reach."""
PAUSE_SPEED = 0.02
"""Share of the greatest speed below which the tool pauses."""
BERM_WIDTH = 0.75
"""Half width of the berms beside the track, in tool widths."""
FACE_LENGTH = 0.6
"""Length of the regions at the tool's face and behind it, in tool widths."""
SURFACE_POINTS = 400
"""Points on the tool's surface that locate it in the soil."""


def stages_of(measurement: Measurement, frames: Sequence[float]) -> tuple[str, ...]:
    """Stage of the motion at each frame: lowering, pushing, pause, withdrawal or lifting."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    last = float(motion.times[-1])
    velocity = []
    for frame in frames:
        # Velocity of the step that ends at the frame.
        end = min(max(frame / rate, 0.5 / rate), last)
        begin = max(end - 1.0 / rate, 0.0)
        velocity.append((motion.pose(end)[1] - motion.pose(begin)[1]) / max(end - begin, 1e-9))
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)
    slow = PAUSE_SPEED * float(speed.max(initial=0.0))
    forward = heading_of(measurement)
    out = []
    for v in velocity:
        flat = float(np.linalg.norm(v[:2]))
        if np.linalg.norm(v) <= slow:
            out.append("pause")
        elif abs(v[2]) > flat:
            out.append("lowering" if v[2] < 0.0 else "lifting")
        else:
            out.append("pushing" if float(v[:2] @ forward) >= 0.0 else "withdrawal")
    return tuple(out)


def bins_of(measurement: Measurement, frames: Sequence[int], most: int) -> list[list[int]]:
    """Groups of neighbouring frames (as indices) of one stage, about ``most`` groups."""
    stages = stages_of(measurement, [float(f) for f in frames])
    size = math.ceil(len(frames) / most)
    bins: list[list[int]] = []
    for i, stage in enumerate(stages):
        if bins and len(bins[-1]) < size and stages[bins[-1][-1]] == stage:
            bins[-1].append(i)
        else:
            bins.append([i])
    return bins


def heading_of(measurement: Measurement) -> FloatArray:
    """(2,) unit vector of the first horizontal motion in the lower half of the tool's path; 0 where there is none."""
    positions = measurement.tool.motion.positions
    level, height = np.diff(positions, axis=0)[:, :2], positions[:, 2]
    # Above, the tool moves through air.
    low = 0.5 * (height[1:] + height[:-1]) <= 0.5 * (height.min() + height.max()) + 1e-9
    length = np.where(low, np.linalg.norm(level, axis=1), 0.0)
    if not length.max(initial=0.0) > 0.0:
        return np.zeros(2)
    first = int(np.argmax(length > 0.5 * length.max()))
    return np.asarray(level[first] / length[first])


def _placed(measurement: Measurement, points: FloatArray, moment: float) -> FloatArray:
    """(n, 3) positions of ``points`` of the tool at a moment in frames."""
    rotation, position = measurement.tool.motion.pose(moment / measurement.frame_rate)
    return np.asarray(points @ np.asarray(rotation).T + position)


def regions_of(
    measurement: Measurement, surface: HeightField, frames: Sequence[float], sites: Sequence[Site]
) -> npt.NDArray[np.str_]:
    """(t, s) region of each site: tool face, behind the tool, trench, berm or undisturbed, from the tool's path in the
    soil."""
    tool, rate = measurement.tool, measurement.frame_rate
    place = np.array([[site.x, site.y] for site in sites])
    # Trimesh.sample takes no seed in trimesh 4.8 and older.
    points = np.asarray(trimesh.sample.sample_surface(tool.mesh, SURFACE_POINTS, seed=0)[0], dtype=np.float64)
    width = float(np.sort(tool.mesh.extents)[1])
    moments = np.unique(np.concatenate([np.arange(0.0, max(frames) + 1.0, 2.0), frames]))
    nearest = np.full(len(sites), np.inf)
    out = np.full((len(frames), len(sites)), UNDISTURBED, dtype="<U16")
    previous = None
    for moment in moments:
        position = tool.motion.pose(moment / rate)[1]
        at = _placed(measurement, points, moment)
        sunk = at[at[:, 2] < surface.smooth(at[:, :2])][:, :2]
        distance = np.full(len(sites), np.inf)
        if len(sunk):
            distance = np.linalg.norm(place[:, None] - sunk[None], axis=-1).min(axis=1)
            nearest = np.minimum(nearest, distance)
        rows = [i for i, frame in enumerate(frames) if frame == moment]
        heading = np.zeros(2) if previous is None else np.asarray(position)[:2] - previous
        previous = np.asarray(position)[:2] if previous is None or np.linalg.norm(heading) > 0.0 else previous
        for row in rows:
            out[row, nearest < BERM_WIDTH * width] = "berm"
            out[row, nearest < 0.25 * width] = "trench"
            side = (place - np.asarray(position)[:2]) @ heading
            close = distance < FACE_LENGTH * width
            out[row, close & (side > 0.0)] = "tool face"
            out[row, close & (side <= 0.0) & (nearest < 0.25 * width)] = "behind the tool"
    return out
