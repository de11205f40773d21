# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""CPU kernels of SSIM: one task per band of rows, both blurs in the first-level cache.

The window is separable. For every output row the five blurred moments (a, b, a², b², ab) are summed down the columns
first (eleven rows, straight through memory), then along the row. With S the similarity as a function of the blurred
moments and g the gradient of the loss by S, the gradient by picture a is W∗(g ∂S/∂W(a)) + 2a W∗(g ∂S/∂W(a²)) +
b W∗(g ∂S/∂W(ab)), where W∗ is the same symmetric blur.
"""

from __future__ import annotations

import warp as wp

BAND = 16
"""Rows per task."""

MAX_CHANNELS = 16
"""Most interleaved channels the row buffers have room for."""

WINDOW = 11
"""Side of the window, px."""

C1 = 0.01**2
C2 = 0.03**2

# Columns are taken in blocks, so that the padded row buffers live on the stack whatever the picture's width. For each
# block of a row, so many sums are blurred down the columns, where DOWN adds what a row of the window gives, and then
# along the row; FINISH has them in ``blurred``.
_BAND = """
    const int y_begin = band * BAND, y_end = y_begin + BAND < height ? y_begin + BAND : height;
    const int edge = HALF * channels;
    const long long plane = (long long)height * row;
    float wide[SUMS][BLOCK + 2 * EDGE], blurred[SUMS][BLOCK];
    for (int y = y_begin; y < y_end; ++y) {
        const int first = y - HALF > 0 ? y - HALF : 0, last = y + HALF < height - 1 ? y + HALF : height - 1;
        for (int x0 = 0; x0 < row; x0 += BLOCK) {
            const int n = row - x0 < BLOCK ? row - x0 : BLOCK;
            const int from = x0 - edge > 0 ? x0 - edge : 0, to = x0 + n + edge < row ? x0 + n + edge : row;
            for (int m = 0; m < SUMS; ++m) for (int i = 0; i < n + 2 * edge; ++i) wide[m][i] = 0.0f;
            const int shift = from - (x0 - edge), count = to - from;
            for (int j = first; j <= last; ++j) {
                const float weight = window.data[j - y + HALF];
                const long long here = (long long)j * row + from;
                DOWN
            }
            for (int m = 0; m < SUMS; ++m) {
                for (int i = 0; i < n; ++i) blurred[m][i] = 0.0f;
                for (int k = 0; k < WINDOW; ++k) {
                    const float weight = window.data[k];
                    const float* source = wide[m] + k * channels;
                    #pragma clang loop vectorize(enable) interleave(enable)
                    for (int i = 0; i < n; ++i) blurred[m][i] += weight * source[i];
                }
            }
            const long long at = (long long)y * row + x0;
            FINISH
        }
    }
"""

_SIMILARITY_DOWN = """
                const float *pa = a.data + here, *pb = b.data + here;
                #pragma clang loop vectorize(enable) interleave(enable)
                for (int i = 0; i < count; ++i) {
                    const float u = pa[i], v = pb[i], wu = weight * u, wv = weight * v;
                    wide[0][shift + i] += wu;
                    wide[1][shift + i] += wv;
                    wide[2][shift + i] += wu * u;
                    wide[3][shift + i] += wv * v;
                    wide[4][shift + i] += wu * v;
                }
"""

_SIMILARITY_FINISH = """
            #pragma clang loop vectorize(enable)
            for (int i = 0; i < n; ++i) {
                const float mu_a = blurred[0][i], mu_b = blurred[1][i];
                const float var_a = blurred[2][i] - mu_a * mu_a, var_b = blurred[3][i] - mu_b * mu_b;
                const float cov = blurred[4][i] - mu_a * mu_b;
                const float l = 2.0f * mu_a * mu_b + C1, c = 2.0f * cov + C2;
                const float p = 1.0f / (mu_a * mu_a + mu_b * mu_b + C1), q = 1.0f / (var_a + var_b + C2);
                const float s = l * p * c * q;
                out.data[at + i] = s;
                // by a², by ab, and by the blurred mean, of which variance and covariance depend, too
                blurred[0][i] = -s * q;
                blurred[1][i] = 2.0f * l * p * q;
                blurred[2][i] = 2.0f * p * (mu_b * c * q - mu_a * s) + 2.0f * mu_a * s * q - mu_b * blurred[1][i];
                blurred[3][i] = 2.0f * p * (mu_a * c * q - mu_b * s) + 2.0f * mu_b * s * q - mu_a * blurred[1][i];
            }
            float* slopes[2] = {slopes_a.shape[0] > 0 ? slopes_a.data : nullptr,
                                slopes_b.shape[0] > 0 ? slopes_b.data : nullptr};
            for (int picture = 0; picture < 2; ++picture)
                for (int i = 0; slopes[picture] && i < n; ++i) {
                    slopes[picture][at + i] = blurred[2 + picture][i];
                    slopes[picture][plane + at + i] = blurred[0][i];
                    slopes[picture][2 * plane + at + i] = blurred[1][i];
                }
