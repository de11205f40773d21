"""The offset between the clocks of video and tool, by where the tool is seen.

Coarsely, the mutual information of a pixel's colour and its cover by the tool is maximised (Viola & Wells 1997, Int. J.
Comput. Vis. 24:137). The tool's colour need not be known. Occlusion by soil biases the offset by milliseconds.

Finely, the mean absolute deviation of the colours of places on the tool from their medians over the video is minimised.
Occlusion is an outlier at any offset. Images are compared with images, so that an error of the camera's pose cancels.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import map_coordinates

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement import Measurement
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.motion import ToolMotion
from splatsoil.reconstruction.views import load_views, surface_points

WIDTH = 480
"""Pictures are halved until they are no wider, px."""
LEVELS = 16
"""Of each colour, in the histograms."""
PLACES = 2000
"""On the tool, at least, whose colours are compared."""
STEP = 0.25
"""Way of the tool, over its width, from one offset of the coarse search to the next."""
LOOKED_AT = 60
"""Images of each video that its clock is estimated from, at most."""
RESTING = 0.01
"""Of the largest speed: a tool that is no faster rests."""
LEAST_SHARE = 0.1
"""Least uncertainty coefficient (Theil 1970, Am. J. Sociol. 76:103) of a pixel's cover by its colour. Noise has a few
hundredths, because histograms have few entries."""


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


class _FilmedTool:
    """One camera's pictures, cropped to where the tool is at any time."""

    def __init__(self, footage: Footage, mesh: trimesh.Trimesh, motion: ToolMotion) -> None:
        from splatsoil.scene import ToolBody

        self.motion, self.times, self.body = motion, footage.times, ToolBody(mesh)
        self.camera, self.pictures = footage.camera, footage.pictures
        moments = np.linspace(motion.times[0], motion.times[-1], 50)
        rows, columns = np.nonzero(np.any([self._covered(time) for time in moments], axis=0))
        self.seen = len(rows) > 0
        if not self.seen:
            return
        margin = max(2, (columns.max() - columns.min()) // 10)
        x0, y0 = (max(int(places.min()) - margin, 0) for places in (columns, rows))
        self.pictures = self.pictures[:, y0 : rows.max() + 1 + margin, x0 : columns.max() + 1 + margin]
        self.camera = self.camera.cropped(x0, y0, self.pictures.shape[2], self.pictures.shape[1])
        levels = self.pictures.astype(np.int64) * LEVELS // 256
        self.colours = (levels @ np.array([LEVELS * LEVELS, LEVELS, 1])).reshape(-1)
        self.places, faces = surface_points(mesh, (mesh.area / PLACES) ** 0.5)
        self.normals = mesh.face_normals[faces]

    def information(self, offset: float) -> tuple[float, float]:
        """Mutual information of colour and cover at an offset in s, and the entropy of cover, in nats a pixel."""
        covered = np.concatenate([self._covered(time + offset).reshape(-1) for time in self.times])
        everywhere, inside = (
            np.bincount(which, minlength=LEVELS**3) / len(covered) for which in (self.colours, self.colours[covered])
        )
        information = entropy = 0.0
        for joint in (inside, everywhere - inside):
            there, share = joint > 1e-15, float(joint.sum())
            information += float(np.sum(joint[there] * np.log(joint[there] / (everywhere[there] * share))))
            entropy -= share * float(np.log(share)) if share > 0.0 else 0.0
        return information, entropy

    def deviation(self, offset: float) -> float:
        """Mean absolute deviation, in grey levels, of the colours of places on the tool from their medians."""
        values = np.full((len(self.times), len(self.places), 3), np.nan)
        for out, picture, time in zip(values, self.pictures, self.times, strict=True):
            rotation, position = self.motion.pose(float(time + offset))
            points = self.places @ rotation.T + position
            pixels, _ = self.camera.project(points)
            towards = np.sum((self.camera.position - points) * (self.normals @ rotation.T), axis=1) > 0.0
            shown = towards & np.all((pixels > 0.5) & (pixels < np.array(picture.shape[1::-1]) - 0.5), axis=1)
            where = (pixels[shown, ::-1] - 0.5).T
            out[shown] = np.stack([map_coordinates(picture[..., k], where, np.float64, order=1) for k in range(3)], -1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of places that are never shown
            return float(np.nanmean(np.abs(values - np.nanmedian(values, axis=0))))

    def _covered(self, time: float) -> npt.NDArray[np.bool_]:
        from splatsoil.scene import silhouette

        return silhouette(self.body.at(*self.motion.pose(float(time))), self.camera).numpy()


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

    cameras = [w for w in (_FilmedTool(one, mesh, motion) for one in footage) if w.seen]
    if not cameras:
        raise MeasurementError("no camera of the video sees the tool's motion; give --clock-offset in seconds")

    times = np.concatenate([w.times for w in cameras])
    begin, end, speed = moving(motion)
    step = STEP * float(np.sort(mesh.extents)[1]) / speed
    offsets = np.arange(begin - times.max(), end - times.min() + step, step)
    found = np.array([np.sum([w.information(offset) for w in cameras], axis=0) for offset in offsets])
    best = int(found[:, 0].argmax())
    if not found[best, 0] > LEAST_SHARE * found[best, 1]:
        raise MeasurementError(
            "the tool has the colours of what is behind it, so no offset is found; give --clock-offset in seconds"
        )

    def refined(*chosen: _FilmedTool) -> float:
        result = minimize_scalar(
            lambda offset: sum(w.deviation(offset) for w in chosen),
            bounds=(offsets[best] - step, offsets[best] + step),
            method="bounded",
            options={"xatol": 1e-4},
        )
        return float(result.x)

    return ClockOffset(refined(*cameras), tuple(refined(w) for w in cameras))


def late_cameras(measurement: Measurement) -> dict[str, float]:
    """Fixed cameras whose clock is not the tool's, and what is added to their times to get the tool's, s.

    An offset counts from half a frame on, to which frame numbers tell times. Every other image must give the same one
    as the images between them (split-half reliability), which needs two of each at least.
    """
    tool, tolerance, found = measurement.tool, 0.5 / measurement.frame_rate, {}
    for name in measurement.cameras:
        frames = [f for f in measurement.video if f.camera_name == name and (f.frame or 0) >= 0]
        if len(frames) < 4:
            continue
        frames = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).astype(int))]
        halves = []
        for part in (frames[::2], frames[1::2]):
            views = load_views(part, WIDTH)
            pictures = np.rint(255.0 * views.images.permute(0, 2, 3, 1).numpy()).astype(np.uint8)
            footage = Footage(views.cameras[0], np.array([f.time or 0.0 for f in part]), pictures)
            with suppress(MeasurementError):
                halves.append(clock_offset([footage], tool.mesh, tool.motion).seconds)
        if len(halves) == 2 and np.abs(halves).min() > tolerance > np.ptp(halves):
            found[name] = float(np.mean(halves))
    return found
