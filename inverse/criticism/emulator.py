"""Gaussian-process emulators of simulations (Rasmussen & Williams 2006).

There is one process for each component of the output; they share their length scales. The kernel of the base model has
a constant, a linear, a quadratic and a smooth part. An effect's increment to the base model vanishes with its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from splatsoil.arrays import FloatArray

Points = tuple[FloatArray, FloatArray, FloatArray]
"""Base parameters (m, n) in [-1, 1], sizes (m, k) over the smallest meaningful ones, shapes (m, j) in [-1, 1]."""

TREND_VARIANCES = (9.0, 9.0, 4.0)
"""Prior variance of the constant, linear and quadratic parts of the base emulator over that of the smooth part."""
LENGTH = 0.8
"""Length scale of the smooth part, in halves of the parameters' ranges."""
UNIT_SIZE = 4.0
"""Size, over the smallest meaningful one, at which an increment has its prior amplitude."""
AMPLITUDES = np.array([0.0, *np.geomspace(0.01, 10.0, 10)])
"""Prior variances of an increment that are tried, over the mean square of its simulations."""
LENGTHS = ((0.7, 2.0), (4.0, 10.0), (0.3, 0.8))
"""Length scales that are tried for an increment in base parameters, sizes and shapes."""


@dataclass(frozen=True)
class BaseEmulator:
    """Emulator of the base model.

    Attributes:
        points: (m, n) of the simulations, in [-1, 1].
        scatter: (p,) variance between simulations with different seeds.
        signal: (p,) variance of the smooth part.
        scores: (m, p) of the simulations.
    """

    points: FloatArray
    scatter: FloatArray
    signal: FloatArray
    scores: FloatArray

    @classmethod
    def through(cls, points: FloatArray, scores: FloatArray, scatter: FloatArray) -> BaseEmulator:
        """Through scores (m, p) at points (m, n) whose seed-to-seed scatter has a variance (p,)."""
        signal = np.maximum(scores.var(axis=0) - scatter, 0.05 * scatter) / sum(TREND_VARIANCES[1:2])
        return cls(points, scatter, signal, scores)

    def predict(self, where: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (q, p) at points (q, n)."""
        square = np.sum(where**2, axis=1)
        prior = TREND_VARIANCES[0] + TREND_VARIANCES[1] * square + TREND_VARIANCES[2] * square**2 + 1.0
        kernels = _base_kernel(self.points, self.points), _base_kernel(where, self.points)
        noise = np.broadcast_to(self.scatter, self.scores.shape)
        return _regressed(*kernels, prior, self.signal, noise, self.scores)


@dataclass(frozen=True)
class IncrementEmulator:
    """Emulator of an effect's increment to the base model; hyperparameters maximise the likelihood.

    Attributes:
        points: of the simulations.
        lengths: in base parameters, sizes and shapes.
        amplitude: (p,) prior variance at `UNIT_SIZE`.
        noise: (m, p) variance of a simulated increment.
        increments: (m, p) of the simulations.
    """

    points: Points
    lengths: tuple[float, float, float]
    amplitude: FloatArray
    noise: FloatArray
    increments: FloatArray

    @classmethod
    def through(cls, points: Points, increments: FloatArray, noise: FloatArray) -> IncrementEmulator:
        """Through increments (m, p) whose noise has a variance (m, p)."""
        best, found = -np.inf, None
        shaped = LENGTHS[2] if points[2].shape[1] else LENGTHS[2][:1]
        for lengths in product(LENGTHS[0], LENGTHS[1], shaped):
            kernel = _increment_kernel(points, points, lengths)
            scale = np.mean(increments**2, axis=0) / float(np.mean(np.diag(kernel)))
            likelihoods = np.stack([_likelihoods(kernel, a * scale, noise, increments) for a in AMPLITUDES])
            total = float(likelihoods.max(axis=0).sum())
            if total > best:
                amplitude = AMPLITUDES[likelihoods.argmax(axis=0)] * scale
                best, found = total, cls(points, lengths, amplitude, noise, increments)
        assert found is not None
        return found

    def predict(self, where: Points) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (q, p) of the increment."""
        inner, cross = (_increment_kernel(x, self.points, self.lengths) for x in (self.points, where))
        prior = np.sum(where[1] ** 2, axis=1) / UNIT_SIZE**2
        return _regressed(inner, cross, prior, self.amplitude, self.noise, self.increments)


def _regressed(
    inner: FloatArray, cross: FloatArray, prior: FloatArray, signal: FloatArray, noise: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (q, p) of Gaussian-process regression: kernels (m, m), (q, m), (q,) times signals (p,), through
    values (m, p) whose noise has a variance (m, p)."""
    mean, variance = np.zeros((len(cross), len(signal))), np.zeros((len(cross), len(signal)))
    for c in np.flatnonzero(signal):
        factor = cho_factor(signal[c] * inner + np.diag(noise[:, c]))
        mean[:, c] = signal[c] * cross @ cho_solve(factor, values[:, c])
        gain = cho_solve(factor, cross.T)
        variance[:, c] = signal[c] * prior - signal[c] ** 2 * np.einsum("ij,ji->i", cross, gain)
    return mean, np.maximum(variance, 0.0)


def _likelihoods(kernel: FloatArray, amplitude: FloatArray, noise: FloatArray, values: FloatArray) -> FloatArray:
    """(p,) log likelihoods of columns of values (m, p): kernel (m, m) times amplitudes (p,), plus noise (m, p)."""
    m = len(values)
    covariance = kernel * amplitude[:, None, None] + np.eye(m) * noise.T[:, None]
    factor = np.linalg.cholesky(covariance)
    z = np.linalg.solve(factor, values.T[..., None])[..., 0]
    return np.asarray(-np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1) - 0.5 * np.sum(z**2, axis=1))


def _base_kernel(a: FloatArray, b: FloatArray) -> FloatArray:
    inner = a @ b.T
    near = np.exp(-0.5 * np.sum((a[:, None] - b[None]) ** 2, axis=-1) / LENGTH**2)
    return TREND_VARIANCES[0] + TREND_VARIANCES[1] * inner + TREND_VARIANCES[2] * inner**2 + near


def _increment_kernel(a: Points, b: Points, lengths: Sequence[float]) -> FloatArray:
    apart = [
        np.sum(((x[:, None] - y[None]) / length) ** 2, axis=-1) for x, y, length in zip(a, b, lengths, strict=True)
    ]
    return np.asarray(a[1] @ b[1].T / UNIT_SIZE**2 * np.exp(-0.5 * sum(apart)))
