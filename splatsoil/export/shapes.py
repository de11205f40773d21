"""The soil's surface as a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatsoil.scene import Relief


def surface_points(surface: Relief) -> npt.NDArray[np.float32]:
    """The surface's cell centres (ny * nx, 3) in m, row after row."""
    return np.ascontiguousarray(surface.points.reshape(-1, 3).cpu().numpy(), dtype=np.float32)


def surface_quads(surface: Relief) -> npt.NDArray[np.int32]:
    """Quadrilaterals (k, 4) between these points, counter-clockwise as seen from above."""
    ny, nx = surface.height.shape
    corner = np.arange(ny * nx, dtype=np.int32).reshape(ny, nx)[:-1, :-1].reshape(-1, 1)
    return corner + np.array([0, 1, nx + 1, nx], dtype=np.int32)
