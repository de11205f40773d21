"""Rigid motions: checks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def why_not_rigid(matrix: FloatArray, tolerance: float = 1e-3) -> str | None:
    """What keeps a (4, 4) matrix from being a rigid motion, or None when nothing does."""
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
        return "its last row is not 0 0 0 1"
    rotation = matrix[:3, :3]
    lengths = np.linalg.norm(rotation, axis=0)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > tolerance:
        if lengths.min() > 0.0 and lengths.max() / lengths.min() < 1.0 + tolerance:
            scaled = rotation / lengths.mean()
            if np.abs(scaled.T @ scaled - np.eye(3)).max() < tolerance:
                return f"it scales by {lengths.mean():g}"
        return "its upper left 3 x 3 part is not a rotation (columns of length 1 at right angles)"
    if np.linalg.det(rotation) < 0.0:
        return "it mirrors (its determinant is -1)"
    return None


def nearest_rigid(matrix: FloatArray) -> FloatArray:
    """The rigid motion nearest to a (4, 4) matrix that is one up to rounding."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = matrix[:3, 3]
    return out
