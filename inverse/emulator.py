"""An emulator of features: what a simulation would say of them, and how sure that is, in microseconds.

Features (residuals of hundreds of blocks) vary along few directions when parameters do. Principal components find
these, and each component's score is a Gaussian process over the parameters, averaged over draws of its hyperparameters
(Higdon et al. 2008, J. Am. Stat. Assoc. 103:570). The scatter between particle seeds is the processes' noise: what is
predicted is the mean over seeds, and chance is reported apart, as it is over the whole range of the points.

Components are those of evaluations, chance included, and so each evaluation's own chance lies partly along them, which
a new observation's doesn't: their scores are too large, and parameters read off them too near the middle. Scores are
shrunk by the share that isn't chance's (Lee, Zou & Wright 2010, Ann. Stat. 38:3605, for many more features than
evaluations).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import digamma, erf, polygamma

from .process import Process

FloatArray = npt.NDArray[np.float64]

#: Share of the training features' variance that the components keep, and the most of them.
VARIANCE, MOST = 0.995, 10
#: A component predicted worse than this (share of its variance, points left out) says nothing of the parameters.
LEAST_SKILL = 0.1
#: Nor does one of whose variance less than this is anything but its evaluations' own chance.
LEAST_SHARE = 0.25
#: Share of the scores' variance that points left out must be predicted with, or the loss is the better guide.
TRUSTED_SKILL = 0.6
#: Half the step of derivatives, of an axis from -1 to 1.
STEP = 0.01
#: Fewest training evaluations, beyond one for each parameter.
FEWEST = 4


#: A normal distribution's standard deviation over its median distance from the middle.
MAD = 1.4826
#: Standard deviations of what isn't explained from which a feature counts with its distance only, and rounds of that.
HUBER, HUBER_ROUNDS = 2.5, 30
#: Degrees of freedom of what features have in common, from which they don't differ.
MOST_SHARED = 1e4
#: Variances below this share of the middle one are rounding's.
ROUNDING = 1e-12
#: A feature's error variance is at least this share of the middle one's: what hardly varies isn't known better for it.
LEAST_ERROR = 1e-3


@dataclass(frozen=True)
class LeftOut:
    """How well training points are predicted by the others.

    Attributes:
        skill: (p,) 1 − mean square error / variance, for each component; 1 is perfect, 0 no better than the mean.
        z: (m, p) standardised errors, whose root mean square is 1 when the quoted variance is right.
        coverage: share of errors inside the central 90 % interval.
    """

    skill: FloatArray
    z: FloatArray
    coverage: float


class Emulator:
    """Principal components of features, and a Gaussian process for each.

    Args:
        points: (m, n) parameters in [-1, 1]; a point may repeat, with another seed.
        features: (m, b) of the simulations there.
        seed: of the hyperparameters' draws.
        scale: (b,) units in which features are compared, such as `error_scale`; their own by default.

    Attributes:
        centre: (b,) mean features.
        scale: (b,) units of the features.
        basis: (b, p) orthonormal directions of features in these units.
        chance: (p, p) covariance of one simulation's scores about the mean over seeds, its expectation.
        left_out: leave-one-out diagnostics.

    Raises:
        ValueError: too few points, features that aren't finite, or shapes that don't agree.
    """

    def __init__(
        self, points: npt.ArrayLike, features: npt.ArrayLike, *, seed: int = 0, scale: FloatArray | None = None
    ) -> None:
        self.points = np.atleast_2d(np.asarray(points, dtype=np.float64))
        features = np.asarray(features, dtype=np.float64)
        m, n = self.points.shape
        if features.ndim != 2 or len(features) != m or features.shape[1] == 0:
            raise ValueError(f"{m} points need features of shape ({m}, b), not {features.shape}")
        if not np.all(np.isfinite(features)):
            raise ValueError("some features are not finite")
        if m < n + FEWEST:
            raise ValueError(f"{m} evaluations are too few to emulate {n} parameters; {n + FEWEST} are needed at least")
        self.centre = features.mean(axis=0)
        self.scale = np.ones(features.shape[1]) if scale is None else scale
        varying = (features - self.centre) / self.scale
        left, size, right = np.linalg.svd(varying, full_matrices=False)
        share = np.cumsum(size**2) / max(float(np.sum(size**2)), 1e-300)
        count = min(int(np.searchsorted(share, VARIANCE)) + 1, MOST, m - 2)
        if size[0] <= 1e-12 * max(1.0, float(np.abs(self.centre).max())):
            raise ValueError("the features are the same wherever they were simulated: there is nothing to emulate")
        scores = left[:, :count] * size[:count]
        processes = [Process(self.points, scores[:, k], seed + k) for k in range(count)]
        # All of it chance: one component stays, so that what follows can say that nothing is determined.
        skilful = [k for k, process in enumerate(processes) if process.skill() > LEAST_SKILL] or [0]
        kept, share = beyond_chance(size**2, skilful, *features.shape)
        self._tells = bool(np.all(share >= LEAST_SHARE))
        share = np.maximum(share, LEAST_SHARE)
        self._processes = [processes[k].shrunk(by) for k, by in zip(kept, share, strict=True)]
        self.basis = right[kept].T.copy()
        self.scores = scores[:, kept] * share
        self._outside = varying - scores[:, kept] @ self.basis.T
        self.chance = self._measure_chance()
        self.left_out = self._leave_out()

    @property
    def dimension(self) -> int:
        """Number of parameters n."""
        return self.points.shape[1]

    @property
    def count(self) -> int:
        """Number of components p."""
        return self.basis.shape[1]

    @property
    def freedom(self) -> float:
        """Degrees of freedom behind ``chance``: evaluations less what the processes' means use up, on the average."""
        return float(np.mean([process.freedom() for process in self._processes]))

    @cached_property
    def chance_scale(self) -> FloatArray:
        """(p, p) scale of Student's t with `freedom` that scores have about the mean over seeds.

        Variances of few samples are skewed: `chance` is their mean, and the scale the inverse of their inverses' mean,
        which is the variance that these samples themselves have.
        """
        mean = np.array([process.noise_variance() for process in self._processes])
        scale = np.sqrt(np.array([process.noise_scale() for process in self._processes]) / mean)
        return scale[:, None] * self.chance * scale

    @property
    def trusted(self) -> bool:
        """Whether the features vary in as many ways as there are parameters, and points left out are predicted well."""
        return self.count >= self.dimension and self.skilled

    @property
    def skilled(self) -> bool:
        """Whether features are more than chance, and points left out are predicted well."""
        if not self._tells:
            return False
        weight = self.scores.var(axis=0)
        return float(weight @ self.left_out.skill) >= TRUSTED_SKILL * float(weight.sum())

    @property
    def outside_variance(self) -> FloatArray:
        """(b,) variance, over training points, of the part of each feature that the components leave out, in units
        of the scale."""
        dof = max(len(self.points) - 1 - self.count, 1)
        return np.sum(self._outside**2, axis=0) / dof

    def project(self, features: npt.ArrayLike) -> FloatArray:
        """Scores (…, p) of features (…, b)."""
        return (np.asarray(features, dtype=np.float64) - self.centre) / self.scale @ self.basis

    def project_robustly(self, features: npt.ArrayLike) -> FloatArray:
        """Scores (p,) of features (b,) of which some are far from what any parameter explains.

        Huber's M-estimate by iterated weights, with the size of what isn't explained read off its median (Huber and
        Ronchetti, Robust Statistics, 2009, 7.8): a lump that fell elsewhere, or a shadow's edge, counts with its
        distance and not with the square of it.
        """
        varying = (np.asarray(features, dtype=np.float64) - self.centre) / self.scale
        scores = varying @ self.basis
        for _ in range(HUBER_ROUNDS):
            off = np.abs(varying - self.basis @ scores)
            limit = HUBER * MAD * float(np.median(off))
            weight = np.where(off > limit, limit / np.maximum(off, 1e-300), 1.0)
            if limit == 0.0:
                break
            weighted = self.basis * weight[:, None]
            scores = np.linalg.solve(weighted.T @ self.basis, weighted.T @ varying)
        return np.asarray(scores)

    def remainder(self, features: npt.ArrayLike) -> FloatArray:
        """The part (…, b) of features that no parameter can explain: outside the basis, in units of the scale."""
        varying = (np.asarray(features, dtype=np.float64) - self.centre) / self.scale
        return varying - (varying @ self.basis) @ self.basis.T

    def predict(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean (q, p) of the scores over seeds, and variance (q, p) of what is known of it, at points (q, n)."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        found = [process.predict(where) for process in self._processes]
        return np.stack([mean for mean, _ in found], axis=1), np.stack([var for _, var in found], axis=1)

    def features(self, points: npt.ArrayLike) -> FloatArray:
        """Mean features (q, b) at points (q, n)."""
        return self.centre + self.predict(points)[0] @ self.basis.T * self.scale

    def chance_variance(self) -> FloatArray:
        """(b,) variance of one simulation's features about the mean over seeds."""
        within = np.einsum("bp,pq,bq->b", self.basis, self.chance, self.basis)
        return np.asarray((within + self.outside_variance) * self.scale**2)

    def _measure_chance(self) -> FloatArray:
        """Variances as the processes infer them over the whole range of the points, correlations as the scatter about
        their means shows them, leaning on none where points are few."""
        residuals = np.stack([process.residuals() for process in self._processes], axis=1)
        noise = np.array([process.noise_variance() for process in self._processes])
        # As much weight for independence as for p + 1 evaluations: the fewest that make a covariance.
        shown = residuals.T @ residuals + (self.count + 1.0) * np.diag(noise)
        scale = np.sqrt(noise / np.diag(shown))
        return scale[:, None] * shown * scale

    def _leave_out(self) -> LeftOut:
        """Each point, with its repeats, predicted by all others with the same hyperparameters."""
        z = np.empty_like(self.scores)
        skill = np.empty(self.count)
        for k, process in enumerate(self._processes):
            error, std = process.left_out
            z[:, k] = error / std
            skill[k] = process.skill()
        return LeftOut(skill, z, float(np.mean(np.abs(z) < 1.6449)))


def beyond_chance(
    squares: FloatArray, chosen: list[int], evaluations: int, features: int
) -> tuple[list[int], FloatArray]:
    """Components that are more than chance, and the share of each one's squares that isn't an evaluation's own.

    What no chosen component holds is chance, alike in all directions. The squared length of one evaluation's stands in
    the sum of squares of each component, because components are made of evaluations. The weakest are dropped, one after
    the other, until each has `LEAST_SHARE` beyond that; the last one stays.

    Args:
        squares: sums of squares of all components.
        chosen: indices of those that may be more than chance.
        evaluations: m, less one of which the mean has used.
        features: b.
    """
    kept = sorted(chosen)
    while True:
        left = (max(evaluations - 1 - len(kept), 1), max(features - len(kept), 1))
        own = float(squares.sum() - squares[kept].sum()) * features / (left[0] * left[1])
        share = 1.0 - own / squares[kept]
        weakest = int(np.argmin(share))
        if len(kept) == 1 or share[weakest] >= LEAST_SHARE:
            return kept, share
        del kept[weakest]


def slopes_of(emulator: Emulator, point: FloatArray) -> FloatArray:
    """(p, n) derivatives of the mean scores at a point (n,)."""
    steps = STEP * np.eye(len(point))
    ahead, behind = (emulator.predict(point + side * steps)[0] for side in (1.0, -1.0))
    return np.asarray((ahead - behind).T / (2.0 * STEP))


def weighed_emulator(
    points: npt.ArrayLike, features: npt.ArrayLike, observed: FloatArray, *, seed: int = 0
) -> Emulator:
    """An emulator whose features are compared in units of what each may be off; see `error_scale`."""
    return Emulator(points, features, seed=seed, scale=error_scale(points, features, observed, seed=seed))


def error_scale(points: npt.ArrayLike, features: npt.ArrayLike, observed: FloatArray, *, seed: int = 0) -> FloatArray:
    """How far each feature may be off, over what the middle one may: units to compare features in.

    Where sand slides in lumps, features differ from seed to seed far more than elsewhere, and say as much less of the
    parameters. The model's own error comes on top, as large in one feature as in another: the larger it is, the less
    chance matters.

    Args:
        points: (m, n) parameters in [-1, 1].
        features: (m, b) of the simulations there.
        observed: (b,).
        seed: of the emulator.

    Returns:
        (b,) positive, 1 in the middle.

    Raises:
        ValueError: as `Emulator` does.
    """
    emulator = Emulator(points, features, seed=seed)
    chance = moderated(emulator.chance_variance(), emulator.freedom)
    variance = chance + _beyond(chance, float(np.median(np.abs(emulator.remainder(observed)))))
    middle = float(np.median(variance))
    return np.sqrt(np.maximum(variance / middle, LEAST_ERROR)) if middle > 0.0 else np.ones(len(variance))


def _beyond(chance: FloatArray, median: float) -> float:
    """The variance, the same for all, with which normal errors beyond chance have this median distance from 0."""

    def share(more: float) -> float:
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.mean(np.where(chance + more > 0.0, erf(median / np.sqrt(2.0 * (chance + more))), 1.0)))

    most = (MAD * median) ** 2
    # With this much alone half of the errors are nearer; with less than nothing, all that there is, is chance.
    if most == 0.0 or share(0.0) <= 0.5:
        return 0.0
    return float(brentq(lambda more: share(more) - 0.5, 0.0, 2.0 * most))


