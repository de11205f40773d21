"""Where emulated features come closest to the observed ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from .likelihood import Likelihood
from .surrogate import sobol

FloatArray = npt.NDArray[np.float64]
Squares = Callable[[FloatArray], FloatArray]
"""Points (q, n) to squared distances (q,)."""

#: Candidates from which the least squares start, the evaluations besides.
CANDIDATES = 1024
#: How far outside of the evaluations' range the least squares may look, of an axis from -1 to 1.
BEYOND = 0.1


def closest(squares: Squares, points: FloatArray, seed: int) -> FloatArray:
    """Minimiser (n,) of squared distances, near the evaluations' points (m, n).

    Far from them (where simulations failed, say) an emulator falls back to its mean, which may lie anywhere.
    """
    low = np.maximum(points.min(axis=0) - BEYOND, -1.0)
    high = np.minimum(points.max(axis=0) + BEYOND, 1.0)
    spread = low + 0.5 * (sobol(CANDIDATES, points.shape[1], seed) + 1.0) * (high - low)
    candidates = np.concatenate([spread, points])
    start = candidates[np.argmin(squares(candidates))]
    bounds = list(zip(low, high, strict=True))
    polished = minimize(lambda x: float(squares(x[None])[0]), start, bounds=bounds)
    return np.clip(polished.x, low, high)


def of_pictures(likelihood: Likelihood) -> Squares:
    """Squared distance between emulated and observed scores of the pictures."""

    def squares(where: FloatArray) -> FloatArray:
        found, _ = likelihood.emulator.predict(where)
        return np.asarray(np.sum((found - likelihood.scores) ** 2, axis=1))

    return squares


def score_covariance(likelihood: Likelihood, estimate: FloatArray) -> FloatArray:
    """(p, p) of the pictures' scores about the emulated ones: chance, the emulator's doubt, and the misfit."""
    _, variance = likelihood.emulator.predict(estimate[None])
    covariance = likelihood.emulator.chance + np.diag(variance[0])
    return covariance if likelihood.misfit is None else covariance + likelihood.misfit.covariance
