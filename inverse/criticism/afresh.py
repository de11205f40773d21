"""A second look, from soil as one would guess it: the fit may have been led astray.

Soil that is viscous, or sticks together, drives the friction angle of a model without that effect far off, up to its
bound. There the derivatives are those of another regime, and the effect that is missing looks like nothing in
particular. From the law's defaults it stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment

from .evidence import STRIDE, Evidence, Run, Vantage, Visit, around, directions_of, look_from
from .floor import Floor
from .sight import Sight
from .simulations import Simulations

FloatArray = npt.NDArray[np.float64]


DECADE = 10.0
"""Factor by which what shapes an effect may be off its default: where its scale is logarithmic, not even its order of
magnitude is known beforehand."""


def look_afresh(
    experiment: Experiment,
    evidence: Evidence,
    off: bool,
    simulate: Simulations,
    floor: Floor,
    basis: FloatArray,
) -> Vantage | None:
    """The soil's own parameters at their defaults, those of effects as fitted; effects of physics switched on there.

    Each of these in the shape in which it would explain most: as by default, or a decade off. Soil that dilates without
    end leaves other traces than soil that soon is loose. Where the fit lies near the defaults, effects are tried in
    other shapes there.

    None where nothing says that the fit was led astray (the model isn't ``off`` by more than noise, and no bound is
    reached), where the defaults can't be simulated, or where the fit lies near them and nothing has a shape.
    """
    bound = any(len(around(p, evidence.values[p.name])) == 1 for p in experiment.parameters)
    own = {p.name: p.default for p in experiment.parameters if p.off is None}
    far = any(abs(evidence.values[name] - value) > evidence.widths[name] for name, value in own.items())
    if not (bound or off):
        return None
    there = {**evidence.values, **own}
    candidates = [c for c in experiment.candidates if c.kind == "physics" and c.name in evidence.directions]

    def look(ask: Callable[..., FloatArray]) -> tuple[Vantage, list[_Variant]]:
        def run(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = (), seed: int = 0) -> FloatArray:
            where = "from the defaults" if far else "in another shape"
            return ask(at, effects=effects, seed=seed, purpose=f"{where}: {purpose}")

        found = look_from(experiment, there, candidates, run) if far else _at_the_fit(evidence, candidates)
        on = [c for c in candidates if c.name in found.directions]
        return found, [v for c in on for v in _variants(c, found, run, STRIDE if experiment.chance else 1.0)]

    simulate.ahead(look)
    try:
        found, variants = look(simulate)
    except SimulationError:
        return None
    if variants:
        return _in_best_shapes(experiment, found, variants, floor, basis)
    return found if far else None


def _at_the_fit(evidence: Evidence, candidates: Sequence[Candidate]) -> Vantage:
    """The fit as a point to look from, whose own simulations count already."""
    directions = {c.name: evidence.directions[c.name] for c in candidates}
    return replace(evidence, directions=directions, visits=())


@dataclass(frozen=True)
class _Variant:
    """A candidate's directions (k, t, s) in another shape than by default, and the simulations that tell them."""

    candidate: Candidate
    shape: Mapping[str, float]
    directions: FloatArray
    visits: tuple[Visit, ...]


def _variants(candidate: Candidate, point: Vantage, run: Run, times: float) -> list[_Variant]:
    """A candidate in other shapes."""
    out = []
    for parameter in (p for p in candidate.shapes if p.log):
        for factor in (1.0 / DECADE, DECADE):
            shape = {parameter.name: float(np.clip(factor * parameter.default, parameter.lower, parameter.upper))}
            visits: list[Visit] = []

            def visit(
                purpose: str, at: Mapping[str, float], effects: tuple[str, ...], visits: list[Visit] = visits
            ) -> FloatArray:
                visits.append(Visit(dict(at), effects, run(purpose, at, effects)))
                return visits[-1].table

            try:
                directions = directions_of(candidate, {**point.values, **shape}, point.prediction, visit, {}, times)
            except SimulationError:
                continue
            out.append(_Variant(candidate, shape, directions, tuple(visits)))
    return out


def _in_best_shapes(
    experiment: Experiment, point: Vantage, variants: Sequence[_Variant], floor: Floor, basis: FloatArray
) -> Vantage:
    """The point, with each candidate in the shape in which it explains most from there."""
    every = {**point.directions, **{f"{v.candidate.name} {k}": v.directions for k, v in enumerate(variants)}}
    cost = _cost(experiment, point, Sight.of(experiment, floor, basis, replace(point, directions=every)))
    directions, shapes = dict(point.directions), {}
    least = {v.candidate.name: cost(v.candidate, directions[v.candidate.name]) for v in variants}
    for variant in variants:
        name, now = variant.candidate.name, cost(variant.candidate, variant.directions)
        if now < least[name]:
            least[name], directions[name], shapes[name] = now, variant.directions, variant.shape
    visits = (*point.visits, *(visit for variant in variants for visit in variant.visits))
    return replace(point, directions=directions, shapes=shapes, visits=visits)


def promising(
    experiment: Experiment,
    vantage: Vantage,
    sight: Sight,
    candidates: Sequence[Candidate],
    price: Callable[[Candidate], float],
) -> list[str]:
    """Names of the effects that would explain most from there, for their parameters; the best first.

    Least squares within the bounds, over the model's parameters and one effect's at a time; effects that bring less
    than their price are left out.
    """
    cost = _cost(experiment, vantage, sight)
    there = [c for c in candidates if c.name in vantage.directions]
    costs = {c.name: cost(c, vantage.directions[c.name]) + price(c) for c in there}
    alone = cost(None, np.zeros((0, *experiment.layout.shape)))
    return sorted((name for name in costs if costs[name] < alone), key=lambda name: costs[name])


def _cost(experiment: Experiment, vantage: Vantage, sight: Sight) -> Callable[[Candidate | None, FloatArray], float]:
    """χ² that the model's parameters leave with a candidate's directions (k, t, s), or with none."""
    target = sight(experiment.observed - vantage.prediction)
    model = np.stack([sight(vantage.slopes[p.name]) for p in experiment.parameters], axis=-1)

    def cost(candidate: Candidate | None, directions: FloatArray) -> float:
        free = (*experiment.parameters, *(() if candidate is None else candidate.parameters))
        columns = np.concatenate([model, sight(np.moveaxis(directions, 0, -1))], axis=-1)
        at = np.array([vantage.values.get(p.name, p.off if p.off is not None else p.default) for p in free])
        lower, upper = (np.array([getattr(p, side) for p in free]) for side in ("lower", "upper"))
        span = upper - lower
        room = np.minimum((lower - at) / span, 0.0), np.maximum((upper - at) / span, 1e-9)
        return 2.0 * float(lsq_linear(columns * span, target, bounds=room).cost)

    return cost
