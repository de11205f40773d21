"""How probable each model is, and what its parameters are: importance sampling over emulators.

The evidence of a model is the mean of its likelihood over its prior (MacKay 2003, Information Theory, Inference, and
Learning Algorithms, ch. 28; Kass & Raftery 1995, J. Am. Stat. Assoc. 90:773). The likelihood is normal, with the
emulator's own doubt beside the noise; the numerics' factors are integrated over, which makes its tails long. Points are
a Sobol sequence over the prior, then draws where the posterior is (adaptive importance sampling with a defensive share
of the prior: Cappé et al. 2008, Stat. Comput. 18:447; Hesterberg 1995, Technometrics 37:185). "Something else" is the
base model with a discrepancy larger than numerics (Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63:425).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.special import logsumexp
from scipy.stats import multivariate_t, qmc

from splatsoil.experiment.base import Candidate
from splatsoil.parameters import Parameter, ParameterSpace

from .design import Prior, Run, effect_points, effect_values, sizes
from .emulator import BaseEmulator, IncrementEmulator
from .noise import FACTORS, Noise

FloatArray = npt.NDArray[np.float64]
Prediction = tuple[Mapping[str, FloatArray], FloatArray, FloatArray]
"""Values by name (q,), mean and variance (q, p) of whitened scores."""
Predict = Callable[[FloatArray], Prediction]
"""At points (q, d) of the unit cube."""

POINTS = 2048
"""Of the sequence, and of each later round's draws."""
ROUNDS, DEFENSIVE, HEAVY = 2, 0.2, 5.0
"""Later rounds, the prior's share in them, and degrees of freedom of Student's distribution that makes the rest."""
FEWEST = 40.0
"""Effective points from which a distribution is fitted: weights are flattened until there are as many."""
AS_IT_IS, ELSE = "", "something else"
"""Names of the two models without an effect."""
PRIOR = 0.5
"""Probability of the base model beforehand; the others share the rest."""
SLAB = 4.0
"""Standard deviation of an observation effect's sizes, over the smallest meaningful ones: its drawings are linear."""
NEAR_BOUND, CROWDED = 0.05, 0.10
"""A bound is reached where this share of the axis near it holds more than twice its share of the posterior."""


