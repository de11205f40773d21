# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""The sky over each cell of a relief, in C++ that both the CPU's clang and CUDA compile.

A task is sixteen cells of a row on the CPU, so that the loop over them fills vector registers, and one cell on a GPU,
where a map has too few cells to keep it at work otherwise.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from splatsoil.scene.kernels_maps import PLACE, Grid

WIDTH = 16
"""Cells of a row that one task does on a CPU."""

WIDTH_SOURCE = f"""
#if defined(__CUDA_ARCH__)
    constexpr int W = 1;
#else
    constexpr int W = {WIDTH};
#endif
    const int first = group * W;
"""
"""Of C++ that does a group: its width, and its first cell."""

_NOTHING = 1.0e6
"""A height beyond all others, m."""

_SNIPPET = """
    constexpr int S = STRIDE;
    const int ny = height.shape[0], nx = height.shape[1], across = wide.shape[1];
    const int i = row * S;
    const float* surface = wide.data + (i + margin_y) * across + margin_x + first * S;
    const float* under = below.data + (i + margin_y) * across + margin_x + first * S;
    const float* over = above.data + (i + margin_y) * across + margin_x + first * S;
    float here[W], nx_[W], ny_[W], up[W], along[W], slope[W], low[W], high[W], sum[W];
    for (int l = 0; l < W; ++l) {
        const int j = (first + l) * S < nx ? (first + l) * S : nx - 1;
        here[l] = height.data[i * nx + j];
        const float* n = (const float*)normal.data + 3 * (i * nx + j);
        nx_[l] = n[0]; ny_[l] = n[1]; up[l] = n[2];
        sum[l] = 0.0f;
    }
    for (int a = 0; a < azimuths; ++a) {
        const float c = directions.data[2 * a], s = directions.data[2 * a + 1];
        for (int l = 0; l < W; ++l) {
            along[l] = c * nx_[l] + s * ny_[l];
            slope[l] = -along[l] / up[l];
            low[l] = NOTHING; high[l] = -NOTHING;
        }
        for (int k = a * looks; k < (a + 1) * looks; ++k) {
            const int offset = offsets.data[k];
            const float inverse = inverses.data[k];
            for (int l = 0; l < W; ++l) {
                const float rise = (surface[offset + l * S] - here[l]) * inverse;
                slope[l] = rise > slope[l] ? rise : slope[l];
            }
            if (TOOL)
                for (int l = 0; l < W; ++l) {
                    const float b = (under[offset + l * S] - here[l]) * inverse;
                    const float t = (over[offset + l * S] - here[l]) * inverse;
                    low[l] = b < low[l] ? b : low[l];
                    high[l] = t > high[l] ? t : high[l];
                }
        }
        for (int l = 0; l < W; ++l) {
            const float horizon = WEDGE(slope[l], up[l], along[l]);
            if (TOOL) {
                const float b = low[l] > slope[l] ? low[l] : slope[l];
                const float taken = WEDGE(high[l], up[l], along[l]) - WEDGE(b, up[l], along[l]);
                sum[l] += high[l] > b ? taken : 0.0f;
            } else
                sum[l] += 0.5f * up[l] + 0.78539816f * along[l] - horizon;
        }
    }
    for (int l = 0; l < W && first + l < result.shape[1]; ++l) result.data[row * result.shape[1] + first + l] = sum[l];
"""

# Light of a slice of uniform sky below a slope, up to a constant: the antiderivative of (up sin e + along cos e) cos e;
# the arc tangent is Abramowitz & Stegun's 4.4.49, good to 1e-5.
_WEDGE = """[](float slope, float up, float along) {
        const float size = slope < 0.0f ? -slope : slope;
        const float x = size > 1.0f ? 1.0f / size : size, q = x * x;
        const float p = x * (0.9998660f + q * (-0.3302995f + q * (0.1801410f + q * (-0.0851330f + q * 0.0208351f))));
        const float angle = size > 1.0f ? 1.57079633f - p : p;
        const float rest = 1.0f / (1.0f + slope * slope);
        return 0.5f * up * (1.0f - rest) + 0.5f * along * ((slope < 0.0f ? -angle : angle) + slope * rest);
    }"""


