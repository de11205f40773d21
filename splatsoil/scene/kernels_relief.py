# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels of the height map: density of particles, its level set, erosion."""

import warp as wp


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
def erode(
    height: wp.array2d(dtype=wp.float32), drops: wp.array2d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)
) -> None:
    """Heights eroded by a body: the lowest of those around less what it drops there; minus infinity where it isn't."""
    i, j = wp.tid()
    rows = drops.shape[0] // 2
    columns = drops.shape[1] // 2
    lowest = float(1.0e6)  # noqa: UP018 - Warp takes a bare literal for a constant
    for k in range(wp.max(i - rows, 0), wp.min(i + rows + 1, out.shape[0])):
        for m in range(wp.max(j - columns, 0), wp.min(j + columns + 1, out.shape[1])):
            lowest = wp.min(lowest, height[k, m] - drops[k - i + rows, m - j + columns])
    out[i, j] = lowest
