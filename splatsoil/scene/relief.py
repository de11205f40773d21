"""The soil's surface as a height map over the bed, computed from particles.

Particles are spread on a grid with a smooth kernel whose standard deviation is their spacing; the surface is where the
number density falls to half of its value inside the soil, taken from above. The kernel is even and the walls mirror it,
so that a plane stays the plane that bounds the particles' volume.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.scene import kernels_relief
from splatsoil.scene.kernels_maps import Grid, Surface
from splatsoil.splats.steps import Steps, finished, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

SMOOTHING = 1.0
"""Standard deviation of the kernel in particle spacings. Less shows single particles, more rounds off trench and heaps,
so that soil looks weaker than it is and a fit takes it to be stronger."""

_COARSE = 0.8
"""Cell of the density grid in particle spacings; the kernel is wide enough for it."""


@dataclass(frozen=True)
class Relief:
    """Heights on a regular grid.

    Attributes:
        height: (ny, nx) float32, m.
        normal: (ny, nx, 3) float32, unit length, upward.
        origin: x and y of the first cell's centre, m.
        cell: cell size along x and y, m.
        filling: (nz, ny, nx) float32 density over that of the bulk in layers over the same cells, by which the surface
            slopes; no layers where heights are all that is known.
        layers: height of the lowest layer, and from one to the next, m.
    """

    height: Tensor
    normal: Tensor
    origin: tuple[float, float]
    cell: tuple[float, float]
    filling: Tensor
    layers: tuple[float, float] = (0.0, 1.0)

    @classmethod
    def of_heights(cls, height: Tensor, origin: tuple[float, float], cell: tuple[float, float]) -> Relief:
        """A relief with the normals of its heights (central differences)."""
        height = height.to(torch.float32).contiguous()
        along_y, along_x = torch.gradient(height, spacing=(cell[1], cell[0]))
        normal = functional.normalize(torch.stack([-along_x, -along_y, torch.ones_like(height)], dim=-1), dim=-1)
        return cls(height, normal, origin, cell, height.new_zeros((0, 0, 0)))

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
        if "range" not in self.__dict__:  # where a cached property is looked for
            self.__dict__["range"] = yield from self._range()
        return self

    @property
    def reach(self) -> float:
        """How far off there is something to look at, m."""
        low, high = self.range
        return max(4.0 * (high - low), 0.15)

    @cached_property
    def surface(self) -> Any:
        """This in the kernels' form."""
        wp.init()  # or Warp knows no devices
        out = Surface()
        out.height, out.normal = wp.from_torch(self.height), wp.from_torch(self.normal, dtype=wp.vec3)
        grid = Grid()
        grid.x0, grid.y0 = self.origin
        grid.inverse_x, grid.inverse_y = 1.0 / self.cell[0], 1.0 / self.cell[1]
        out.grid = grid
        out.filling, out.lowest, out.inverse_z = wp.from_torch(self.filling), self.layers[0], 1.0 / self.layers[1]
        out.step, out.top, out.reach = max(self.cell), self.range[1] + 1e-3, self.reach
        return out

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
        ny, nx, *rest = values.shape
        first, extent = np.array(self.origin), np.array(self.cell) * [nx - 1, ny - 1]
        places = 2.0 * (xy[:, :2] - upload(first, xy.device)) / upload(extent, xy.device) - 1.0
        maps = values.reshape(1, ny, nx, -1).movedim(-1, 1)
        found = functional.grid_sample(maps, places[None, None], padding_mode="border", align_corners=True)
        return found[0, :, 0].T.reshape(len(xy), *rest).contiguous()

    def depth_below(self, points: Tensor) -> Tensor:
        """How far points (n, 3) lie below the surface, measured along its normal, m; negative above it."""
        gap = self.sample(self.height, points) - points[:, 2]
        return gap * self.sample(self.normal[..., 2], points)

    def within(self, depth: float, points: Tensor) -> Tensor:
        """Which points (n,) lie above the surface or nearer to it than a depth in m, in whatever direction.

        What lies behind a steep wall is near to it, however far below the rim; the bed's own walls are no surface.
        """
        x, y = (np.arange(-int(depth / c), int(depth / c) + 1) * c for c in self.cell)
        ball = depth**2 - y[:, None] ** 2 - x**2
        drops = upload(np.where(ball >= 0.0, np.sqrt(np.maximum(ball, 0.0)), -np.inf), self.device)
        eroded = torch.empty_like(self.height)
        inputs = [as_warp(m, wp.float32) for m in (self.height, drops, eroded)]
        launch(kernels_relief.erode, tuple(eroded.shape), inputs, eroded)
        return points[:, 2] > self.sample(eroded, points)


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
    fine = functional.interpolate(layers, scale_factor=2, mode="bicubic", align_corners=False)[0].contiguous()
    height = fine.new_empty(fine.shape[1:])
    inputs = [as_warp(fine, wp.float32), 0.5, float(low[2]), float(cell[2]), as_warp(height, wp.float32)]
    launch(kernels_relief.crossing, tuple(height.shape), inputs, fine)
    half = (float(cell[0]) / 2, float(cell[1]) / 2)
    relief = Relief.of_heights(height, (float(low[0]) + half[0] / 2, float(low[1]) + half[1] / 2), half)
    relief = replace(relief, filling=fine, layers=(float(low[2]) + 0.5 * float(cell[2]), float(cell[2])))
    return (yield from relief.ranged())


def _spread(positions: Tensor, low: FloatArray, cell: FloatArray, count: npt.NDArray[np.int64]) -> Tensor:
    """Particles per cell (nx, ny, nz) of centres (i + ½)·cell, walls and floor mirroring what would leave."""
    grid = torch.zeros(tuple(int(c) for c in count), dtype=torch.float32, device=positions.device)
    inputs = [as_warp(positions.float(), wp.vec3), wp.vec3(*low), wp.vec3(*(1.0 / cell)), as_warp(grid, wp.float32)]
    launch(kernels_relief.spread, len(positions), inputs, positions)
    return grid


def _blur(grid: Tensor, axis: int, variance: float) -> Tensor:
    """Add a variance (cells²) along an axis by repeated (w, 1 − 2w, w), the ends mirrored."""
    if variance <= 0.0:
        return grid
    passes = max(1, math.ceil(variance / 0.5))
    w, count = variance / (2.0 * passes), grid.shape[axis]
    for _ in range(passes):
        wide = torch.cat([grid.narrow(axis, 0, 1), grid, grid.narrow(axis, count - 1, 1)], dim=axis)
        grid = (1.0 - 2.0 * w) * grid + w * (wide.narrow(axis, 0, count) + wide.narrow(axis, 2, count))
    return grid
