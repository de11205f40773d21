"""Instruments beside the cameras (the tool's force): few numbers, of errors that are known beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .emulator import Emulator, slopes_of

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beside:
    """Emulated residuals of other instruments, whose own and the model's known errors are independent of variance 1.

    Attributes:
        emulator: of predicted minus observed, so that the observation is 0.
    """

    emulator: Emulator

    @classmethod
    def of(cls, points: FloatArray, residuals: FloatArray, *, seed: int = 0) -> Beside | None:
        """From residuals (m, k) of evaluations at points (m, n); None where these don't differ."""
        try:
            return cls(Emulator(points, -residuals, seed=seed))
        except ValueError:
            return None

    @cached_property
    def scores(self) -> FloatArray:
        """(p,) the observation in the emulator's basis."""
        return self.emulator.project(np.zeros(len(self.emulator.centre)))

    @property
    def count(self) -> int:
        """Numbers p that tell of parameters."""
        return self.emulator.count

    def squares(self, points: FloatArray) -> FloatArray:
        """χ² (q,) at points (q, n)."""
        return np.sum(self._whitened(points)[0] ** 2, axis=1)

    def log_likelihood(self, points: FloatArray) -> FloatArray:
        """Normal log density (q,) at points (q, n), up to a constant."""
        white, factor = self._whitened(points)
        logs = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(-0.5 * np.sum(white**2, axis=1) - logs)

    def slopes(self, point: FloatArray) -> FloatArray:
        """(p, n) derivatives of the whitened prediction at a point (n,)."""
        _, factor = self._whitened(point[None])
        return np.linalg.solve(factor[0], slopes_of(self.emulator, point))

    def _whitened(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(q, p) observation minus prediction in independent units, and Cholesky factors (q, p, p) of the covariance:
        known errors, one simulation's chance, and the emulator's doubt."""
        mean, variance = self.emulator.predict(points)
        known = np.eye(self.count) + self.emulator.chance
        factor = np.linalg.cholesky(known + variance[:, :, None] * np.eye(self.count))
        white = np.linalg.solve(factor, (self.scores - mean)[..., None])[..., 0]
        return np.asarray(white), np.asarray(factor)
