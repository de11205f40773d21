# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""CPU kernels: one task per 16 × 16 tile, one 8-wide vector per half row of pixels.

Written in C++ for the clang that comes with Warp (``wp.func_native``): arrays of a whole tile stay in the first-level
cache, Gaussians are the outer loop, rows that a Gaussian's ellipse misses are skipped for each half of the tile, and a
row is eight pixels without a branch (polynomial exp2). A negative transmittance marks a finished pixel; its magnitude
is the final value.

The backward pass walks front to back again. With S, the part of (colour · gradient) that is still to come, the
derivative of the loss by a Gaussian's opacity in a pixel is T (c·v) − S / (1 − α). Position, shape and opacity need six
moments of ∂L/∂σ over the pixels; a lane is a column, so three sums (weights 1, dy, dy²) stay in registers and dx enters
once per half tile.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil.splats import constants
from splatsoil.splats.kernels_binning import HEADER, MOMENTS

PARTS = 1
"""Rows of gradients for every entry: a tile is one task."""

_COMMON = """
    typedef float v8 __attribute__((ext_vector_type(8)));
    typedef int i8 __attribute__((ext_vector_type(8)));
    const v8 lane = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const int x0 = (tile % tiles_x) * 16, y0 = (tile / tiles_x) * 16;
    const int columns = width - x0 < 16 ? width - x0 : 16, lines = height - y0 < 16 ? height - y0 : 16;
    const int begin = starts.data[tile], end = starts.data[tile + 1];
    int top[2] = {0, 0}, bottom[2] = {lines - 1, lines - 1};
    v8 T[2][16];
    for (int h = 0; h < 2; ++h)
        for (int r = 0; r < 16; ++r) {
            const v8 inside = lane + 8.0f * h < (float)columns ? (v8)(1.0f) : (v8)(-1.0f);
            T[h][r] = r < lines ? inside : (v8)(-1.0f);
        }
"""

# The rows of each half of the tile that the ellipse dy = slope·dx ± √(room − bend·dx²) reaches; tip is dx of its lowest
# point, and the highest one lies opposite. Sixteen Gaussians at a time and without branches, apart from the loops over
# rows, whose length would otherwise be known too late for the processor to run ahead.
_RANGES = """
        const int count = end - chunk < 16 ? end - chunk : 16;
        int from[16][2], to[16][2];
        for (int i = 0; i < count; ++i) {
            const float* g = rows.data + (long long)ranks.data[chunk + i] * STRIDE;
            for (int h = 0; h < 2; ++h) {
                const float left = (float)(x0 + 8 * h) + 0.5f - g[0], right = left + 7.0f, tip = g[8];
                const float low = tip < left ? left : tip > right ? right : tip;
                const float high = -tip < left ? left : -tip > right ? right : -tip;
                const float low_room = g[10] - g[11] * (low * low), high_room = g[10] - g[11] * (high * high);
                const float middle = g[1] - 0.5f - (float)y0;
                const float first = g[9] * high + middle - __builtin_sqrtf(high_room > 0.0f ? high_room : 0.0f);
                const float last = g[9] * low + middle + __builtin_sqrtf(low_room > 0.0f ? low_room : 0.0f);
                const float begin_row = (float)top[h], end_row = (float)bottom[h];
                const int start = (int)__builtin_ceilf(first > begin_row ? first : begin_row);
                from[i][h] = ((low_room < 0.0f) | (high_room < 0.0f)) ? 16 : start;
                to[i][h] = (int)__builtin_floorf(last < end_row ? last : end_row);
            }
        }
"""

_GAUSSIAN = """
                const v8 dx = lane + ((float)(x0 + 8 * h) - g[0]);
                const v8 quadratic = (dx * dx) * g[2] + g[5];
                const v8 linear = dx * g[3];
"""