"""

_GRADIENT_DOWN = """
                const float *g = upstream.data + here, *s0 = slopes.data + here, *s1 = s0 + plane, *s2 = s1 + plane;
                #pragma clang loop vectorize(enable) interleave(enable)
                for (int i = 0; i < count; ++i) {
                    const float scaled = weight * g[i];
                    wide[0][shift + i] += scaled * s0[i];
                    wide[1][shift + i] += scaled * s1[i];
                    wide[2][shift + i] += scaled * s2[i];
                }
"""

_GRADIENT_FINISH = """
            for (int i = 0; i < n; ++i)
                out.data[at + i] = blurred[0][i] + 2.0f * own.data[at + i] * blurred[1][i]
                                 + other.data[at + i] * blurred[2][i];
"""


def _snippet(sums: int, down: str, finish: str) -> str:
    """C++ text of a band's task."""
    return f"""{{
    #pragma clang fp contract(on)
    constexpr float C1 = {C1!r}f, C2 = {C2!r}f;
    constexpr int SUMS = {sums}, BAND = {BAND}, WINDOW = {WINDOW}, HALF = WINDOW / 2, BLOCK = 256;
    constexpr int EDGE = HALF * {MAX_CHANNELS};
    {_BAND.replace("DOWN", down.strip()).replace("FINISH", finish.strip())}}}"""


@wp.func_native(_snippet(5, _SIMILARITY_DOWN, _SIMILARITY_FINISH))
def _similarity_band(
    band: int,
    height: int,
    row: int,
    channels: int,
    a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    window: wp.array(dtype=float),
    out: wp.array(dtype=float),
    slopes_a: wp.array(dtype=float),
    slopes_b: wp.array(dtype=float),
): ...


@wp.kernel(enable_backward=False, module="unique")
def similarity(
    first: int,
    height: int,
    row: int,
    channels: int,
    a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    window: wp.array(dtype=float),
    out: wp.array(dtype=float),
    slopes_a: wp.array(dtype=float),
    slopes_b: wp.array(dtype=float),
):
    """SSIM map of two pictures (height, row), channels interleaved, and its slopes (3, height, row) where wanted."""
    _similarity_band(first + wp.tid(), height, row, channels, a, b, window, out, slopes_a, slopes_b)


@wp.func_native(_snippet(3, _GRADIENT_DOWN, _GRADIENT_FINISH))
def _gradient_band(
    band: int,
    height: int,
    row: int,
    channels: int,
    own: wp.array(dtype=float),
    other: wp.array(dtype=float),
    upstream: wp.array(dtype=float),
    window: wp.array(dtype=float),
    slopes: wp.array(dtype=float),
    out: wp.array(dtype=float),
): ...


@wp.kernel(enable_backward=False, module="unique")
def similarity_gradient(
    first: int,
    height: int,
    row: int,
    channels: int,
    own: wp.array(dtype=float),
    other: wp.array(dtype=float),
    upstream: wp.array(dtype=float),
    window: wp.array(dtype=float),
    slopes: wp.array(dtype=float),
    out: wp.array(dtype=float),
):
    """Gradient of a loss by the picture ``own``, from the map's ``upstream`` gradient and that picture's slopes."""
    _gradient_band(first + wp.tid(), height, row, channels, own, other, upstream, window, slopes, out)
