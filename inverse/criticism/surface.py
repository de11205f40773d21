"""Features over parameters, through simulations that were made for other ends: a response surface with its own doubt.

Few directions of the features vary by more than the chance of a simulation; singular values tell which (Gavish &
Donoho 2014, IEEE Trans. Inf. Theory 60:5040). Each is a parabola in the parameters, and a Gaussian process about that.
All share length scales and the parabola's share, which some twenty simulations then determine well enough to take the
most probable ones, in tenths of a second; :class:`~splatsoil.inverse.emulator.Emulator` gives each component its own
and averages over them, in seconds. Signal and noise are each direction's own: chance isn't the same in all, and where
it is large a direction looks as if it varied.

A part of the chance is the same in all simulations that share a seed (random effects, Laird & Ware 1982, Biometrics
38:963): within a seed it cancels in differences, over seeds it averages out, and simulations tell how large it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from splatsoil.inverse.hyperparameters import LENGTH_BOUNDS, LENGTH_MEAN, LENGTH_STD

from .noise import triangular

FloatArray = npt.NDArray[np.float64]

MOST = 10
"""Directions of the features."""
LEAST = 1e-4
"""Variance of a simulation's chance at least, of features whose own noise has a variance of 1."""
TREND = 2.0
"""Standard deviation of the logarithm of the parabola's share."""
SIGNAL, NOISE = 0.5, 1.0
"""Standard deviations of the logarithms of a direction's signal and noise about what the singular values say."""
STEP = 1e-6
"""Of differences that make a slope of the likelihood."""
COMMON = 1.5
"""Standard deviation of the logarithm of a seed's chance over that of a simulation alone."""


