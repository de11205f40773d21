"""Refitting with an effect on: Gauss-Newton on whitened features, the derivatives mended by what each step shows.

Some ten simulations, enough to say how far χ² really falls; :mod:`.reading` goes on from there where simulations have
chance in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.optimize import lsq_linear

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.parameters import Parameter, ParameterSpace, distance

from .derivatives import around, derivatives, ignorance
from .noise import Noise, independent
from .simulations import Simulations

FloatArray = npt.NDArray[np.float64]

TRUST = 0.5
"""First trust region, as a share of each parameter's range."""
LEAST_FALL, LEAST_SHARE = 0.1, 2e-4
"""Falls of χ² below this, or below this share of it, are not worth a simulation: an estimate that is one standard
deviation off costs one unit."""
IDLE = 2
"""Steps in a row that bring too little, after which a refit ends."""
ROUNDS = 3
"""Most times that derivatives are measured anew where a refit stands."""


@dataclass(frozen=True)
class Refit:
    """Where a refit ended.

    Attributes:
        values: parameters by name.
        chi2: of the whitened residual there.
        prediction: (t, s) the features predicted there.
        simulations: how many were tried.
        slopes: (t, s, k) the derivatives there: as last mended, or of the surface that the parameters were read off.
    """

    values: Mapping[str, float]
    chi2: float
    prediction: FloatArray
    simulations: int
    slopes: FloatArray


@dataclass(frozen=True)
class Known:
    """What other measurements say of parameters: normal about a centre.

    Attributes:
        root: (m, k) whose product with a distance from the centre has independent errors of variance 1.
        centre: (k,).
    """

    root: FloatArray
    centre: FloatArray

    @classmethod
    def nothing(cls, count: int) -> Known:
        """Of ``count`` parameters nothing is known."""
        return cls(np.zeros((0, count)), np.zeros(count))

    def scaled(self, space: ParameterSpace, about: Mapping[str, float]) -> Known:
        """The same of parameters in [-1, 1]; along logarithmic scales as they are at some values."""
        scale = half_ranges(space.parameters, about)
        here = space.to_vector(about)
        return Known(self.root * scale, space.to_unit(here) + (self.centre - here) / scale)

    def chi2(self, at: FloatArray) -> float:
        """Of parameters (k,)."""
        return float(np.sum((self.root @ (self.centre - at)) ** 2))

    def chance(self, at: FloatArray) -> float:
        """Of what is known, or more, if the parameters were (k,)."""
        return float(stats.chi2.sf(self.chi2(at), len(self.root))) if len(self.root) else 1.0


def refit(
    predict: Callable[[Mapping[str, float]], FloatArray],
    whiten: Callable[[FloatArray], FloatArray],
    observed: FloatArray,
    parameters: Sequence[Parameter],
    start: Mapping[str, float],
    prediction: FloatArray,
    slopes: FloatArray,
    *,
    chance: bool,
    known: Known | None = None,
    most: int = 5,
    least: float = -math.inf,
) -> Refit:
    """Minimise χ².

    Args:
        predict: (t, s) features by parameters.
        whiten: a (t, s, …) table to whitened features (n, …), those only that the refit may see.
        observed: (t, s).
        parameters: free ones, with bounds.
        start: their values.
        prediction: (t, s) there.
        slopes: (t, s, k) derivatives there.
        chance: whether predictions hold some.
        known: what other measurements say of the parameters.
        most: simulations.
        least: fall of χ², over what each number still holds, below which a step counts as idle; after two such in a row
            (the first may have gone too far) there are no more.
    """
    space = ParameterSpace(parameters)
    at = space.to_unit(space.to_vector(start))
    scale = half_ranges(parameters, start)
    widths = measured_over(parameters, start) / scale
    slopes, here = slopes * scale, prediction
    other = (known or Known.nothing(len(at))).scaled(space, start)
    chi2 = float(np.sum(whiten(observed - here) ** 2) + other.chi2(at))
    trust, tried, idle = 2.0 * TRUST, 0, 0
    while tried < most:
        matrix = np.concatenate([whiten(slopes), other.root])
        target = np.concatenate([whiten(observed - here), other.root @ (other.centre - at)])
        low, high = np.maximum(-1.0 - at, -trust), np.minimum(1.0 - at, trust)
        high = np.maximum(high, low + 1e-9)
        step = np.clip(lsq_linear(matrix, target, bounds=(low, high)).x, low, high)
        predicted = chi2 - float(np.sum((target - matrix @ step) ** 2))
        # A fall below the noise, or a step nobody would notice: done.
        if predicted < least_fall(chi2) or np.max(np.abs(step)) < 2e-3:
            break
        there = np.clip(at + step, -1.0, 1.0)
        tried += 1
        try:
            table = predict(space.to_dict(space.from_unit(there)))
        except SimulationError:
            trust *= 0.4
            continue
        moved = there - at
        if not np.any(moved):
            break
        slopes = mended(slopes, table - here, moved, widths, chance=chance)
        fresh = float(np.sum(whiten(observed - table) ** 2) + other.chi2(there))
        fall = chi2 - fresh
        gain = fall / predicted
        if fresh < chi2:
            at, here, chi2 = there, table, fresh
        idle = idle + 1 if fall < least * max(1.0, chi2 / max(len(target) - len(at), 1)) else 0
        if idle == IDLE:
            break
        trust = min(2.0 * trust, 2.0) if gain > 0.75 else trust if gain > 0.25 else 0.4 * float(np.max(np.abs(step)))
    values = space.to_dict(space.from_unit(at))
    return Refit(values, chi2, here, tried, slopes / half_ranges(parameters, values))


