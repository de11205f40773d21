"""The sRGB curve (IEC 61966-2-1), on arrays; tensors and kernels have their own in ``splatsoil.scene``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def linear(srgb: FloatArray) -> FloatArray:
    """sRGB values in [0, 1] to linear ones, of any shape."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(colour: FloatArray) -> FloatArray:
    """Linear values, not negative, to sRGB."""
    curve = 1.055 * np.maximum(colour, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(colour <= 0.0031308, 12.92 * colour, curve)