@dataclass(frozen=True)
class Surface:
    """Emulated features.

    Attributes:
        centre: (d,) mean features.
        basis: (d, p) orthonormal directions that vary.
        points: (m, n) of the simulations, in [-1, 1].
        lengths: (n,) of the processes, in halves of the parameters' ranges.
        trend: variance of a parabola's coefficients over that of the process.
        signal: (p,) variance of each direction's process.
        noise: (p,) variance of a simulation's own chance in each direction.
        common: variance of what all simulations of a seed have in common over that; 0 where none share one.
        root: (m, m) Cholesky factor of chance's covariance, over that noise.
        scores: (m, p) simulations along the directions.
        modes: (m, m) in which both the points' correlation and that of chance are diagonal.
        strengths: (m,) the former there, of the latter as 1.
        doubt: (p,) by which simulations left out are farther off, squared, than what is quoted; 1 at least.
    """

    centre: FloatArray
    basis: FloatArray
    points: FloatArray
    lengths: FloatArray
    trend: float
    signal: FloatArray
    noise: FloatArray
    common: float
    root: FloatArray
    scores: FloatArray
    modes: FloatArray
    strengths: FloatArray
    doubt: FloatArray

    @classmethod
    def through(cls, points: FloatArray, features: FloatArray, seeds: npt.ArrayLike) -> Surface:
        """Through simulations.

        Args:
            points: (m, n) in [-1, 1].
            features: (m, d) of the simulations there, in units of their noise.
            seeds: (m,) theirs.

        Raises:
            ValueError: fewer than three simulations, or all alike.
        """
        m, n = points.shape
        if m < 3:
            raise ValueError(f"{m} simulations make no surface")
        alike = np.equal.outer(np.asarray(seeds), np.asarray(seeds))
        centre = features.mean(axis=0)
        within, free = _within(features, np.asarray(seeds))
        _, size, right = np.linalg.svd(within, full_matrices=False)
        size = size[: free + 1]
        count = int(np.clip(np.sum(size > _edge(size, (free + 1, features.shape[1]))), 1, max(min(MOST, free - 1), 1)))
        if size[0] <= 1e-12 * max(1.0, float(np.abs(centre).max())):
            raise ValueError("the features are the same wherever they were simulated")
        scores = (features - centre) @ right[:count].T
        level = max(float(np.sum(size[count:] ** 2)) / max((free - count) * (features.shape[1] - count), 1), LEAST)
        signal = np.maximum(np.mean(scores**2, axis=0) - level, 1e-3 * level)
        apart = bool(alike.sum() > m)  # else nothing tells a seed's chance from a simulation's own

        density = _Density(points, scores, alike, signal, level, apart)
        starts = [np.where(np.arange(density.size) < n, np.log(length), 0.0) for length in (0.5, 2.0)]
        found = (minimize(density, s, jac=True, bounds=density.bounds, method="L-BFGS-B") for s in starts)
        best = min(found, key=lambda found: found.fun).x
        lengths, trend, common = density.shared(best)
        strengths, modes, root = _modes(points, lengths, trend, alike, common)
        signal, noise = density.own(best)
        # Errors of those left out are K⁻¹y / diag(K⁻¹), their variances 1 / diag(K⁻¹).
        inverse = 1.0 / (strengths[:, None] * signal + noise)
        z2 = (modes @ (inverse * (modes.T @ scores))) ** 2 / (modes**2 @ inverse)
        doubt = np.maximum(z2.mean(axis=0), 1.0)
        basis = right[:count].T
        return cls(centre, basis, points, lengths, trend, signal, noise, common, root, scores, modes, strengths, doubt)

    def project(self, features: FloatArray) -> FloatArray:
        """Features (…, d) along the directions (…, p)."""
        return np.asarray((features - self.centre) @ self.basis)

    def remainder(self, features: FloatArray) -> FloatArray:
        """What of features (…, d) no parameter varies."""
        return np.asarray(features - self.centre - self.project(features) @ self.basis.T)

    def predict(self, where: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean features over seeds along the directions, and its variance, (q, p) each, at points (q, n)."""
        seen, gain = _kernel(where, self.points, self.lengths, self.trend) @ self.modes, self._gain
        alone = 1.0 + self.trend * (np.sum(where**2, axis=1) + 0.5 * np.sum(where**2, axis=1) ** 2)
        variance = self.doubt * self.signal * (alone[:, None] - seen**2 @ gain)
        return seen @ (gain * (self.modes.T @ self.scores)), np.maximum(variance, 0.0)

    def slopes(self, where: FloatArray) -> FloatArray:
        """Derivatives (n, p) of the mean features along the directions, at one point (n,)."""
        slopes = _kernel_slopes(where, self.points, self.lengths, self.trend)
        return slopes @ self.modes @ (self._gain * (self.modes.T @ self.scores))

    def patterns(self, tables: FloatArray) -> FloatArray:
        """(p, …) what the directions are in tables (m, …) of the simulations: regressed on their scores, by chance's
        covariance (generalised least squares)."""
        columns = np.column_stack([np.ones(len(tables)), self.scores])
        columns, told = (triangular(self.root, a) for a in (columns, tables.reshape(len(tables), -1)))
        return np.asarray(np.linalg.lstsq(columns, told, rcond=None)[0][1:].reshape(-1, *tables.shape[1:]))

    @property
    def _gain(self) -> FloatArray:
        """(m, p) what a mode's score counts for in a prediction."""
        return np.asarray(self.signal / (self.strengths[:, None] * self.signal + self.noise))


@dataclass(frozen=True)
class _Density:
    """Minus the log posterior density of the logarithms of lengths (n,), the parabola's share, what a seed's
    simulations have in common, and signals and noises (p,) over those that singular values say.

    Attributes:
        points: (m, n) of the simulations.
        scores: (m, p) of these.
        alike: (m, m) whether two share a seed.
        signal: (p,) by singular values.
        level: noise by these, in any direction.
        apart: whether some share a seed, so that anything tells what they have in common.
    """

    points: FloatArray
    scores: FloatArray
    alike: npt.NDArray[np.bool_]
    signal: FloatArray
    level: float
    apart: bool

    @property
    def size(self) -> int:
        """Of its argument."""
        return self.points.shape[1] + 2 + 2 * self.scores.shape[1]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Of its argument."""
        n = self.points.shape[1]
        return [LENGTH_BOUNDS] * n + [(-8.0, 8.0)] * (self.size - n)

    def shared(self, at: FloatArray) -> tuple[FloatArray, float, float]:
        """Lengths (n,), the parabola's share, and what a seed's simulations have in common."""
        n = self.points.shape[1]
        return np.exp(at[:n]), float(np.exp(at[n])), float(np.exp(at[n + 1])) * self.apart

    def own(self, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Each direction's signal and noise (p,)."""
        signal, noise = np.exp(at[self.points.shape[1] + 2 :].reshape(2, -1))
        return signal * self.signal, noise * self.level

    def __call__(self, at: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient."""
        n, count = self.points.shape[1], self.scores.shape[1]
        # The prior of lengths is the unit cube's, whose sides are half as long.
        middle = np.array([np.log(2.0) + LENGTH_MEAN + 0.5 * np.log(n)] * n + [0.0] * (self.size - n))
        spread = np.array([LENGTH_STD] * n + [TREND, COMMON] + [SIGNAL] * count + [NOISE] * count)
        value, own = self._likelihood(at)
        slopes = [(self._likelihood(at + step)[0] - value) / STEP for step in STEP * np.eye(n + 2, self.size)]
        z = (at - middle) / spread
        return value + 0.5 * float(z @ z), np.concatenate([slopes, own]) + z / spread

    def _likelihood(self, at: FloatArray) -> tuple[float, FloatArray]:
        """Minus its logarithm, and the derivatives by signals and noises."""
        lengths, trend, common = self.shared(at)
        strengths, modes, root = _modes(self.points, lengths, trend, self.alike, common)
        signal, noise = self.own(at)
        of_signal = signal * strengths[:, None]
        variance, squares = of_signal + noise, (modes.T @ self.scores) ** 2
        value = np.sum(np.log(variance) + squares / variance) + 2.0 * len(signal) * np.sum(np.log(np.diag(root)))
        pull = 1.0 / variance - squares / variance**2
        own = [np.sum(pull * part, axis=0) for part in (of_signal, noise)]
        return 0.5 * float(value), 0.5 * np.concatenate(own)


def _kernel(a: FloatArray, b: FloatArray, lengths: FloatArray, trend: float) -> FloatArray:
    """(q, m) covariance at two sets of points, over the process' variance."""
    product = a @ b.T
    near = np.exp(-0.5 * np.sum(((a[:, None] - b[None]) / lengths) ** 2, axis=-1))
    return near + trend * (product + 0.5 * product**2)


def _kernel_slopes(where: FloatArray, b: FloatArray, lengths: FloatArray, trend: float) -> FloatArray:
    """(n, m) derivatives of the same at a point (n,)."""
    apart = where - b
    near = np.exp(-0.5 * np.sum((apart / lengths) ** 2, axis=1))
    return np.asarray((trend * (1.0 + b @ where)[:, None] * b - near[:, None] * apart / lengths**2).T)


def _within(features: FloatArray, seeds: npt.NDArray[np.int_]) -> tuple[FloatArray, int]:
    """Features (m, d) less the mean of their seed's (of all, where a seed has but one), and how many are independent.

    What simulations of a seed have in common would else be taken for what soil does.
    """
    _, group, size = np.unique(seeds, return_inverse=True, return_counts=True)
    means = np.stack([features[group == g].mean(axis=0) for g in range(len(size))])
    means[size == 1] = features.mean(axis=0)
    return features - means[group], len(features) - int(np.sum(size > 1)) - int(np.any(size == 1))


def _modes(
    points: FloatArray, lengths: FloatArray, trend: float, alike: npt.NDArray[np.bool_], common: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Strengths (m,) of the points' correlation and modes (m, m) with which it is theirs and chance's is 1, and the
    Cholesky factor (m, m) of the latter."""
    chance = np.linalg.cholesky(common * alike + np.eye(len(points))).astype(np.float64)
    half = triangular(chance, _kernel(points, points, lengths, trend))
    strengths, modes = np.linalg.eigh(triangular(chance, half.T))
    return np.maximum(strengths, 0.0), triangular(chance, modes, transposed=True), chance


def _edge(size: FloatArray, shape: tuple[int, int]) -> float:
    """Singular value up to which a matrix of that shape may be noise, by the middle one."""
    few, many = sorted(shape)
    ratio = few / many
    # The centre is taken off, so the last one is 0.
    return float((0.56 * ratio**3 - 0.95 * ratio**2 + 1.82 * ratio + 1.43) * np.median(size[:-1]))
