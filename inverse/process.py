"""A Gaussian process over one component's scores, averaged over draws of its hyperparameters."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .hyperparameters import JITTER, Hyperparameters, posterior

FloatArray = npt.NDArray[np.float64]

#: Draws of the hyperparameters from which a prediction is averaged.
DRAWS = 16


class Process:
    """A Gaussian process over scores, averaged over hyperparameters."""

    def __init__(self, points: FloatArray, scores: FloatArray, seed: int) -> None:
        self.x = 0.5 * (points + 1.0)
        self.shift, self.scale = float(scores.mean()), float(scores.std(ddof=1)) or 1.0
        self.y = (scores - self.shift) / self.scale
        self.groups = _groups(points)
        draws = max(DRAWS, 2 * (points.shape[1] + 3))
        _, settings = posterior(self.x, self.y, None, count=draws + draws % 2, seed=seed)
        self.settings = settings
        inverses = [np.linalg.inv(self._kernel(settings, d)) for d in range(len(settings))]
        self.inverse = np.stack(inverses)
        self.weights = np.einsum("dij,dj->di", self.inverse, self.y - settings.mean[:, None])

    def _kernel(self, settings: Hyperparameters, draw: int) -> FloatArray:
        squares = (self.x[:, None] - self.x[None]) ** 2
        kernel = np.exp(-0.5 * squares @ settings.lengths[draw] ** -2.0)
        return kernel + np.diag(settings.noise[draw] + JITTER)

    def noise_variance(self) -> float:
        """Of one simulation's score."""
        return float(self.settings.noise[:, 0].mean()) * self.scale**2

    def noise_scale(self) -> float:
        """Likewise, the harmonic mean."""
        return float(1.0 / (1.0 / self.settings.noise[:, 0]).mean()) * self.scale**2

    def residuals(self) -> FloatArray:
        """(m,) of the scores from the means: noise K⁻¹ (y − μ)."""
        return self.scale * (self.settings.noise * self.weights).mean(axis=0)

    def freedom(self) -> float:
        """Evaluations less the trace of the smoother K(K + noise)⁻¹ (Hastie & Tibshirani 1990, 3.5) and the mean."""
        left = np.sum(self.settings.noise * np.diagonal(self.inverse, axis1=1, axis2=2), axis=1)
        return max(float(left.mean()) - 1.0, 0.0)

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = 0.5 * (points + 1.0)
        squares = (x[:, None] - self.x[None]) ** 2
        kernel = np.exp(-0.5 * np.einsum("qmn,dn->dqm", squares, self.settings.lengths**-2.0))
        means = self.settings.mean[:, None] + np.einsum("dqm,dm->dq", kernel, self.weights)
        variances = np.maximum(1.0 - np.einsum("dqm,dqm->dq", kernel @ self.inverse, kernel), 0.0)
        total = variances.mean(axis=0) + means.var(axis=0)
        return self.shift + self.scale * means.mean(axis=0), self.scale**2 * total

    @cached_property
    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Errors (m,) and their quoted standard deviations when a point's own evaluations are left out, in units of the
        scores' scale.

        Closed form: the errors of a left-out group G are (K⁻¹)_GG⁻¹ (K⁻¹(y − μ))_G, their covariance is (K⁻¹)_GG⁻¹.
        """
        variances = 1.0 / np.diagonal(self.inverse, axis1=1, axis2=2)
        errors = variances * self.weights
        for group in (group for group in self.groups if len(group) > 1):
            blocks = np.linalg.inv(self.inverse[:, group[:, None], group])
            errors[:, group] = np.einsum("dij,dj->di", blocks, self.weights[:, group])
            variances[:, group] = np.diagonal(blocks, axis1=1, axis2=2)
        total = variances.mean(axis=0) + errors.var(axis=0)
        return errors.mean(axis=0), np.sqrt(total)

    def skill(self) -> float:
        """1 − mean square error over variance, points left out."""
        return 1.0 - float(np.mean(self.left_out[0] ** 2))

    def shrunk(self, share: float) -> Process:
        """The process of ``share`` times the scores."""
        smaller = copy(self)
        smaller.shift, smaller.scale = share * self.shift, share * self.scale
        return smaller


def _groups(points: FloatArray) -> list[npt.NDArray[np.int64]]:
    """Indices of points that are the same."""
    _, which = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    return [np.flatnonzero(which == g) for g in range(which.max() + 1)]
