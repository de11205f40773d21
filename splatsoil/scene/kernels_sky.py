# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""What a place sees around it: sky, soil that sends light back, and the tool."""

# ruff: noqa: UP018 - Warp takes a bare literal for a constant, so what a loop changes starts as float(...)

from __future__ import annotations

import math

import warp as wp

from splatsoil.scene.kernels_maps import Surface, cell_centre, height_at

AZIMUTHS = 12
_TURN = 2.0 * math.pi / AZIMUTHS


@wp.struct
class Around:
    """Light from the soil around, and the shares of the sky that the soil leaves open and that the tool takes of it."""

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
def look_around(
    surface: Surface,
    sent: wp.array2d(dtype=wp.vec3),
    tool: wp.array2d(dtype=wp.vec2),
    place: wp.vec3,
    normal: wp.vec3,
) -> Around:
    """What a place of a unit normal sees, by its horizon in a dozen directions, in steps each a fifth longer than the
    last (horizon-based indirect light, after Bavoil and Sainz, 2009).

    ``sent`` is what each cell sends back, ``tool`` the lowest and highest point of the tool over each cell; both may be
    left empty.
    """
    out = Around()
    rows = surface.height.shape[0]
    columns = surface.height.shape[1]
    u = (place[0] - surface.grid.x0) * surface.grid.inverse_x + 0.5
    v = (place[1] - surface.grid.y0) * surface.grid.inverse_y + 0.5
    here = wp.clamp(int(v), 0, rows - 1) * columns + wp.clamp(int(u), 0, columns - 1)
    up = wp.max(normal[2], 0.05)  # slopes are finite
    for a in range(AZIMUTHS):
        angle = _TURN * (float(a) + 0.5)
        c = wp.cos(angle)
        s = wp.sin(angle)
        along = c * normal[0] + s * normal[1]
        whole = 0.5 * up + 0.25 * wp.pi * along
        slope = -along / up
        seen = _wedge(slope, up, along)
        if whole - seen > 0.0:  # else it looks into the wall
            low = float(1.0e6)
            high = float(-1.0e6)
            last = int(here)
            below = float(place[2])
            step = float(surface.step)
            r = float(step)
            while r < surface.reach:
                i = int(wp.clamp(v + r * s * surface.grid.inverse_y, 0.0, float(rows) - 0.5))
                j = int(wp.clamp(u + r * c * surface.grid.inverse_x, 0.0, float(columns) - 0.5))
                top = height_at(surface, place[0] + r * c, place[1] + r * s)
                climb = top - below
                # A wall between two looks stands midway on the average.
                rise = (top - place[2]) / wp.where(climb > step, r - 0.5 * step, r)
                if rise > slope:
                    slope = rise
                    upto = _wedge(slope, up, along)
                    # Soil between two looks sends their mean, but for a wall: none of the light on its top is on it.
                    upper = wp.where(climb <= step, 0.5, wp.max(1.0 - 0.5 * climb / step, 0.0))
                    if sent.shape[0] > 0:
                        before = sent[last // columns, last % columns]
                        out.light += (upto - seen) * (before + upper * (sent[i, j] - before))
                    seen = upto
                if tool.shape[0] > 0:
                    low = wp.min(low, (tool[i, j][0] - place[2]) / r)
                    high = wp.max(high, (tool[i, j][1] - place[2]) / r)
                last = i * columns + j
                below = top
                step = wp.max(0.2 * r, surface.step)
                r += step
            out.sky += whole - seen
            if high > wp.max(low, slope):
                out.tool += _wedge(high, up, along) - _wedge(wp.max(low, slope), up, along)
    share = 2.0 / float(AZIMUTHS)
    out.light *= share
    out.tool = wp.clamp(share * out.tool, 0.0, 1.0)
    out.sky = wp.clamp(share * out.sky, 0.0, 1.0)
    return out


@wp.kernel(enable_backward=False)
def cells_look_around(
    surface: Surface,
    sent: wp.array2d(dtype=wp.vec3),
    tool: wp.array2d(dtype=wp.vec2),
    light: wp.array2d(dtype=wp.vec3),
    sky: wp.array2d(dtype=wp.vec2),
) -> None:
    """`look_around` of each cell: light, and the shares of the sky that soil leaves open and that the tool takes."""
    i, j = wp.tid()
    seen = look_around(surface, sent, tool, cell_centre(surface, i, j), surface.normal[i, j])
    light[i, j] = seen.light
    sky[i, j] = wp.vec2(seen.sky, seen.tool)
