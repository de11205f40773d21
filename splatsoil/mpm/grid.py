"""The background grid: trilinear hexahedra that fill the bed exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

HEADROOM = 3
"""Cells above the space that the soil may use; a particle that rises higher stops the run."""
ROUNDING = 4.0 * float(np.finfo(np.float32).eps)
"""Relative error of the ratio of two lengths whose ends have been through single precision, as an STL's have."""


def nearest(ratio: float) -> int:
    """The whole number nearest to a ratio of lengths; of two, the odd one, also where rounding has moved the ratio."""
    below = math.floor(ratio)
    return below | 1 if abs(ratio - below - 0.5) <= ROUNDING * ratio else math.floor(ratio + 0.5)


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
        """Grid over the box from ``lower`` to ``upper`` (3,) in m with cells as near to ``cell`` as division allows.

        Rounding decides nothing: see `nearest`, and no layer on top is made of it.
        """
        low = np.asarray(lower, dtype=np.float64)
        extent = np.asarray(upper, dtype=np.float64) - low
        plan = [max(nearest(side / cell), 1) for side in extent[:2]]
        tall = math.ceil((1.0 - ROUNDING) * extent[2] / cell) + HEADROOM
        size = np.array([extent[0] / plan[0], extent[1] / plan[1], cell])
        return cls(low, size, (plan[0] + 1, plan[1] + 1, tall + 1))

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


@wp.struct
class Field:
    """A trilinear field about a point of a cell, in powers of local coordinates: per cell, cell and cell, and so on."""

    value: wp.vec3
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    yz: wp.vec3
    xz: wp.vec3
    xy: wp.vec3
    xyz: wp.vec3


@wp.func
def field_at(nodes: wp.array(dtype=wp.vec3), grid: Grid, base: int, f: wp.vec3) -> Field:
    """Field of the nodes of the cell with lowest node ``base`` about local coordinates ``f``, axis by axis."""
    along_y = grid.shape[2]
    along_x = grid.shape[1] * grid.shape[2]
    # along four edges, which are named by their y and z; then along two; then between these
    x00 = nodes[base + along_x] - nodes[base]
    x01 = nodes[base + along_x + 1] - nodes[base + 1]
    x10 = nodes[base + along_x + along_y] - nodes[base + along_y]
    x11 = nodes[base + along_x + along_y + 1] - nodes[base + along_y + 1]
    v00 = nodes[base] + f[0] * x00
    v01 = nodes[base + 1] + f[0] * x01
    v10 = nodes[base + along_y] + f[0] * x10
    v11 = nodes[base + along_y + 1] + f[0] * x11
    xy0 = x10 - x00
    xy1 = x11 - x01
    y0 = v10 - v00
    y1 = v11 - v01
    x0 = x00 + f[1] * xy0
    x1 = x01 + f[1] * xy1
    v0 = v00 + f[1] * y0
    v1 = v01 + f[1] * y1
    out = Field()
    out.xyz = xy1 - xy0
    out.xz = x1 - x0
    out.yz = y1 - y0
    out.z = v1 - v0
    out.xy = xy0 + f[2] * out.xyz
    out.x = x0 + f[2] * out.xz
    out.y = y0 + f[2] * out.yz
    out.value = v0 + f[2] * out.z
    return out


@wp.func
def field_beside(field: Field, d: wp.vec3) -> wp.vec3:
    """Value of a field ``d`` away from the point that it is about, in cells."""
    plane = field.value + d[0] * field.x + d[1] * (field.y + d[0] * field.xy)
    return plane + d[2] * (field.z + d[0] * field.xz + d[1] * (field.yz + d[0] * field.xyz))


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
