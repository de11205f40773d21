"""The soil's surface under the light: heights over the bed, computed from particles.

Particles are spread on a grid with a smooth kernel whose standard deviation is their spacing; the surface is where the
number density falls to half of its value inside the soil, taken from above. The kernel is even and the walls mirror it,
so that a plane stays the plane that bounds the particles' volume.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels
from splatsoil.splats.steps import Steps, finished, stepwise
from splatsoil.splats.warp_torch import as_warp, launch

FloatArray = npt.NDArray[np.float64]

SMOOTHING = 1.0
"""Standard deviation of the kernel in particle spacings. Less shows single particles, more rounds off trench and heaps,
so that soil looks weaker than it is and a fit takes it to be stronger (docs/photographs.md)."""

_COARSE = 0.8
"""Cell of the density grid in particle spacings; the kernel is wide enough for it."""

_PAD = 3
"""Cells around the bed, folded back at the walls."""


@dataclass(frozen=True)
class Relief:
    """Heights on a regular grid.

    Attributes:
        height: (ny, nx) float32, m.
        normal: (ny, nx, 3) float32, unit length, upward.
        origin: x and y of the first cell's centre, m.
        cell: cell size along x and y, m.
    """

    height: Tensor
    normal: Tensor
    origin: tuple[float, float]
    cell: tuple[float, float]

    @classmethod
    def of_heights(cls, height: Tensor, origin: tuple[float, float], cell: tuple[float, float]) -> Relief:
        """A relief with the normals of its heights (central differences)."""
        height = height.to(torch.float32).contiguous()
        along_y, along_x = torch.gradient(height, spacing=[float(cell[1]), float(cell[0])])
        normal = functional.normalize(torch.stack([-along_x, -along_y, torch.ones_like(height)], dim=-1), dim=-1)
        return cls(height, normal.contiguous(), origin, cell)

    @property
    def device(self) -> torch.device:
        """Where the heights live."""
        return self.height.device

    @cached_property
    def range(self) -> tuple[float, float]:
        """Lowest and highest height, m."""
        return finished(self._range())

    def _range(self) -> Steps[tuple[float, float]]:
        low, high = yield torch.stack(torch.aminmax(self.height))
        return low, high

    def ranged(self) -> Steps[Relief]:
        """This, with its range known."""
        self.__dict__["range"] = yield from self._range()
        return self

    @property
    def points(self) -> Tensor:
        """(ny, nx, 3) the cell centres on the surface, m."""
        ny, nx = self.height.shape
        x = self.origin[0] + self.cell[0] * torch.arange(nx, device=self.device, dtype=torch.float32)
        y = self.origin[1] + self.cell[1] * torch.arange(ny, device=self.device, dtype=torch.float32)
        ys, xs = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([xs, ys, self.height], dim=-1)

    def sample(self, values: Tensor, xy: Tensor) -> Tensor:
        """Bilinear values at points.

        Args:
            values: (ny, nx) or (ny, nx, k) on this grid.
            xy: (n, 2) or (n, 3), m; only x and y are used; held constant beyond the outermost cell centres.

        Returns:
            (n,) or (n, k).
        """
        ny, nx = self.height.shape
        column = ((xy[:, 0] - self.origin[0]) / self.cell[0]).clamp(0.0, nx - 1.0)
        row = ((xy[:, 1] - self.origin[1]) / self.cell[1]).clamp(0.0, ny - 1.0)
        i, j = row.floor().long().clamp_max(ny - 2), column.floor().long().clamp_max(nx - 2)
        u, v = row - i, column - j
        if values.ndim == 3:
            u, v = u[:, None], v[:, None]
        low = values[i, j] * (1 - v) + values[i, j + 1] * v
        high = values[i + 1, j] * (1 - v) + values[i + 1, j + 1] * v
        return low * (1 - u) + high * u

    def depth_below(self, points: Tensor) -> Tensor:
        """How far points (n, 3) lie below the surface, measured along its normal, m; negative above it."""
        gap = self.sample(self.height, points) - points[:, 2]
        return gap * self.sample(self.normal[..., 2], points)

    def within(self, depth: float, points: Tensor) -> Tensor:
        """Which points (n,) lie above the surface or nearer to it than a depth in m, in whatever direction.

        What lies behind a steep wall is near to it, however far below the rim. The surface is eroded by a ball of that
        radius; the bed's own walls are no surface.
        """
        reach = [int(depth / self.cell[k]) for k in (0, 1)]
        wide = functional.pad(self.height[None, None], (reach[0], reach[0], reach[1], reach[1]), value=math.inf)[0, 0]
        ny, nx = self.height.shape
        eroded = torch.full_like(self.height, math.inf)
        for row in range(-reach[1], reach[1] + 1):
            for column in range(-reach[0], reach[0] + 1):
                left = depth**2 - (row * self.cell[1]) ** 2 - (column * self.cell[0]) ** 2
                if left >= 0.0:
                    shifted = wide[reach[1] + row : reach[1] + row + ny, reach[0] + column : reach[0] + column + nx]
                    eroded = torch.minimum(eroded, shifted - math.sqrt(left))
        return points[:, 2] > self.sample(eroded, points)


def grid_of(relief: Relief) -> Any:
    """Where the relief's maps lie, in the kernels' form."""
    grid = kernels.Grid()
    grid.x0, grid.y0 = relief.origin
    grid.inverse_x, grid.inverse_y = 1.0 / relief.cell[0], 1.0 / relief.cell[1]
    return grid


@stepwise
def relief_of_particles(
    positions: Tensor,
    spacing: float,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    smoothing: float = SMOOTHING,
) -> Steps[Relief]:
    """The surface of a bed of particles.

    Args:
        positions: (n, 3) float32, m; those outside the box count at its faces.
        spacing: side of the cube of soil that a particle stands for, m.
        lower: (3,) corner of the bed's box, m; walls and floor.
        upper: (3,) the opposite corner; its height only bounds the grid.
        smoothing: standard deviation of the kernel in spacings.

    Returns:
        Heights on cells of about half of the density grid's, on the device of the positions; the floor where no
        particle is.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    (highest,) = (yield positions[:, 2].max()) if len(positions) else (0.0,)
    top = max(float(high[2]), highest) + 3.0 * spacing
    extent = np.array([high[0] - low[0], high[1] - low[1], top - low[2]])
    count = np.maximum(np.round(extent / (_COARSE * spacing)).astype(int), 4)
    cell = extent / count
    density = _spread(positions, low, cell, count)
    # The quadratic B-spline has a variance of a quarter of a cell; two three-point passes add what is missing.
    missing = (smoothing * spacing / cell) ** 2 - 0.25
    for axis in range(3):
        density = _blur(density, axis, float(missing[axis]))
    density *= spacing**3 / float(np.prod(cell))
    # The density is smooth, heights aren't: a wall stands where the former says, not somewhere in a coarse cell.
    layers = density.permute(2, 1, 0)[None]
    fine = functional.interpolate(layers, scale_factor=2, mode="bicubic", align_corners=False)[0]
    height = _crossing(fine, 0.5) * float(cell[2]) + float(low[2])
    half = (float(cell[0]) / 2, float(cell[1]) / 2)
    relief = Relief.of_heights(height, (float(low[0]) + half[0] / 2, float(low[1]) + half[1] / 2), half)
    return (yield from relief.ranged())


