"""The estimate from all features at once, instead of from their sum of squares.

A loss adds up thousands of features and keeps one number; chance (lumps that fall here or there) moves its minimum by a
degree. An emulator of the features themselves, through the same evaluations, tells what varies with the parameters
from what doesn't: emulated residuals are smooth in the parameters, and their least squares are where the pictures
agree best. The spread is the sandwich of least squares under errors of known covariance,

    (JᵀJ)⁻¹ Jᵀ (chance + emulator + misfit) J (JᵀJ)⁻¹,

J the scores' derivative (White 1980, Econometrica 48:817). Chance is known from a handful of evaluations only; with ν
degrees of freedom behind it the estimate is distributed as Student's t, ν/(ν − 2) times as wide (variance).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from .likelihood import Likelihood
from .posterior import Data, likelihood_of
from .surrogate import Minimum, Surrogate, sobol

FloatArray = npt.NDArray[np.float64]

#: Candidates from which the least squares start, the evaluations besides.
CANDIDATES = 1024
#: How far outside of the evaluations' range the least squares may look, of an axis from -1 to 1.
BEYOND = 0.1
#: Half the step of the derivatives, of an axis from -1 to 1.
STEP = 0.01


def by_features(data: Data, surrogate: Surrogate, fallback: Minimum, *, seed: int = 0) -> Minimum | None:
    """Where the emulated residuals' sum of squares is least.

    Args:
        data: evaluations with their residuals.
        surrogate: of the loss, for the loss at the estimate.
        fallback: the loss' own minimum; what features say nothing of is taken from it.
        seed: of the emulator and the candidates.

    Returns:
        The minimum; None where the features vary in fewer ways than there are parameters, or points left out aren't
        predicted well enough to trust the emulator.

    Raises:
        RunError: too few evaluations, or they don't differ.
    """
    likelihood = likelihood_of(data, seed=seed)
    emulator = likelihood.emulator
    if not emulator.trusted:
        return None
    estimate = _least_squares(likelihood, data.points, seed)
    return fallback.moved(estimate, _spread(likelihood, estimate), surrogate)


def _least_squares(likelihood: Likelihood, points: FloatArray, seed: int) -> FloatArray:
    """Minimiser (n,) of the squared distance between emulated and observed scores, near the points.

    Far from them (where simulations failed, say) an emulator falls back to its mean, which may lie anywhere.
    """

    def squares(where: FloatArray) -> FloatArray:
        found, _ = likelihood.emulator.predict(where)
        return np.asarray(np.sum((found - likelihood.scores) ** 2, axis=1))

    low = np.maximum(points.min(axis=0) - BEYOND, -1.0)
    high = np.minimum(points.max(axis=0) + BEYOND, 1.0)
    spread = low + 0.5 * (sobol(CANDIDATES, likelihood.emulator.dimension, seed) + 1.0) * (high - low)
    candidates = np.concatenate([spread, points])
    start = candidates[np.argmin(squares(candidates))]
    bounds = list(zip(low, high, strict=True))
    polished = minimize(lambda x: float(squares(x[None])[0]), start, bounds=bounds)
    return np.clip(polished.x, low, high)


def _spread(likelihood: Likelihood, estimate: FloatArray) -> FloatArray:
    """Standard deviation (n,) of the least squares' minimiser."""
    emulator = likelihood.emulator
    steps = STEP * np.eye(emulator.dimension)
    ahead, _ = emulator.predict(estimate + steps)
    behind, _ = emulator.predict(estimate - steps)
    slope = (ahead - behind).T / (2.0 * STEP)
    _, variance = emulator.predict(estimate[None])
    freedom = likelihood.freedom
    covariance = freedom / (freedom - 2.0) * (emulator.chance + np.diag(variance[0]))
    if likelihood.misfit is not None:
        covariance = covariance + likelihood.misfit.covariance
    bread = np.linalg.pinv(slope.T @ slope) @ slope.T
    return np.sqrt(np.maximum(np.diag(bread @ covariance @ bread.T), 0.0))
