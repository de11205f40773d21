"""Soil that has an effect, judged by what such soil leaves by chance and by other numerics.

Cohesive soil falls by chance where dry soil flows, and numerics move it farther: what remains after an effect is added
has to be judged by that, and parameters are known no better than it lets them be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .confirmation import (
    Confirmation,
    Report,
    beforehand,
    confirm,
    free_in,
    judged,
    known_of,
    noise_on,
    reach_of,
    split_times,
    stds_of,
    widened,
)
from .estimates import Estimate, at_odds, untried, weighed_there
from .evidence import Evidence, Numerics, Visit, ignorance, other_numerics, pair_of
from .floor import Floor, floor_of
from .misfit import Omnibus, omnibus, smooth_basis
from .reading import read, tangent
from .sight import Sight
from .simulations import Simulations

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OwnFloor:
    """What soil that has an effect leaves by chance and by other numerics.

    Attributes:
        before: misfit of the model as it is on that floor.
        after: of the model with the effect.
        refit: with its parameters read off on that floor, and what that leaves on times hidden from refits.
    """

    before: Omnibus
    after: Omnibus
    refit: Confirmation


def on_its_own_floor(
    experiment: Experiment,
    evidence: Evidence,
    best: Confirmation,
    candidate: Candidate,
    simulate: Simulations,
    residual: FloatArray,
) -> OwnFloor:
    """Judge the model as it is and with its best effect by the chance and numerics of soil that has the effect."""
    told: dict[str, Any] = {"effects": (best.name,), "purpose": f"floor with {best.name}"}
    # Half of the times may have led a refit far along a valley from where all of them say that the parameters are.
    at, middle = best.values, best.fit.prediction
    try:
        middle = simulate(at, **told)
    except SimulationError:
        at = best.fit.values
    seeds = range(1, 1 + len(evidence.repeats))

    def spread(ask: Callable[..., FloatArray]) -> tuple[FloatArray, Numerics, list[FloatArray]]:
        guesses = [ask(at, numerics=name, **told) - middle for name in experiment.guesses]
        numerics = other_numerics(
            experiment, lambda name, seed: ask(at, numerics=name, seed=seed, **told), pair_of(experiment, len(seeds))
        )
        return np.stack([ask(at, seed=seed, **told) for seed in seeds]), numerics, guesses

    simulate.ahead(spread)
    runs, (patterns, doubts), guesses = spread(simulate)
    deviations = (runs - runs.mean(axis=0)) * np.sqrt(len(runs) / max(len(runs) - 1, 1))
    there = replace(
        evidence,
        mean=runs.mean(axis=0),
        repeats=deviations,
        numerics=patterns,
        numerics_doubts=doubts,
        guesses=np.stack(guesses) if guesses else evidence.guesses,
        slopes={},
        curves={},
        widths={},
    )
    floor = floor_of(experiment, there)
    basis = smooth_basis(experiment.layout, floor.noise)
    parameters, slopes = free_in(experiment, candidate), best.fit.slopes
    # Where simulations were too few for a surface at first, they still are.
    visits = (*best.visits, Visit(dict(at), (best.name,), middle)) if best.visits else ()
    if visits:
        slopes = tangent(visits, _sight(experiment, floor, basis, slopes), parameters, at)
    left = (experiment.observed - there.mean)[experiment.seen]
    without = _with(floor, slopes[..., : len(experiment.parameters)])
    after = omnibus(floor.noise, _with(floor, slopes), left, basis)
    refit = replace(best, floor=noise_on(floor.single, judged(experiment, split_times(experiment)[1])))
    if visits:
        values, stds, systematic = _told(
            experiment, there, floor, basis, visits, parameters, at, slopes, after, best.name
        )
        refit = replace(refit, values=values, stds=stds, systematic=systematic)
    return OwnFloor(before=omnibus(floor.noise, without, residual, basis), after=after, refit=refit)


def as_it_is(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    basis: FloatArray,
    found: Confirmation | None,
    simulate: Simulations,
    steps: int,
    told: Report,
) -> dict[str, Estimate]:
    """Parameters of an adequate model that has effects, by name.

    Beside an effect's size the angle lies in a valley, where two seeds' derivatives are little but chance: both are
    read off all simulations of a refit, as they were when the effect was named.

    Args:
        experiment: whose model has them, so that the floor is that of such soil.
        evidence: from the fit.
        floor: of that.
        basis: slow waves (n, k).
        found: the model's refit as it is, if there was one.
        simulate: for a refit.
        steps: of that; see :func:`~splatsoil.inverse.criticism.confirmation.confirm`.
        told: called with (what, share done).
    """
    if found is None:
        found = confirm(experiment, evidence, floor, [], simulate, steps, basis, told)[""]
    if not found.visits:
        return weighed_there(experiment, evidence, floor, basis, simulate)
    parameters, at = experiment.parameters, evidence.values
    slopes = tangent(found.visits, _sight(experiment, floor, basis, found.fit.slopes), parameters, at)
    left = (experiment.observed - evidence.mean)[experiment.seen]
    after = omnibus(floor.noise, _with(floor, slopes), left, basis)
    values, stds, systematic = _told(experiment, evidence, floor, basis, found.visits, parameters, at, slopes, after)
    noise = {name: math.sqrt(max(std**2 - systematic[name] ** 2, 0.0)) for name, std in stds.items()}
    return {p.name: Estimate.of(p, values[p.name], noise[p.name], systematic[p.name]) for p in parameters}


def _with(floor: Floor, slopes: FloatArray) -> FloatArray:
    """(n, q + k) what numerics and parameters, whose derivatives are (t, s, k), can take up."""
    return np.concatenate([floor.nuisance, reach_of(floor.noise, slopes)], axis=1)


def _sight(experiment: Experiment, floor: Floor, basis: FloatArray, slopes: FloatArray) -> Sight:
    """Where to look on a floor, for parameters whose derivatives are (t, s, k)."""
    return Sight.of(experiment, replace(floor, parameters=reach_of(floor.noise, slopes)), basis)


def _told(
    experiment: Experiment,
    there: Evidence,
    floor: Floor,
    basis: FloatArray,
    visits: Sequence[Visit],
    parameters: Sequence[Parameter],
    at: Mapping[str, float],
    slopes: FloatArray,
    after: Omnibus,
    effect: str = "",
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Parameters, their standard deviations and what of these is systematic, by name."""
    sight, known = _sight(experiment, floor, basis, slopes), known_of(there, parameters)
    reading = read(visits, sight, experiment.observed, parameters, known)
    # Draws don't leave the simulations' range, and these were made where another floor let the parameters be.
    precision = beforehand(parameters, at, known)
    least = stds_of(parameters, sight(slopes), precision, after)
    stds = {name: max(std, least[name]) for name, std in reading.stds.items()}
    contradictions = at_odds(floor, experiment.layout.parts, slopes, precision, experiment.observed - there.mean)
    solvers = [experiment.reproducibility(p, reading.values[p.name], effect) for p in parameters]
    systematic = np.sqrt(untried(floor, slopes, precision) ** 2 + contradictions**2 + np.square(solvers))
    stds, named = widened(stds, np.minimum(systematic, [ignorance(p, at[p.name]) for p in parameters]))
    return dict(reading.values), stds, named
