"""Which Gaussians touch which screen tile, front to back.

Visible Gaussians are ranked by depth once (stable: ties keep their input order). Each rank then lists the tiles that
its ellipse of opacity 1/255 really touches, and a stable sort of these entries by tile leaves every tile's list in
depth order. An entry's number in rank order stays with it: the backward pass writes one row of gradients per entry, and
rows of one Gaussian are neighbours, so that their sum has a fixed order however many threads draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from scipy.sparse import coo_array
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats import constants
from splatsoil.splats import kernels_binning as kernels
from splatsoil.splats.projection import Projection
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload


@dataclass(frozen=True)
class Bins:
    """Depth-ordered lists of Gaussians for every tile.

    Attributes:
        tiles_x: tiles per row.
        tiles_y: rows of tiles.
        order: (v,) int32, index of the Gaussian of each rank; v are visible, or all, the others last and in no tile.
        rows: (v, HEADER + k) float32, a Gaussian's numbers packed by rank.
        ends: (v,) int32, one past the last entry of each rank.
        starts: (tiles + 1,) int32, of all views, where each tile's list begins in ``ranks`` and ``entries``.
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


@stepwise
def bin_by_tile(projection: Projection, features: Tensor, camera: Camera, counts: Sequence[int] = ()) -> Steps[Bins]:
    """Sort by depth, pack, list tiles, sort by tile. Nothing here carries gradients.

    Args:
        projection: of n Gaussians.
        features: (n, k).
        camera: tells the picture's size.
        counts: Gaussians of each of several views of this size, whose Gaussians, and then tiles, follow each other.
    """
    tiles_x, tiles_y = -(-camera.width // constants.TILE), -(-camera.height // constants.TILE)
    order = _depth_order(projection)
    count = order.shape[0]
    rows = features.new_empty((count, kernels.HEADER + features.shape[1]))
    ends = torch.empty(count, dtype=torch.int32, device=features.device)
    inputs = [
        as_warp(order, wp.int32),
        as_warp(projection.centres, wp.vec2),
        as_warp(projection.conics, wp.vec3),
        as_warp(projection.strengths, wp.float32),
        as_warp(projection.reaches, wp.vec2),
        as_warp(features, wp.float32),
    ]
    packed = as_warp(rows, wp.float32)
    launch(kernels.pack, count, [*inputs, tiles_x, tiles_y, packed, as_warp(ends, wp.int32)], features)
    ends = ends.cumsum(0, dtype=torch.int32)
    (total,) = (yield ends[-1]) if count else (0,)
    tiles = torch.empty(int(total), dtype=torch.int32, device=features.device)
    owners = torch.empty_like(tiles)
    lists = [as_warp(tiles, wp.int32), as_warp(owners, wp.int32)]
    launch(kernels.list_tiles, count, [packed, as_warp(ends, wp.int32), tiles_x, tiles_y, *lists], features)
    if counts:
        tiles += tiles_x * tiles_y * _numbers(counts, features.device)[order[owners]]
    starts, ranks, entries = _sort_by_tile(tiles, owners, tiles_x * tiles_y * max(len(counts), 1))
    return Bins(tiles_x, tiles_y, order, rows, ends, starts, ranks, entries)


def _numbers(counts: Sequence[int], device: torch.device) -> Tensor:
    """(n,) int32: of the view that each Gaussian belongs to."""
    each = torch.arange(len(counts), dtype=torch.int32, device=device)
    return torch.repeat_interleave(each, upload(counts, device, torch.int64), output_size=sum(counts))


def _depth_order(projection: Projection) -> Tensor:
    """Indices (v,) int32 of the Gaussians, nearest first: the visible ones, on CUDA followed by the others."""
    depths = projection.depths.detach()
    if depths.is_cuda:
        return _depth_order_torch(projection)
    numbers = np.flatnonzero(projection.visible.numpy())
    bits = depths.numpy()[numbers].view(np.uint32)  # of positive numbers: in the same order
    # NumPy's stable sort of 16-bit integers is by radix: the lower halves first.
    order = np.argsort(bits.astype(np.uint16), kind="stable")
    order = order[np.argsort((bits >> 16).astype(np.uint16)[order], kind="stable")]
    return torch.from_numpy(numbers[order].astype(np.int32))


def _depth_order_torch(projection: Projection) -> Tensor:
    """`_depth_order` by torch's own sort, for CUDA; counting the visible ones would make the host wait."""
    depths = torch.where(projection.visible, projection.depths.detach(), torch.inf)
    return torch.argsort(depths, stable=True).to(torch.int32)


def _sort_by_tile(tiles: Tensor, owners: Tensor, tile_count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where each tile begins (tile_count + 1,), ranks (m,) and entries (m,) by tile in a stable order; all int32."""
    if tiles.is_cuda:
        return _sort_by_tile_torch(tiles, owners, tile_count)
    # SciPy orders a sparse matrix by rows, which are tiles here, by a stable counting sort.
    places = (tiles.numpy(), np.arange(len(tiles), dtype=np.int32))
    rows = coo_array((owners.numpy(), places), shape=(tile_count, len(tiles))).tocsr()
    return torch.from_numpy(rows.indptr), torch.from_numpy(rows.data), torch.from_numpy(rows.indices)


def _sort_by_tile_torch(tiles: Tensor, owners: Tensor, tile_count: int) -> tuple[Tensor, Tensor, Tensor]:
    """`_sort_by_tile` by torch's own sort, for CUDA."""
    ordered, entries = torch.sort(tiles, stable=True)
    numbers = torch.arange(tile_count + 1, dtype=torch.int32, device=tiles.device)
    return torch.searchsorted(ordered, numbers, out_int32=True), owners[entries], entries.to(torch.int32)
