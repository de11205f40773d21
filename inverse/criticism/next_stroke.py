"""Design of the next experiment: the stroke with the largest expected information about which model is correct.

Expected information is the mutual information of model and data (Lindley 1956, Ann. Math. Stat. 27:986) in bits: the
expected decrease of the entropy of the models' probabilities. Each probable model is simulated at draws from its
posterior, each with its own seed. Its data are approximated as normal. The mean is that of its simulations; the
covariance is the simulations' scatter, shrunk and common to all models, plus the noise. Each simulation, with noise
added, is classified by models that leave it out. The estimate is a lower bound in expectation (Barber & Agakov 2003,
Adv. Neural Inf. Process. Syst. 16), so few simulations underestimate it. Its error is the standard error over
simulations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import expit, logsumexp
from scipy.stats import t as student

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.base import Experiment, Run
from splatsoil.parameters import ParameterSpace

from .design import Prior
from .diagnosis import FINE, LISTED, PAIRS
from .evidence import BASE_MODEL, DISCREPANCY, Evidence
from .noise import Tables, noise_of, shrunk
from .power import NAMED
from .simulations import Simulate

STORED_DRAWS = 32
"""Draws from a model's posterior that a diagnosis stores."""
MIN_SIMULATIONS = 3
"""Simulations that a model needs."""
MAX_MODELS = 4
NOISE_DRAWS = 200
"""Draws of the noise for each simulation."""
CONFIDENCE = 0.95
"""Level at which two strokes differ."""


class Proposed(Experiment, Protocol):
    """An experiment that has not been made."""

    def expect(self, table: FloatArray) -> None:
        """Take features (t, s) for those that will be observed."""


@dataclass(frozen=True)
class Information:
    """Expected information of an experiment about which model is correct.

    Attributes:
        bits: (n,) by model, of each simulation: increase of the log2 probability of the correct model; NaN for a
            simulation that failed.
        probability: of the models beforehand, summing to 1.
        pairs: by pair of models the expected posterior probability of the correct one, for prior probabilities of one
            half.
    """

    bits: Mapping[str, FloatArray]
    probability: Mapping[str, float]
    pairs: Mapping[tuple[str, str], float]

    @property
    def mean(self) -> float:
        """Mutual information, bits; a negative estimate is 0."""
        return max(_weighted(self.bits, self.probability)[0], 0.0)

    @property
    def std(self) -> float:
        """Monte-Carlo standard error of the mean."""
        return _weighted(self.bits, self.probability)[1]

    @property
    def distinguished(self) -> list[tuple[str, str]]:
        """Pairs of which the correct one would be named."""
        return [pair for pair, probability in self.pairs.items() if probability >= NAMED]

    def exceeds(self, other: Information) -> bool:
        """Whether this is significantly more than another, for the same draws (Welch's test)."""
        difference = {m: self.bits[m] - other.bits[m] for m in self.bits}
        mean, std, freedom = _weighted(difference, self.probability)
        return bool(mean > student.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * std)


def entropy(probability: Mapping[str, float]) -> float:
    """Entropy of probabilities in bits: the upper bound of the information."""
    p = np.array([v for v in probability.values() if v > 0.0])
    return float(-np.sum(p * np.log2(p)))


def posterior_draws(evidence: Evidence, seed: int) -> dict[str, list[dict[str, float]]]:
    """Draws from the posteriors of the base model and of all listed effects."""
    rng = np.random.default_rng([seed, 29])
    names = [n for n, p in evidence.probability.items() if n == BASE_MODEL or (p >= LISTED and n != DISCREPANCY)]
    return {name: evidence.models[name].sample(STORED_DRAWS, rng) for name in names}


