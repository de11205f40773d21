# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels that make a relief of particles and look things up in it: one launch where torch takes dozens, which a
GPU waits for and several processes that share one wait for all the more."""

import warp as wp

from splatsoil.scene.kernels_sky import WIDTH_SOURCE


@wp.func
def _mirrored(i: int, count: int) -> int:
    """A cell beyond the box, at most by the width of the box, to its mirror image in it."""
    return wp.where(i < 0, -1 - i, wp.where(i >= count, 2 * count - 1 - i, i))


@wp.kernel(enable_backward=False)
def spread(
    positions: wp.array(dtype=wp.vec3), low: wp.vec3, inverse: wp.vec3, grid: wp.array3d(dtype=wp.float32)
) -> None:
    """Add each particle to a grid by a quadratic B-spline; walls, floor and top mirror what would leave."""
    p = wp.tid()
    q = wp.cw_mul(positions[p] - low, inverse)
    nx = grid.shape[0]
    ny = grid.shape[1]
    nz = grid.shape[2]
    x = wp.clamp(q[0], 0.0, float(nx - 1) + 0.999) - 0.5
    y = wp.clamp(q[1], 0.0, float(ny - 1) + 0.999) - 0.5
    z = wp.clamp(q[2], 0.0, float(nz - 1) + 0.999) - 0.5
    i = int(wp.floor(x + 0.5))
    j = int(wp.floor(y + 0.5))
    k = int(wp.floor(z + 0.5))
    fx = x - float(i)
    fy = y - float(j)
    fz = z - float(k)
    wx = wp.vec3(0.5 * (0.5 - fx) * (0.5 - fx), 0.75 - fx * fx, 0.5 * (0.5 + fx) * (0.5 + fx))
    wy = wp.vec3(0.5 * (0.5 - fy) * (0.5 - fy), 0.75 - fy * fy, 0.5 * (0.5 + fy) * (0.5 + fy))
    wz = wp.vec3(0.5 * (0.5 - fz) * (0.5 - fz), 0.75 - fz * fz, 0.5 * (0.5 + fz) * (0.5 + fz))
    for a in range(3):
        for b in range(3):
            w = wx[a] * wy[b]
            for c in range(3):
                wp.atomic_add(
                    grid, _mirrored(i + a - 1, nx), _mirrored(j + b - 1, ny), _mirrored(k + c - 1, nz), w * wz[c]
                )


@wp.func_native("""
    const int ny = grid.shape[1], nz = grid.shape[2], line = (i * ny + j) * nz;
    const float* g = grid.data + line;
    float* o = out.data + line;
    const float v = 1.0f - 2.0f * w;
    if (axis == 2) {
        for (int k = 1; k < nz - 1; ++k) o[k] = v * g[k] + w * (g[k - 1] + g[k + 1]);
        o[0] = v * g[0] + w * (g[0] + g[1]);
        o[nz - 1] = v * g[nz - 1] + w * (g[nz - 2] + g[nz - 1]);
    } else {
        const int m = axis == 0 ? i : j, n = axis == 0 ? grid.shape[0] : ny, step = axis == 0 ? ny * nz : nz;
        const float* b = m > 0 ? g - step : g;
        const float* a = m < n - 1 ? g + step : g;
        for (int k = 0; k < nz; ++k) o[k] = v * g[k] + w * (b[k] + a[k]);
    }