_SLOPES_SNIPPET = """
    constexpr int CHANNELS = 3;
    const int ny = height.shape[0], nx = height.shape[1], across = wide.shape[1];
    const int plane = wide.shape[0] * across, start = (row + margin_y) * across + margin_x + first;
    float here[W], nx_[W], ny_[W], up[W], along[W], slope[W], before[W], sum[W], light[CHANNELS][W];
    for (int l = 0; l < W; ++l) {
        const int j = first + l < nx ? first + l : nx - 1;
        here[l] = height.data[row * nx + j];
        const float* n = (const float*)normal.data + 3 * (row * nx + j);
        nx_[l] = n[0]; ny_[l] = n[1]; up[l] = n[2];
        sum[l] = 0.0f;
        for (int c = 0; c < CHANNELS; ++c) light[c][l] = 0.0f;
    }
    for (int a = 0; a < azimuths; ++a) {
        for (int l = 0; l < W; ++l) {
            along[l] = directions.data[2 * a] * nx_[l] + directions.data[2 * a + 1] * ny_[l];
            slope[l] = -along[l] / up[l];
            before[l] = WEDGE(slope[l], up[l], along[l]);
        }
        for (int k = a * looks; k < (a + 1) * looks; ++k) {
            const int place = start + offsets.data[k], last = k > a * looks ? start + offsets.data[k - 1] : start;
            const float inverse = inverses.data[k];
            const float run = 1.0f / inverse - (k > a * looks ? 1.0f / inverses.data[k - 1] : 0.0f);
            for (int l = 0; l < W; ++l) {
                const float rise = (wide.data[place + l] - here[l]) * inverse;
                slope[l] = rise > slope[l] ? rise : slope[l];
                const float upto = WEDGE(slope[l], up[l], along[l]);
                const float part = upto - before[l];
                before[l] = upto;
                sum[l] += part;
                const float upper = UPPER(wide.data[place + l] - wide.data[last + l], run);
                for (int c = 0; c < CHANNELS; ++c) {
                    const float* p = sent.data + c * plane + l;
                    light[c][l] += part * (p[last] + upper * (p[place] - p[last]));
                }
            }
        }
    }
    for (int l = 0; l < W && first + l < nx; ++l) {
        const float share = sum[l] > 1.0e-5f ? 1.0f / sum[l] : 0.0f;
        for (int c = 0; c < CHANNELS; ++c) result.data[(c * ny + row) * nx + first + l] = share * light[c][l];
    }
"""

# What soil between two looks sends is the mean of both ends, but for a wall: none of the light on its top is on it.
_UPPER = """[](float climb, float run) {
        return climb <= run ? 0.5f : climb < 2.0f * run ? 1.0f - 0.5f * climb / run : 0.0f;
    }"""

_AROUND_SNIPPET = """
    constexpr int AZIMUTHS = 12;
    const int ny = height.shape[0], nx = height.shape[1];
    const auto look = [&](float x, float y, float* light) {
        PLACE
        const float* p = height.data + i * nx + j;
        const float* s = (const float*)sent.data + 3 * (i * nx + j);
        for (int c = 0; c < 3; ++c) {
            const float low = s[c] + fu * (s[c + 3] - s[c]);
            const float high = s[c + 3 * nx] + fu * (s[c + 3 * nx + 3] - s[c + 3 * nx]);
            light[c] = low + fv * (high - low);
        }
        const float low = p[0] + fu * (p[1] - p[0]), high = p[nx] + fu * (p[nx + 1] - p[nx]);
        return low + fv * (high - low);
    };
    const float up = normal[2] > 0.05f ? normal[2] : 0.05f;  // slopes are finite
    float sky = 0.0f, around[3] = {0.0f, 0.0f, 0.0f}, here[3], last[3], there[3];
    look(place[0], place[1], here);
    for (int a = 0; a < AZIMUTHS; ++a) {
        const float angle = 6.2831853f * ((float)a + 0.5f) / (float)AZIMUTHS;
        const float c = cosf(angle), s = sinf(angle), along = c * normal[0] + s * normal[1];
        const float all = 0.5f * up + 0.78539816f * along;
        float slope = -along / up, before = WEDGE(slope, up, along), below = place[2], run = step;
        if (all - before < 0.01f) continue;  // into the wall
        for (int k = 0; k < 3; ++k) last[k] = here[k];
        for (float r = step; r < reach; r += run) {
            const float top = look(place[0] + r * c, place[1] + r * s, there);
            const float rise = (top - place[2]) / r;
            if (rise > slope) {
                slope = rise;
                const float upto = WEDGE(slope, up, along), part = upto - before;
                const float upper = UPPER(top - below, run);
                for (int k = 0; k < 3; ++k) around[k] += part * (last[k] + upper * (there[k] - last[k]));
                before = upto;
            }
            for (int k = 0; k < 3; ++k) last[k] = there[k];
            below = top;
            run = 0.2f * r > step ? 0.2f * r : step;
        }
        sky += all - before;
    }
    const float share = 2.0f / (float)AZIMUTHS;
    sky *= share;
    sky = sky < 0.0f ? 0.0f : sky > 1.0f ? 1.0f : sky;
    return wp::vec_t<4, float>(share * around[0], share * around[1], share * around[2], sky);
"""


