"""Evidence and posterior of each model, by importance sampling on emulators.

The evidence is the mean of the likelihood over the prior (MacKay 2003, Information Theory, Inference, and Learning
Algorithms, ch. 28; Kass & Raftery 1995, J. Am. Stat. Assoc. 90:773). The likelihood is normal; its covariance is noise
plus the emulator's variance. Integrating over the factors of the discretisation error gives it long tails. Points are a
Sobol sequence over the prior, then draws near the posterior (adaptive importance sampling with a defensive share of the
prior: Cappé et al. 2008, Stat. Comput. 18:447; Hesterberg 1995, Technometrics 37:185). The discrepancy model
("something else") is the base model with an error larger than the discretisation error (Kennedy & O'Hagan 2001, J. R.
Stat. Soc. B 63:425).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp
from scipy.stats import multivariate_t, qmc

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.base import Candidate, Run
from splatsoil.parameters import Parameter, ParameterSpace

from .design import Prior, effect_points, effect_values, sizes
from .emulator import BaseEmulator, IncrementEmulator
from .noise import FACTORS, Noise

Prediction = tuple[Mapping[str, FloatArray], FloatArray, FloatArray]
"""Values by name (q,), mean and variance (q, p) of whitened scores."""
Predict = Callable[[FloatArray], Prediction]
"""At points (q, d) of the unit cube."""

SAMPLES = 2048
"""Points of the Sobol sequence, and draws of each later round."""
ROUNDS, DEFENSIVE_SHARE, STUDENT_DOF = 2, 0.2, 5.0
"""Later rounds, the prior's share in them, and degrees of freedom of the Student distribution of the rest."""
MIN_EFFECTIVE_SAMPLES = 40.0
"""Weights are flattened until the effective sample size reaches this; then the Student distribution is fitted."""
BASE_MODEL, DISCREPANCY = "", "something else"
"""Names of the two models without an effect."""
BASE_PRIOR = 0.5
"""Prior probability of the base model; the others share the rest equally."""
OBSERVATION_SIZE_STD = 4.0
"""Prior standard deviation of an observation effect's sizes, over the smallest meaningful ones."""
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
        """Bounds of the parameter's range near which the posterior concentrates."""
        unit = ParameterSpace([parameter]).to_unit(self.values[:, None])[:, 0]
        edge = 1.0 - 2.0 * NEAR_BOUND
        near: dict[Literal["lower", "upper"], BoolArray] = {"lower": unit < -edge, "upper": unit > edge}
        return [bound for bound, close in near.items() if float(self.weights @ close) > CROWDED]


