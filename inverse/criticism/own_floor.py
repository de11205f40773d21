"""Soil that has an effect, judged by what such soil leaves by chance and by other numerics.

Cohesive soil falls by chance where dry soil flows, and numerics move it farther: what remains after an effect is added
has to be judged by that, and parameters are known no better than it lets them be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .confirmation import (
    Confirmation,
    beforehand,
    confirm,
    judged,
    noise_on,
    reach_of,
    split_times,
    stds_of,
)
from .estimates import Estimate, at_odds, bounded, untried, weighed_there
from .evidence import Evidence, Numerics, Visit, deviations, joined, other_numerics, pair_of
from .floor import Floor, floor_of
from .misfit import Block, Omnibus, blocks, omnibus, smooth_basis
from .reading import read, tangent
from .refits import SHARED, Report, free_in, has_surface, known_of
from .sight import Sight
from .simulations import Simulations

FloatArray = npt.NDArray[np.float64]

NEAR = 0.5
"""Of a parameter's standard deviation: soil so near is the same to noise and numerics."""


@dataclass(frozen=True)
class OwnFloor:
    """What soil that has an effect leaves by chance and by other numerics.

    Attributes:
        before: misfit of the model as it is on that floor.
        after: of the model with the effect.
        refit: with its parameters read off on that floor, and what that leaves on times hidden from refits.
        whole: how far the model with the effect is off in all.
        whole_before: the same of the model as it is, on that floor.
    """

    before: Omnibus
    after: Omnibus
    refit: Confirmation
    whole: Block
    whole_before: Block


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
    # Where they haven't, simulations by other seeds are there already.
    at, middle = best.fit.values, best.fit.prediction
    if any(abs(best.values[name] - at[name]) > NEAR * std for name, std in best.stds.items()):
        with suppress(SimulationError):
            middle = simulate(best.values, **told)
            at = best.values
    seeds = range(1, 1 + len(evidence.repeats))

    def spread(ask: Callable[..., FloatArray]) -> tuple[FloatArray, Numerics, list[FloatArray]]:
        guesses = [ask(at, numerics=name, **told) for name in experiment.guesses]
        numerics = other_numerics(
            experiment, lambda name, seed: ask(at, numerics=name, seed=seed, **told), pair_of(experiment, len(seeds))
        )
        return np.stack([ask(at, seed=seed, **told) for seed in seeds]), numerics, guesses

    simulate.ahead(spread)
    runs, (patterns, doubts), guesses = spread(simulate)
    there = replace(
        evidence,
        mean=runs.mean(axis=0),
        repeats=deviations(runs),
        numerics=patterns,
        numerics_doubts=doubts,
        guesses=deviations(guesses) if guesses else evidence.guesses,
        slopes={},
        curves={},
        widths={},
    )
    floor = floor_of(experiment, there)
    basis = smooth_basis(experiment.layout, floor.noise)
    # Where simulations were too few for a surface at first, they still are.
    here = [(SHARED, middle), *zip(seeds, runs, strict=True)]
    there_too = [Visit(dict(at), (best.name,), table, seed) for seed, table in here]
    visits = joined(best.visits, there_too) if best.visits else ()
    parameters = free_in(experiment, candidate)
    soil = _Soil(experiment, there, floor, basis, parameters, at, visits, best.fit.slopes).smoothed
    refit = replace(best, floor=noise_on(floor.single, judged(experiment, split_times(experiment)[1])))
    if visits:
        values, noise, systematic = soil.told(best.name)
        stds = {name: math.hypot(noise[name], systematic[name]) for name in noise}
        refit = replace(refit, values=values, stds=stds, systematic=systematic)
    own = len(experiment.parameters)
    return OwnFloor(
        before=soil.misfit(residual, own),
        after=soil.after,
        refit=refit,
        whole=soil.whole,
        whole_before=soil.in_all(residual, own),
    )


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
        found: the model's refit as it is, if there was one; one that stopped early is made anew.
        simulate: for a refit.
        steps: of that; see :func:`~splatsoil.inverse.criticism.confirmation.confirm`.
        told: called with (what, share done).
    """
    if not has_surface(experiment, None):
        return weighed_there(experiment, evidence, floor, basis, simulate)
    if found is None or found.stopped:
        found = confirm(experiment, evidence, floor, [], simulate, steps, basis, told)[""]
    parameters, at = experiment.parameters, evidence.values
    soil = _Soil(experiment, evidence, floor, basis, parameters, at, found.visits, found.fit.slopes)
    try:
        values, noise, systematic = soil.smoothed.told()
    except ValueError:  # simulations that make no surface
        return weighed_there(experiment, evidence, floor, basis, simulate)
    return {p.name: Estimate.of(p, *(of[p.name] for of in (values, noise, systematic, at))) for p in parameters}


@dataclass(frozen=True)
class _Soil:
    """Soil that has effects, as simulations of it show it.

    Attributes:
        experiment: what was observed.
        there: repeats and numerics of such soil.
        floor: of these.
        basis: slow waves (n, k).
        parameters: free ones.
        at: their values where repeats and numerics were simulated.
        visits: all simulations; none where a surface has no place.
        slopes: (t, s, k) derivatives there.
    """

    experiment: Experiment
    there: Evidence
    floor: Floor
    basis: FloatArray
    parameters: Sequence[Parameter]
    at: Mapping[str, float]
    visits: Sequence[Visit]
    slopes: FloatArray

    @property
    def smoothed(self) -> _Soil:
        """With the derivatives of the surface through all visits, where there are any; those at hand tell where to
        look."""
        if not self.visits:
            return self
        return replace(self, slopes=tangent(self.visits, self.sight, self.parameters, self.at))

    @property
    def sight(self) -> Sight:
        """Where to look for the parameters."""
        along = reach_of(self.floor.noise, self.slopes)
        return Sight.of(self.experiment, replace(self.floor, parameters=along), self.basis, averaged=True)

    @property
    def left(self) -> FloatArray:
        """(t, s) what is left of the observation."""
        return self.experiment.observed - self.there.mean

    @cached_property
    def after(self) -> Omnibus:
        """Misfit of such soil."""
        return self.misfit(self.left[self.experiment.seen], len(self.parameters))

    @property
    def whole(self) -> Block:
        """How far such soil is off in all."""
        return self.in_all(self.left[self.experiment.seen], len(self.parameters))

    def in_all(self, residual: FloatArray, count: int) -> Block:
        """How much of a residual (n,) there is once numerics and the first parameters have taken their part."""
        return blocks(self.experiment.layout, self.floor.noise, self._free(count), residual)[0]

    def misfit(self, residual: FloatArray, count: int) -> Omnibus:
        """What of a residual (n,) stands on slow waves once numerics and the first parameters have taken their part."""
        return omnibus(self.floor.noise, self._free(count), residual, self.basis)

    def _free(self, count: int) -> FloatArray:
        """(n, q) what numerics and the first parameters can take up."""
        return np.concatenate([self.floor.nuisance, reach_of(self.floor.noise, self.slopes[..., :count])], axis=1)

    def told(self, effect: str = "") -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
        """Parameters, and standard deviations of them by noise and by what is systematic, by name; ``effect`` is one
        that the experiment's model lacks."""
        experiment, sight, known = self.experiment, self.sight, known_of(self.there, self.parameters)
        reading = read(self.visits, sight, experiment.observed, self.parameters, known)
        # Draws don't leave the simulations' range, and these were made where another floor let the parameters be.
        precision = beforehand(self.parameters, self.at, known)
        least = stds_of(self.parameters, sight(self.slopes), precision, self.after)
        noise = {name: max(std, least[name]) for name, std in reading.stds.items()}
        contradictions = at_odds(self.floor, experiment.layout.parts, self.slopes, precision, self.left)
        solvers = [experiment.reproducibility(p, reading.values[p.name], effect) for p in self.parameters]
        systematic = np.sqrt(untried(self.floor, self.slopes, precision) ** 2 + contradictions**2 + np.square(solvers))
        named = {p.name: bounded(s, p, self.at[p.name]) for p, s in zip(self.parameters, systematic, strict=True)}
        return dict(reading.values), noise, named
