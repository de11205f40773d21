"""How probable the observed features are at given parameters, by the emulator, with every known source of doubt in it.

In the emulator's basis the observed scores z lie about the predicted ones, with covariance

    Σ(θ) = sensor + chance (one simulation's, standing for the sand's own) + emulator(θ) + s² · misfit

Chance is itself read off the evaluations, and in a handful of them it may happen to look small. With ν degrees of
freedom behind it, its size is integrated out, and z is distributed as Student's t with ν degrees of freedom and scale
Σ (Sellentin & Heavens 2016, MNRAS 456:L132); of many evaluations that is the normal. The misfit's size s is not known
better than to a factor, so it is sampled with the parameters (log-normal prior); this makes the likelihood
heavy-tailed, as it should be when the model is known to be wrong. Instruments beside the cameras, whose errors are
known beforehand, count as normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import gammaln

from .beside import Beside
from .emulator import Emulator
from .misfit import Misfit

FloatArray = npt.NDArray[np.float64]

#: Prior standard deviation of ln s, and the range it is sampled in.
MISFIT_SPREAD = 0.5
MISFIT_RANGE = (-2.0, 2.0)
#: Fewest degrees of freedom that chance is said to have.
FEWEST_FREE = 3.0


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Log likelihood of points in [-1, 1]^n, or of points and ln s where there is a misfit.

    Attributes:
        emulator: of the features.
        observed: (b,) features.
        sensor: variance of an observed feature's own noise.
        misfit: the model's own error; None for none.
        beside: other instruments than those of the features; None for none.
    """

    emulator: Emulator
    observed: FloatArray
    sensor: float = 0.0
    misfit: Misfit | None = None
    beside: Beside | None = None

    @property
    def with_misfit(self) -> bool:
        """Whether the last coordinate is ln s."""
        return self.misfit is not None and self.misfit.present

    @property
    def dimension(self) -> int:
        """Length of a point."""
        return self.emulator.dimension + self.with_misfit

    @property
    def lower(self) -> FloatArray:
        """(d,) lower bounds."""
        return np.array([-1.0] * self.emulator.dimension + [MISFIT_RANGE[0]] * self.with_misfit)

    @property
    def upper(self) -> FloatArray:
        """(d,) upper bounds."""
        return np.array([1.0] * self.emulator.dimension + [MISFIT_RANGE[1]] * self.with_misfit)

    @property
    def middle(self) -> FloatArray:
        """(1, d) the middle of the bounds."""
        return 0.5 * (self.lower + self.upper)[None]

    @cached_property
    def scores(self) -> FloatArray:
        """(p,) the observed features in the basis, those far from all that parameters explain counting less."""
        return self.emulator.project_robustly(self.observed)

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom behind the emulator's chance, and so of the likelihood."""
        return max(self.emulator.freedom, FEWEST_FREE)

    @cached_property
    def _fixed(self) -> FloatArray:
        basis, scale = self.emulator.basis, self.emulator.scale
        return self.emulator.chance_scale + self.sensor * (basis / scale[:, None] ** 2).T @ basis

    def covariance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted mean scores (k, p) and scale Σ (k, p, p) of the observed ones about them."""
        n = self.emulator.dimension
        mean, variance = self.emulator.predict(points[:, :n])
        total = self._fixed + variance[:, :, None] * np.eye(self.emulator.count)
        if self.with_misfit and self.misfit is not None:
            total = total + np.exp(2.0 * points[:, n])[:, None, None] * self.misfit.covariance
        return mean, total

    def log_likelihood(self, points: npt.ArrayLike) -> FloatArray:
        """(k, d) to (k,)."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        mean, covariance = self.covariance(where)
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, (self.scores - mean)[..., None])[..., 0]
        logs = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        p, free = self.emulator.count, self.freedom
        constant = gammaln(0.5 * (free + p)) - gammaln(0.5 * free) - 0.5 * p * np.log(np.pi * free)
        tail = -0.5 * (free + p) * np.log1p(np.sum(white**2, axis=1) / free)
        other = 0.0 if self.beside is None else self.beside.log_likelihood(where[:, : self.emulator.dimension])
        return np.asarray(constant + tail - logs + other, dtype=np.float64)

    def log_prior(self, points: npt.ArrayLike) -> FloatArray:
        """(k, d) to (k,): uniform parameters, log-normal misfit, −∞ out of bounds; not normalised."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        inside = np.all((where >= self.lower) & (where <= self.upper), axis=1)
        density = -0.5 * (where[:, -1] / MISFIT_SPREAD) ** 2 if self.with_misfit else np.zeros(len(where))
        return np.where(inside, density, -np.inf)

    def __call__(self, points: npt.ArrayLike) -> FloatArray:
        """Log posterior density (k,) up to a constant."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        out = self.log_prior(where)
        good = np.isfinite(out)
        if good.any():
            out[good] += self.log_likelihood(where[good])
        return out

    def transform(self, cube: FloatArray) -> FloatArray:
        """Points of the unit cube (…, d) to parameters distributed as the prior, for nested sampling."""
        from scipy.stats import truncnorm

        out = 2.0 * np.asarray(cube, dtype=np.float64) - 1.0
        if self.with_misfit:
            ends = np.array(MISFIT_RANGE) / MISFIT_SPREAD
            out[..., -1] = MISFIT_SPREAD * truncnorm.ppf(cube[..., -1], *ends)
        return out
