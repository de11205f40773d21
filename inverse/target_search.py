"""Where to evaluate next, when an evaluation gives thousands of residuals and not only their sum of squares.

The emulator of the features predicts them at points not evaluated, so the sum of squares there has a mean and a
variance in closed form; the next point is where it is expected to improve most on the least so far (Uhrenholt & Jensen
2019, AISTATS, "Efficient Bayesian optimization for target vector estimation"; here with a normal distribution of that
mean and variance). Residuals are smooth where their sum of squares has a narrow, bent valley, so few evaluations find
its bottom, in several parameters most of all. Features are weighed, and far-off ones count less, as in the estimate
that is made of the evaluations in the end.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from .emulator import Emulator, weighed_emulator
from .surrogate import sobol

FloatArray = npt.NDArray[np.float64]

#: Space-filling candidates; then around this many of the best, at these distances (of an axis from -1 to 1), this many.
CANDIDATES = 1024
BEST, AROUND, EACH = 8, (0.2, 0.05, 0.01), 32


def propose(points: FloatArray, residuals: FloatArray, count: int = 1, *, seed: int = 0) -> FloatArray | None:
    """Where to evaluate next, so that the residuals' sum of squares is expected to fall most.

    Args:
        points: (m, n) evaluated so far, in [-1, 1].
        residuals: (m, b) observed minus predicted features there; 0 where a feature was hidden.
        count: of proposals to be evaluated side by side; each takes the others to come out as emulated.
        seed: of the emulator and the candidates.

    Returns:
        (count, n) in [-1, 1]; None where no emulator can be made, or none to be trusted.
    """
    features = -residuals[:, np.all(residuals != 0.0, axis=0)]
    known, chosen = points, np.empty((0, points.shape[1]))
    for k in range(count):
        try:
            emulator = weighed_emulator(known, features, np.zeros(features.shape[1]), seed=seed + k)
        except ValueError:
            return None
        if not emulator.trusted:
            return None
        following = _most_improving(emulator, seed + k)[None]
        known, chosen = np.concatenate([known, following]), np.concatenate([chosen, following])
        features = np.concatenate([features, emulator.features(following)])
    return chosen


def _most_improving(emulator: Emulator, seed: int) -> FloatArray:
    """The point (n,) of the largest expected improvement of the squared distance to features of 0."""
    target = emulator.project_robustly(np.zeros(len(emulator.centre)))

    def squares(where: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, variance = emulator.predict(where)
        off = (mean - target) ** 2
        # Mean and variance of a sum of squares of independent normals.
        return np.sum(off + variance, axis=1), np.sum(2.0 * variance**2 + 4.0 * variance * off, axis=1)

    least = float(squares(emulator.points)[0].min())

    def improvement(where: FloatArray) -> FloatArray:
        mean, variance = squares(where)
        std = np.sqrt(np.maximum(variance, 1e-300))
        z = (least - mean) / std
        return np.asarray(std * (z * ndtr(z) + np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)))

    rng = np.random.default_rng([seed, 5])
    candidates = sobol(CANDIDATES, emulator.dimension, seed % 2**31)
    # Near the least squares so far, too: with many parameters no space-filling sequence comes close to it.
    candidates = np.concatenate([candidates, emulator.points])
    for distance in AROUND:
        best = candidates[np.argsort(-improvement(candidates))[:BEST]]
        cloud = np.repeat(best, EACH, axis=0) + distance * rng.standard_normal((BEST * EACH, emulator.dimension))
        candidates = np.concatenate([candidates, np.clip(cloud, -1.0, 1.0)])
    return np.asarray(candidates[np.argmax(improvement(candidates))])