def _spread(positions: Tensor, low: FloatArray, cell: FloatArray, count: npt.NDArray[np.int64]) -> Tensor:
    """Particles per cell (nx, ny, nz) of centres (i + ½)·cell, walls and floor mirroring what would leave."""
    shape = tuple(int(c) + 2 * _PAD for c in count)
    grid = torch.zeros(shape, dtype=torch.float32, device=positions.device)
    inverse = wp.vec3(*(1.0 / cell))
    inputs = [as_warp(positions.float(), wp.vec3), wp.vec3(*low), inverse, as_warp(grid, wp.float32)]
    launch(_spread_kernel, len(positions), inputs, positions)
    for axis in range(3):
        inner = grid.narrow(axis, _PAD, int(count[axis])).clone()
        before = grid.narrow(axis, 0, _PAD).flip(axis)
        after = grid.narrow(axis, _PAD + int(count[axis]), _PAD).flip(axis)
        inner.narrow(axis, 0, _PAD).add_(before)
        inner.narrow(axis, int(count[axis]) - _PAD, _PAD).add_(after)
        grid = inner
    return grid


@wp.kernel(enable_backward=False)
def _spread_kernel(
    positions: wp.array(dtype=wp.vec3), low: wp.vec3, inverse: wp.vec3, grid: wp.array3d(dtype=wp.float32)
) -> None:
    p = wp.tid()
    q = wp.cw_mul(positions[p] - low, inverse)
    edge_x = float(grid.shape[0]) - 7.0
    edge_y = float(grid.shape[1]) - 7.0
    edge_z = float(grid.shape[2]) - 7.0
    x = wp.clamp(q[0], 0.0, edge_x + 0.999) - 0.5
    y = wp.clamp(q[1], 0.0, edge_y + 0.999) - 0.5
    z = wp.clamp(q[2], 0.0, edge_z + 0.999) - 0.5
    i = int(wp.floor(x + 0.5))
    j = int(wp.floor(y + 0.5))
    k = int(wp.floor(z + 0.5))
    fx = x - float(i)
    fy = y - float(j)
    fz = z - float(k)
    wx = wp.vec3(0.5 * (0.5 - fx) * (0.5 - fx), 0.75 - fx * fx, 0.5 * (0.5 + fx) * (0.5 + fx))
    wy = wp.vec3(0.5 * (0.5 - fy) * (0.5 - fy), 0.75 - fy * fy, 0.5 * (0.5 + fy) * (0.5 + fy))
    wz = wp.vec3(0.5 * (0.5 - fz) * (0.5 - fz), 0.75 - fz * fz, 0.5 * (0.5 + fz) * (0.5 + fz))
    for a in range(3):
        for b in range(3):
            w = wx[a] * wy[b]
            for c in range(3):
                wp.atomic_add(grid, i + a + 2, j + b + 2, k + c + 2, w * wz[c])


