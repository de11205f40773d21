"""Soil that has an effect, judged by what such soil leaves by chance and by other numerics.

Cohesive soil falls by chance where dry soil flows, and numerics move it farther: what remains after an effect is added
has to be judged by that, and parameters are known no better than it lets them be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment

from .confirmation import (
    Confirmation,
    beforehand,
    free_in,
    judged,
    known_of,
    noise_on,
    reach_of,
    split_times,
    stds_of,
    widened,
)
from .estimates import at_odds, untried
from .evidence import Evidence, Numerics, Visit, ignorance, other_numerics, pair_of
from .floor import floor_of
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
        seeing = Sight.of(experiment, replace(floor, parameters=reach_of(floor.noise, slopes)), basis)
        slopes = tangent(visits, seeing, parameters, at)
    along = reach_of(floor.noise, slopes)
    free = np.concatenate([floor.nuisance, along], axis=1)
    left = experiment.observed - there.mean
    without = np.concatenate([floor.nuisance, reach_of(floor.noise, slopes[..., : len(experiment.parameters)])], axis=1)
    after = omnibus(floor.noise, free, left[experiment.seen], basis)
    refit = replace(best, floor=noise_on(floor.single, judged(experiment, split_times(experiment)[1])))
    if visits:
        sight = Sight.of(experiment, replace(floor, parameters=along), basis)
        known = known_of(evidence, parameters)
        reading = read(visits, sight, experiment.observed, parameters, known)
        # Draws don't leave the simulations' range, and these were made where another floor let the parameters be.
        precision = beforehand(parameters, at, known)
        least = stds_of(parameters, sight(slopes), precision, after)
        stds = {name: max(std, least[name]) for name, std in reading.stds.items()}
        contradictions = at_odds(floor, experiment.layout.parts, slopes, precision, left)
        systematic = np.hypot(untried(floor, slopes, precision), contradictions)
        stds, named = widened(stds, np.minimum(systematic, [ignorance(p, at[p.name]) for p in parameters]))
        refit = replace(refit, values=dict(reading.values), stds=stds, systematic=named)
    return OwnFloor(before=omnibus(floor.noise, without, residual, basis), after=after, refit=refit)
