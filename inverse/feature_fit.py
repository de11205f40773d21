"""The estimate from all features at once, instead of from their sum of squares.

A loss adds up thousands of features and keeps one number; chance (lumps that fall here or there) moves its minimum by a
degree. An emulator of the features themselves, through the same evaluations, tells what varies with the parameters
from what doesn't: emulated residuals are smooth in the parameters, and their least squares are where the pictures
agree best. The spread is the sandwich of least squares under errors of known covariance,

    (JᵀJ)⁻¹ Jᵀ (chance + emulator + misfit) J (JᵀJ)⁻¹,

J the scores' derivative (White 1980, Econometrica 48:817). Chance is known from a handful of evaluations only; with ν
degrees of freedom behind it the estimate is distributed as Student's t, ν/(ν − 2) times as wide (variance).

Where the force on the tool was measured, its χ² is added to that of the pictures' estimate, taken as normal; where
their emulator isn't to be trusted, that is the loss' minimum and its spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from .least_squares import closest, of_pictures, score_covariance, slopes
from .likelihood import Likelihood
from .posterior import Data, likelihood_of
from .surrogate import Minimum, Surrogate

FloatArray = npt.NDArray[np.float64]

DENIED = 1e-3
"""Chance of other instruments' being so far off, below which they aren't counted: something is wrong with them, or
with the model, that an angle mustn't be bent for."""
UNKNOWN = 1e-3
"""Precision that every parameter has, so that there is an inverse."""


@dataclass(frozen=True)
class FeatureFit:
    """What features say.

    Attributes:
        minimum: the estimate by all instruments that agree.
        source: whether pictures are in it by their features, or by their loss.
        pictures: the estimate by pictures alone; None where there is nothing else.
        agreement: chance that the other instruments are as far off if nothing is wrong. Where it is below `DENIED` they
            aren't counted.
    """

    minimum: Minimum
    source: Literal["features", "loss"] = "features"
    pictures: Minimum | None = None
    agreement: float = 1.0

    @property
    def denied(self) -> bool:
        """Whether other instruments were left out."""
        return self.agreement < DENIED


def by_features(data: Data, surrogate: Surrogate, fallback: Minimum, *, seed: int = 0) -> FeatureFit | None:
    """Where the emulated residuals' sum of squares is least.

    Args:
        data: evaluations with their residuals.
        surrogate: of the loss, for the loss at the estimate.
        fallback: the loss' own minimum; what features say nothing of is taken from it.
        seed: of the emulator and the candidates.

    Returns:
        The minimum; None where there are only pictures, and their features vary in fewer ways than there are
        parameters, or points left out aren't predicted well enough to trust the emulator.

    Raises:
        RunError: too few evaluations, or they don't differ.
    """
    likelihood = likelihood_of(data, seed=seed)
    emulator, other = likelihood.emulator, likelihood.beside
    found = closest(of_pictures(likelihood), data.points, seed)
    known = _precision(likelihood, found)
    minimum = fallback.moved(found, _spread(known), surrogate) if emulator.trusted else fallback
    if other is None:
        return FeatureFit(minimum) if emulator.trusted else None
    source: Literal["features", "loss"]
    # Ways that the pictures don't vary in, the other instruments may.
    if emulator.skilled and emulator.count + other.count >= emulator.dimension:
        source, middle, precision = "features", found, known
    else:
        source, middle, precision = "loss", fallback.estimate, np.diag(fallback.std**-2.0)

    def squares(where: FloatArray) -> FloatArray:
        off = where - middle
        return np.einsum("qi,ij,qj->q", off, precision, off) + other.squares(where)

    estimate = closest(squares, data.points, seed)
    agreement = other.agreement(estimate)
    if agreement < DENIED:
        return FeatureFit(minimum, "features" if emulator.trusted else "loss", minimum, agreement)
    slope = other.slopes(estimate)
    together = fallback.moved(estimate, _spread(precision + slope.T @ slope), surrogate)
    return FeatureFit(together, source, minimum, agreement)


def _precision(likelihood: Likelihood, estimate: FloatArray) -> FloatArray:
    """(n, n) inverse covariance of the least squares' minimiser, the sandwich above."""
    slope = slopes(likelihood, estimate)
    bread = slope.T @ slope
    meat = slope.T @ score_covariance(likelihood, estimate) @ slope
    return np.asarray(bread @ np.linalg.pinv(meat, hermitian=True) @ bread)


def _spread(precision: FloatArray) -> FloatArray:
    """(n,) standard deviations; far beyond an axis' length where nothing is known."""
    return np.sqrt(np.diag(np.linalg.inv(precision + UNKNOWN * np.eye(len(precision)))))
