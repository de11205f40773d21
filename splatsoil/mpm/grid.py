"""The background grid: trilinear hexahedra that fill the bed exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

HEADROOM = 3
"""Cells above the space that the soil may use; a particle that rises higher stops the run."""


@wp.struct
class Grid:
    """Geometry of the grid as kernels see it; nodes are numbered x-major, ``nodes`` per simulation.

    Attributes:
        shape: number of nodes along each axis.
        cell: edge lengths of a cell in m.
        inverse: 1 / cell.
        origin: position of node (0, 0, 0) in m.
        nodes: number of nodes of one simulation.
    """

    shape: wp.vec3i
    cell: wp.vec3
    inverse: wp.vec3
    origin: wp.vec3
    nodes: int


@dataclass(frozen=True)
class GridShape:
    """Cells that divide the bed's floor plan exactly, so that walls and floor lie on nodes."""

    lower: npt.NDArray[np.float64]
    cell: npt.NDArray[np.float64]
    nodes: tuple[int, int, int]

    @classmethod
    def covering(cls, lower: npt.ArrayLike, upper: npt.ArrayLike, cell: float) -> GridShape:
        """Grid over the box from ``lower`` to ``upper`` (3,) in m with cells as near to ``cell`` as division allows."""
        low = np.asarray(lower, dtype=np.float64)
        extent = np.asarray(upper, dtype=np.float64) - low
        plan = np.maximum(np.rint(extent[:2] / cell), 1).astype(int)
        tall = int(np.ceil(extent[2] / cell - 1e-9)) + HEADROOM
        size = np.array([extent[0] / plan[0], extent[1] / plan[1], cell])
        return cls(low, size, (int(plan[0]) + 1, int(plan[1]) + 1, tall + 1))

    @property
    def count(self) -> int:
        """Number of nodes of one simulation."""
        return self.nodes[0] * self.nodes[1] * self.nodes[2]

    def to_warp(self) -> Grid:
        """The same grid as a kernel argument."""
        grid = Grid()
        grid.shape = wp.vec3i(*self.nodes)
        grid.cell = wp.vec3(*self.cell)
        grid.inverse = wp.vec3(*(1.0 / self.cell))
        grid.origin = wp.vec3(*self.lower)
        grid.nodes = self.count
        return grid


@wp.func
def corner_weight(f: wp.vec3, corner: int) -> float:
    """Trilinear weight of a cell's corner (bits x, y, z = 4, 2, 1) at local coordinates ``f`` in [0, 1]^3."""
    wx = wp.where((corner & 4) == 0, 1.0 - f[0], f[0])
    wy = wp.where((corner & 2) == 0, 1.0 - f[1], f[1])
    wz = wp.where((corner & 1) == 0, 1.0 - f[2], f[2])
    return wx * wy * wz


@wp.func
def corner_gradient(f: wp.vec3, corner: int, inverse: wp.vec3) -> wp.vec3:
    """Gradient of :func:`corner_weight` in 1/m."""
    wx = wp.where((corner & 4) == 0, 1.0 - f[0], f[0])
    wy = wp.where((corner & 2) == 0, 1.0 - f[1], f[1])
    wz = wp.where((corner & 1) == 0, 1.0 - f[2], f[2])
    sx = wp.where((corner & 4) == 0, -inverse[0], inverse[0])
    sy = wp.where((corner & 2) == 0, -inverse[1], inverse[1])
    sz = wp.where((corner & 1) == 0, -inverse[2], inverse[2])
    return wp.vec3(sx * wy * wz, wx * sy * wz, wx * wy * sz)


@wp.func
def corner_twist(f: wp.vec3, corner: int) -> wp.vec3:
    """Mixed second derivatives (yz, xz, xy) of :func:`corner_weight`, per cell and cell."""
    wx = wp.where((corner & 4) == 0, 1.0 - f[0], f[0])
    wy = wp.where((corner & 2) == 0, 1.0 - f[1], f[1])
    wz = wp.where((corner & 1) == 0, 1.0 - f[2], f[2])
    sx = wp.where((corner & 4) == 0, -1.0, 1.0)
    sy = wp.where((corner & 2) == 0, -1.0, 1.0)
    sz = wp.where((corner & 1) == 0, -1.0, 1.0)
    return wp.vec3(wx * sy * sz, sx * wy * sz, sx * sy * wz)


@wp.func
def corner_sign(corner: int) -> float:
    """Third mixed derivative (xyz) of :func:`corner_weight`, per cell, cell and cell."""
    return wp.where((((corner >> 2) + (corner >> 1) + corner) & 1) == 0, -1.0, 1.0)


@wp.func
def corner_offset(grid: Grid, corner: int) -> int:
    """Node number of a corner relative to the cell's lowest node."""
    return ((corner >> 2) * grid.shape[1] + ((corner >> 1) & 1)) * grid.shape[2] + (corner & 1)


@wp.func
def cell_of(grid: Grid, position: wp.vec3) -> wp.vec3i:
    """Indices of the cell that holds ``position``, clamped to the grid."""
    q = wp.cw_mul(position - grid.origin, grid.inverse)
    return wp.vec3i(
        wp.clamp(int(q[0]), 0, grid.shape[0] - 2),
        wp.clamp(int(q[1]), 0, grid.shape[1] - 2),
        wp.clamp(int(q[2]), 0, grid.shape[2] - 2),
    )


@wp.func
def local_coordinates(grid: Grid, position: wp.vec3, cell: wp.vec3i) -> wp.vec3:
    """Coordinates of ``position`` inside ``cell``, in [0, 1]^3."""
    q = wp.cw_mul(position - grid.origin, grid.inverse)
    return wp.vec3(q[0] - float(cell[0]), q[1] - float(cell[1]), q[2] - float(cell[2]))


@wp.func
def base_node(grid: Grid, cell: wp.vec3i) -> int:
    """Number of a cell's lowest node inside one simulation."""
    return (cell[0] * grid.shape[1] + cell[1]) * grid.shape[2] + cell[2]
