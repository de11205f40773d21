"""The soil's surface under the light: heights over the bed, computed from particles.

Particles are spread on a grid with a smooth kernel whose standard deviation is their spacing; the surface is where the
number density falls to half of its value inside the soil, taken from above. The kernel is even and the walls mirror it,
so that a plane stays the plane that bounds the particles' volume.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels_relief
from splatsoil.scene.kernels_maps import Grid
from splatsoil.scene.kernels_sky import WIDTH
from splatsoil.splats.steps import Steps, finished, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

FloatArray = npt.NDArray[np.float64]

SMOOTHING = 1.0
"""Standard deviation of the kernel in particle spacings. Less shows single particles, more rounds off trench and heaps,
so that soil looks weaker than it is and a fit takes it to be stronger."""

BLOCK = 64
"""Threads of a GPU's block that work on a map: few, so that it is shared out evenly."""

_LAYERS_BEYOND = 3
"""Layers of the density that are kept beneath and above the surface."""

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
    layers: tuple[float, float]

    @classmethod
    def of_heights(cls, height: Tensor, origin: tuple[float, float], cell: tuple[float, float]) -> Relief:
        """A relief with the normals of its heights (central differences)."""
        height = height.to(torch.float32).contiguous()
        normal = height.new_empty((*height.shape, 3))
        inputs = [as_warp(height, wp.float32), float(cell[0]), float(cell[1]), as_warp(normal, wp.vec3)]
        launch(kernels_relief.normals, tuple(height.shape), inputs, height)
        return cls(height, normal, origin, cell, height.new_zeros((0, 0, 0)), (0.0, 1.0))

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

    def with_filling(self, filling: Tensor, layers: tuple[float, float]) -> Relief:
        """The same surface with the density that it is of; its range, which a GPU is asked for, stays known."""
        out = replace(self, filling=filling, layers=layers)
        out.__dict__["range"] = self.range
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
        out = values.new_empty((len(xy), *values.shape[2:]))
        inputs = [as_warp(m, wp.float32) for m in (values.reshape(*values.shape[:2], -1), xy)]
        inputs += [wp.vec2(*self.origin), wp.vec2(*self.cell), as_warp(out.reshape(len(xy), -1), wp.float32)]
        launch(kernels_relief.sample, len(xy), inputs, values)
        return out

    def depth_below(self, points: Tensor) -> Tensor:
        """How far points (n, 3) lie below the surface, measured along its normal, m; negative above it."""
        gap = self.sample(self.height, points) - points[:, 2]
        return gap * self.sample(self.normal[..., 2], points)

    def within(self, depth: float, points: Tensor) -> Tensor:
        """Which points (n,) lie above the surface or nearer to it than a depth in m, in whatever direction.

        What lies behind a steep wall is near to it, however far below the rim. The surface is eroded by a ball of that
        radius; the bed's own walls are no surface.
        """
        across, along = (int(depth / self.cell[k]) for k in (0, 1))
        width = width_of(self.height)
        wide = padded(self.height, (across, along), width, "constant", math.inf)
        offsets, drops = _ball(depth, self.cell, wide.shape[1], self.device)
        eroded = torch.empty_like(self.height)
        inputs = [depth, as_warp(wide, wp.float32), across, along, as_warp(offsets, wp.int32)]
        inputs += [as_warp(m, wp.float32) for m in (drops, eroded)]
        launch(kernels_relief.erode, (eroded.shape[0], -(-eroded.shape[1] // width)), inputs, eroded, BLOCK)
        return points[:, 2] > self.sample(eroded, points)


@lru_cache(maxsize=16)
def _ball(radius: float, cell: tuple[float, float], width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """A ball's lower half on a map of so many columns: offsets (n,) int32 from its middle's cell, and how far it
    reaches down there (n,), m."""
    across, along = (int(radius / cell[k]) for k in (0, 1))
    rows, columns = np.mgrid[-along : along + 1, -across : across + 1]
    left = radius**2 - (rows * cell[1]) ** 2 - (columns * cell[0]) ** 2
    offsets = (rows * width + columns)[left >= 0.0]
    return upload(offsets, device, torch.int32), upload(np.sqrt(left[left >= 0.0]), device)


def width_of(like: Tensor) -> int:
    """Cells of a row that one task of `kernels_sky` does where a tensor lives."""
    return 1 if like.is_cuda else WIDTH


def padded(values: Tensor, margin: tuple[int, int], beyond: int, mode: str, value: float = 0.0) -> Tensor:
    """Maps (..., ny, nx) with ``margin`` columns and rows more on every side, and ``beyond`` more columns on the
    right."""
    wider = (margin[0], margin[0] + beyond, margin[1], margin[1])
    maps = values.reshape(1, -1, *values.shape[-2:])
    wide = functional.pad(maps, wider, mode=mode, value=value if mode == "constant" else None)
    return wide.reshape(*values.shape[:-2], *wide.shape[-2:])


def grid_of(relief: Relief) -> Any:
    """Where the relief's maps lie, in the kernels' form."""
    grid = Grid()
    grid.x0, grid.y0 = relief.origin
    grid.inverse_x, grid.inverse_y = 1.0 / relief.cell[0], 1.0 / relief.cell[1]
    return grid


def surface_of(relief: Relief) -> list[Any]:
    """Its heights, normals, first cell and cell size, for kernels that look them up at points."""
    maps = as_warp(relief.height, wp.float32), as_warp(relief.normal, wp.vec3)
    return [*maps, wp.vec2(*relief.origin), wp.vec2(*relief.cell)]


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
    height = fine.new_empty(fine.shape[1:])
    inputs = [as_warp(fine, wp.float32), 0.5, float(low[2]), float(cell[2]), as_warp(height, wp.float32)]
    launch(kernels_relief.crossing, tuple(height.shape), inputs, fine)
    half = (float(cell[0]) / 2, float(cell[1]) / 2)
    relief = Relief.of_heights(height, (float(low[0]) + half[0] / 2, float(low[1]) + half[1] / 2), half)
    relief = yield from relief.ranged()
    # Layers within reach of the surface, as a copy: a view would keep them all.
    thick = float(cell[2])
    first, last = (int((end - float(low[2])) / thick) for end in relief.range)
    first = max(first - _LAYERS_BEYOND, 0)
    filling = fine[first : last + 1 + _LAYERS_BEYOND].clone()
    return relief.with_filling(filling, (float(low[2]) + (first + 0.5) * thick, thick))


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
    w = variance / (2.0 * passes)
    for _ in range(passes):
        before, grid = grid.contiguous(), torch.empty(grid.shape, device=grid.device)
        inputs = [axis, w, *(as_warp(g, wp.float32) for g in (before, grid))]
        launch(kernels_relief.blur, tuple(grid.shape[:2]), inputs, grid)
    return grid
