"""What a diagnosis tells of parameters: weighed by all that is noise, and by numerics that nobody tried, too.

The numerics that were tried are nuisances: the data settle how much there is of each, and hardly widen an estimate. But
another solver, and soil itself, differ from ours in other ways as well. What such a way does to an estimate is told by
those that were tried, each in turn treated as if it hadn't been (a jackknife over numerics: the estimator that knows
only the others is shown the one left out). Where soil is wrong in yet another way, parts of the data contradict each
other. And how far solvers of the same equations are apart is known from others' soil (`Experiment.reproducibility`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from splatsoil.inverse.surrogate import UNINFORMED

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.parameters import Parameter, distance

from .derivatives import ignorance
from .dilution import informed
from .evidence import Evidence, look_from, pair_of
from .floor import Floor, taken_up
from .sight import Sight
from .simulations import Simulations

FloatArray = npt.NDArray[np.float64]

MOST_STEPS = 3
"""Of Gauss and Newton."""


@dataclass(frozen=True)
class Estimate:
    """A parameter with what makes it doubtful.

    Attributes:
        value: of the parameter.
        noise: standard deviation by noise, chance and what the numerics that were tried leave.
        systematic: standard deviation by what is the model's own fault: one more way of computing, such as those that
            were tried, and another solver; in soil that has an effect also contradictions between parts of the data.
        unit: of all three.
        determined: False where it is hardly better known than by the parameter's bounds alone.
    """

    value: float
    noise: float
    systematic: float
    unit: str = ""
    determined: bool = True

    @classmethod
    def of(cls, parameter: Parameter, value: float, noise: float, systematic: float, at: float) -> Estimate:
        """Of a parameter, by standard deviations in its unit as it is at some value."""
        told = cls(value, noise, systematic, parameter.unit)
        return replace(told, determined=told.std < UNINFORMED * ignorance(parameter, at))

    @property
    def std(self) -> float:
        """Standard deviation by both."""
        return math.hypot(self.noise, self.systematic)


def untried(floor: Floor, slopes: FloatArray, precision: FloatArray, doubts: FloatArray | None = None) -> FloatArray:
    """(k,) standard deviations of parameters by numerics that weren't tried; 0 where none were.

    Args:
        floor: noise, and what the numerics that were tried change.
        slopes: (t, s, k) derivatives by the parameters.
        precision: (k, k) what is known of the parameters beforehand.
        doubts: (t, s, k) chance in the derivatives, see :class:`~splatsoil.inverse.criticism.evidence.Vantage`.
    """
    count = floor.tried
    if not count:
        return np.zeros(slopes.shape[-1])
    solver = floor.noise.solver
    along, nuisance = solver.whiten(slopes[floor.noise.seen]), solver.whiten(floor.nuisance)
    chance = np.zeros_like(along) if doubts is None else solver.whiten(doubts[floor.noise.seen])
    shifts = []
    for k in range(count):
        left_out, others = nuisance[:, k], np.delete(nuisance, k, axis=1)
        # Woodbury: the others as noise.
        inner = np.linalg.inv(np.eye(others.shape[1]) + others.T @ others)
        weights, unsure = (columns - others @ (inner @ (others.T @ columns)) for columns in (along, chance))
        known = informed(along.T @ weights, chance.T @ unsure)
        shifts.append(np.linalg.solve(known + precision, weights.T @ left_out))
    return np.asarray(np.sqrt(np.mean(np.square(shifts), axis=0)))


def bounded(systematic: float, parameter: Parameter, value: float) -> float:
    """What is systematic in a parameter at a value, no more than is open before any data."""
    return min(float(systematic), ignorance(parameter, value))


def at_odds(
    floor: Floor, parts: npt.NDArray[np.int64], slopes: FloatArray, precision: FloatArray, residual: FloatArray
) -> FloatArray:
    """(k,) standard deviations by which parts of the data contradict each other on parameters, beyond noise.

    Each part pulls the estimate its own way; noise says how far that may be. A wrong model pulls farther, and the same
    way all over a part (cluster-robust covariance: Liang & Zeger 1986, Biometrika 73:13).

    Args:
        floor: of the residual.
        parts: (t, s) number of the part that a feature belongs to.
        slopes: (t, s, k) derivatives by the parameters.
        precision: (k, k) what is known of the parameters beforehand.
        residual: (t, s) observed minus the mean prediction where the slopes were measured.
    """
    seen = floor.noise.seen
    along, left, part = slopes[seen], residual[seen], parts[seen]
    weights = floor.noise.solver.beside(floor.nuisance).solve(along)
    known = along.T @ weights + precision
    inverse = np.linalg.inv(known)
    rest = left - along @ (inverse @ weights.T @ left)
    pulls = np.stack([weights[part == k].T @ rest[part == k] for k in np.unique(part)], axis=1)
    count = pulls.shape[1]
    if count < 2:
        return np.zeros(len(inverse))
    robust = inverse @ (pulls @ pulls.T * (count / (count - 1))) @ inverse
    return np.asarray(np.sqrt(np.maximum(np.diag(robust - inverse), 0.0)))


def weighed(experiment: Experiment, evidence: Evidence, floor: Floor, basis: FloatArray) -> dict[str, Estimate]:
    """The model's own parameters as it is, by name: one step of generalised least squares from the fit.

    A fit weighs features by chance alone and knows nothing of numerics; here all of the floor counts. Where more is
    left than noise, in the directions (slow waves (n, k) among them) in which anything acts, that widens it (Birge
    1932).
    """
    parameters, values = experiment.parameters, evidence.values
    if not parameters:
        return {}
    slopes = np.stack([evidence.slopes[p.name] for p in parameters], axis=-1)
    doubts = np.stack([evidence.doubt(p.name, evidence.slopes[p.name]) for p in parameters], axis=-1)
    # What is chance in derivatives lies in other directions by each seed: all of both are looked at.
    columns = np.concatenate([floor.parameters, doubts[experiment.seen]], axis=1)
    sight = Sight.of(experiment, replace(floor, parameters=columns), basis, averaged=True)
    along, chance, left = sight(slopes), sight(doubts), sight(experiment.observed - evidence.mean)
    beforehand, scores = prior(parameters, values), along.T @ along
    inverse = np.linalg.inv(informed(scores, chance.T @ chance) + beforehand)
    step = inverse @ along.T @ left
    rest = left - along @ step
    wide = max(1.0, float(rest @ rest) / max(len(rest) - len(step), 1))
    noise = np.sqrt(wide * np.diag(inverse @ (scores + beforehand) @ inverse))
    numerics, out = untried(floor, slopes, beforehand, doubts), {}
    for k, p in enumerate(parameters):
        value = float(np.clip(values[p.name] + step[k], p.lower, p.upper))
        systematic = bounded(math.hypot(numerics[k], experiment.reproducibility(p, value)), p, values[p.name])
        out[p.name] = Estimate.of(p, value, float(noise[k]), systematic, values[p.name])
    return out


def weighed_there(
    experiment: Experiment, evidence: Evidence, floor: Floor, basis: FloatArray, simulate: Simulations
) -> dict[str, Estimate]:
    """The same, by further steps from where one leads, as long as that is farther than derivatives were measured over.

    What soil does over ten degrees isn't what two of them promise. Chance and numerics count as they are at the fit.
    """
    found = weighed(experiment, evidence, floor, basis)
    for _ in range(MOST_STEPS - 1):
        values = {name: estimate.value for name, estimate in found.items()}
        off = {p.name: abs(distance(p, evidence.values[p.name], values[p.name])) for p in experiment.parameters}
        if all(off[name] <= evidence.widths[name] for name in off):
            break
        try:
            evidence = _moved(experiment, evidence, values, simulate)
        except SimulationError:
            break
        floor = replace(floor, parameters=taken_up(experiment, evidence))
        found = weighed(experiment, evidence, floor, basis)
    return found


def _moved(experiment: Experiment, evidence: Evidence, values: Mapping[str, float], simulate: Simulations) -> Evidence:
    """The evidence with its mean prediction and the parameters' derivatives at other values."""
    seeds = range(1, 1 + len(evidence.repeats))

    def look(ask: Callable[..., FloatArray]) -> Evidence:
        def run(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = (), seed: int = 0) -> FloatArray:
            return ask(at, effects=effects, seed=seed, purpose=f"weighing: {purpose}")

        mean = np.mean([run(f"repeat {seed} of {len(seeds)}", values, seed=seed) for seed in seeds], axis=0)
        found = look_from(experiment, values, (), run, pair_of(experiment, len(seeds)))
        moved = {name: getattr(found, name) for name in ("values", "prediction", "slopes", "curves", "widths")}
        return replace(evidence, mean=mean, doubts={**evidence.doubts, **found.doubts}, **moved)

    simulate.ahead(look)
    return look(simulate)


def prior(parameters: Sequence[Parameter], values: Mapping[str, float]) -> FloatArray:
    """(k, k) precision of parameters of which only the bounds are known, at some values."""
    return np.diag([ignorance(p, values[p.name]) ** -2.0 for p in parameters])
