"""Which Gaussians touch which screen tile, front to back.

Visible Gaussians are ranked by depth once (stable: ties keep their input order). Each rank then lists the tiles that
its ellipse of opacity 1/255 really touches, and a stable sort of these entries by tile leaves every tile's list in
depth order. An entry's number in rank order stays with it: the backward pass writes one row of gradients per entry, and
rows of one Gaussian are neighbours, so that their sum has a fixed order however many threads draw.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from splatsoil.splats import constants
from splatsoil.splats.camera import View
from splatsoil.splats.projection import Projection
from splatsoil.splats.warp_torch import as_warp, launch

HEADER = 8
"""Numbers in front of the features in a packed row: x, y, three exponents, log₂ strength, reach in y, strength."""

_TILE = wp.constant(wp.int32(constants.TILE))
_SIDE = wp.constant(wp.float32(constants.TILE))
_LOG2E = wp.constant(wp.float32(1.4426950408889634))
_CUT_SCALE = wp.constant(wp.float32(2.0 / 1.4426950408889634))
_LOG2_ALPHA_MIN = wp.constant(wp.float32(-7.994353436858858))


@wp.kernel(enable_backward=False, module="unique")
def _pack(
    order: wp.array(dtype=wp.int32),
    centres: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    strengths: wp.array(dtype=float),
    reaches: wp.array(dtype=wp.vec2),
    features: wp.array2d(dtype=float),
    rows: wp.array2d(dtype=float),
):
    rank = wp.tid()
    i = order[rank]
    conic = conics[i]
    rows[rank, 0] = centres[i][0]
    rows[rank, 1] = centres[i][1]
    rows[rank, 2] = -0.5 * _LOG2E * conic[0]
    rows[rank, 3] = -_LOG2E * conic[1]
    rows[rank, 4] = -0.5 * _LOG2E * conic[2]
    rows[rank, 5] = wp.log2(strengths[i])
    rows[rank, 6] = reaches[i][1]
    rows[rank, 7] = strengths[i]
    for k in range(features.shape[1]):
        rows[rank, 8 + k] = features[i, k]


@wp.func
def _tiles_between(low: float, high: float, tiles: int):
    """First and one-past-last tile with a pixel centre between two places (px); clamped before the integer."""
    first = wp.clamp(wp.floor((low - 0.5) / _SIDE), 0.0, float(tiles))
    last = wp.clamp(wp.floor((high - 0.5) / _SIDE) + 1.0, 0.0, float(tiles))
    return wp.vec2i(int(first), int(last))


@wp.func
def _tile_span(rows: wp.array2d(dtype=float), rank: int, tile_row: int, tiles_x: int):
    """First and one-past-last tile column that the ellipse touches in one row of tiles."""
    x = rows[rank, 0]
    y = rows[rank, 1]
    a = -2.0 * rows[rank, 2]
    b = -rows[rank, 3]
    c = -2.0 * rows[rank, 4]
    # the ellipse a dx² + 2 b dx dy + c dy² = cut, all scaled by log₂ e; a little larger, against rounding
    cut = (2.0 * (rows[rank, 5] - _LOG2_ALPHA_MIN)) * 1.0001 + 1.0e-4
    determinant = wp.max(a * c - b * b, 1.0e-30)
    top = float(tile_row) * _SIDE + 0.5 - y
    bottom = top + _SIDE - 1.0
    # rightmost point of the ellipse, moved into the band of rows; the leftmost one lies opposite
    tip = -b * wp.sqrt(cut / (c * determinant))
    dy_right = wp.clamp(tip, top, bottom)
    dy_left = wp.clamp(-tip, top, bottom)
    right = (-b * dy_right + wp.sqrt(wp.max(cut * a - determinant * dy_right * dy_right, 0.0))) / a
    left = (-b * dy_left - wp.sqrt(wp.max(cut * a - determinant * dy_left * dy_left, 0.0))) / a
    return _tiles_between(x + left, x + right, tiles_x)


@wp.func
def _tile_rows(rows: wp.array2d(dtype=float), rank: int, tiles_y: int):
    """First and one-past-last row of tiles that the ellipse touches."""
    return _tiles_between(rows[rank, 1] - rows[rank, 6], rows[rank, 1] + rows[rank, 6], tiles_y)


@wp.kernel(enable_backward=False, module="unique")
def _count(rows: wp.array2d(dtype=float), tiles_x: int, tiles_y: int, counts: wp.array(dtype=wp.int32)):
    rank = wp.tid()
    band = _tile_rows(rows, rank, tiles_y)
    total = wp.int32(0)
    for tile_row in range(band[0], band[1]):
        span = _tile_span(rows, rank, tile_row, tiles_x)
        total += wp.max(span[1] - span[0], 0)
    counts[rank] = total


@wp.kernel(enable_backward=False, module="unique")
def _list(
    rows: wp.array2d(dtype=float),
    tiles_x: int,
    tiles_y: int,
    ends: wp.array(dtype=wp.int32),
    tiles: wp.array(dtype=wp.int32),
    ranks: wp.array(dtype=wp.int32),
):
    rank = wp.tid()
    entry = wp.int32(0)
    if rank > 0:
        entry = ends[rank - 1]
    band = _tile_rows(rows, rank, tiles_y)
    for tile_row in range(band[0], band[1]):
        span = _tile_span(rows, rank, tile_row, tiles_x)
        for column in range(span[0], span[1]):
            tiles[entry] = tile_row * tiles_x + column
            ranks[entry] = rank
            entry += 1


@dataclass(frozen=True)
class Bins:
    """Depth-ordered lists of Gaussians for every tile.

    Attributes:
        tiles_x: tiles per row.
        tiles_y: rows of tiles.
        order: (v,) int32, index of the Gaussian of each rank; v are visible.
        rows: (v, HEADER + k) float32, a Gaussian's numbers packed by rank.
        ends: (v,) int32, one past the last entry of each rank.
        starts: (tiles + 1,) int32, where each tile's list begins in ``ranks`` and ``entries``.
        ranks: (m,) int32, by tile and then by depth.
        entries: (m,) int32, number of the same entry in rank order.
    """

    tiles_x: int
    tiles_y: int
    order: Tensor
    rows: Tensor
    ends: Tensor
    starts: Tensor
    ranks: Tensor
    entries: Tensor


def bin_by_tile(projection: Projection, features: Tensor, view: View) -> Bins:
    """Sort by depth, pack, list tiles, sort by tile; ``features`` is (n, k). Nothing here carries gradients."""
    tiles_x, tiles_y = -(-view.width // constants.TILE), -(-view.height // constants.TILE)
    order = _depth_order(projection)
    visible = order.shape[0]
    rows = features.new_empty((visible, HEADER + features.shape[1]))
    ends = torch.zeros(visible, dtype=torch.int32, device=features.device)
    if visible:
        inputs = [
            as_warp(order, wp.int32),
            as_warp(projection.centres, wp.vec2),
            as_warp(projection.conics, wp.vec3),
            as_warp(projection.strengths, wp.float32),
            as_warp(projection.reaches, wp.vec2),
            as_warp(features, wp.float32),
            as_warp(rows, wp.float32),
        ]
        launch(_pack, visible, inputs, features)
        launch(_count, visible, [as_warp(rows, wp.float32), tiles_x, tiles_y, as_warp(ends, wp.int32)], features)
        ends = ends.cumsum(0, dtype=torch.int32)
    total = int(ends[-1]) if visible else 0
    tiles = torch.empty(total, dtype=torch.int32, device=features.device)
    owners = torch.empty_like(tiles)
    if total:
        arrays = [as_warp(t, wp.int32) for t in (ends, tiles, owners)]
        launch(_list, visible, [as_warp(rows, wp.float32), tiles_x, tiles_y, *arrays], features)
    starts, entries = _sort_by_tile(tiles, tiles_x * tiles_y)
    return Bins(tiles_x, tiles_y, order, rows, ends, starts, owners[entries.long()], entries)


def _depth_order(projection: Projection) -> Tensor:
    """Indices (v,) int32 of the visible Gaussians, nearest first."""
    visible = torch.nonzero(projection.reaches[:, 0] > 0).squeeze(1)
    depths = projection.depths.detach()[visible]
    return visible[torch.argsort(depths, stable=True)].to(torch.int32)


def _sort_by_tile(tiles: Tensor, tile_count: int) -> tuple[Tensor, Tensor]:
    """Where each tile begins (tile_count + 1,), and the stable order of the entries by tile (m,); both int32."""
    entries = torch.argsort(tiles, stable=True).to(torch.int32)
    counts = torch.bincount(tiles, minlength=tile_count)
    starts = torch.zeros(tile_count + 1, dtype=torch.int32, device=tiles.device)
    starts[1:] = counts.cumsum(0)
    return starts, entries
