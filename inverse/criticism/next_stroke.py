"""Which experiment next: the one with the most expected information about which model is right.

Expected information is the mutual information of model and data (Lindley 1956, Ann. Math. Stat. 27:986) in bits: by
how much the entropy of the models' probabilities falls on average. Each probable model is simulated at draws of its
posterior, each with particles of its own. Its data are taken for normal (a Gaussian approximation): their mean is the
mean of its simulations; their covariance is what simulations of one model scatter by, shrunk and common to all models,
and the noise. Every simulation, with noise on it, is judged by models from which it has been left out. What such a
judge finds is on average no more than there is (Barber & Agakov 2003, Adv. Neural Inf. Process. Syst. 16), so that few
simulations tell too little and not too much. Its error is that of the mean over simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.special import expit, logsumexp
from scipy.stats import t as student

from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.parameters import ParameterSpace

from .design import Prior, Run
from .diagnosis import FINE, PAIRS, SHOWN
from .evidence import AS_IT_IS, ELSE, Evidence
from .noise import Tables, noise_of, shrunk
from .power import NAMED
from .simulations import Simulate

FloatArray = npt.NDArray[np.float64]

KEPT, DRAWS = 32, 8
"""Draws of a model's posterior that a diagnosis keeps, and how many of them are simulated."""
FEWEST = 3
"""Simulations of a model without which it is not judged."""
MOST_MODELS = 4
NOISES = 200
"""Drawings of the noise for each simulation; their error is part of the simulations' scatter."""
CONFIDENCE = 0.95
"""With which a difference between two strokes is one."""


class Proposed(Experiment, Protocol):
    """An experiment that has not been made."""

    def expect(self, table: FloatArray) -> None:
        """Take features (t, s) for what will be observed."""


@dataclass(frozen=True)
class Information:
    """What an experiment is expected to tell of which model is right.

    Attributes:
        bits: (n,) by model, each simulation's: how much more probable the right model becomes, as a logarithm to base
            2; NaN for a simulation that failed.
        probability: of the models beforehand, summing to 1.
        pairs: by pair of models the probability that the right one of them has afterwards, if both had one half.
    """

    bits: Mapping[str, FloatArray]
    probability: Mapping[str, float]
    pairs: Mapping[tuple[str, str], float]

    @property
    def mean(self) -> float:
        """Mutual information, bits. What is estimated below 0 is 0: it cannot be less."""
        return max(_weighted(self.bits, self.probability)[0], 0.0)

    @property
    def std(self) -> float:
        """Monte-Carlo standard error of it."""
        return _weighted(self.bits, self.probability)[1]

    @property
    def told_apart(self) -> list[tuple[str, str]]:
        """Pairs of which the right one would be named."""
        return [pair for pair, probability in self.pairs.items() if probability >= NAMED]

    def beyond(self, other: Information) -> bool:
        """Whether this is more than another, of the same draws, beyond what chance of simulations explains."""
        apart = {m: self.bits[m] - other.bits[m] for m in self.bits}
        mean, std, freedom = _weighted(apart, self.probability)
        return bool(mean > student.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * std)


def entropy(probability: Mapping[str, float]) -> float:
    """Of probabilities, bits: what could be told at most."""
    p = np.array([v for v in probability.values() if v > 0.0])
    return float(-np.sum(p * np.log2(p)))


def posterior_draws(evidence: Evidence, seed: int) -> dict[str, list[dict[str, float]]]:
    """Parameters drawn from the posteriors of the model as it is and of all probable models."""
    rng = np.random.default_rng([seed, 29])
    names = [n for n, p in evidence.probability.items() if n == AS_IT_IS or (p >= SHOWN and n != ELSE)]
    return {name: evidence.models[name].drawn(KEPT, rng) for name in names}


