"""How far the video's clock is off the tool's: where the tool would be seen, against the colours that are seen there.

At the right offset a pixel's colour tells best whether the tool covers it. What is maximised is the mutual information
between the two (Viola & Wells 1997, Int. J. Comput. Vis. 24:137), over one number. It needs no colour of the tool, and
soil that hides a part of it in every frame costs the same at every offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.errors import MeasurementError
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.motion import ToolMotion

FloatArray = npt.NDArray[np.float64]

WIDTH = 480
"""Pictures are halved until they are no wider, px."""
LEVELS = 16
"""Of each colour, in the histograms."""
FINER = 3
"""Rays along a pixel's side, so that what the tool covers of it changes smoothly; the coarse search has one."""
STEP = 0.25
"""Way of the tool, over its width, from one offset of the coarse search to the next."""
RESTING = 0.01
"""Of the largest speed: a tool that is no faster rests."""
LEAST_SHARE = 0.1
"""Of what is unknown of a pixel's cover, its colour must tell this share at least (uncertainty coefficient: Theil 1970,
Am. J. Sociol. 76:103); of noise it tells a few hundredths, as histograms have few entries."""


@dataclass(frozen=True, eq=False)
class Footage:
    """Pictures of one fixed camera.

    Attributes:
        camera: of the pictures' size, without distortion.
        times: (n,) on the video's clock, s.
        pictures: (n, h, w, 3) uint8.
    """

    camera: Camera
    times: FloatArray
    pictures: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ClockOffset:
    """What is added to the video's times to get the tool's.

    Attributes:
        seconds: by all cameras.
        by_camera: by each alone, s.
    """

    seconds: float
    by_camera: tuple[float, ...]


class _ToolInformation:
    """One camera's pictures, cut to where the tool ever is, and their information on it."""

    def __init__(self, footage: Footage, mesh: trimesh.Trimesh, motion: ToolMotion) -> None:
        from splatsoil.scene import ToolBody

        self.motion, self.times, self.body = motion, footage.times, ToolBody(mesh)
        self.camera = footage.camera
        moments = np.linspace(motion.times[0], motion.times[-1], 50)
        swept = np.any([self._covered(self.camera, time) for time in moments], axis=0)
        rows, columns = np.nonzero(swept)
        self.colours: npt.NDArray[np.int64] = np.zeros((0, 0), dtype=np.int64)
        self.seen = len(rows) > 0
        if not self.seen:
            return
        margin = max(2, (columns.max() - columns.min()) // 10)
        height, width = swept.shape
        x0, x1 = max(columns.min() - margin, 0), min(columns.max() + 1 + margin, width)
        y0, y1 = max(rows.min() - margin, 0), min(rows.max() + 1 + margin, height)
        self.camera = self.camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
        levels = footage.pictures[:, y0:y1, x0:x1].astype(np.int64) * LEVELS // 256
        self.colours = (levels @ np.array([LEVELS * LEVELS, LEVELS, 1])).reshape(len(levels), -1)

    def information(self, offset: float, finer: int = FINER) -> float:
        """Mutual information in nats a pixel at an offset in s, by so many rays along a pixel's side."""
        return self.measured(offset, finer)[0]

    def measured(self, offset: float, finer: int = FINER) -> tuple[float, float]:
        """That, and the entropy of whether the tool covers a pixel, in the same unit."""
        weights = np.concatenate([self._shares(time + offset, finer) for time in self.times])
        colours = self.colours.reshape(-1)
        count = LEVELS**3
        everywhere = np.bincount(colours, minlength=count) / len(colours)
        inside = np.bincount(colours, weights=weights, minlength=count) / len(colours)
        information = entropy = 0.0
        for joint in (inside, everywhere - inside):
            there, share = joint > 1e-15, float(joint.sum())
            information += float(np.sum(joint[there] * np.log(joint[there] / (everywhere[there] * share))))
            entropy -= share * float(np.log(share)) if share > 0.0 else 0.0
        return information, entropy

    def _shares(self, time: float, finer: int) -> FloatArray:
        """What the tool covers of each pixel, one after the other."""
        covered = self._covered(self.camera.scaled(finer), time)
        covered = covered.reshape(self.camera.height, finer, self.camera.width, finer)
        return covered.mean(axis=(1, 3)).reshape(-1)

    def _covered(self, camera: Camera, time: float) -> npt.NDArray[np.bool_]:
        from splatsoil.scene import silhouette

        return silhouette(self.body.at(*self.motion.pose(time)), camera).numpy()


def moving(motion: ToolMotion) -> tuple[float, float, float]:
    """When a motion begins and ends, s, and the largest speed in it, m/s.

    Raises:
        MeasurementError: the tool never moves.
    """
    ways = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
    speeds = ways / np.diff(motion.times)
    rows = np.flatnonzero(speeds > RESTING * speeds.max(initial=0.0))
    if not len(rows):
        raise MeasurementError("the tool never moves; its rows all have one position")
    return float(motion.times[rows[0]]), float(motion.times[rows[-1] + 1]), float(speeds.max())


def clock_offset(footage: Sequence[Footage], mesh: trimesh.Trimesh, motion: ToolMotion) -> ClockOffset:
    """The offset of the video's clock.

    Args:
        footage: of each camera, over all of the tool's motion; all on one clock.
        mesh: the tool's, m, in its own frame.
        motion: on the tool's clock.

    Raises:
        MeasurementError: the tool isn't seen to move.
    """
    from scipy.optimize import minimize_scalar

    cameras = [w for w in (_ToolInformation(one, mesh, motion) for one in footage) if w.seen]
    if not cameras:
        raise MeasurementError("no camera of the video sees the tool's motion; give --clock-offset in seconds")

    times = np.concatenate([w.times for w in cameras])
    begin, end, speed = moving(motion)
    step = STEP * float(np.sort(mesh.extents)[1]) / speed
    offsets = np.arange(begin - times.max(), end - times.min() + step, step)
    found = np.array([sum(w.information(offset, 1) for w in cameras) for offset in offsets])
    best = float(offsets[found.argmax()])
    information, entropy = np.sum([w.measured(best) for w in cameras], axis=0)
    if not information > LEAST_SHARE * entropy:
        raise MeasurementError("the tool cannot be told from what is behind it; give --clock-offset in seconds")

    def refined(*chosen: _ToolInformation) -> float:
        result = minimize_scalar(
            lambda offset: -sum(w.information(offset) for w in chosen),
            bounds=(best - step, best + step),
            method="bounded",
            options={"xatol": 1e-4},
        )
        return float(result.x)

    return ClockOffset(refined(*cameras), tuple(refined(w) for w in cameras))
