"""A surface seen from above: one height a cell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeightField:
    """Heights on a regular grid of cells, in the world's frame.

    Attributes:
        x: (nx,) cell centres in metres, evenly spaced, rising.
        y: (ny,) cell centres in metres, evenly spaced, rising, with the spacing of x or one of their own.
        height: (ny, nx) height of the surface at the cell centres, metres.
        deviation: (ny, nx) standard deviation of each height as its maker knows it, metres; None if unknown.
    """

    x: Array
    y: Array
    height: Array
    deviation: Array | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "height", "deviation"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, np.asarray(value, dtype=np.float64))
        if self.x.ndim != 1 or self.y.ndim != 1 or min(len(self.x), len(self.y)) < 2:
            raise ValueError(
                f"a height field needs two cells or more along x and y, not {self.x.shape} and {self.y.shape}"
            )
        if self.height.shape != (len(self.y), len(self.x)):
            raise ValueError(f"heights of shape {self.height.shape} do not fit {len(self.y)} × {len(self.x)} cells")
        for axis in (self.x, self.y):
            steps = np.diff(axis)
            if np.any(steps <= 0) or np.ptp(steps) > 1e-6 * abs(steps[0]):
                raise ValueError("the cell centres of a height field must rise evenly")

    @classmethod
    def over(cls, lower: Array, upper: Array, cell: float, height: float | Array = 0.0) -> HeightField:
        """Cells of about `cell` metres that fill the rectangle from `lower` to `upper` exactly (z is not used)."""
        axes = []
        for k in (0, 1):
            n = max(2, round(float(upper[k] - lower[k]) / cell))
            axes.append(lower[k] + (np.arange(n) + 0.5) * (upper[k] - lower[k]) / n)
        shape = (len(axes[1]), len(axes[0]))
        return cls(axes[0], axes[1], np.broadcast_to(np.asarray(height, dtype=np.float64), shape).copy())

    @property
    def cell(self) -> tuple[float, float]:
        """Size of a cell along x and y in metres."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @property
    def points(self) -> Array:
        """(ny, nx, 3) the cell centres on the surface."""
        xs, ys = np.meshgrid(self.x, self.y)
        return np.stack([xs, ys, self.height], axis=-1)

    @property
    def normals(self) -> Array:
        """(ny, nx, 3) unit upward normals by central differences."""
        slope_y, slope_x = np.gradient(self.height, self.cell[1], self.cell[0])
        normal = np.stack([-slope_x, -slope_y, np.ones_like(self.height)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def sample(self, xy: Array) -> Array:
        """Heights (n,) at points (n, 2): bilinear between cell centres, and held constant beyond the outermost ones.

        Cells without a height (NaN) make the points next to them NaN.
        """
        xy = np.asarray(xy, dtype=np.float64)
        column = (xy[:, 0] - self.x[0]) / self.cell[0]
        row = (xy[:, 1] - self.y[0]) / self.cell[1]
        return map_coordinates(self.height, [row, column], order=1, mode="nearest")

    def smooth(self, xy: Array) -> Array:
        """Heights (n,) at points (n, 2) by a cubic spline through the cell centres, extended beyond them by its slope.

        Unlike `sample` it does not flatten crests or the half cell at the border. All heights must be finite.
        """
        xy = np.asarray(xy, dtype=np.float64)
        order = min(3, len(self.x) - 1, len(self.y) - 1)
        spline = RectBivariateSpline(self.y, self.x, self.height, kx=order, ky=order)
        inside = np.stack([np.clip(xy[:, 0], *self.x[[0, -1]]), np.clip(xy[:, 1], *self.y[[0, -1]])], axis=1)
        value = spline.ev(inside[:, 1], inside[:, 0])
        beyond = xy - inside
        for axis, order_of in ((0, {"dy": 1}), (1, {"dx": 1})):
            out = np.flatnonzero(beyond[:, axis])
            value[out] += spline.ev(inside[out, 1], inside[out, 0], **order_of) * beyond[out, axis]
        return value

    def widened(self, lower: Array, upper: Array) -> HeightField:
        """This field out to a rectangle (2,) or (3,) around it, m, its outermost heights carried on level: by as many
        whole cells as cover it."""
        count = [
            [max(0, math.ceil((gap - 0.5 * cell) / cell - 1e-6)) for gap in gaps]
            for cell, gaps in (
                (self.cell[0], (self.x[0] - lower[0], upper[0] - self.x[-1])),
                (self.cell[1], (self.y[0] - lower[1], upper[1] - self.y[-1])),
            )
        ]
        x, y = (
            axis[0] + (axis[1] - axis[0]) * np.arange(-before, len(axis) + after)
            for axis, (before, after) in zip((self.x, self.y), count, strict=True)
        )
        around = (tuple(count[1]), tuple(count[0]))
        deviation = None if self.deviation is None else np.pad(self.deviation, around, mode="edge")
        return HeightField(x, y, np.pad(self.height, around, mode="edge"), deviation)

    def difference(self, other: HeightField) -> Array:
        """(ny, nx) this height minus the other's at this field's cells; NaN where either is unknown."""
        if self.height.shape == other.height.shape and np.allclose(self.x, other.x) and np.allclose(self.y, other.y):
            return self.height - other.height
        xs, ys = np.meshgrid(self.x, self.y)
        theirs = other.sample(np.stack([xs.ravel(), ys.ravel()], axis=1)).reshape(self.height.shape)
        return self.height - theirs

    def rmse(self, other: HeightField) -> float:
        """Root mean square of the height differences to another surface over the cells known to both, metres."""
        return float(np.sqrt(np.nanmean(self.difference(other) ** 2)))

    def bias(self, other: HeightField) -> float:
        """Mean of this height minus the other's over the cells known to both, metres."""
        return float(np.nanmean(self.difference(other)))