# 2^p by rounding to an integer (adding 1.5·2²³ leaves it in the low bits) and a polynomial on [−½, ½] (from Cephes).
# A finished pixel has t < 0 and so stays finished: t (1 − alpha) < 0.
_ALPHA = """
                const float dy = (float)(y0 + r) + 0.5f - g[1];
                v8 p = (linear + dy * g[4]) * dy + quadratic;
                p = __builtin_elementwise_max(p, (v8)(-64.0f));
                const v8 shifted = p + 12582912.0f;
                const v8 f = p - (shifted - 12582912.0f);
                v8 poly = f * 1.535336188e-4f + 1.339887440e-3f;
                poly = poly * f + 9.618437357e-3f;
                poly = poly * f + 5.550332471e-2f;
                poly = poly * f + 2.402264791e-1f;
                poly = poly * f + 6.931472028e-1f;
                poly = poly * f + 1.0f;
                const i8 exponent = __builtin_bit_cast(i8, shifted) << 23;
                const v8 raw = __builtin_bit_cast(v8, __builtin_bit_cast(i8, poly) + exponent);
                v8 alpha = __builtin_elementwise_min(raw, (v8)(ALPHA_MAX));
                alpha = alpha >= ALPHA_MIN ? alpha : (v8)(0.0f);
                const v8 t = T[h][r];
                const v8 after = t - t * alpha;
                const i8 stop = after <= TRANSMITTANCE_MIN;
                T[h][r] = stop ? -__builtin_elementwise_abs(t) : after;
                const v8 w = stop ? (v8)(0.0f) : alpha * t;
"""

# rows at the upper and lower end of each half that are finished need no more work
_SATURATED = """
        for (int h = 0; h < 2; ++h) {
            while (top[h] <= bottom[h] && !__builtin_reduce_or(T[h][top[h]] > 0.0f)) ++top[h];
            while (top[h] <= bottom[h] && !__builtin_reduce_or(T[h][bottom[h]] > 0.0f)) --bottom[h];
        }
        if (top[0] > bottom[0] && top[1] > bottom[1]) break;
"""

_FORWARD = """
    COMMON
    v8 sum[2][16][K];
    for (int h = 0; h < 2; ++h) for (int r = 0; r < 16; ++r) for (int k = 0; k < K; ++k) sum[h][r][k] = 0.0f;
    for (int chunk = begin; chunk < end; chunk += 16) {
        RANGES
        for (int i = 0; i < count; ++i) {
            const float* g = rows.data + (long long)ranks.data[chunk + i] * STRIDE;
            for (int h = 0; h < 2; ++h) {
                GAUSSIAN
                for (int r = from[i][h]; r <= to[i][h]; ++r) {
                    ALPHA
                    #pragma unroll
                    for (int k = 0; k < K; ++k) sum[h][r][k] = w * g[HEADER + k] + sum[h][r][k];
                }
            }
        }
        SATURATED
    }
    for (int r = 0; r < lines; ++r) {
        for (int x = 0; x < columns; ++x) {
            const long long pixel = (long long)(y0 + r) * width + x0 + x;
            const float left = __builtin_fabsf(T[x >> 3][r][x & 7]);
            transmittance.data[pixel] = left;
            for (int k = 0; k < K; ++k)
                image.data[pixel * K + k] = sum[x >> 3][r][k][x & 7] + left * background.data[k];
        }
    }
"""

