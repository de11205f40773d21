# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels of the hemisphere over a place: visible sky, radiosity of the soil around, and the tool."""

# ruff: noqa: UP018 - Warp takes a bare literal for a constant, so what a loop changes starts as float(...)

from __future__ import annotations

import math
from typing import Any

import warp as wp

from splatsoil.scene.kernels_maps import Maps, Surface, ToolPose, cell_centre, height_at

AZIMUTHS = 12
_TURN = 2.0 * math.pi / AZIMUTHS


@wp.struct
class Hemisphere:
    """Irradiance from the soil around, and the shares of the sky that the soil leaves open and that the tool hides."""

    light: wp.vec3
    sky: float
    tool: float


@wp.func
def _wedge(slope: float, up: float, along: float) -> float:
    """Light of a slice of uniform sky below a slope, up to a constant: the antiderivative of
    (up sin e + along cos e) cos e."""
    rest = 1.0 / (1.0 + slope * slope)
    return 0.5 * up * (1.0 - rest) + 0.5 * along * (wp.atan(slope) + slope * rest)


@wp.func
def _cell(values: wp.array2d(dtype=Any), u: float, v: float):
    """Value of the cell of a map (ny, nx) in which a place lies, or of the nearest one; u and v count cells from the
    map's corner."""
    i = int(wp.clamp(v, 0.0, float(values.shape[0]) - 0.5))
    return values[i, int(wp.clamp(u, 0.0, float(values.shape[1]) - 0.5))]


@wp.func
def scan_horizon(
    surface: Surface,
    maps: Maps,
    tool: ToolPose,
    place: wp.vec3,
    normal: wp.vec3,
) -> Hemisphere:
    """The hemisphere over a place of a unit normal, by its horizon in a dozen directions, in steps each a fifth longer
    than the last (horizon-based indirect light, after Bavoil and Sainz, 2009).

    Irradiance from the soil needs a map of radiosity, the tool one of its columns.
    """
    out = Hemisphere()
    u = (place[0] - surface.grid.x0) * surface.grid.inverse_x + 0.5
    v = (place[1] - surface.grid.y0) * surface.grid.inverse_y + 0.5
    known = maps.radiosity.shape[0] > 0
    up = wp.max(normal[2], 0.05)  # slopes are finite
    ahead = tool.centre - place
    radius = tool.radius + 2.0 * surface.step  # a cell around it may lie in its column
    for a in range(AZIMUTHS):
        angle = _TURN * (float(a) + 0.5)
        c = wp.cos(angle)
        s = wp.sin(angle)
        along = c * normal[0] + s * normal[1]
        whole = 0.5 * up + 0.25 * wp.pi * along
        slope = -along / up
        seen = _wedge(slope, up, along)
        if whole - seen > 0.0:  # else it looks into the wall
            last = float(0.0)
            below = float(place[2])
            step = float(surface.step)
            r = float(step)
            while r < surface.reach:
                if step > surface.step:  # what lies between two cells is nothing to a step over several
                    top = _cell(surface.height, u + r * c * surface.grid.inverse_x, v + r * s * surface.grid.inverse_y)
                else:
                    top = height_at(surface, place[0] + r * c, place[1] + r * s)
                climb = top - below
                # A wall between two samples stands midway on the average.
                rise = (top - place[2]) / wp.where(climb > step, r - 0.5 * step, r)
                if known and rise > slope:
                    upto = _wedge(rise, up, along)
                    # Soil between two samples has their mean radiosity; but a wall has none of that on its top.
                    upper = wp.where(climb <= step, 0.5, wp.max(1.0 - 0.5 * climb / step, 0.0))
                    before = _cell(
                        maps.radiosity, u + last * c * surface.grid.inverse_x, v + last * s * surface.grid.inverse_y
                    )
                    here = _cell(maps.radiosity, u + r * c * surface.grid.inverse_x, v + r * s * surface.grid.inverse_y)
                    out.light += (upto - seen) * (before + upper * (here - before))
                    seen = upto
                slope = wp.max(slope, rise)
                last = r
                below = top
                step = wp.max(0.2 * r, surface.step)
                r += step
            out.sky += whole - _wedge(slope, up, along)
            way = c * ahead[0] + s * ahead[1]
            if maps.columns.shape[0] > 0 and way > -radius and wp.abs(s * ahead[0] - c * ahead[1]) < radius:
                low = float(1.0e6)
                high = float(-1.0e6)
                r = surface.step
                while r < wp.min(surface.reach, way + radius):
                    if r > way - radius:
                        column = _cell(
                            maps.columns, u + r * c * surface.grid.inverse_x, v + r * s * surface.grid.inverse_y
                        )
                        low = wp.min(low, (column[0] - place[2]) / r)
                        high = wp.max(high, (column[1] - place[2]) / r)
                    r += wp.max(0.2 * r, surface.step)
                low = wp.max(low, slope)
                if high > low:
                    out.tool += _wedge(high, up, along) - _wedge(low, up, along)
    share = 2.0 / float(AZIMUTHS)
    out.light *= share
    out.tool = wp.clamp(share * out.tool, 0.0, 1.0)
    out.sky = wp.clamp(share * out.sky, 0.0, 1.0)
    return out


@wp.kernel(enable_backward=False)
def scan_cells(
    surface: Surface,
    maps: Maps,
    tool: ToolPose,
    light: wp.array2d(dtype=wp.vec3),
    sky: wp.array2d(dtype=wp.vec2),
) -> None:
    """`scan_horizon` of each cell: irradiance, and the shares of the sky that soil leaves open and the tool hides."""
    i, j = wp.tid()
    seen = scan_horizon(surface, maps, tool, cell_centre(surface, i, j), surface.normal[i, j])
    light[i, j] = seen.light
    sky[i, j] = wp.vec2(seen.sky, seen.tool)
