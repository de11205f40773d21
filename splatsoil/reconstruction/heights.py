"""Measured heights averaged over cells of the bed, without the tool, and the initial surface from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import griddata
from scipy.ndimage import binary_dilation

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Measurement
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.views import surface_points

TOOL_MARGIN = 2
"""Cells around the tool's outline, seen from above, that are left out: there soil leans on it, and rays graze it."""


@dataclass(frozen=True)
class Cells:
    """Cells of the bed in plan.

    Attributes:
        lower: (2,) corner of the first cell, m.
        size: (2,) sides of a cell, m.
        shape: cells along y and x.
    """

    lower: FloatArray
    size: FloatArray
    shape: tuple[int, int]

    def index(self, points: FloatArray) -> npt.NDArray[np.int64]:
        """(n,) the cell of each of the points (n, 2 or 3), row by row; -1 for those outside."""
        place = np.floor((points[:, :2] - self.lower) / self.size).astype(np.int64)
        inside = np.all((place >= 0) & (place < self.shape[::-1]), axis=1)
        return np.where(inside, place[:, 1] * self.shape[1] + place[:, 0], -1)


def seen_heights(measurement: Measurement, frame: int, cells: Cells) -> FloatArray:
    """(cells, 3) mean of the points that were measured in each cell at a frame, m; NaN where there are none, or where
    the tool stands. No soil is higher than the bed's box."""
    points = measurement.surface_points(frame)
    index = np.where(points[:, 2] <= measurement.bed.upper[2], cells.index(points), -1)
    points, index = points[index >= 0], index[index >= 0]
    count = np.bincount(index, minlength=cells.shape[0] * cells.shape[1]).astype(np.float64)
    count[_under_tool(measurement, frame, cells)] = 0.0
    total = np.stack([np.bincount(index, points[:, k], minlength=len(count)) for k in range(3)], axis=1)
    return np.where(count[:, None] > 0.0, total / np.maximum(count, 1.0)[:, None], np.nan)


def first_surface(measurement: Measurement, cell: float) -> HeightField:
    """The surface before anything moves, in cells of about ``cell`` m: the mean of the first heights, linear between
    the cells that are known, and beyond them as high as the nearest."""
    bed = measurement.bed
    field = HeightField.over(bed.lower, bed.upper, cell)
    cells = Cells(bed.lower[:2], np.array(field.cell), (len(field.y), len(field.x)))
    still = [f for f in measurement.height_frames if f <= measurement.frames[0]]
    known = np.concatenate([seen_heights(measurement, frame, cells) for frame in still])
    known = known[np.isfinite(known).all(axis=1)]
    where = field.points[..., :2]
    linear, nearest = (griddata(known[:, :2], known[:, 2], where, method=m) for m in ("linear", "nearest"))
    height = np.where(np.isfinite(linear), linear, nearest)
    return HeightField(field.x, field.y, np.clip(height, bed.lower[2], bed.upper[2]))


def _under_tool(measurement: Measurement, frame: int, cells: Cells) -> npt.NDArray[np.bool_]:
    """(cells,) where the tool is at a frame, seen from above, and near it."""
    tool = measurement.tool
    skin, _ = surface_points(tool.mesh, 0.7 * float(cells.size.min()))
    rotation, position = tool.motion.pose(frame / measurement.frame_rate)
    index = cells.index(skin @ rotation.T + position)
    out = np.zeros(cells.shape[0] * cells.shape[1], dtype=bool)
    out[index[index >= 0]] = True
    return np.asarray(binary_dilation(out.reshape(cells.shape), iterations=TOOL_MARGIN).reshape(-1))
