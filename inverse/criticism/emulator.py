"""Emulators: what any parameters would give, from a few simulations, with the doubt of that.

Gaussian processes (Rasmussen & Williams 2006), one for each component, that share their lengths. The base model's has a
constant, linear and quadratic part and a smooth rest; an effect's increment to it vanishes with its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

FloatArray = npt.NDArray[np.float64]
Points = tuple[FloatArray, FloatArray, FloatArray]
"""Base parameters (m, n) in [-1, 1], sizes (m, k) over meaningful ones, shapes (m, j) in [-1, 1]."""

SHARES = (9.0, 9.0, 4.0)
"""Prior variance of the constant, linear and quadratic parts of the base emulator over that of the smooth rest."""
LENGTH = 0.8
"""Of the smooth rest, in halves of the parameters' ranges."""
HALFWAY = 4.0
"""Size, over the meaningful one, at which an increment has its prior amplitude."""
AMPLITUDES = np.array([0.0, *np.geomspace(0.01, 10.0, 10)])
"""Prior variances of an increment that are tried, over what its simulations have."""
LENGTHS = ((0.7, 2.0), (4.0, 10.0), (0.3, 0.8))
"""Lengths that are tried of an increment in base parameters, sizes and shapes."""


@dataclass(frozen=True)
class BaseEmulator:
    """The base model.

    Attributes:
        points: (m, n) of the simulations, in [-1, 1].
        chance: (p,) variance of one simulation's own chance.
        signal: (p,) variance of the smooth rest.
        scores: (m, p) simulations.
    """

    points: FloatArray
    chance: FloatArray
    signal: FloatArray
    scores: FloatArray

    @classmethod
    def through(cls, points: FloatArray, scores: FloatArray, chance: FloatArray) -> BaseEmulator:
        """Through simulations' scores (m, p) at points (m, n), whose own chance has a variance (p,)."""
        signal = np.maximum(scores.var(axis=0) - chance, 0.05 * chance) / sum(SHARES[1:2])
        return cls(points, chance, signal, scores)

    def predict(self, where: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (q, p) at points (q, n)."""
        square = np.sum(where**2, axis=1)
        alone = SHARES[0] + SHARES[1] * square + SHARES[2] * square**2 + 1.0
        kernels = _base_kernel(self.points, self.points), _base_kernel(where, self.points)
        noise = np.broadcast_to(self.chance, self.scores.shape)
        return _regressed(*kernels, alone, self.signal, noise, self.scores)


@dataclass(frozen=True)
class IncrementEmulator:
    """What an effect adds to the base model; its lengths and amplitudes are those of the largest likelihood.

    Attributes:
        points: of the simulations.
        lengths: in base parameters, sizes and shapes.
        amplitude: (p,) prior variance at `HALFWAY`.
        noise: (m, p) variance of an increment that was simulated.
        increments: (m, p).
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
        alone = np.sum(where[1] ** 2, axis=1) / HALFWAY**2
        return _regressed(inner, cross, alone, self.amplitude, self.noise, self.increments)


def _regressed(
    inner: FloatArray, cross: FloatArray, alone: FloatArray, signal: FloatArray, noise: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (q, p) of Gaussian processes: kernels (m, m), (q, m), (q,) times signals (p,), through values
    (m, p) whose noise has a variance (m, p)."""
    mean, variance = np.zeros((len(cross), len(signal))), np.zeros((len(cross), len(signal)))
    for c in np.flatnonzero(signal):
        factor = cho_factor(signal[c] * inner + np.diag(noise[:, c]))
        mean[:, c] = signal[c] * cross @ cho_solve(factor, values[:, c])
        gain = cho_solve(factor, cross.T)
        variance[:, c] = signal[c] * alone - signal[c] ** 2 * np.einsum("ij,ji->i", cross, gain)
    return mean, np.maximum(variance, 0.0)


def _likelihoods(kernel: FloatArray, amplitude: FloatArray, noise: FloatArray, values: FloatArray) -> FloatArray:
    """(p,) log likelihoods of columns of values (m, p): kernel (m, m) times amplitudes (p,), plus noise (m, p)."""
    m = len(values)
    covariance = kernel * amplitude[:, None, None] + np.eye(m) * noise.T[:, None]
    factor = np.linalg.cholesky(covariance)
    z = np.linalg.solve(factor, values.T[..., None])[..., 0]
    return np.asarray(-np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1) - 0.5 * np.sum(z**2, axis=1))


def _base_kernel(a: FloatArray, b: FloatArray) -> FloatArray:
    product_ = a @ b.T
    near = np.exp(-0.5 * np.sum((a[:, None] - b[None]) ** 2, axis=-1) / LENGTH**2)
    return SHARES[0] + SHARES[1] * product_ + SHARES[2] * product_**2 + near


def _increment_kernel(a: Points, b: Points, lengths: Sequence[float]) -> FloatArray:
    apart = [
        np.sum(((x[:, None] - y[None]) / length) ** 2, axis=-1) for x, y, length in zip(a, b, lengths, strict=True)
    ]
    return np.asarray(a[1] @ b[1].T / HALFWAY**2 * np.exp(-0.5 * sum(apart)))