def _source(snippet: str) -> str:
    """A snippet with its width, and what its wedges are."""
    return WIDTH_SOURCE + _with_wedges(snippet)


def _with_wedges(snippet: str) -> str:
    """A snippet with what its wedges are, and the light of what it sees between two looks."""
    text = snippet.replace("WEDGE(", "wedge(").replace("UPPER(", "upper_share(")
    return f"    const auto wedge = {_WEDGE};\n    const auto upper_share = {_UPPER};\n{text}"


@cache
def sky_kernel(stride: int, tool: bool) -> Any:
    """Kernel over (rows, groups) of every ``stride``-th row and column of a map.

    It sums, over the azimuths, the sky that soil leaves open to a cell, or what of that a tool takes; maps with margins
    are wide enough for every look and a group's width times the stride more.
    """
    text = _source(_SNIPPET).replace("STRIDE", str(stride))

    @wp.func_native(text.replace("NOTHING", f"{_NOTHING!r}f").replace("TOOL", "true" if tool else "false"))
    def sky_of_cells(
        row: int,
        group: int,
        height: wp.array2d(dtype=wp.float32),
        normal: wp.array2d(dtype=wp.vec3),
        wide: wp.array2d(dtype=wp.float32),
        below: wp.array2d(dtype=wp.float32),
        above: wp.array2d(dtype=wp.float32),
        margin_x: int,
        margin_y: int,
        directions: wp.array(dtype=wp.float32),
        offsets: wp.array(dtype=wp.int32),
        inverses: wp.array(dtype=wp.float32),
        azimuths: int,
        looks: int,
        result: wp.array2d(dtype=wp.float32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def sky(
        height: wp.array2d(dtype=wp.float32),
        normal: wp.array2d(dtype=wp.vec3),
        wide: wp.array2d(dtype=wp.float32),
        below: wp.array2d(dtype=wp.float32),
        above: wp.array2d(dtype=wp.float32),
        margin_x: int,
        margin_y: int,
        directions: wp.array(dtype=wp.float32),
        offsets: wp.array(dtype=wp.int32),
        inverses: wp.array(dtype=wp.float32),
        azimuths: int,
        looks: int,
        result: wp.array2d(dtype=wp.float32),
    ):
        row, group = wp.tid()
        sky_of_cells(
            row,
            group,
            height,
            normal,
            wide,
            below,
            above,
            margin_x,
            margin_y,
            directions,
            offsets,
            inverses,
            azimuths,
            looks,
            result,
        )

    return sky


@wp.func_native(_with_wedges(_AROUND_SNIPPET.replace("PLACE", PLACE)))
def light_around(
    height: wp.array2d(dtype=wp.float32),
    sent: wp.array2d(dtype=wp.vec3),
    grid: Grid,
    place: wp.vec3,
    normal: wp.vec3,
    step: float,
    reach: float,
) -> wp.vec4:
    """Light ``sent`` by the soil within ``reach`` to a place that slopes in any way, and the share of the sky that this
    leaves open to it; both as for the cells of a map."""


@wp.func_native(_source(_SLOPES_SNIPPET))
def _slopes_of_cells(
    row: int,
    group: int,
    height: wp.array2d(dtype=wp.float32),
    normal: wp.array2d(dtype=wp.vec3),
    wide: wp.array2d(dtype=wp.float32),
    sent: wp.array3d(dtype=wp.float32),
    margin_x: int,
    margin_y: int,
    directions: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.int32),
    inverses: wp.array(dtype=wp.float32),
    azimuths: int,
    looks: int,
    result: wp.array3d(dtype=wp.float32),
): ...


@wp.kernel(enable_backward=False, module="unique")
def light_of_slopes(
    height: wp.array2d(dtype=wp.float32),
    normal: wp.array2d(dtype=wp.vec3),
    wide: wp.array2d(dtype=wp.float32),
    sent: wp.array3d(dtype=wp.float32),
    margin_x: int,
    margin_y: int,
    directions: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.int32),
    inverses: wp.array(dtype=wp.float32),
    azimuths: int,
    looks: int,
    result: wp.array3d(dtype=wp.float32),
):
    """Over (rows, groups of cells): the mean of three maps over the soil in the sky's way of a cell.

    What rises above the horizon at a look shows the soil between that look and the one before. Maps with margins are
    wide enough for every look and a group's width more; 0 where nothing stands in the way.
    """
    row, group = wp.tid()
    _slopes_of_cells(
        row,
        group,
        height,
        normal,
        wide,
        sent,
        margin_x,
        margin_y,
        directions,
        offsets,
        inverses,
        azimuths,
        looks,
        result,
    )
