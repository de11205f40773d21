# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Light and colour to a picture, in C++ that both the CPU's clang and CUDA compile; `Layers` says the same in words.

A task is sixteen pixels: powers of that many numbers at once, by polynomials good to 1e-6, cost a quarter of torch's.
"""

from __future__ import annotations

import warp as wp

WIDTH = 16
"""Pixels that one task does."""

_SNIPPET = """
    constexpr int W = 3 * 16;
    // log2 by the odd series in (m - 1) / (m + 1), m between sqrt(1/2) and sqrt(2); exp2 by Cephes' polynomial
    const auto power = [](float x, float p) {
        union { float f; int i; } a, b;
        a.f = x;
        const int e = (a.i - 0x3f3504f3) >> 23;
        a.i -= e << 23;
        const float t = (a.f - 1.0f) / (a.f + 1.0f), q = t * t;
        const float log = (float)e + t * (2.885390082f + q * (0.961796694f + q * (0.577078016f + q * 0.412198583f)));
        const float y = p * log;
        const float shifted = y + 12582912.0f;
        const float f = y - (shifted - 12582912.0f);
        float poly = f * 1.535336188e-4f + 1.339887440e-3f;
        poly = poly * f + 9.618437357e-3f;
        poly = poly * f + 5.550332471e-2f;
        poly = poly * f + 2.402264791e-1f;
        poly = poly * f + 6.931472028e-1f;
        poly = poly * f + 1.0f;
        a.f = shifted;
        b.f = poly;
        b.i += a.i << 23;
        return b.f;
    };
    float srgb[W], gain[W], rest[W], added[W];
    for (int k = 0; k < W; ++k) {
        const int pixel = first + k / 3 < count ? first + k / 3 : count - 1, c = k % 3;
        srgb[k] = colour.data[3 * pixel + c];
        gain[k] = 1.0f + soil.data[pixel] * (light.data[3 * pixel + c] - 1.0f);
        rest[k] = 1.0f - tool.data[4 * pixel + 3];
        added[k] = tool.data[4 * pixel + c];
    }
    for (int k = 0; k < W; ++k) {
        const float bright = srgb[k] > 0.04045f ? srgb[k] : 0.04045f;
        const float curve = power((bright + 0.055f) * (1.0f / 1.055f), 2.4f);
        const float linear = (srgb[k] <= 0.04045f ? srgb[k] * (1.0f / 12.92f) : curve) * gain[k] * rest[k] + added[k];
        const float above = linear > 0.0031308f ? linear : 0.0031308f;
        const float root = 1.055f * power(above, 1.0f / 2.4f) - 0.055f;
        const float out = linear <= 0.0031308f ? linear * 12.92f : root;
        srgb[k] = out < 0.0f ? 0.0f : out > 1.0f ? 1.0f : out;
    }
    for (int k = 0; k < W && first + k / 3 < count; ++k) image.data[3 * first + k] = srgb[k];
"""


@wp.func_native(_SNIPPET)
def _developed(
    first: int,
    count: int,
    colour: wp.array(dtype=wp.float32),
    soil: wp.array(dtype=wp.float32),
    light: wp.array(dtype=wp.float32),
    tool: wp.array(dtype=wp.float32),
    image: wp.array(dtype=wp.float32),
): ...


@wp.kernel(enable_backward=False)
def develop(
    count: int,
    colour: wp.array(dtype=wp.float32),
    soil: wp.array(dtype=wp.float32),
    light: wp.array(dtype=wp.float32),
    tool: wp.array(dtype=wp.float32),
    image: wp.array(dtype=wp.float32),
):
    """sRGB of ``count`` pixels from their layers, all contiguous; one task for `WIDTH` pixels."""
    _developed(wp.tid() * wp.static(WIDTH), count, colour, soil, light, tool, image)