def _blur(grid: Tensor, axis: int, variance: float) -> Tensor:
    """Add a variance (cells²) along an axis by repeated (w, 1 − 2w, w), the ends mirrored."""
    if variance <= 0.0:
        return grid
    passes = max(1, math.ceil(variance / 0.5))
    w = variance / (2.0 * passes)
    n = grid.shape[axis]
    for _ in range(passes):
        before = torch.cat([grid.narrow(axis, 0, 1), grid.narrow(axis, 0, n - 1)], dim=axis)
        after = torch.cat([grid.narrow(axis, 1, n - 1), grid.narrow(axis, n - 1, 1)], dim=axis)
        grid = (1.0 - 2.0 * w) * grid + w * (before + after)
    return grid


def _crossing(density: Tensor, level: float) -> Tensor:
    """Height in cells (ny, nx) above the floor where the density (nz, ny, nx) falls through the level, from above."""
    nz = len(density)
    index = torch.arange(nz, device=density.device)[:, None, None]
    last = torch.where(density > level, index, -1).amax(dim=0)
    inside = last.clamp(0, nz - 2)[None]
    below = density.gather(0, inside)[0]
    above = density.gather(0, inside + 1)[0]
    part = ((below - level) / (below - above).clamp_min(1e-9)).clamp(0.0, 1.0)
    return torch.where(last >= 0, inside[0] + 0.5 + part, torch.zeros_like(part))