def moderated(variances: FloatArray, freedom: float) -> FloatArray:
    """Variances of many things, each known from few samples, drawn towards what they have in common.

    As far as samples of ``freedom`` degrees of freedom scatter more than such samples of one variance would, the things
    differ (empirical Bayes with an inverse-χ² prior fitted by moments of logarithms; Smyth 2004, Stat. Appl. Genet.
    Mol. Biol. 3:3, section 6.2).

    Args:
        variances: (b,) sampled; those of things that don't vary become 0.
        freedom: behind each.

    Returns:
        (b,) means of the variances' posteriors' scale.
    """
    some = variances > ROUNDING * float(np.median(variances))
    if np.count_nonzero(some) < 3 or freedom < 1.0:
        return np.full(len(variances), float(np.median(variances)))
    half = 0.5 * freedom
    logs = np.log(variances[some]) - digamma(half) + np.log(half)
    spread = float(np.var(logs, ddof=1)) - float(polygamma(1, half))
    if spread <= float(polygamma(1, MOST_SHARED / 2.0)):
        return np.where(some, np.exp(logs.mean()), 0.0)
    prior = 2.0 * brentq(lambda x: float(polygamma(1, x)) - spread, 1e-3, MOST_SHARED / 2.0)
    common = float(np.exp(logs.mean() + digamma(0.5 * prior) - np.log(0.5 * prior)))
    return np.where(some, (prior * common + freedom * variances) / (prior + freedom), 0.0)
