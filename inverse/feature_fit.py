"""The estimate from all features at once, instead of from their sum of squares.

A loss adds up thousands of features and keeps one number; chance (lumps that fall here or there) moves its minimum by a
degree. An emulator of the features themselves, through the same evaluations, tells what varies with the parameters
from what doesn't: emulated residuals are smooth in the parameters, and their least squares are where the pictures
agree best. The spread is the sandwich of least squares under errors of known covariance,

    (JᵀJ)⁻¹ Jᵀ (chance + emulator + misfit) J (JᵀJ)⁻¹,

J the scores' derivative (White 1980, Econometrica 48:817). Chance is known from a handful of evaluations only: its
expectation counts, which is larger than what they themselves scatter by.

Where the force on the tool was measured, its χ² is added to that of the pictures' estimate, taken as normal; where
their emulator isn't to be trusted, that is the loss' minimum and its spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from .beside import Beside
from .emulator import slopes_of
from .least_squares import closest, of_pictures, score_covariance
from .likelihood import Likelihood
from .posterior import Data, likelihood_of
from .surrogate import Minimum, Surrogate

FloatArray = npt.NDArray[np.float64]

DENIED = 1e-3
"""Chance of other instruments' being so far from pictures, below which they aren't counted: something is wrong with
them, or with the model, that an angle mustn't be bent for."""
FORCE_DENIED = (
    "The measured force on the tool can't be what this model needs where the pictures agree, so it wasn't counted: its "
    "unit, sign or zero may be off, or the model lacks an effect."
)
UNKNOWN = 1e-3
"""Precision that every parameter has, so that there is an inverse."""


@dataclass(frozen=True)
class FeatureFit:
    """What features say.

    Attributes:
        minimum: the estimate by all instruments that agree.
        source: whether pictures are in it by their features, or by their loss.
        pictures: the estimate by pictures alone; None where there is nothing else.
        agreement: chance that the other instruments and pictures are as far from each other if nothing is wrong. Where
            it is below `DENIED` the others aren't counted.
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
        source, together = "features", _together(found, known, other, data.points, seed)
    else:
        loss = np.diag(fallback.std**-2.0)
        source, together = "loss", _together(fallback.estimate, loss, other, data.points, seed)
    if together.agreement < DENIED:
        return FeatureFit(minimum, "features" if emulator.trusted else "loss", minimum, together.agreement)
    joint = fallback.moved(together.estimate, _spread(together.precision), surrogate)
    return FeatureFit(joint, source, minimum, together.agreement)


def agreement(data: Data, *, seed: int = 0) -> float:
    """Chance that pictures and other instruments are as far from each other as they are if nothing is wrong; 1 where
    there are no others.

    Raises:
        RunError: too few evaluations, or they don't differ.
    """
    if data.beside is None:
        return 1.0
    likelihood = likelihood_of(data, seed=seed)
    assert likelihood.beside is not None
    found = closest(of_pictures(likelihood), data.points, seed)
    return _together(found, _precision(likelihood, found), likelihood.beside, data.points, seed).agreement


@dataclass(frozen=True)
class _Together:
    """An estimate (n,) by pictures and other instruments, its inverse covariance (n, n), and how well these agree."""

    estimate: FloatArray
    precision: FloatArray
    agreement: float


def _together(middle: FloatArray, precision: FloatArray, other: Beside, points: FloatArray, seed: int) -> _Together:
    """From the pictures' estimate (n,) and its inverse covariance (n, n)."""

    def squares(where: FloatArray) -> FloatArray:
        off = where - middle
        return np.asarray(np.einsum("qi,ij,qj->q", off, precision, off) + other.squares(where))

    estimate = closest(squares, points, seed)
    # What pictures don't determine can't contradict anything; an end of a parameter's range can.
    freedom = max(other.count + int(np.linalg.matrix_rank(precision, hermitian=True)) - len(middle), 1)
    chance = float(chi2.sf(squares(estimate[None])[0], freedom))
    slope = other.slopes(estimate)
    return _Together(estimate, precision + slope.T @ slope, chance)


def _precision(likelihood: Likelihood, estimate: FloatArray) -> FloatArray:
    """(n, n) inverse covariance of the least squares' minimiser, the sandwich above."""
    slope = slopes_of(likelihood.emulator, estimate)
    bread = slope.T @ slope
    meat = slope.T @ score_covariance(likelihood, estimate) @ slope
    return np.asarray(bread @ np.linalg.pinv(meat, hermitian=True) @ bread)


def _spread(precision: FloatArray) -> FloatArray:
    """(n,) standard deviations; far beyond an axis' length where nothing is known."""
    return np.sqrt(np.diag(np.linalg.inv(precision + UNKNOWN * np.eye(len(precision)))))