def probable(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """The models that a stroke could distinguish, the most probable first, and their normalised probabilities.

    The discrepancy model predicts nothing. Effects of observation belong to the cameras, not to the soil.

    Args:
        diagnosis: contents of ``diagnosis.json``.

    Raises:
        RunError: there are fewer than two.
    """
    kinds = ("base", "physics")
    models = {m["name"]: m["probability"] for m in diagnosis["models"] if m["kind"] in kinds}
    chosen = sorted((n for n, p in models.items() if p >= LISTED), key=lambda n: -models[n])[:MAX_MODELS]
    if len(chosen) < 2:
        only = f"only {chosen[0].replace('_', ' ') or 'the model as it is'}" if chosen else "none"
        raise RunError(
            f"{only} of the soil models has a probability of {LISTED:g} or more: a stroke has no two models to "
            "distinguish"
        )
    total = sum(models[name] for name in chosen)
    return {name: models[name] / total for name in chosen}


def expected_information(
    experiment: Proposed,
    draws: Mapping[str, Sequence[Mapping[str, float]]],
    probability: Mapping[str, float],
    simulate: Simulate,
    *,
    discretisation_factor: float = 1.0,
    seed: int = 0,
) -> Information:
    """Expected information of an experiment, from simulations of it.

    Args:
        experiment: not made yet.
        draws: parameters by model, equally many for each, the base model included: it determines the noise.
        probability: of the models to distinguish.
        simulate: the experiment's simulations.
        discretisation_factor: of the discretisation error, from the diagnosis.
        seed: of simulations and noise; the same for experiments that are compared with each other.

    Raises:
        SimulationError: too few simulations of a model succeeded.
    """
    runs = runs_of(draws, seed, pairs=FINE in experiment.discretisations)
    # Variants of a simulation follow it directly, while it is in memory.
    first = next((run for run in runs[BASE_MODEL] if _table(simulate, run) is not None), runs[BASE_MODEL][0])
    others = (*experiment.albedo_draws, *experiment.renderings)
    variants = {n: simulate(replace(first, variant=n)) for n in others}
    succeeded: dict[str, BoolArray] = {}
    simulated: dict[str, tuple[list[Run], FloatArray]] = {FINE: ([], np.zeros((0, *experiment.layout.shape)))}
    for name, mine in runs.items():
        found = [_table(simulate, run) for run in mine]
        succeeded[name] = np.array([table is not None for table in found])
        if name != FINE and succeeded[name].sum() < MIN_SIMULATIONS:
            raise SimulationError(f"{name.replace('_', ' ') or 'the model as it is'} could hardly be simulated")
        tables = [table for table in found if table is not None]
        done = [run for run, table in zip(mine, found, strict=True) if table is not None]
        simulated[name] = done, np.array(tables).reshape(-1, *experiment.layout.shape)
    base, fine = simulated[BASE_MODEL], simulated[FINE]
    experiment.expect(base[1].mean(axis=0))
    effects = {name: found for name, found in simulated.items() if name not in (BASE_MODEL, FINE)}
    prior = _range_of(experiment, draws[BASE_MODEL])
    noise = noise_of(experiment, prior, Tables(base, fine, effects, variants, base[1][0]), ())
    # Each simulation contains its own scatter.
    covariance = noise.covariance(discretisation_factor) - noise.scatter
    scores = {name: noise.scores(simulated[name][1]) for name in probability}
    found_bits = information(scores, probability, covariance, seed)
    bits = {name: np.full(len(succeeded[name]), np.nan) for name in probability}
    for name, values in found_bits.bits.items():
        bits[name][succeeded[name]] = values
    return replace(found_bits, bits=bits)


def runs_of(
    draws: Mapping[str, Sequence[Mapping[str, float]]], seed: int, *, pairs: bool = True
) -> dict[str, list[Run]]:
    """Simulations by model, and fine ones."""
    out = {
        name: [Run(v, (name,) if name else (), seed + 1000 * k + i) for i, v in enumerate(values)]
        for k, (name, values) in enumerate(draws.items())
    }
    if pairs:
        first = seed + 1000 * len(draws)
        out[FINE] = [Run(v, seed=first + i, variant=FINE) for i, v in enumerate(draws[BASE_MODEL][:PAIRS])]
    return out


def information(
    scores: Mapping[str, FloatArray], probability: Mapping[str, float], covariance: FloatArray, seed: int = 0
) -> Information:
    """Mutual information of model and data, from simulations of each model.

    Args:
        scores: (n, p) simulated data by model, without noise; at least 3 of each.
        probability: of the models.
        covariance: (p, p) of the noise.
        seed: of the draws of the noise.
    """
    rng = np.random.default_rng([seed, 31])
    root = np.linalg.cholesky(covariance + 1e-9 * np.mean(np.diag(covariance)) * np.eye(len(covariance)))
    white = {name: solve_triangular(root, rows.T, lower=True).T for name, rows in scores.items()}
    names = list(white)
    prior = np.log([probability[name] for name in names])
    bits: dict[str, FloatArray] = {}
    logs: dict[str, FloatArray] = {}
    for m, name in enumerate(names):
        drawn = rng.standard_normal((len(white[name]), NOISE_DRAWS, len(covariance)))
        logs[name] = np.stack([_densities(white, name, i, noise) for i, noise in enumerate(drawn)])
        joint = logs[name] + prior
        bits[name] = ((joint[..., m] - logsumexp(joint, axis=-1) - prior[m]) / np.log(2.0)).mean(axis=1)
    pairs = {}
    for (a, first), (b, second) in combinations(enumerate(names), 2):
        right = expit(logs[first][..., a] - logs[first][..., b]).mean()
        pairs[first, second] = float(0.5 * (right + expit(logs[second][..., b] - logs[second][..., a]).mean()))
    return Information(bits, dict(probability), pairs)


def _densities(white: Mapping[str, FloatArray], left_out: str, index: int, noise: FloatArray) -> FloatArray:
    """(q, k) log density under each model of one simulation plus noise (q, p), with that simulation left out."""
    rest = {name: np.delete(rows, index, axis=0) if name == left_out else rows for name, rows in white.items()}
    residuals = [(rows - rows.mean(axis=0)) * np.sqrt(len(rows) / (len(rows) - 1.0)) for rows in rest.values()]
    scatter, data = shrunk(np.concatenate(residuals)), white[left_out][index] + noise
    out = np.empty((len(noise), len(rest)))
    for k, rows in enumerate(rest.values()):
        # The mean of n simulations has a variance of 1/n.
        root = np.linalg.cholesky(np.eye(len(scatter)) + (1.0 + 1.0 / len(rows)) * scatter)
        z = solve_triangular(root, (data - rows.mean(axis=0)).T, lower=True)
        out[:, k] = -0.5 * np.sum(z**2, axis=0) - np.log(np.diag(root)).sum()
    return out


def _weighted(bits: Mapping[str, FloatArray], probability: Mapping[str, float]) -> tuple[float, float, float]:
    """Mean over models of the simulations' means, its standard error, and the degrees of freedom of that (Welch 1947,
    Biometrika 34:28)."""
    found = {name: values[np.isfinite(values)] for name, values in bits.items()}
    mean = sum(weight * float(found[name].mean()) for name, weight in probability.items())
    own = [weight**2 * float(found[name].var(ddof=1)) / len(found[name]) for name, weight in probability.items()]
    spread = sum(v**2 / (len(found[name]) - 1) for name, v in zip(probability, own, strict=True))
    return mean, float(np.sqrt(sum(own))), sum(own) ** 2 / max(spread, 1e-300)


def _table(simulate: Simulate, run: Run) -> FloatArray | None:
    """(t, s) of a simulation; None where it failed."""
    try:
        return simulate(run)
    except SimulationError:
        return None


def _range_of(experiment: Experiment, draws: Sequence[Mapping[str, float]]) -> Prior:
    """The draws' range of the first parameter: scatter is the residual about a trend in it."""
    first = experiment.parameters[0]
    values = [draw[first.name] for draw in draws]
    low, high = min(values), max(values)
    margin = 1e-6 * (first.upper - first.lower)
    return Prior(ParameterSpace([replace(first, lower=low - margin, upper=high + margin, default=low)]))