@dataclass(frozen=True, eq=False)
class Model:
    """A model's evidence and posterior.

    Attributes:
        name: the effect's; `BASE_MODEL`, `DISCREPANCY`.
        values: parameters (q,) by name at the importance samples.
        weights: (f, q) posterior over factors of the discretisation error and samples, summing to 1.
        log_evidence: natural logarithm of the evidence.
    """

    name: str
    values: Mapping[str, FloatArray]
    weights: FloatArray
    log_evidence: float

    @classmethod
    def of(cls, name: str, values: Mapping[str, FloatArray], log: FloatArray, log_prior: FloatArray) -> Model:
        """From log likelihoods plus log importance weights (f, q), and log prior probabilities of the factors (f,)."""
        joint = log + log_prior[:, None]
        weights = np.exp(joint - joint.max())
        return cls(name, values, weights / weights.sum(), float(logsumexp(joint)) - float(np.log(joint.shape[1])))

    def moments(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation of a parameter."""
        marginal = Marginal(self.values[name], self.weights.sum(axis=0))
        return marginal.mean, marginal.std

    @property
    def factors(self) -> FloatArray:
        """(2,) geometric means of the factors of the discretisation error."""
        return np.asarray(np.exp(self.weights.sum(axis=1) @ np.log(FACTORS)))

    def sample(self, count: int, rng: np.random.Generator) -> list[dict[str, float]]:
        """Draws of the parameters from the posterior."""
        weights = self.weights.sum(axis=0)
        chosen = rng.choice(len(weights), count, p=weights / weights.sum())
        return [{name: float(v[i]) for name, v in self.values.items()} for i in chosen]


@dataclass(frozen=True, eq=False)
class Evidence:
    """All models, given one observation.

    Attributes:
        noise: of the scores.
        models: by name.
        probability: posterior probability of each.
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
    """Normal likelihood of scores that are whitened by the noise for factors of 1.

    Attributes:
        root: (p, p) Cholesky factor of that noise.
        rotations: for each factor the eigenvalues (p,) and eigenvectors (p, p) of its whitened noise.
    """

    root: FloatArray
    rotations: Sequence[tuple[FloatArray, FloatArray]]

    @classmethod
    def of(cls, noise: Noise) -> Likelihood:
        """With this noise model."""
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

    def log(self, residual: FloatArray, variance: FloatArray, pattern: FloatArray, every: int = 1) -> FloatArray:
        """(f, q) log likelihoods up to a constant.

        Args:
            residual: (q, p) whitened.
            variance: (q, p) of the emulator.
            pattern: (k, p) of an observation effect, whose sizes are integrated over; empty for none.
            every: step through the factors.
        """
        out = []
        for size, modes in self.rotations[::every]:
            turned, spread = residual @ modes, size + variance @ modes**2
            if len(pattern):
                # In closed form, with one emulator variance for all points: the mean.
                inner = np.diag(spread.mean(axis=0)) + OBSERVATION_SIZE_STD**2 * (pattern @ modes).T @ (pattern @ modes)
                root = np.linalg.cholesky(inner)
                z = solve_triangular(root, turned.T, lower=True)
                out.append(-0.5 * np.sum(z**2, axis=0) - np.log(np.diag(root)).sum())
            else:
                out.append(-0.5 * np.sum(turned**2 / spread + np.log(spread), axis=1))
        return np.array(out)


@dataclass(frozen=True, eq=False)
class Emulated:
    """A model's emulator on the unit cube, where its prior is uniform.

    Attributes:
        name: the effect's; `BASE_MODEL`.
        predict: values by name, mean and variance (q, p) of whitened scores, at points (q, d) of the cube.
        pattern: (k, p) of an observation effect, else empty.
        prior: a Sobol sequence and the prediction there.
    """

    name: str
    predict: Predict
    pattern: FloatArray
    prior: tuple[FloatArray, Prediction]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Emulators of all models.

    Attributes:
        noise: of the scores, with the observation.
        likelihood: of whitened scores.
        models: all but the discrepancy model.
        seed: of the samples.
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
        """Train the emulators.

        Args:
            noise: of the observation.
            prior: of the base model's parameters.
            candidates: effects; those without simulations, or without a pattern, are left out.
            simulated: runs and scores (m, p) by effect.
            seed: of sequences and samples.
        """
        likelihood = Likelihood.of(noise)
        n = len(prior.space)
        scatter = np.maximum(np.diag(likelihood.white(likelihood.white(noise.scatter).T)), 1e-4)
        white = likelihood.white(noise.base)
        middle = white.mean(axis=0)
        base = BaseEmulator.through(noise.points, white - middle, scatter)

        def base_model(cube: FloatArray) -> Prediction:
            where = 2.0 * cube[:, :n] - 1.0
            physical = prior.space.from_unit(where)
            mean, variance = base.predict(where)
            return {p.name: physical[:, i] for i, p in enumerate(prior.space)}, mean + middle, variance

        def with_effect(candidate: Candidate, runs: Sequence[Run], scores: FloatArray) -> Predict:
            k = len(candidate.parameters)
            mean_there, variance_there = base.predict(prior.unit(runs))
            points = (prior.unit(runs), *effect_points(candidate, runs))
            increments = likelihood.white(scores) - middle - mean_there
            emulator = IncrementEmulator.through(points, increments, scatter + variance_there)

            def predict(cube: FloatArray) -> Prediction:
                values, mean, variance = base_model(cube)
                size, shape = sizes(candidate, cube[:, n : n + k]), 2.0 * cube[:, n + k :] - 1.0
                increment, its_variance = emulator.predict((2.0 * cube[:, :n] - 1.0, size, shape))
                return {**values, **effect_values(candidate, size, shape)}, mean + increment, variance + its_variance

            return predict

        def emulated(name: str, dimension: int, predict: Predict, *patterns: FloatArray) -> Emulated:
            cube = qmc.Sobol(dimension, seed=seed).random(SAMPLES)
            return Emulated(name, predict, np.reshape(patterns, (-1, white.shape[1])), (cube, predict(cube)))

        models = [emulated(BASE_MODEL, n, base_model)]
        for candidate in candidates:
            if candidate.name in noise.patterns:
                patterns = likelihood.white(noise.patterns[candidate.name])
                models.append(emulated(candidate.name, n, base_model, *patterns))
            elif candidate.name in simulated:
                dimension = n + len(candidate.parameters) + len(candidate.shapes)
                models.append(emulated(candidate.name, dimension, with_effect(candidate, *simulated[candidate.name])))
        return cls(noise, likelihood, models, seed)

    def evidence(self) -> Evidence:
        """Evidence and posterior of every model."""
        sampled = {model.name: self._sample(model) for model in self.models}
        models = {name: Model.of(name, *samples, self.noise.log_prior) for name, samples in sampled.items()}
        models[DISCREPANCY] = Model.of(DISCREPANCY, *sampled[BASE_MODEL], self.noise.log_prior_discrepancy)
        weight = {
            name: model.log_evidence
            + np.log(BASE_PRIOR if name == BASE_MODEL else (1.0 - BASE_PRIOR) / (len(models) - 1))
            for name, model in models.items()
        }
        total = logsumexp(list(weight.values()))
        return Evidence(self.noise, models, {name: float(np.exp(w - total)) for name, w in weight.items()})

    def _sample(self, model: Emulated) -> tuple[Mapping[str, FloatArray], FloatArray]:
        """Importance samples: parameters (q,), and log likelihoods plus log importance weights (f, q)."""
        rng, white = np.random.default_rng([self.seed, 23]), self.likelihood.white(self.noise.observed)[0]
        cube, (values, mean, variance) = model.prior
        importance = np.zeros(len(cube))
        for _ in range(ROUNDS):
            log = self.likelihood.log(white - mean, variance, model.pattern) + self.noise.log_prior[:, None]
            cube, importance = _resampled(cube, logsumexp(log, axis=0) + importance, rng)
            values, mean, variance = model.predict(cube)
        return values, self.likelihood.log(white - mean, variance, model.pattern) + importance


def _resampled(cube: FloatArray, log_weights: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """New points (q, d) of the cube near the posterior, given points (m, d) and their log weights (m,), and log
    importance weights (q,): the prior's density over theirs."""
    power, d = 1.0, cube.shape[1]
    while True:
        flat = np.exp(power * (log_weights - log_weights.max()))
        flat /= flat.sum()
        if 1.0 / np.sum(flat**2) >= MIN_EFFECTIVE_SAMPLES or power < 1e-4:
            break
        power *= 0.7
    middle = flat @ cube
    spread = (cube - middle).T @ ((cube - middle) * flat[:, None]) + 1e-8 * np.eye(d)
    student = multivariate_t(middle, spread, df=STUDENT_DOF)
    defensive = round(DEFENSIVE_SHARE * SAMPLES)
    points = np.concatenate(
        [rng.uniform(size=(defensive, d)), student.rvs(SAMPLES, random_state=rng).reshape(SAMPLES, d)]
    )
    points = points[np.all((points >= 0.0) & (points <= 1.0), axis=1)]
    # Draws outside the cube are rejected; the density is normalised by the share that is left.
    inside = max(len(points) - defensive, 1) / SAMPLES
    share = DEFENSIVE_SHARE / (DEFENSIVE_SHARE + inside)
    density = share + (1.0 - share) * student.pdf(points).reshape(-1) / inside
    return points, -np.log(density)