""")
def _blurred_line(
    i: int, j: int, axis: int, w: float, grid: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)
): ...


@wp.kernel(enable_backward=False)
def blur(axis: int, w: float, grid: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)) -> None:
    """Over lines along z, which fill vector registers on the CPU: one pass of (w, 1 - 2w, w) along an axis, the ends
    mirrored; two cells or more along each."""
    i, j = wp.tid()
    _blurred_line(i, j, axis, w, grid, out)


@wp.kernel(enable_backward=False)
def crossing(
    density: wp.array3d(dtype=wp.float32), level: float, floor: float, cell: float, out: wp.array2d(dtype=wp.float32)
) -> None:
    """Height at which a density (nz, ny, nx) falls through a level, from above; the floor where it never reaches it."""
    i, j = wp.tid()
    last = density.shape[0] - 1
    while last >= 0 and density[last, i, j] <= level:
        last -= 1
    height = 0.0
    if last >= 0:
        k = wp.min(last, density.shape[0] - 2)
        below = density[k, i, j]
        part = (below - level) / wp.max(below - density[k + 1, i, j], 1.0e-9)
        height = float(k) + 0.5 + wp.clamp(part, 0.0, 1.0)
    out[i, j] = height * cell + floor


@wp.kernel(enable_backward=False)
def between(values: wp.array2d(dtype=wp.float32), stride: int, out: wp.array2d(dtype=wp.float32)) -> None:
    """A map known at every so many rows and columns, the first among them, linearly in between, constant beyond."""
    i, j = wp.tid()
    row = float(i) / float(stride)
    column = float(j) / float(stride)
    k = wp.min(int(row), wp.max(values.shape[0] - 2, 0))
    m = wp.min(int(column), wp.max(values.shape[1] - 2, 0))
    k_next = wp.min(k + 1, values.shape[0] - 1)
    m_next = wp.min(m + 1, values.shape[1] - 1)
    u = wp.min(row - float(k), 1.0)
    v = wp.min(column - float(m), 1.0)
    low = values[k, m] * (1.0 - u) + values[k_next, m] * u
    high = values[k, m_next] * (1.0 - u) + values[k_next, m_next] * u
    out[i, j] = low * (1.0 - v) + high * v


@wp.kernel(enable_backward=False)
def normals(height: wp.array2d(dtype=wp.float32), cell_x: float, cell_y: float, out: wp.array2d(dtype=wp.vec3)) -> None:
    """Unit normals, upward, by central differences; by the neighbour inside at the edges."""
    i, j = wp.tid()
    left = wp.max(j - 1, 0)
    right = wp.min(j + 1, height.shape[1] - 1)
    down = wp.max(i - 1, 0)
    up = wp.min(i + 1, height.shape[0] - 1)
    along_x = (height[i, right] - height[i, left]) / (float(right - left) * cell_x)
    along_y = (height[up, j] - height[down, j]) / (float(up - down) * cell_y)
    out[i, j] = wp.normalize(wp.vec3(-along_x, -along_y, 1.0))


@wp.func
def place_of(x: float, y: float, origin: wp.vec2, cell: wp.vec2, rows: int, columns: int) -> wp.vec4:
    """Row and column of the cell's centre before a place on a map, and how far on the place is along each, in cells;
    held at the outermost centres."""
    column = wp.clamp((x - origin[0]) / cell[0], 0.0, float(columns - 1))
    row = wp.clamp((y - origin[1]) / cell[1], 0.0, float(rows - 1))
    i = wp.min(int(row), rows - 2)
    j = wp.min(int(column), columns - 2)
    return wp.vec4(float(i), float(j), row - float(i), column - float(j))


@wp.kernel(enable_backward=False)
def sample(
    values: wp.array3d(dtype=wp.float32),
    points: wp.array2d(dtype=wp.float32),
    origin: wp.vec2,
    cell: wp.vec2,
    out: wp.array2d(dtype=wp.float32),
) -> None:
    """Bilinear values of a map (ny, nx, k) at points (n, 2 or 3), constant beyond the outermost cells' centres."""
    p = wp.tid()
    place = place_of(points[p, 0], points[p, 1], origin, cell, values.shape[0], values.shape[1])
    i = int(place[0])
    j = int(place[1])
    u = place[2]
    v = place[3]
    for c in range(values.shape[2]):
        low = values[i, j, c] * (1.0 - v) + values[i, j + 1, c] * v
        high = values[i + 1, j, c] * (1.0 - v) + values[i + 1, j + 1, c] * v
        out[p, c] = low * (1.0 - u) + high * u


@wp.func_native(f"""
{WIDTH_SOURCE}    const int across = wide.shape[1];
    const float* here = wide.data + (row + margin_y) * across + margin_x + first;
    float lowest[W];
    for (int l = 0; l < W; ++l) lowest[l] = here[l] - radius;
    for (int k = 0; k < offsets.shape[0]; ++k) {{
        const float* there = here + offsets.data[k];
        const float drop = drops.data[k];
        for (int l = 0; l < W; ++l) lowest[l] = there[l] - drop < lowest[l] ? there[l] - drop : lowest[l];
    }}
    for (int l = 0; l < W && first + l < out.shape[1]; ++l) out.data[row * out.shape[1] + first + l] = lowest[l];
""")
def _eroded_cells(
    row: int,
    group: int,
    radius: float,
    wide: wp.array2d(dtype=wp.float32),
    margin_x: int,
    margin_y: int,
    offsets: wp.array(dtype=wp.int32),
    drops: wp.array(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
): ...


@wp.kernel(enable_backward=False, module="unique")
def erode(
    radius: float,
    wide: wp.array2d(dtype=wp.float32),
    margin_x: int,
    margin_y: int,
    offsets: wp.array(dtype=wp.int32),
    drops: wp.array(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
) -> None:
    """Over (rows, groups of cells): a map with margins eroded by a ball, given by what it drops where."""
    row, group = wp.tid()
    _eroded_cells(row, group, radius, wide, margin_x, margin_y, offsets, drops, out)
