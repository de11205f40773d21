# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""CUDA kernels: a block of 256 threads per 16 × 16 tile, one pixel per thread, Gaussians front to back.

The same arguments and arithmetic as `splatsoil.splats.kernels_cpu`. A warp (two rows of a tile) walks its tile's list
together and leaves it together; in the backward pass it sums its pixels' gradients in registers before one lane adds
them to the entry's row. Written in Warp but for three warp-wide operations, which on a CPU are those of a warp of one
lane: so these kernels run, slowly, on a CPU, too, and are tested there. On CUDA the order in which the eight warps of a
tile add is not fixed, so the last bits of gradients vary from run to run, unless each warp has a row of its own.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil import deterministic
from splatsoil.splats import constants
from splatsoil.splats.kernels_binning import HEADER, MOMENTS

THREADS = constants.TILE * constants.TILE
"""Threads per tile."""
WARPS = THREADS // 32
"""Warps per tile."""
PARTS = WARPS if deterministic.wanted() else 1
"""Rows of gradients for every entry: one, to which a tile's warps add in any order, or one for each warp."""

_TILE = wp.constant(wp.int32(constants.TILE))
_THREADS = wp.constant(wp.int32(THREADS))
_PARTS = wp.constant(wp.int32(PARTS))
_LANES = wp.constant(wp.int32(32))
_LN2 = wp.constant(wp.float32(0.6931471805599453))
_ALPHA_MAX = wp.constant(wp.float32(constants.ALPHA_MAX))
_ALPHA_MIN = wp.constant(wp.float32(constants.ALPHA_MIN))
_TRANSMITTANCE_MIN = wp.constant(wp.float32(constants.TRANSMITTANCE_MIN))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
""")
def any_lane(flag: int) -> int:
    """Whether the flag is set in any lane of the warp."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1) value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
""")
def lane_sum(value: float) -> float:
    """Sum over the lanes of the warp, in every lane."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return (int)(threadIdx.x & 31u);
#else
    return 0;
