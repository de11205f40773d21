"""How much of the sky each place of a relief sees."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels
from splatsoil.scene.relief import Relief, grid_of
from splatsoil.splats.warp_torch import as_warp, launch

_AZIMUTHS = 12

_STRIDE = 3
"""Cells between those at which the tool is looked for: what it hides changes slowly."""

_NOTHING = 1e6
"""A height beyond all others, m."""


def sky_openness(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """What of a uniform sky reaches each cell, by the horizon in a dozen directions.

    Args:
        relief: the surface.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.

    Returns:
        Two maps (ny, nx): the share of the sky's light, weighted by the cosine, that soil and tool leave (1 on an open
        plane), and the share that the tool alone takes.
    """
    z, normal = relief.height, relief.normal
    bottom, top = _tool_columns(relief, tool)
    distances = _distances(relief)
    margin = [int(np.ceil(distances[-1] / c)) for c in relief.cell]
    wide = _padded(z, margin, "replicate")
    below, above = _padded(bottom, margin, "constant", _NOTHING), _padded(top, margin, "constant", -_NOTHING)
    with_tool = bool((top > bottom).any())
    some = (slice(None, None, _STRIDE), slice(None, None, _STRIDE))
    here, up = z[some].contiguous(), normal[..., 2][some].contiguous()
    total, rise = torch.zeros_like(z), torch.empty_like(z)
    taken, part = torch.zeros_like(here), torch.empty_like(here)
    for angle in 2.0 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS:
        along = float(np.cos(angle)) * normal[..., 0] + float(np.sin(angle)) * normal[..., 1]
        slope = -along / normal[..., 2]
        looks = _looks(angle, distances, relief.cell)
        for row, column, inverse in looks:
            torch.sub(_shifted(wide, row, column, margin, z), z, out=rise)
            torch.maximum(slope, rise.mul_(inverse), out=slope)
        total += _wedge(None, normal[..., 2], along) - _wedge(slope, normal[..., 2], along)
        if with_tool:
            low, high = torch.full_like(here, _NOTHING), torch.full_like(here, -_NOTHING)
            for row, column, inverse in looks:
                torch.sub(_shifted(below, row, column, margin, z)[some], here, out=part)
                torch.minimum(low, part.mul_(inverse), out=low)
                torch.sub(_shifted(above, row, column, margin, z)[some], here, out=part)
                torch.maximum(high, part.mul_(inverse), out=high)
            torch.maximum(low, slope[some], out=low)
            taken += torch.where(high > low, _wedge(high, up, along[some]) - _wedge(low, up, along[some]), 0.0)
    hidden = _between(taken, _STRIDE, (z.shape[0], z.shape[1]))
    scale = 2.0 / _AZIMUTHS
    return (scale * (total - hidden)).clamp(0.0, 1.0), (scale * hidden).clamp(0.0, 1.0)


def _between(values: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    """A map known at every so many rows and columns, the first among them, linearly in between."""
    for axis in (0, 1):
        place = torch.arange(size[axis], device=values.device) / stride
        before = place.floor().long().clamp_max(max(values.shape[axis] - 2, 0))
        after = (before + 1).clamp_max(values.shape[axis] - 1)
        part = (place - before).clamp(0.0, 1.0).reshape((-1, 1) if axis == 0 else (1, -1))
        values = values.index_select(axis, before) * (1.0 - part) + values.index_select(axis, after) * part
    return values


def _wedge(slope: Tensor | None, up: Tensor, along: Tensor) -> Tensor:
    """What a slice of uniform sky below an elevation e gives to a facet, up to a constant: the antiderivative of
    (up·sin e + along·cos e)·cos e, from the slope tan e; None for the zenith."""
    if slope is None:
        return 0.5 * up + 0.25 * np.pi * along
    rest = 1.0 / (1.0 + slope.square())
    return 0.5 * up * (1.0 - rest) + 0.5 * along * (torch.atan(slope) + slope * rest)


def _distances(relief: Relief) -> list[float]:
    """How far off a cell looks: each step a fifth farther, a cell at least, for blockers far away hide little sky."""
    cell = max(relief.cell)
    reach = max(4.0 * float(relief.height.max() - relief.height.min()), 0.15)
    out = [cell]
    while out[-1] < reach:
        out.append(out[-1] + max(cell, 0.2 * out[-1]))
    return out


def _looks(angle: float, distances: list[float], cell: tuple[float, float]) -> list[tuple[int, int, float]]:
    """Rows, columns and one over the distance of the cells looked at in a direction."""
    out = []
    for distance in distances:
        column, row = round(np.cos(angle) * distance / cell[0]), round(np.sin(angle) * distance / cell[1])
        out.append((row, column, 1.0 / float(np.hypot(column * cell[0], row * cell[1]))))
    return out


def _padded(values: Tensor, margin: list[int], mode: str, value: float = 0.0) -> Tensor:
    """A map with ``margin`` columns and rows more on every side."""
    wider = (margin[0], margin[0], margin[1], margin[1])
    return functional.pad(values[None, None], wider, mode=mode, value=value if mode == "constant" else None)[0, 0]


def _shifted(wide: Tensor, row: int, column: int, margin: list[int], like: Tensor) -> Tensor:
    """The padded map as seen from cells that look some rows and columns on."""
    ny, nx = like.shape
    return wide[margin[1] + row : margin[1] + row + ny, margin[0] + column : margin[0] + column + nx]


def _tool_columns(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """Lowest and highest point (ny, nx) of the tool over each cell, m; above all and below all where there is none."""
    bottom, top = torch.empty_like(relief.height), torch.empty_like(relief.height)
    reach = 1.0  # metres above and below the soil within which the tool is looked for
    low, high = float(relief.height.min()) - reach, float(relief.height.max()) + reach
    inputs = [grid_of(relief), tool, high, low, as_warp(bottom, wp.float32), as_warp(top, wp.float32)]
    launch(kernels.tool_columns, tuple(relief.height.shape), inputs, bottom)
    return bottom, top
