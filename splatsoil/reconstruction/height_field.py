"""Height fields: surfaces with one height a cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates

from splatsoil.arrays import FloatArray


def centres(low: float, high: float, count: int) -> FloatArray:
    """(count,) middles of equal parts of a stretch."""
    return low + (np.arange(count) + 0.5) * (high - low) / count


def around(lower: FloatArray, upper: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) on a rectangle's border, and outward normals (n, 3)."""
    points, normals = [], []
    for axis in (0, 1):
        along = centres(lower[axis], upper[axis], max(1, round(float(upper[axis] - lower[axis]) / spacing)))
        for end, sign in ((lower, -1.0), (upper, 1.0)):
            point, normal = np.empty((len(along), 2)), np.zeros((len(along), 3))
            point[:, axis], point[:, 1 - axis] = along, end[1 - axis]
            normal[:, 1 - axis] = sign
            points.append(point)
            normals.append(normal)
    return np.concatenate(points), np.concatenate(normals)


@dataclass(frozen=True)
class HeightField:
    """Heights on a regular grid of cells, in the world's frame.

    Attributes:
        x: (nx,) cell centres in metres, evenly spaced, rising.
        y: (ny,) cell centres in metres, evenly spaced, rising, with the spacing of x or one of their own.
        height: (ny, nx) height of the surface at the cell centres, metres.
        deviation: (ny, nx) standard deviation of each height as its maker knows it, metres; None if unknown.
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    deviation: FloatArray | None = None

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
    def over(cls, lower: FloatArray, upper: FloatArray, cell: float, height: float | FloatArray = 0.0) -> HeightField:
        """Cells of about `cell` metres that fill the rectangle from `lower` to `upper` exactly (z is not used)."""
        x, y = (centres(lower[k], upper[k], max(2, round(float(upper[k] - lower[k]) / cell))) for k in (0, 1))
        return cls(x, y, np.broadcast_to(np.asarray(height, dtype=np.float64), (len(y), len(x))).copy())

    @property
    def cell(self) -> tuple[float, float]:
        """Size of a cell along x and y in metres."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @property
    def points(self) -> FloatArray:
        """(ny, nx, 3) the cell centres on the surface."""
        xs, ys = np.meshgrid(self.x, self.y)
        return np.stack([xs, ys, self.height], axis=-1)

    @property
    def normals(self) -> FloatArray:
        """(ny, nx, 3) unit upward normals by central differences."""
        slope_y, slope_x = np.gradient(self.height, self.cell[1], self.cell[0])
        normal = np.stack([-slope_x, -slope_y, np.ones_like(self.height)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def sample(self, xy: FloatArray) -> FloatArray:
        """Heights (...) at points (..., 2): bilinear between cell centres, and held constant beyond the outermost ones.

        Cells without a height (NaN) make the points next to them NaN.
        """
        column = (xy[..., 0] - self.x[0]) / self.cell[0]
        row = (xy[..., 1] - self.y[0]) / self.cell[1]
        return map_coordinates(self.height, [row, column], order=1, mode="nearest")

    def smooth(self, xy: FloatArray) -> FloatArray:
        """Heights (...) at points (..., 2) by a cubic spline through the cell centres, carried on beyond by its slope.

        Unlike `sample` it does not flatten crests or the half cell at the border. All heights must be finite.
        """
        order = min(3, len(self.x) - 1, len(self.y) - 1)
        spline = RectBivariateSpline(self.y, self.x, self.height, kx=order, ky=order)
        inside = np.clip(xy, [self.x[0], self.y[0]], [self.x[-1], self.y[-1]])
        value = spline.ev(inside[..., 1], inside[..., 0])
        beyond = xy - inside
        for axis, order_of in ((0, {"dy": 1}), (1, {"dx": 1})):
            out = beyond[..., axis] != 0.0
            value[out] += spline.ev(inside[out, 1], inside[out, 0], **order_of) * beyond[out, axis]
        return value

    def widened(self, lower: FloatArray, upper: FloatArray) -> HeightField:
        """This field out to a rectangle (2,) or (3,) around it, m, its outermost heights carried on level: by as many
        whole cells as cover it."""
        axes, around = [], []
        for k, axis in enumerate((self.x, self.y)):
            gaps = np.array([axis[0] - lower[k], upper[k] - axis[-1]])
            before, after = np.maximum(np.ceil(gaps / self.cell[k] - 0.5 - 1e-6), 0.0).astype(int)
            axes.append(axis[0] + self.cell[k] * np.arange(-before, len(axis) + after))
            around.append((before, after))
        height = np.pad(self.height, around[::-1], mode="edge")
        deviation = None if self.deviation is None else np.pad(self.deviation, around[::-1], mode="edge")
        return HeightField(axes[0], axes[1], height, deviation)

    def difference(self, other: HeightField) -> FloatArray:
        """(ny, nx) this height minus the other's at this field's cells; NaN where either is unknown."""
        if self.height.shape == other.height.shape and np.allclose(self.x, other.x) and np.allclose(self.y, other.y):
            return self.height - other.height
        return self.height - other.sample(self.points[..., :2])

    def rmse(self, other: HeightField) -> float:
        """Root mean square of the height differences to another surface over the cells known to both, metres."""
        return float(np.sqrt(np.nanmean(self.difference(other) ** 2)))

    def bias(self, other: HeightField) -> float:
        """Mean of this height minus the other's over the cells known to both, metres."""
        return float(np.nanmean(self.difference(other)))
