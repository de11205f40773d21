"""CPU kernels: one task per 16 × 16 tile, one 16-wide vector per row of pixels.

Written in C++ for the clang that comes with Warp (``wp.func_native``): arrays of a whole tile stay in the first-level
cache, Gaussians are the outer loop, rows out of a Gaussian's reach are skipped, and a row is sixteen pixels without a
branch (polynomial exp2). A negative transmittance marks a finished pixel; its magnitude is the final value.

The backward pass walks front to back again. With S, the part of (colour · gradient) that is still to come, the
derivative of the loss by a Gaussian's opacity in a pixel is T (c·v) − S / (1 − α). Position, shape and opacity need six
moments of ∂L/∂σ over the pixels; a lane is a column, so three sums (weights 1, dy, dy²) stay in registers and dx enters
once per tile.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil.splats import constants
from splatsoil.splats.binning import HEADER

MOMENTS = 6
"""Moments of ∂L/∂σ per entry (1, dx, dy, dx², dx·dy, dy²), in front of the feature gradients."""

_COMMON = """
    typedef float v16 __attribute__((ext_vector_type(16)));
    typedef int i16 __attribute__((ext_vector_type(16)));
    const v16 lane = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f,
                      8.5f, 9.5f, 10.5f, 11.5f, 12.5f, 13.5f, 14.5f, 15.5f};
    const int x0 = (tile % tiles_x) * 16, y0 = (tile / tiles_x) * 16;
    const int columns = width - x0 < 16 ? width - x0 : 16, lines = height - y0 < 16 ? height - y0 : 16;
    const int begin = starts.data[tile], end = starts.data[tile + 1];
    v16 T[16];
    for (int r = 0; r < 16; ++r)
        T[r] = r < lines ? (lane < (float)columns ? (v16)(1.0f) : (v16)(-1.0f)) : (v16)(-1.0f);
"""

_GAUSSIAN = """
        const float* g = rows.data + (long long)ranks.data[e] * STRIDE;
        const v16 dx = lane + ((float)x0 - g[0]);
        const float from = g[1] - g[6] - 0.5f - (float)y0, to = g[1] + g[6] - 0.5f - (float)y0;
        const int r0 = from > 0.0f ? (int)__builtin_ceilf(from) : 0;
        const int r1 = to < (float)(lines - 1) ? (int)__builtin_floorf(to) : lines - 1;
        const v16 quadratic = g[5] + (dx * dx) * g[2];
        const v16 linear = dx * g[3];
"""

# 2^p by rounding to an integer (adding 1.5·2²³ leaves it in the low bits) and a polynomial on [−½, ½] (from Cephes)
_ALPHA = """
            const float dy = (float)(y0 + r) + 0.5f - g[1];
            v16 p = quadratic + dy * (linear + dy * g[4]);
            p = __builtin_elementwise_max(p, (v16)(-64.0f));
            const v16 shifted = p + 12582912.0f;
            const v16 f = p - (shifted - 12582912.0f);
            v16 poly = f * 1.535336188e-4f + 1.339887440e-3f;
            poly = poly * f + 9.618437357e-3f;
            poly = poly * f + 5.550332471e-2f;
            poly = poly * f + 2.402264791e-1f;
            poly = poly * f + 6.931472028e-1f;
            poly = poly * f + 1.0f;
            const i16 exponent = __builtin_bit_cast(i16, shifted) << 23;
            const v16 raw = __builtin_bit_cast(v16, __builtin_bit_cast(i16, poly) + exponent);
            v16 alpha = __builtin_elementwise_min(raw, (v16)(ALPHA_MAX));
            v16 t = T[r];
            alpha = ((alpha >= ALPHA_MIN) & (t > 0.0f)) ? alpha : (v16)(0.0f);
            const v16 after = t - t * alpha;
            const i16 stop = (after <= TRANSMITTANCE_MIN) & (alpha > 0.0f);
            T[r] = stop ? -t : after;
            const v16 w = stop ? (v16)(0.0f) : alpha * t;
"""

_SATURATED = """
        if (((e - begin) & 15) == 15) {
            i16 alive = T[0] > 0.0f;
            for (int r = 1; r < 16; ++r) alive |= T[r] > 0.0f;
            if (!__builtin_reduce_or(alive)) break;
        }
