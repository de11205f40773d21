"""Maps over the bed, in the form of Warp's kernels, and what they say between their cells."""

from __future__ import annotations

import warp as wp


@wp.struct
class Grid:
    """Where a map over the bed lies: centre of its first cell and one over the cell size."""

    x0: float
    y0: float
    inverse_x: float
    inverse_y: float


_ROWS = """
    const int ny = values.shape[0], nx = values.shape[1];
"""
PLACE = """
    const float right = (float)nx - 1.001f, upper = (float)ny - 1.001f;
    float u = (x - grid.x0) * grid.inverse_x, v = (y - grid.y0) * grid.inverse_y;
    u = u > 0.0f ? u : 0.0f; u = u < right ? u : right;
    v = v > 0.0f ? v : 0.0f; v = v < upper ? v : upper;
    const int j = (int)u, i = (int)v;
    const float fu = u - (float)j, fv = v - (float)i;
"""
"""Of C++: the cell (i, j) of a map of nx columns and ny rows before a place (x, y), and how far on to the next."""


@wp.func_native(
    _ROWS
    + PLACE
    + """
    const float* p = values.data + i * nx + j;
    const float low = p[0] + fu * (p[1] - p[0]), high = p[nx] + fu * (p[nx + 1] - p[nx]);
    return low + fv * (high - low);
"""
)
def sample(values: wp.array2d(dtype=wp.float32), grid: Grid, x: float, y: float) -> float:  # type: ignore[empty-body]
    """Bilinear value of a contiguous map (ny, nx), held constant beyond its border."""


Shade = wp.types.vector(length=8, dtype=wp.float32)
"""What decides the light on a place: normal, share of sky, share of sun, light bounced (red, green, blue)."""


@wp.func_native(
    _ROWS
    + PLACE
    + """
    const float* p = (const float*)values.data + 8 * (i * nx + j);
    const float* q = p + 8 * nx;
    wp::vec_t<8, float> out;
    for (int k = 0; k < 8; ++k) {
        const float low = p[k] + fu * (p[k + 8] - p[k]), high = q[k] + fu * (q[k + 8] - q[k]);
        out[k] = low + fv * (high - low);
    }
    return out;
"""
)
def sample_shade(values: wp.array2d(dtype=Shade), grid: Grid, x: float, y: float) -> Shade:
    """The same for all that decides the light at once."""


@wp.func_native(
    """
    const int nz = values.shape[0], ny = values.shape[1], nx = values.shape[2];
"""
    + PLACE
    + """
    const float top = (float)nz - 1.001f;
    float w = (z - layers[0]) * layers[1];
    w = w > 0.0f ? w : 0.0f; w = w < top ? w : top;
    const int k = (int)w;
    const float fw = w - (float)k;
    const float* p = values.data + ((long long)k * ny + i) * nx + j;
    const float* q = p + (long long)ny * nx;
    const float p0 = p[0] + fu * (p[1] - p[0]), p1 = p[nx] + fu * (p[nx + 1] - p[nx]);
    const float q0 = q[0] + fu * (q[1] - q[0]), q1 = q[nx] + fu * (q[nx + 1] - q[nx]);
    const float low = p0 + fv * (p1 - p0), high = q0 + fv * (q1 - q0);
    return low + fw * (high - low);
"""
)
def sample_layers(  # type: ignore[empty-body]
    values: wp.array3d(dtype=wp.float32), grid: Grid, layers: wp.vec2, x: float, y: float, z: float
) -> float:
    """Trilinear value of contiguous layers of maps (nz, ny, nx), held constant beyond their border; ``layers`` are the
    lowest one's height and one over the distance from one to the next."""


@wp.func
def slope_of_layers(values: wp.array3d(dtype=wp.float32), grid: Grid, layers: wp.vec2, x: wp.vec3) -> wp.vec3:
    """Gradient of the same, by differences over a cell each way, and half a layer."""
    dx = 1.0 / grid.inverse_x
    dy = 1.0 / grid.inverse_y
    dz = 0.5 / layers[1]
    along_x = sample_layers(values, grid, layers, x[0] + dx, x[1], x[2])
    along_x -= sample_layers(values, grid, layers, x[0] - dx, x[1], x[2])
    along_y = sample_layers(values, grid, layers, x[0], x[1] + dy, x[2])
    along_y -= sample_layers(values, grid, layers, x[0], x[1] - dy, x[2])
    along_z = sample_layers(values, grid, layers, x[0], x[1], x[2] + dz)
    along_z -= sample_layers(values, grid, layers, x[0], x[1], x[2] - dz)
    return 0.5 * wp.vec3(along_x / dx, along_y / dy, along_z / dz)
