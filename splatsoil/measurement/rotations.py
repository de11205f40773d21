"""Rigid motions: quaternions (w, x, y, z), rotation vectors, checks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def quaternion_to_matrix(quaternion: npt.ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4) wxyz to rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_vector(start: npt.ArrayLike, end: npt.ArrayLike) -> FloatArray:
    """The shortest rotation vector (3,), in the world, that takes the orientation ``start`` to ``end`` (unit wxyz)."""
    w0, v0 = np.split(np.asarray(start, dtype=np.float64), [1])
    w1, v1 = np.split(np.asarray(end, dtype=np.float64), [1])
    # end * conjugate(start)
    w = float(w1[0] * w0[0] + v1 @ v0)
    v = -w1[0] * v0 + w0[0] * v1 - np.cross(v1, v0)
    if w < 0.0:
        w, v = -w, -v
    sine = float(np.linalg.norm(v))
    return 2.0 * v if sine < 1e-12 else v * (2.0 * np.arctan2(sine, w) / sine)


def rotation_matrix(vector: npt.ArrayLike) -> FloatArray:
    """The rotation (3, 3) about a rotation vector (3,) in radians."""
    axis = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(axis))
    half = 0.5 * np.sinc(angle / (2.0 * np.pi)) * axis  # sin(angle/2) times the unit axis
    return quaternion_to_matrix(np.concatenate([[np.cos(0.5 * angle)], half]))


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