def least_fall(chi2: float) -> float:
    """Fall of χ² that is worth a simulation."""
    return max(LEAST_FALL, LEAST_SHARE * chi2)


@dataclass(frozen=True)
class Start:
    """Where a refit may begin.

    Attributes:
        values: parameters by name.
        prediction: (t, s) features there.
        slopes: (t, s, k) derivatives there.
    """

    values: Mapping[str, float]
    prediction: FloatArray
    slopes: FloatArray


def settle(
    predict: Callable[[Mapping[str, float]], FloatArray],
    whiten: Callable[[FloatArray], FloatArray],
    observed: FloatArray,
    parameters: Sequence[Parameter],
    starts: Sequence[Start],
    *,
    chance: bool,
    known: Known | None = None,
    renewed: Sequence[str],
    most: int = 5,
    rounds: int = ROUNDS,
    least: float = -math.inf,
) -> Refit:
    """Minimise χ² from several points, and go on from the best of them until it falls no more than noise does.

    A fit that lacks an effect can lie on a bound, where the derivatives say little of the valley that the effect opens.

    Args:
        predict: see :func:`refit`, like the next three.
        whiten: only what the choice may see.
        observed: (t, s).
        parameters: free ones.
        starts: at least one.
        chance: whether predictions hold some.
        known: see :func:`refit`.
        renewed: names of the parameters whose derivatives are measured anew in each round.
        most: simulations from each start, and two less (but two at least) in each round.
        rounds: most of them.
        least: see :func:`refit`.
    """
    told: dict[str, Any] = {"chance": chance, "known": known, "least": least}
    runs = [
        refit(predict, whiten, observed, parameters, s.values, s.prediction, s.slopes, most=most, **told)
        for s in starts
    ]
    best = min(runs, key=lambda run: run.chi2)
    spent = sum(run.simulations for run in runs)
    for _ in range(rounds):
        if all(np.array_equal(best.prediction, s.prediction) for s in starts):
            break
        slopes = best.slopes.copy()
        for index, parameter in enumerate(parameters):
            if parameter.name not in renewed:
                continue
            value = best.values[parameter.name]
            end = around(parameter, value)[0]
            try:
                change = predict({**best.values, parameter.name: end}) - best.prediction
                slopes[..., index] = change / distance(parameter, value, end)
            except SimulationError:
                continue
            finally:
                spent += 1
        again = refit(
            predict,
            whiten,
            observed,
            parameters,
            best.values,
            best.prediction,
            slopes,
            most=max(most - 2, 2),
            **told,
        )
        fall, spent, best = best.chi2 - again.chi2, spent + again.simulations, again
        if fall < least_fall(again.chi2):
            break
    return replace(best, simulations=spent)


def mended(
    slopes: FloatArray, change: FloatArray, moved: FloatArray, widths: FloatArray, *, chance: bool
) -> FloatArray:
    """The (t, s, k) slopes after a move (k,) that changed the features by ``change`` (t, s).

    Broyden's update, which trusts the last step alone, where predictions are exact. With chance in them, a slope taken
    over a short step is mostly that: old slopes and the new one then count in proportion to the squares of what they
    were taken over, ``widths`` (k,) and the move (Kalman's gain), or a parameter that hardly moved would seem known.
    """
    weight = moved / widths**2
    missing = change - slopes @ moved
    return slopes + missing[..., None] * (weight / (float(chance) + float(weight @ moved)))


def measured_over(parameters: Sequence[Parameter], at: Mapping[str, float]) -> FloatArray:
    """(k,) the steps that derivatives at a point are measured over."""
    values = [(p, float(at[p.name])) for p in parameters]
    return np.array([abs(distance(p, value, around(p, value)[0])) for p, value in values])


def half_ranges(parameters: Sequence[Parameter], at: Mapping[str, float]) -> FloatArray:
    """(k,) what a step of 1 in [-1, 1] is in each parameter's unit at a point."""
    return np.array([math.sqrt(3.0) * ignorance(p, float(at[p.name])) for p in parameters])


def optimum(
    experiment: Experiment, simulate: Simulations, start: Mapping[str, float], *, rounds: int = 2, most: int = 8
) -> dict[str, float]:
    """Least squares over the model's own parameters, for experiments that no other fit was made of.

    Weighs features by the instruments' noise alone; the derivatives are measured afresh in each round.

    Args:
        experiment: what to fit.
        simulate: its simulations.
        start: parameters by name.
        rounds: how often to measure derivatives.
        most: simulations in each round, derivatives aside.
    """
    values = dict(start)
    noise = Noise.of(
        experiment.layout, [(1.0, independent(experiment.sensor, experiment.sensor_memory))], experiment.seen
    ).solver

    def whiten(table: FloatArray) -> FloatArray:
        return noise.whiten(table[experiment.seen])

    for _ in range(rounds):
        middle, slopes = simulate(values), []
        for parameter in experiment.parameters:
            ends = around(parameter, values[parameter.name])
            tables = [simulate({**values, parameter.name: end}) for end in ends]
            offsets = [distance(parameter, values[parameter.name], end) for end in ends]
            slopes.append(derivatives(offsets, tables, middle)[0])
        found = refit(
            simulate,
            whiten,
            experiment.observed,
            experiment.parameters,
            values,
            middle,
            np.stack(slopes, axis=-1),
            chance=experiment.chance,
            most=most,
        )
        values = dict(found.values)
    return values
