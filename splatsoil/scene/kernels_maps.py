# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp structs of the soil's surface and its shading maps, and their interpolation between cells."""

from __future__ import annotations

from typing import Any

import warp as wp


@wp.struct
class Grid:
    """Where a map over the bed lies: centre of its first cell and one over the cell size."""

    x0: float
    y0: float
    inverse_x: float
    inverse_y: float


@wp.struct
class Surface:
    """A bed's surface.

    Attributes:
        height: (ny, nx), m.
        normal: (ny, nx), unit.
        filling: (nz, ny, nx) density over that of the bulk, in layers.
        lowest, inverse_z: height of the lowest layer, and one over the distance from one to the next.
        grid: where the maps lie.
        step: by which rays march, m.
        top: a height that no soil reaches, m.
        reach: how far off there is something to look at, m.
    """

    height: wp.array2d(dtype=wp.float32)
    normal: wp.array2d(dtype=wp.vec3)
    filling: wp.array3d(dtype=wp.float32)
    lowest: float
    inverse_z: float
    grid: Grid
    step: float
    top: float
    reach: float


Shade = wp.types.vector(length=8, dtype=wp.float32)
"""Shading of a cell: normal, visibility of sky and sun, and interreflection (red, green, blue)."""


@wp.struct
class Maps:
    """What is known of the cells of a surface; what isn't is left empty.

    Attributes:
        shades: what light reaches them.
        radiosity: light that they send back.
        columns: lowest and highest point of the tool over each.
        tool_occlusion: share of the sky that the tool takes.
    """

    shades: wp.array2d(dtype=Shade)
    radiosity: wp.array2d(dtype=wp.vec3)
    columns: wp.array2d(dtype=wp.vec2)
    tool_occlusion: wp.array2d(dtype=wp.float32)


@wp.struct
class ToolPose:
    """The tool's mesh (in its own frame) and where it stands; ``mesh`` is 0 for no tool."""

    mesh: wp.uint64
    rotation: wp.mat33
    position: wp.vec3
    centre: wp.vec3
    radius: float


@wp.func
def sample(values: wp.array2d(dtype=Any), grid: Grid, x: float, y: float):
    """Bilinear value of a map (ny, nx), held constant beyond its outermost cells' centres."""
    u = wp.clamp((x - grid.x0) * grid.inverse_x, 0.0, float(values.shape[1]) - 1.001)
    v = wp.clamp((y - grid.y0) * grid.inverse_y, 0.0, float(values.shape[0]) - 1.001)
    i = int(v)
    j = int(u)
    low = values[i, j] + (values[i, j + 1] - values[i, j]) * (u - float(j))
    high = values[i + 1, j] + (values[i + 1, j + 1] - values[i + 1, j]) * (u - float(j))
    return low + (high - low) * (v - float(i))


@wp.func
def height_at(surface: Surface, x: float, y: float) -> float:
    return sample(surface.height, surface.grid, x, y)


@wp.func
def cell_centre(surface: Surface, i: int, j: int) -> wp.vec3:
    """The point of the surface over a cell's centre."""
    x = surface.grid.x0 + float(j) / surface.grid.inverse_x
    y = surface.grid.y0 + float(i) / surface.grid.inverse_y
    return wp.vec3(x, y, surface.height[i, j])


@wp.func
def _filling_at(surface: Surface, x: float, y: float, z: float) -> float:
    w = wp.clamp((z - surface.lowest) * surface.inverse_z, 0.0, float(surface.filling.shape[0]) - 1.001)
    k = int(w)
    low = sample(surface.filling[k], surface.grid, x, y)
    return low + (sample(surface.filling[k + 1], surface.grid, x, y) - low) * (w - float(k))


@wp.func
def outward(surface: Surface, x: wp.vec3) -> wp.vec3:
    """Unit normal of the density at a point, by differences over a cell each way, and half a layer."""
    dx = 1.0 / surface.grid.inverse_x
    dy = 1.0 / surface.grid.inverse_y
    dz = 0.5 / surface.inverse_z
    along_x = _filling_at(surface, x[0] - dx, x[1], x[2]) - _filling_at(surface, x[0] + dx, x[1], x[2])
    along_y = _filling_at(surface, x[0], x[1] - dy, x[2]) - _filling_at(surface, x[0], x[1] + dy, x[2])
    along_z = _filling_at(surface, x[0], x[1], x[2] - dz) - _filling_at(surface, x[0], x[1], x[2] + dz)
    return wp.normalize(wp.vec3(along_x / dx, along_y / dy, along_z / dz))