def probable(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """The models that a stroke could tell apart, the most probable first, and their probabilities among themselves.

    "Something else" predicts nothing, and effects of observation are the cameras' and no soil's.

    Args:
        diagnosis: what ``diagnosis.json`` holds.

    Raises:
        RunError: there is one only, or none.
    """
    kinds = ("base", "physics")
    models = {m["name"]: m["probability"] for m in diagnosis["models"] if m["kind"] in kinds}
    chosen = sorted((n for n, p in models.items() if p >= SHOWN), key=lambda n: -models[n])[:MOST_MODELS]
    if len(chosen) < 2:
        only = f"only {chosen[0].replace('_', ' ') or 'the model as it is'}" if chosen else "none"
        raise RunError(
            f"{only} of the models that soil can follow has a probability of {SHOWN:g} or more: there are no two that "
            "a stroke could tell apart"
        )
    total = sum(models[name] for name in chosen)
    return {name: models[name] / total for name in chosen}


def expected_information(
    experiment: Proposed,
    draws: Mapping[str, Sequence[Mapping[str, float]]],
    probability: Mapping[str, float],
    simulate: Simulate,
    *,
    numerics: float = 1.0,
    seed: int = 0,
) -> Information:
    """What an experiment would tell, by simulations of it.

    Args:
        experiment: not made yet.
        draws: parameters by model, as many for each; the model as it is among them, by which noise is known.
        probability: of the models that may be right.
        simulate: the experiment's simulations.
        numerics: factor of the numerics' error that the diagnosis has found.
        seed: of particles and noise; the same for experiments that are compared with each other.

    Raises:
        SimulationError: too few simulations of a model could be made.
    """
    runs = runs_of(draws, seed, pairs=FINE in experiment.numerics)
    # What draws a simulation otherwise comes right after it, while it is at hand.
    first = next((run for run in runs[AS_IT_IS] if _made(simulate, run) is not None), runs[AS_IT_IS][0])
    others = (*experiment.guesses, *experiment.redrawn)
    drawn = {n: simulate(first.values, seed=first.seed, numerics=n, purpose=n) for n in others}
    there: dict[str, npt.NDArray[np.bool_]] = {}
    kept: dict[str, tuple[list[Run], FloatArray]] = {FINE: ([], np.zeros((0, *experiment.layout.shape)))}
    for name, mine in runs.items():
        found = [_made(simulate, run) for run in mine]
        there[name] = np.array([table is not None for table in found])
        if name != FINE and there[name].sum() < FEWEST:
            raise SimulationError(f"{name.replace('_', ' ') or 'the model as it is'} could hardly be simulated")
        tables = [table for table in found if table is not None]
        made = [run for run, table in zip(mine, found, strict=True) if table is not None]
        kept[name] = made, np.array(tables).reshape(-1, *experiment.layout.shape)
    base, fine = kept[AS_IT_IS], kept[FINE]
    experiment.expect(base[1].mean(axis=0))
    effects = {name: found for name, found in kept.items() if name not in (AS_IT_IS, FINE)}
    prior = _among(experiment, draws[AS_IT_IS])
    noise = noise_of(experiment, prior, Tables(base, fine, effects, drawn, base[1][0]), ())
    # One simulation's own chance is in all of them.
    covariance = noise.covariance(numerics) - noise.chance
    found_bits = information({name: noise.scores(kept[name][1]) for name in probability}, probability, covariance, seed)
    bits = {name: np.full(len(there[name]), np.nan) for name in probability}
    for name, values in found_bits.bits.items():
        bits[name][there[name]] = values
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
        out[FINE] = [Run(v, seed=first + i, numerics=FINE) for i, v in enumerate(draws[AS_IT_IS][:PAIRS])]
    return out


def information(
    scores: Mapping[str, FloatArray], probability: Mapping[str, float], covariance: FloatArray, seed: int = 0
) -> Information:
    """Mutual information of model and data, from simulations of each model.

    Args:
        scores: (n, p) simulated data by model, without noise; at least 3 of each.
        probability: of the models.
        covariance: (p, p) of the noise.
        seed: of drawings of the noise.
    """
    rng = np.random.default_rng([seed, 31])
    root = np.linalg.cholesky(covariance + 1e-9 * np.mean(np.diag(covariance)) * np.eye(len(covariance)))
    white = {name: solve_triangular(root, rows.T, lower=True).T for name, rows in scores.items()}
    names = list(white)
    prior = np.log([probability[name] for name in names])
    bits: dict[str, FloatArray] = {}
    logs: dict[str, FloatArray] = {}
    for m, name in enumerate(names):
        drawn = rng.standard_normal((len(white[name]), NOISES, len(covariance)))
        logs[name] = np.stack([_densities(white, name, i, noise) for i, noise in enumerate(drawn)])
        joint = logs[name] + prior
        bits[name] = ((joint[..., m] - logsumexp(joint, axis=-1) - prior[m]) / np.log(2.0)).mean(axis=1)
    pairs = {}
    for (a, first), (b, second) in combinations(enumerate(names), 2):
        right = expit(logs[first][..., a] - logs[first][..., b]).mean()
        pairs[first, second] = float(0.5 * (right + expit(logs[second][..., b] - logs[second][..., a]).mean()))
    return Information(bits, dict(probability), pairs)


def _densities(white: Mapping[str, FloatArray], held: str, index: int, noise: FloatArray) -> FloatArray:
    """(q, k) log densities by each model of one simulation with noise (q, p) on it, known by the others alone."""
    rest = {name: np.delete(rows, index, axis=0) if name == held else rows for name, rows in white.items()}
    apart = [(rows - rows.mean(axis=0)) * np.sqrt(len(rows) / (len(rows) - 1.0)) for rows in rest.values()]
    scatter, data = shrunk(np.concatenate(apart)), white[held][index] + noise
    out = np.empty((len(noise), len(rest)))
    for k, rows in enumerate(rest.values()):
        # The mean is known no better than its simulations say.
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


def _made(simulate: Callable[..., FloatArray], run: Run) -> FloatArray | None:
    try:
        return simulate(**run.arguments(), purpose=", ".join(run.effects) or run.numerics or "the model as it is")
    except SimulationError:
        return None


def _among(experiment: Experiment, draws: Sequence[Mapping[str, float]]) -> Prior:
    """The range of the draws in the first parameter: about the trend in it the rest is chance."""
    first = experiment.parameters[0]
    values = [draw[first.name] for draw in draws]
    low, high = min(values), max(values)
    margin = 1e-6 * (first.upper - first.lower)
    return Prior(ParameterSpace([replace(first, lower=low - margin, upper=high + margin, default=low)]))