@dataclass(frozen=True, eq=False)
class Marginal:
    """Weighted draws of one parameter.

    Attributes:
        values: (k,) in its unit.
        weights: (k,) that sum to 1.
    """

    values: FloatArray
    weights: FloatArray

    @property
    def mean(self) -> float:
        """Mean."""
        return float(self.weights @ self.values)

    @property
    def std(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    def quantile(self, share: float) -> float:
        """The value below which a share of the weight lies."""
        order = np.argsort(self.values)
        index = np.searchsorted(np.cumsum(self.weights[order]), share * self.weights.sum())
        return float(self.values[order][min(int(index), len(order) - 1)])

    def bounds_reached(self, parameter: Parameter) -> list[Literal["lower", "upper"]]:
        """Bounds of the parameter's range that the posterior crowds at."""
        unit = ParameterSpace([parameter]).to_unit(self.values[:, None])[:, 0]
        edge = 1.0 - 2.0 * NEAR_BOUND
        near: dict[Literal["lower", "upper"], npt.NDArray[np.bool_]] = {"lower": unit < -edge, "upper": unit > edge}
        return [bound for bound, close in near.items() if float(self.weights @ close) > CROWDED]


@dataclass(frozen=True, eq=False)
class Model:
    """One model that could be true.

    Attributes:
        name: the effect's; `AS_IT_IS`, `ELSE`.
        values: parameters (q,) by name at the points.
        weights: (f, q) posterior by the numerics' factors, summing to 1.
        log_evidence: of it.
    """

    name: str
    values: Mapping[str, FloatArray]
    weights: FloatArray
    log_evidence: float

    @classmethod
    def of(cls, name: str, values: Mapping[str, FloatArray], log: FloatArray, factors: FloatArray) -> Model:
        """From logarithms (f, q) of likelihoods times importance weights, and of the factors' probabilities (f,)."""
        joint = log + factors[:, None]
        weights = np.exp(joint - joint.max())
        return cls(name, values, weights / weights.sum(), float(logsumexp(joint)) - float(np.log(joint.shape[1])))

    def moments(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation of a parameter."""
        marginal = Marginal(self.values[name], self.weights.sum(axis=0))
        return marginal.mean, marginal.std

    @property
    def factors(self) -> FloatArray:
        """(2,) geometric means of the numerics' factors."""
        return np.asarray(np.exp(self.weights.sum(axis=1) @ np.log(FACTORS)))

    def drawn(self, count: int, rng: np.random.Generator) -> list[dict[str, float]]:
        """Parameters drawn from the posterior."""
        weights = self.weights.sum(axis=0)
        chosen = rng.choice(len(weights), count, p=weights / weights.sum())
        return [{name: float(v[i]) for name, v in self.values.items()} for i in chosen]


@dataclass(frozen=True, eq=False)
class Evidence:
    """All models, against one observation.

    Attributes:
        noise: of the scores.
        models: by name.
        probability: of each.
    """

    noise: Noise
    models: Mapping[str, Model]
    probability: Mapping[str, float]

    @property
    def best(self) -> str:
        """The most probable model."""
        return max(self.probability, key=lambda name: self.probability[name])

    def marginal(self, name: str) -> Marginal:
        """Posterior of a base parameter, averaged over models (Hoeting et al. 1999, Stat. Sci. 14:382)."""
        weights = [self.probability[m] * model.weights.sum(axis=0) for m, model in self.models.items()]
        values = [model.values[name] for model in self.models.values()]
        return Marginal(np.concatenate(values), np.concatenate(weights))


@dataclass(frozen=True)
class Likelihood:
    """Of scores whitened by the expected noise.

    Attributes:
        root: (p, p) Cholesky factor of that.
        rotations: for each factor the variances (p,) and directions (p, p) in which its noise is independent.
    """

    root: FloatArray
    rotations: Sequence[tuple[FloatArray, FloatArray]]

    @classmethod
    def of(cls, noise: Noise) -> Likelihood:
        """With the noise of scores."""
        root = np.linalg.cholesky(noise.covariance(np.ones(2)) + 1e-9 * np.eye(len(noise.fixed)))
        rotations = []
        for factor in FACTORS:
            half = solve_triangular(root, noise.covariance(factor), lower=True)
            size, modes = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
            rotations.append((np.maximum(size, 1e-9), modes))
        return cls(np.asarray(root, dtype=np.float64), rotations)

    def white(self, scores: FloatArray) -> FloatArray:
        """(q, p) whitened scores (q, p)."""
        return np.asarray(solve_triangular(self.root, np.atleast_2d(scores).T, lower=True).T)

    def log(self, left: FloatArray, variance: FloatArray, pattern: FloatArray, every: int = 1) -> FloatArray:
        """(f, q) of whitened residuals (q, p) with the emulator's variance (q, p), and free sizes of a pattern (k, p);
        for ``every`` so many factors."""
        out = []
        for size, modes in self.rotations[::every]:
            turned, spread = left @ modes, size + variance @ modes**2
            if len(pattern):
                # one doubt for all points: a pattern's sizes are integrated over in closed form
                inner = np.diag(spread.mean(axis=0)) + SLAB**2 * (pattern @ modes).T @ (pattern @ modes)
                root = np.linalg.cholesky(inner)
                z = solve_triangular(root, turned.T, lower=True)
                out.append(-0.5 * np.sum(z**2, axis=0) - np.log(np.diag(root)).sum())
            else:
                out.append(-0.5 * np.sum(turned**2 / spread + np.log(spread), axis=1))
        return np.array(out)


@dataclass(frozen=True, eq=False)
class Emulated:
    """A model's emulator over the unit cube, on which its prior is uniform.

    Attributes:
        name: the effect's; `AS_IT_IS`.
        predict: values by name, mean and variance (q, p) of whitened scores, at points (q, d) of the cube.
        pattern: (k, p) of an effect of observation, else empty.
        prior: what it predicts at a Sobol sequence.
    """

    name: str
    predict: Predict
    pattern: FloatArray
    prior: tuple[FloatArray, Prediction]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Emulators of all models, ready to meet an observation.

    Attributes:
        noise: of the scores.
        likelihood: of whitened ones.
        models: all but "something else".
        seed: of draws.
    """

    noise: Noise
    likelihood: Likelihood
    models: Sequence[Emulated] = field(repr=False)
    seed: int = 0

    @classmethod
    def of(
        cls,
        noise: Noise,
        prior: Prior,
        candidates: Sequence[Candidate],
        simulated: Mapping[str, tuple[Sequence[Run], FloatArray]],
        seed: int = 0,
    ) -> Comparison:
        """Emulators.

        Args:
            noise: of the observation.
            prior: of the base model's parameters.
            candidates: effects; those of physics that weren't simulated, and those of observation that weren't drawn,
                are left out.
            simulated: runs and scores (m, p) by effect.
            seed: of sequences and draws.
        """
        likelihood = Likelihood.of(noise)
        n = len(prior.space)
        chance = np.maximum(np.diag(likelihood.white(likelihood.white(noise.chance).T)), 1e-4)
        white = likelihood.white(noise.base)
        middle = white.mean(axis=0)
        base = BaseEmulator.through(noise.points, white - middle, chance)

        def as_it_is(cube: FloatArray) -> Prediction:
            where = 2.0 * cube[:, :n] - 1.0
            physical = prior.space.from_unit(where)
            mean, variance = base.predict(where)
            return {p.name: physical[:, i] for i, p in enumerate(prior.space)}, mean + middle, variance

        def with_effect(candidate: Candidate, runs: Sequence[Run], scores: FloatArray) -> Predict:
            k = len(candidate.parameters)
            there, doubt = base.predict(prior.unit(runs))
            points = (prior.unit(runs), *effect_points(candidate, runs))
            emulator = IncrementEmulator.through(points, likelihood.white(scores) - middle - there, chance + doubt)

            def predict(cube: FloatArray) -> Prediction:
                values, mean, variance = as_it_is(cube)
                size, shape = sizes(candidate, cube[:, n : n + k]), 2.0 * cube[:, n + k :] - 1.0
                added, own = emulator.predict((2.0 * cube[:, :n] - 1.0, size, shape))
                return {**values, **effect_values(candidate, size, shape)}, mean + added, variance + own

            return predict

        def emulated(name: str, dimension: int, predict: Predict, *patterns: FloatArray) -> Emulated:
            cube = qmc.Sobol(dimension, seed=seed).random(POINTS)
            return Emulated(name, predict, np.reshape(patterns, (-1, white.shape[1])), (cube, predict(cube)))

        models = [emulated(AS_IT_IS, n, as_it_is)]
        for candidate in candidates:
            if candidate.name in noise.patterns:
                models.append(emulated(candidate.name, n, as_it_is, *likelihood.white(noise.patterns[candidate.name])))
            elif candidate.name in simulated:
                dimension = n + len(candidate.parameters) + len(candidate.shapes)
                models.append(emulated(candidate.name, dimension, with_effect(candidate, *simulated[candidate.name])))
        return cls(noise, likelihood, models, seed)

    def judge(self) -> Evidence:
        """Every model against the observation."""
        sampled = {model.name: self._sampled(model) for model in self.models}
        found = {name: Model.of(name, *points, self.noise.expected) for name, points in sampled.items()}
        found[ELSE] = Model.of(ELSE, *sampled[AS_IT_IS], self.noise.beyond)
        weight = {
            name: model.log_evidence + np.log(PRIOR if name == AS_IT_IS else (1.0 - PRIOR) / (len(found) - 1))
            for name, model in found.items()
        }
        total = logsumexp(list(weight.values()))
        return Evidence(self.noise, found, {name: float(np.exp(w - total)) for name, w in weight.items()})

    def _sampled(self, model: Emulated) -> tuple[Mapping[str, FloatArray], FloatArray]:
        """Parameters (q,) at points drawn where the posterior is, and logarithms (f, q) of their likelihoods times
        importance weights."""
        rng, white = np.random.default_rng([self.seed, 23]), self.likelihood.white(self.noise.observed)[0]
        cube, (values, mean, variance) = model.prior
        importance = np.zeros(len(cube))
        for _ in range(ROUNDS):
            log = self.likelihood.log(white - mean, variance, model.pattern) + self.noise.expected[:, None]
            cube, importance = _drawn(cube, logsumexp(log, axis=0) + importance, rng)
            values, mean, variance = model.predict(cube)
        return values, self.likelihood.log(white - mean, variance, model.pattern) + importance


def _drawn(cube: FloatArray, weights: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """New points (q, d) of the cube where weights (their logarithms) are large, and the logarithms of the prior's
    density over theirs."""
    power, d = 1.0, cube.shape[1]
    while True:
        flat = np.exp(power * (weights - weights.max()))
        flat /= flat.sum()
        if 1.0 / np.sum(flat**2) >= FEWEST or power < 1e-4:
            break
        power *= 0.7
    middle = flat @ cube
    spread = (cube - middle).T @ ((cube - middle) * flat[:, None]) + 1e-8 * np.eye(d)
    student = multivariate_t(middle, spread, df=HEAVY)
    points = np.concatenate(
        [rng.uniform(size=(round(DEFENSIVE * POINTS), d)), student.rvs(POINTS, random_state=rng).reshape(POINTS, d)]
    )
    points = points[np.all((points >= 0.0) & (points <= 1.0), axis=1)]
    # Draws outside of the cube are left out: what is inside is the share that counts.
    inside = max(len(points) - round(DEFENSIVE * POINTS), 1) / POINTS
    share = DEFENSIVE / (DEFENSIVE + inside)
    density = share + (1.0 - share) * student.pdf(points).reshape(-1) / inside
    return points, -np.log(density)
