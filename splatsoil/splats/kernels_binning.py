# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels, for CPU and CUDA: pack Gaussians by rank, count and list the tiles they touch, gather gradients."""

from __future__ import annotations

import warp as wp

from splatsoil.splats import constants

HEADER = 12
"""Numbers in front of the features in a packed row: x, y, the quadratic, mixed and other quadratic coefficient of log₂
opacity, log₂ strength, reach in y, strength, and the ellipse of opacity 1/255 as dy = slope·dx ± √(room − bend·dx²):
dx of its lowest point, slope, room, bend."""

MOMENTS = 6
"""Moments of ∂L/∂σ per entry (1, dx, dy, dx², dx·dy, dy²), in front of the feature gradients."""

_HEADER = wp.constant(wp.int32(HEADER))
_MOMENTS = wp.constant(wp.int32(MOMENTS))
_SIDE = wp.constant(wp.float32(constants.TILE))
_ALPHA_MIN = wp.constant(wp.float32(constants.ALPHA_MIN))
_LOG2E = wp.constant(wp.float32(1.4426950408889634))
_LOG2_ALPHA_MIN = wp.constant(wp.float32(-7.994353436858858))


@wp.func
def _determinant(a: float, b: float, c: float):
    """ac − b², kept positive where a needle's is lost in rounding."""
    return wp.max(a * c - b * b, 1.0e-7 * a * c)


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
    determinant = _determinant(a, b, c)
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
def pack(
    order: wp.array(dtype=wp.int32),
    centres: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    strengths: wp.array(dtype=float),
    reaches: wp.array(dtype=wp.vec2),
    features: wp.array2d(dtype=float),
    tiles_x: int,
    tiles_y: int,
    rows: wp.array2d(dtype=float),
    counts: wp.array(dtype=wp.int32),
):
    """Write a rank's row, and count the tiles it touches."""
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
    # a little larger than the ellipse, against rounding
    cut = 2.0 * wp.log(strengths[i] / _ALPHA_MIN) * 1.0001 + 1.0e-4
    determinant = _determinant(conic[0], conic[1], conic[2])
    rows[rank, 8] = -conic[1] * wp.sqrt(cut / (conic[0] * determinant))
    rows[rank, 9] = -conic[1] / conic[2]
    rows[rank, 10] = cut / conic[2]
    rows[rank, 11] = determinant / (conic[2] * conic[2])
    for k in range(features.shape[1]):
        rows[rank, _HEADER + k] = features[i, k]
    band = _tile_rows(rows, rank, tiles_y)
    total = wp.int32(0)
    for tile_row in range(band[0], band[1]):
        span = _tile_span(rows, rank, tile_row, tiles_x)
        total += wp.max(span[1] - span[0], 0)
    counts[rank] = total


@wp.kernel(enable_backward=False, module="unique")
def list_tiles(
    rows: wp.array2d(dtype=float),
    ends: wp.array(dtype=wp.int32),
    tiles_x: int,
    tiles_y: int,
    tiles: wp.array(dtype=wp.int32),
    ranks: wp.array(dtype=wp.int32),
):
    """Write a rank's entries: the tiles it touches, and itself."""
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


@wp.kernel(enable_backward=False, module="unique")
def gather(
    order: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    gradients: wp.array2d(dtype=float),
    conics: wp.array(dtype=wp.vec3),
    strengths: wp.array(dtype=float),
    v_centres: wp.array(dtype=wp.vec2),
    v_conics: wp.array(dtype=wp.vec3),
    v_strengths: wp.array(dtype=float),
    v_features: wp.array2d(dtype=float),
):
    """Sum the entries of a rank in order, and turn moments of ∂L/∂σ into gradients (σ = ½ dᵀ conic d, α = o e^−σ)."""
    rank = wp.tid()
    begin = wp.int32(0)
    if rank > 0:
        begin = ends[rank - 1]
    i = order[rank]
    s = wp.float32(0.0)
    first = wp.vec2()
    second = wp.vec3()
    for e in range(begin, ends[rank]):
        s += gradients[e, 0]
        first += wp.vec2(gradients[e, 1], gradients[e, 2])
        second += wp.vec3(gradients[e, 3], gradients[e, 4], gradients[e, 5])
    conic = conics[i]
    v_centres[i] = -wp.vec2(conic[0] * first[0] + conic[1] * first[1], conic[1] * first[0] + conic[2] * first[1])
    v_conics[i] = wp.vec3(0.5 * second[0], second[1], 0.5 * second[2])
    v_strengths[i] = -s / strengths[i]
    for k in range(v_features.shape[1]):
        v = wp.float32(0.0)
        for e in range(begin, ends[rank]):
            v += gradients[e, _MOMENTS + k]
        v_features[i, k] = v
