"""How much of the sky each place of a relief sees, and what soil it sees instead."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels, kernels_relief
from splatsoil.scene.kernels_sky import light_of_slopes, sky_kernel
from splatsoil.scene.relief import BLOCK, Relief, grid_of, padded, width_of
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_AZIMUTHS = 12

_STRIDE = 3
"""Cells between those at which the tool is looked for: what it hides changes slowly."""

_NOTHING = 1e6
"""A height beyond all others, m."""


@stepwise
def sky_openness(relief: Relief, tool: Any) -> Steps[tuple[Tensor, Tensor]]:
    """What of a uniform sky reaches each cell, by the horizon in a dozen directions.

    Args:
        relief: the surface.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.

    Returns:
        Two maps (ny, nx): the share of the sky's light, weighted by the cosine, that soil and tool leave (1 on an open
        plane), and the share that the tool alone takes.
    """
    bottom, top = _tool_columns(relief, tool)
    looks = _Looks.over(relief)
    scale = 2.0 / _AZIMUTHS
    total = _sum(relief, looks, None, 1)
    (covered,) = yield (top > bottom).any()
    if not covered:
        return (scale * total).clamp(0.0, 1.0), torch.zeros_like(total)
    taken = _sum(relief, looks, (bottom, top), _STRIDE)
    hidden = torch.empty_like(total)
    between = [as_warp(taken, wp.float32), _STRIDE, as_warp(hidden, wp.float32)]
    launch(kernels_relief.between, tuple(hidden.shape), between, hidden)
    return (scale * (total - hidden)).clamp(0.0, 1.0), (scale * hidden).clamp(0.0, 1.0)


def light_from_slopes(relief: Relief, sent: Tensor) -> Tensor:
    """What each cell sees of a light that the soil sends back, averaged over the soil in the sky's way.

    Slopes in view are those that face a cell: a sunlit trench wall sees the shaded one (horizon-based indirect light,
    after Bavoil and Sainz, 2009).

    Args:
        relief: the surface.
        sent: (3, ny, nx) light sent back by each cell, the same in all directions.

    Returns:
        (3, ny, nx) its mean over the soil seen, weighted as light on the cell is; 0 where no soil stands in the way.
    """
    z = relief.height
    ny, nx = z.shape
    looks, width = _Looks.over(relief), width_of(z)
    wide, planes = (padded(m, looks.margin, width, "replicate") for m in (z, sent))
    result = sent.new_empty(sent.shape)
    inputs = [as_warp(z, wp.float32), as_warp(relief.normal, wp.vec3), as_warp(wide, wp.float32)]
    inputs += [as_warp(planes, wp.float32), *looks.tables(wide), *looks.rows.shape]
    launch(light_of_slopes, (ny, -(-nx // width)), [*inputs, as_warp(result, wp.float32)], z, BLOCK)
    return result


@dataclass(frozen=True)
class _Looks:
    """Where a cell looks: the same distances in every direction.

    Attributes:
        directions: (azimuths, 2) cosine and sine.
        rows, columns: (azimuths, looks) cells on.
        inverses: (azimuths, looks) one over the distance, 1/m.
        uploaded: what `tables` has put on devices, by the maps' width.
    """

    directions: FloatArray
    rows: IntArray
    columns: IntArray
    inverses: FloatArray
    uploaded: dict[tuple[int, torch.device], list[Tensor]] = field(default_factory=dict)

    @classmethod
    def over(cls, relief: Relief) -> _Looks:
        return _looks(_distances(relief), relief.cell)

    @cached_property
    def margin(self) -> tuple[int, int]:
        """Most columns and rows that a cell looks on."""
        return int(np.abs(self.columns).max()), int(np.abs(self.rows).max())

    def tables(self, wide: Tensor) -> list[Any]:
        """Margins, directions, offsets in a map with these margins, and inverses, as the kernels take them."""
        key, kinds = (wide.shape[1], wide.device), (wp.float32, wp.int32, wp.float32)
        if key not in self.uploaded:
            offsets = (self.rows * wide.shape[1] + self.columns).astype(np.int32)
            parts: tuple[npt.NDArray[Any], ...] = (self.directions, offsets, self.inverses)
            types = (torch.float32, torch.int32, torch.float32)
            on = [upload(part.reshape(-1), wide.device, dtype) for part, dtype in zip(parts, types, strict=True)]
            self.uploaded[key] = on
        return [*self.margin, *(as_warp(table, kind) for table, kind in zip(self.uploaded[key], kinds, strict=True))]


def _sum(relief: Relief, looks: _Looks, tool: tuple[Tensor, Tensor] | None, stride: int) -> Tensor:
    """Sum over the azimuths of the sky that soil leaves open to every so many cells, or of what the tool takes of it.

    Args:
        relief: the surface.
        looks: where its cells look.
        tool: its lowest and highest point over each cell, or None for the soil.
        stride: rows and columns from one cell to the next.
    """
    z = relief.height
    ny, nx = z.shape
    width = width_of(z)
    beyond = stride * width
    wide = below = above = padded(z, looks.margin, beyond, "replicate")
    if tool is not None:
        below, above = (
            padded(part, looks.margin, beyond, "constant", value)
            for part, value in zip(tool, (_NOTHING, -_NOTHING), strict=True)
        )
    result = z.new_empty((-(-ny // stride), -(-nx // stride)))
    inputs = [as_warp(z, wp.float32), as_warp(relief.normal, wp.vec3)]
    inputs += [as_warp(m, wp.float32) for m in (wide, below, above)]
    inputs += [*looks.tables(wide), *looks.rows.shape, as_warp(result, wp.float32)]
    rows, columns = result.shape
    launch(sky_kernel(stride, tool is not None), (rows, -(-columns // width)), inputs, z, BLOCK)
    return result


@lru_cache(maxsize=64)
def _looks(distances: tuple[float, ...], cell: tuple[float, float]) -> _Looks:
    """Made once: frames differ in how far off there is something to look at, by a few steps."""
    angle = 2.0 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    away = directions[:, :, None] * np.array(distances)
    columns, rows = (np.round(away[:, k] / cell[k]).astype(np.int64) for k in (0, 1))
    return _Looks(directions, rows, columns, 1.0 / np.hypot(columns * cell[0], rows * cell[1]))


def _distances(relief: Relief) -> tuple[float, ...]:
    """How far off a cell looks: each step a fifth farther, a cell at least, for blockers far away hide little sky."""
    cell = max(relief.cell)
    out, farthest = [cell], reach(relief)
    while out[-1] < farthest:
        out.append(out[-1] + max(cell, 0.2 * out[-1]))
    return tuple(out)


def reach(relief: Relief) -> float:
    """How far off there is something to look at, m."""
    low, high = relief.range
    return max(4.0 * (high - low), 0.15)


def _tool_columns(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """Lowest and highest point (ny, nx) of the tool over each cell, m; above all and below all where there is none."""
    bottom, top = torch.empty_like(relief.height), torch.empty_like(relief.height)
    reach = 1.0  # metres above and below the soil within which the tool is looked for
    low, high = relief.range[0] - reach, relief.range[1] + reach
    inputs = [grid_of(relief), tool, high, low, as_warp(bottom, wp.float32), as_warp(top, wp.float32)]
    launch(kernels.tool_columns, tuple(relief.height.shape), inputs, bottom)
    return bottom, top