_BACKWARD = """
    typedef float v4 __attribute__((ext_vector_type(4)));
    COMMON
    v8 v[2][16][K], S[2][16];
    for (int h = 0; h < 2; ++h) for (int r = 0; r < 16; ++r) {
        S[h][r] = 0.0f;
        for (int k = 0; k < K; ++k) v[h][r][k] = 0.0f;
    }
    for (int r = 0; r < lines; ++r) {
        for (int x = 0; x < columns; ++x) {
            const long long pixel = (long long)(y0 + r) * width + x0 + x;
            float s = transmittance.data[pixel] * v_transmittance.data[pixel];
            for (int k = 0; k < K; ++k) {
                const float gradient = v_image.data[pixel * K + k];
                v[x >> 3][r][k][x & 7] = gradient;
                s += gradient * image.data[pixel * K + k];
            }
            S[x >> 3][r][x & 7] = s;
        }
    }
    for (int chunk = begin; chunk < end; chunk += 16) {
        RANGES
        for (int i = 0; i < count; ++i) {
        const float* g = rows.data + (long long)ranks.data[chunk + i] * STRIDE;
        v8 sums[MOMENTS + K];
        for (int j = 0; j < MOMENTS + K; ++j) sums[j] = 0.0f;
        for (int h = 0; h < 2; ++h) {
            GAUSSIAN
            v8 m0 = 0.0f, m1 = 0.0f, m2 = 0.0f;
            for (int r = from[i][h]; r <= to[i][h]; ++r) {
                ALPHA
                v8 cv = v[h][r][0] * g[HEADER];
                #pragma unroll
                for (int k = 1; k < K; ++k) cv = v[h][r][k] * g[HEADER + k] + cv;
                #pragma unroll
                for (int k = 0; k < K; ++k) sums[MOMENTS + k] = w * v[h][r][k] + sums[MOMENTS + k];
                const v8 part = w * cv;
                const v8 rest = S[h][r] - part;
                S[h][r] = rest;
                // nothing where the pixel is finished or alpha was clamped
                v8 vs = rest * (alpha / (1.0f - alpha)) - part;
                vs = (stop | (raw > ALPHA_MAX)) ? (v8)(0.0f) : vs;
                m0 += vs;
                m1 = vs * dy + m1;
                m2 = vs * (dy * dy) + m2;
            }
            const v8 dx_m0 = dx * m0;
            sums[0] += m0;
            sums[1] += dx_m0;
            sums[2] += m1;
            sums[3] = dx * dx_m0 + sums[3];
            sums[4] = dx * m1 + sums[4];
            sums[5] += m2;
        }
        float* out = gradients.data + (long long)entries.data[chunk + i] * (MOMENTS + K);
        #pragma unroll
        for (int j = 0; j < MOMENTS + K; ++j) {
            const v4 a = sums[j].lo + sums[j].hi;
            out[j] = (a.x + a.z) + (a.y + a.w);
        }
        }
        SATURATED
    }
"""


def _snippet(template: str, channels: int) -> str:
    """C++ text of a template for ``channels`` features."""
    text = template
    for name, part in (
        ("COMMON", _COMMON),
        ("RANGES", _RANGES),
        ("GAUSSIAN", _GAUSSIAN),
        ("ALPHA", _ALPHA),
        ("SATURATED", _SATURATED),
    ):
        text = text.replace(f" {name}\n", part)
    return f"""{{
    #pragma clang fp contract(on)
    constexpr int K = {channels}, HEADER = {HEADER}, MOMENTS = {MOMENTS}, STRIDE = {HEADER + channels};
    constexpr float ALPHA_MAX = {constants.ALPHA_MAX!r}f, ALPHA_MIN = {constants.ALPHA_MIN!r}f;
    constexpr float TRANSMITTANCE_MIN = {constants.TRANSMITTANCE_MIN!r}f;
    {text}}}"""


@cache
def forward_kernel(channels: int) -> Any:
    """Kernel over tiles that blends ``channels`` features; one kernel is compiled for each number of channels."""

    @wp.func_native(_snippet(_FORWARD, channels))
    def draw(
        tile: int,
        width: int,
        height: int,
        tiles_x: int,
        rows: wp.array2d(dtype=float),
        starts: wp.array(dtype=wp.int32),
        ranks: wp.array(dtype=wp.int32),
        background: wp.array(dtype=float),
        image: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def splat_forward(
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
        draw(first + wp.tid(), width, height, tiles_x, rows, starts, ranks, background, image, transmittance)

    return splat_forward


@cache
def backward_kernel(channels: int) -> Any:
    """Kernel over tiles that writes one row of moments and feature gradients for every entry."""

    @wp.func_native(_snippet(_BACKWARD, channels))
    def pull(
        tile: int,
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
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def splat_backward(
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
        pull(
            first + wp.tid(), width, height, tiles_x, rows, starts, ranks, entries,
            image, transmittance, v_image, v_transmittance, gradients,
        )  # fmt: skip

    return splat_backward
