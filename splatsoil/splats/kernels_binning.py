# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels, for CPU and CUDA: pack Gaussians by rank, count and list the tiles they touch, gather gradients."""

from __future__ import annotations

from functools import cache

import warp as wp

from splatsoil.splats import constants

HEADER = 12
"""Numbers in front of the features in a packed row: x, y, the quadratic, mixed and other quadratic coefficient of log₂
opacity, log₂ strength, reach in y, nothing (it makes a row of four features one cache line), and the ellipse of
opacity 1/255 as dy = slope·dx ± √(room − bend·dx²): dx of its lowest point, slope, room, bend."""

MOMENTS = 6
"""Moments of ∂L/∂σ per entry (1, dx, dy, dx², dx·dy, dy²), in front of the feature gradients."""

_HEADER = wp.constant(wp.int32(HEADER))
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


@wp.struct
class Ellipse:
    """Where a Gaussian's opacity is 1/255: dx = slope·dy ± √(room − bend·dy²) around (x, y)."""

    x: float
    y: float
    reach: float
    tip: float
    slope: float
    room: float
    bend: float


@wp.func
def _ellipse(rows: wp.array2d(dtype=float), rank: int):
    a = -2.0 * rows[rank, 2]
    b = -rows[rank, 3]
    c = -2.0 * rows[rank, 4]
    # everything is scaled by log₂ e; a little larger, against rounding
    cut = (2.0 * (rows[rank, 5] - _LOG2_ALPHA_MIN)) * 1.0001 + 1.0e-4
    determinant = _determinant(a, b, c)
    ellipse = Ellipse()
    ellipse.x = rows[rank, 0]
    ellipse.y = rows[rank, 1]
    ellipse.reach = rows[rank, 6]
    ellipse.tip = -b * wp.sqrt(cut / (c * determinant))
    ellipse.slope = -b / a
    ellipse.room = cut / a
    ellipse.bend = determinant / (a * a)
    return ellipse


@wp.func
def _tile_rows(ellipse: Ellipse, tiles_y: int):
    """First and one-past-last row of tiles that the ellipse touches."""
    return _tiles_between(ellipse.y - ellipse.reach, ellipse.y + ellipse.reach, tiles_y)


@wp.func
def _tile_span(ellipse: Ellipse, tile_row: int, tiles_x: int):
    """First and one-past-last tile column that the ellipse touches in one row of tiles."""
    top = float(tile_row) * _SIDE + 0.5 - ellipse.y
    bottom = top + _SIDE - 1.0
    # rightmost point of the ellipse, moved into the band of rows; the leftmost one lies opposite
    dy_right = wp.clamp(ellipse.tip, top, bottom)
    dy_left = wp.clamp(-ellipse.tip, top, bottom)
    right = ellipse.slope * dy_right + wp.sqrt(wp.max(ellipse.room - ellipse.bend * dy_right * dy_right, 0.0))
    left = ellipse.slope * dy_left - wp.sqrt(wp.max(ellipse.room - ellipse.bend * dy_left * dy_left, 0.0))
    return _tiles_between(ellipse.x + left, ellipse.x + right, tiles_x)


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
    """Write a rank's row, and count the tiles it touches; none, and no row, for what can't be seen."""
    rank = wp.tid()
    i = order[rank]
    if reaches[i][0] <= 0.0:
        counts[rank] = 0
        return
    conic = conics[i]
    rows[rank, 0] = centres[i][0]
    rows[rank, 1] = centres[i][1]
    rows[rank, 2] = -0.5 * _LOG2E * conic[0]
    rows[rank, 3] = -_LOG2E * conic[1]
    rows[rank, 4] = -0.5 * _LOG2E * conic[2]
    rows[rank, 5] = wp.log2(strengths[i])
    rows[rank, 6] = reaches[i][1]
    rows[rank, 7] = 0.0
    # a little larger than the ellipse, against rounding
    cut = 2.0 * wp.log(strengths[i] / _ALPHA_MIN) * 1.0001 + 1.0e-4
    determinant = _determinant(conic[0], conic[1], conic[2])
    rows[rank, 8] = -conic[1] * wp.sqrt(cut / (conic[0] * determinant))
    rows[rank, 9] = -conic[1] / conic[2]
    rows[rank, 10] = cut / conic[2]
    rows[rank, 11] = determinant / (conic[2] * conic[2])
    for k in range(features.shape[1]):
        rows[rank, _HEADER + k] = features[i, k]
    ellipse = _ellipse(rows, rank)
    band = _tile_rows(ellipse, tiles_y)
    total = wp.int32(0)
    for tile_row in range(band[0], band[1]):
        span = _tile_span(ellipse, tile_row, tiles_x)
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
    if entry == ends[rank]:
        return
    ellipse = _ellipse(rows, rank)
    band = _tile_rows(ellipse, tiles_y)
    for tile_row in range(band[0], band[1]):
        span = _tile_span(ellipse, tile_row, tiles_x)
        for column in range(span[0], span[1]):
            tiles[entry] = tile_row * tiles_x + column
            ranks[entry] = rank
            entry += 1


@cache
def gather_kernel(channels: int):
    """Kernel over ranks that sums their entries' rows of gradients for ``channels`` features."""
    Row = wp.types.vector(length=MOMENTS + channels, dtype=float)
    Features = wp.types.vector(length=channels, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    def gather(
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        gradients: wp.array(dtype=Row),
        conics: wp.array(dtype=wp.vec3),
        strengths: wp.array(dtype=float),
        v_centres: wp.array(dtype=wp.vec2),
        v_conics: wp.array(dtype=wp.vec3),
        v_strengths: wp.array(dtype=float),
        v_features: wp.array(dtype=Features),
    ):
        """Sum in order, and turn moments of ∂L/∂σ into gradients (σ = ½ dᵀ conic d, α = o e^−σ)."""
        rank = wp.tid()
        begin = wp.int32(0)
        if rank > 0:
            begin = ends[rank - 1]
        if begin == ends[rank]:
            return
        s = Row()
        for e in range(begin, ends[rank]):
            s += gradients[e]
        i = order[rank]
        conic = conics[i]
        v_centres[i] = -wp.vec2(conic[0] * s[1] + conic[1] * s[2], conic[1] * s[1] + conic[2] * s[2])
        v_conics[i] = wp.vec3(0.5 * s[3], s[4], 0.5 * s[5])
        v_strengths[i] = -s[0] / strengths[i]
        v = Features()
        for k in range(channels):
            v[k] = s[MOMENTS + k]
        v_features[i] = v

    return gather