#endif
""")
def lane() -> int:
    """Number of this lane in its warp."""


@wp.func
def _opacity(rows: wp.array2d(dtype=float), rank: int, dx: float, dy: float):
    """Opacity before the clamp."""
    exponent = (rows[rank, 2] * dx + rows[rank, 3] * dy) * dx + rows[rank, 4] * dy * dy + rows[rank, 5]
    return wp.exp(_LN2 * exponent)


@wp.func
def _pixel(first: int, thread: int, tiles_x: int):
    """Tile, column and row of a thread's pixel; rows go on from view to view, by whole tiles."""
    tile = first + thread // _THREADS
    cell = thread % _THREADS
    return wp.vec3i(tile, (tile % tiles_x) * _TILE + cell % _TILE, (tile // tiles_x) * _TILE + cell // _TILE)


@cache
def forward_kernel(channels: int) -> Any:
    """Kernel over pixels, tile after tile, that blends ``channels`` features, of one view or of several of one size,
    whose tiles and pictures follow each other."""
    Features = wp.types.vector(length=channels, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    def splat_forward_cuda(
        first: int,
        width: int,
        height: int,
        tiles_x: int,
        rows: wp.array2d(dtype=float),
        starts: wp.array(dtype=wp.int32),
        ranks: wp.array(dtype=wp.int32),
        background: wp.array(dtype=float),
        image: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
    ):
        place = _pixel(first, wp.tid(), tiles_x)
        tile = place[0]
        tiles_y = (height + _TILE - 1) // _TILE
        view = tile // (tiles_x * tiles_y)
        row = place[2] - view * tiles_y * _TILE
        inside = place[1] < width and row < height
        x = float(place[1]) + 0.5
        y = float(row) + 0.5
        t = wp.float32(-1.0)  # negative: finished
        if inside:
            t = wp.float32(1.0)
        total = Features()
        for e in range(starts[tile], starts[tile + 1]):
            if any_lane(int(t > 0.0)) == 0:
                break
            rank = ranks[e]
            alpha = wp.min(_opacity(rows, rank, x - rows[rank, 0], y - rows[rank, 1]), _ALPHA_MAX)
            if t > 0.0 and alpha >= _ALPHA_MIN:
                after = t - t * alpha
                if after <= _TRANSMITTANCE_MIN:
                    t = -t
                else:
                    w = alpha * t
                    for k in range(channels):
                        total[k] += w * rows[rank, HEADER + k]
                    t = after
        if inside:
            pixel = (view * height + row) * width + place[1]
            left = wp.abs(t)
            transmittance[pixel] = left
            for k in range(channels):
                image[pixel * channels + k] = total[k] + left * background[k]

    return splat_forward_cuda


@cache
def backward_kernel(channels: int) -> Any:
    """Kernel over pixels that adds moments and feature gradients to the rows of every entry.

    An entry has `PARTS` rows, one after the other.
    """
    Features = wp.types.vector(length=channels, dtype=float)
    Row = wp.types.vector(length=MOMENTS + channels, dtype=float)

    # its additions have an order where one is wanted: nothing for Warp to sort
    @wp.kernel(
        enable_backward=False,
        module="unique",
        module_options={"deterministic": wp.DeterministicMode.NOT_GUARANTEED},
    )
    def splat_backward_cuda(
        first: int,
        width: int,
        height: int,
        tiles_x: int,
        rows: wp.array2d(dtype=float),
        starts: wp.array(dtype=wp.int32),
        ranks: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        image: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
        v_image: wp.array(dtype=float),
        v_transmittance: wp.array(dtype=float),
        gradients: wp.array(dtype=float),
    ):
        place = _pixel(first, wp.tid(), tiles_x)
        tile = place[0]
        part = (wp.tid() % _THREADS) // _LANES % _PARTS
        x = float(place[1]) + 0.5
        y = float(place[2]) + 0.5
        t = wp.float32(-1.0)
        v = Features()
        rest = wp.float32(0.0)  # the part of colour · gradient that is still to come
        if place[1] < width and place[2] < height:
            t = wp.float32(1.0)
            pixel = place[2] * width + place[1]
            rest = transmittance[pixel] * v_transmittance[pixel]
            for k in range(channels):
                v[k] = v_image[pixel * channels + k]
                rest += v[k] * image[pixel * channels + k]
        for e in range(starts[tile], starts[tile + 1]):
            if any_lane(int(t > 0.0)) == 0:
                break
            rank = ranks[e]
            dx = x - rows[rank, 0]
            dy = y - rows[rank, 1]
            raw = _opacity(rows, rank, dx, dy)
            alpha = wp.min(raw, _ALPHA_MAX)
            row = Row()
            drawn = wp.int32(0)
            if t > 0.0 and alpha >= _ALPHA_MIN:
                after = t - t * alpha
                if after <= _TRANSMITTANCE_MIN:
                    t = -t
                else:
                    drawn = 1
                    w = alpha * t
                    dot = wp.float32(0.0)
                    for k in range(channels):
                        dot += v[k] * rows[rank, HEADER + k]
                        row[MOMENTS + k] = w * v[k]
                    rest -= w * dot
                    if raw <= _ALPHA_MAX:
                        s = rest * alpha / (1.0 - alpha) - w * dot
                        row[0] = s
                        row[1] = s * dx
                        row[2] = s * dy
                        row[3] = s * dx * dx
                        row[4] = s * dx * dy
                        row[5] = s * dy * dy
                    t = after
            if any_lane(drawn) != 0:
                at = (entries[e] * _PARTS + part) * (MOMENTS + channels)
                for k in range(MOMENTS + channels):
                    total = lane_sum(row[k])
                    if lane() == 0:
                        wp.atomic_add(gradients, at + k, total)

    return splat_backward_cuda