"""

_FORWARD = """
    COMMON
    v16 sum[K][16];
    for (int k = 0; k < K; ++k) for (int r = 0; r < 16; ++r) sum[k][r] = 0.0f;
    for (int e = begin; e < end; ++e) {
        GAUSSIAN
        for (int r = r0; r <= r1; ++r) {
            ALPHA
            #pragma unroll
            for (int k = 0; k < K; ++k) sum[k][r] += w * g[8 + k];
        }
        SATURATED
    }
    for (int r = 0; r < lines; ++r) {
        for (int x = 0; x < columns; ++x) {
            const long long pixel = (long long)(y0 + r) * width + x0 + x;
            const float left = __builtin_fabsf(T[r][x]);
            transmittance.data[pixel] = left;
            for (int k = 0; k < K; ++k) image.data[pixel * K + k] = sum[k][r][x] + left * background.data[k];
        }
    }
"""

_BACKWARD = """
    COMMON
    typedef float v8 __attribute__((ext_vector_type(8)));
    typedef float v4 __attribute__((ext_vector_type(4)));
    const auto total = [](v16 a) {
        const v8 b = a.lo + a.hi;
        const v4 c = b.lo + b.hi;
        return (c.x + c.z) + (c.y + c.w);
    };
    v16 v[K][16], S[16];
    for (int r = 0; r < 16; ++r) {
        S[r] = 0.0f;
        for (int k = 0; k < K; ++k) v[k][r] = 0.0f;
        for (int x = 0; r < lines && x < columns; ++x) {
            const long long pixel = (long long)(y0 + r) * width + x0 + x;
            float s = transmittance.data[pixel] * v_transmittance.data[pixel];
            for (int k = 0; k < K; ++k) {
                const float gradient = v_image.data[pixel * K + k];
                v[k][r][x] = gradient;
                s += gradient * image.data[pixel * K + k];
            }
            S[r][x] = s;
        }
    }
    for (int e = begin; e < end; ++e) {
        GAUSSIAN
        v16 m0 = 0.0f, m1 = 0.0f, m2 = 0.0f, vf[K];
        for (int k = 0; k < K; ++k) vf[k] = 0.0f;
        for (int r = r0; r <= r1; ++r) {
            ALPHA
            v16 cv = g[8] * v[0][r];
            #pragma unroll
            for (int k = 1; k < K; ++k) cv += g[8 + k] * v[k][r];
            #pragma unroll
            for (int k = 0; k < K; ++k) vf[k] += w * v[k][r];
            const v16 left = S[r] - w * cv;
            S[r] = left;
            // zero where nothing was blended or where alpha was clamped
            v16 vs = left * alpha / (1.0f - alpha) - w * cv;
            vs = ((w > 0.0f) & (raw <= ALPHA_MAX)) ? vs : (v16)(0.0f);
            m0 += vs;
            m1 += vs * dy;
            m2 += vs * (dy * dy);
        }
        float* out = gradients.data + (long long)entries.data[e] * (6 + K);
        const v16 sums[6 + K] = {m0, dx * m0, m1, dx * dx * m0, dx * m1, m2};
        #pragma unroll
        for (int i = 0; i < 6; ++i) out[i] = total(sums[i]);
        #pragma unroll
        for (int k = 0; k < K; ++k) out[6 + k] = total(vf[k]);
        SATURATED
    }
"""


def _snippet(template: str, channels: int) -> str:
    """C++ text of a template for ``channels`` features."""
    text = template
    for name, part in (("COMMON", _COMMON), ("GAUSSIAN", _GAUSSIAN), ("ALPHA", _ALPHA), ("SATURATED", _SATURATED)):
        text = text.replace(f" {name}\n", part)
    return f"""
    constexpr int K = {channels}, STRIDE = {HEADER + channels};
    constexpr float ALPHA_MAX = {constants.ALPHA_MAX!r}f, ALPHA_MIN = {constants.ALPHA_MIN!r}f;
    constexpr float TRANSMITTANCE_MIN = {constants.TRANSMITTANCE_MIN!r}f;
    {text}"""


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
