"""Functions of kernels that pictures hardly show, against brute force."""

import numpy as np
import torch
import warp as wp

from splatsoil.scene import Relief
from splatsoil.scene.kernels import way_out
from splatsoil.scene.kernels_maps import Surface

ROWS, COLUMNS, CELL = 30, 40, 0.02
FIRST = (-0.1, 0.3)


@wp.kernel(enable_backward=False)
def ways_out(
    surface: Surface,
    origins: wp.array(dtype=wp.vec3),
    rays: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    out[i] = way_out(surface, origins[i], rays[i])


def test_rays_end_where_the_map_does() -> None:
    """From above and from beside the bed; the map ends half a cell beyond its outermost cells' centres."""
    rng = np.random.default_rng(3)
    lower = np.array(FIRST) - 0.5 * CELL
    upper = lower + CELL * np.array([COLUMNS, ROWS])
    targets = rng.uniform(lower, upper, (400, 2))
    origins = np.column_stack([rng.uniform(lower - 1.0, upper + 1.0, (400, 2)), rng.uniform(0.5, 1.0, 400)])
    rays = np.column_stack([targets, np.zeros(400)]) - origins
    rays[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]  # along an axis
    origins[:2, :2] = 0.5 * (lower + upper)
    surface = Relief.of_heights(torch.zeros(ROWS, COLUMNS), FIRST, (CELL, CELL)).surface
    found = wp.zeros(400, dtype=wp.float32, device="cpu")
    given = [wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (origins, rays)]
    wp.launch(ways_out, dim=400, inputs=[surface, *given], outputs=[found], device="cpu")
    # The last of many points along the ray that lies on the map.
    depth = np.linspace(0.0, 12.0, 60_001)
    for origin, ray, end in zip(origins, rays, found.numpy(), strict=True):
        places = origin[:2] + depth[:, None] * ray[:2]
        on = np.all((places > lower) & (places < upper), axis=1)
        assert on.any()
        assert abs(depth[on][-1] - end) < 1e-3
