"""Where effects are switched on: at the fit, or at soil as one would guess it where the fit may have been led astray.

Soil that is viscous, or sticks together, drives the friction angle of a model without that effect far off, up to its
bound. There the derivatives are those of another regime, and the effect that is missing looks like nothing in
particular. From the law's defaults it stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment

from .bench import Bench
from .derivatives import Run, around, directions_of
from .evidence import STRIDE, Evidence, Vantage, Visit, look_from, switched_on
from .floor import Floor
from .sight import Sight
from .simulations import Simulations
from .verdicts import LEVEL

FloatArray = npt.NDArray[np.float64]


DECADE = 10.0
"""Factor by which what shapes an effect may be off its default: where its scale is logarithmic, not even its order of
magnitude is known beforehand."""


@dataclass(frozen=True)
class Looks:
    """What was seen of effects.

    Attributes:
        evidence: with all effects' derivatives: at the fit, or those of physics at the defaults.
        bench: what a residual is judged by.
        off: whether the model as it is leaves more than noise.
        vantage: the law's defaults where the fit was led astray; else the fit where effects were tried in other shapes
            there; None where neither was.
    """

    evidence: Evidence
    bench: Bench
    off: bool
    vantage: Vantage | None

    @property
    def astray(self) -> bool:
        """Whether effects were switched on at the defaults."""
        return self.vantage is not None and self.vantage.values != self.evidence.values


def foreseen(experiment: Experiment, evidence: Evidence, simulate: Simulations) -> None:
    """Have helpers begin with what :func:`look` will most likely ask for, before it is known what is noise."""
    astray = _astray(experiment, evidence, True)
    simulate.ahead(lambda ask: (_defaults if astray else switched_on)(experiment, ask, evidence))


def look(
    experiment: Experiment, evidence: Evidence, simulate: Simulations, *, level: float = LEVEL, seed: int = 0
) -> Looks:
    """Switch the effects of physics on, one at a time.

    At the fit, by two seeds, and where the model is off by more than noise in other shapes, too: soil that dilates
    without end leaves other traces than soil that soon is loose. Where the fit was led astray (the model is off, or a
    bound is reached, and the fit lies far from the law's defaults) at these instead: the soil's own parameters at their
    defaults, those of effects as fitted. Shapes are as by default, or a decade off.

    Args:
        experiment: whose effects are tried.
        evidence: of :func:`~splatsoil.inverse.criticism.evidence.gather`.
        simulate: for what that hasn't.
        level: family-wise chance of naming an effect when none is missing.
        seed: of draws.
    """
    left = (experiment.observed - evidence.mean)[experiment.seen]
    first = Bench.of(experiment, evidence, seed=seed, scored=False)
    off = first.off(left)
    vantage = None
    if _astray(experiment, evidence, off):
        simulate.ahead(lambda ask: _defaults(experiment, ask, evidence))
        with suppress(SimulationError):  # then the fit will have to do
            vantage = _defaults(experiment, simulate, evidence)
    else:
        simulate.forget()  # what was foreseen, if it was something else
    if vantage is None:
        simulate.ahead(lambda ask: switched_on(experiment, ask, evidence))
        whole = switched_on(experiment, simulate, evidence)
    else:
        point, _ = vantage
        whole = evidence.with_effects(experiment.candidates, point.directions, steps=point.steps, failed=point.failed)
    bench = Bench.of(experiment, whole, level=level, seed=seed, before=first.floor)
    off = bench.off(left)
    if vantage is None and off:
        vantage = _at_the_fit(experiment, whole, simulate)
    if vantage is None:
        return Looks(whole, bench, off, None)
    point, variants = vantage
    best = _in_best_shapes(experiment, point, variants, bench.floor, bench.basis) if variants else point
    return Looks(whole, bench, off, best)


def _astray(experiment: Experiment, evidence: Evidence, off: bool) -> bool:
    """Whether a missing effect may have led the fit astray, the model being ``off`` by more than noise or not."""
    bound = any(len(around(p, evidence.values[p.name])) == 1 for p in experiment.parameters)
    far = any(abs(evidence.values[name] - value) > evidence.widths[name] for name, value in _own(experiment).items())
    return bool(experiment.candidates) and far and (bound or off)


def _own(experiment: Experiment) -> dict[str, float]:
    """The soil's own parameters at the law's defaults."""
    return {p.name: p.default for p in experiment.parameters if p.off is None}


def _defaults(
    experiment: Experiment, ask: Callable[..., FloatArray], evidence: Evidence
) -> tuple[Vantage, list[_Variant]]:
    """From the defaults.

    Raises:
        SimulationError: these can't be simulated.
    """
    physics = [c for c in experiment.candidates if c.kind == "physics"]
    run = _called("from the defaults", ask)
    found = look_from(experiment, {**evidence.values, **_own(experiment)}, physics, run)
    return found, _variants(experiment, found, run)


def _at_the_fit(
    experiment: Experiment, evidence: Evidence, simulate: Simulations
) -> tuple[Vantage, list[_Variant]] | None:
    """The fit as a point to look from in other shapes, whose own simulations count already; None where there are none
    to try."""
    names = [c.name for c in experiment.candidates if c.kind == "physics" and c.name in evidence.directions]
    point = replace(evidence, directions={name: evidence.directions[name] for name in names}, visits=())

    def seen(ask: Callable[..., FloatArray]) -> list[_Variant]:
        return _variants(experiment, point, _called("in another shape", ask))

    simulate.ahead(seen)
    variants = seen(simulate)
    return (point, variants) if variants else None


def _called(where: str, ask: Callable[..., FloatArray]) -> Run:
    """Asks for simulations, and says what for."""

    def run(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = (), seed: int = 0) -> FloatArray:
        return ask(at, effects=effects, seed=seed, purpose=f"{where}: {purpose}")

    return run


@dataclass(frozen=True)
class _Variant:
    """A candidate's directions (k, t, s) in another shape than by default, and the simulations that tell them."""

    candidate: Candidate
    shape: Mapping[str, float]
    directions: FloatArray
    visits: tuple[Visit, ...]


def _variants(experiment: Experiment, point: Vantage, run: Run) -> list[_Variant]:
    """The point's effects in other shapes, each from one side; one that can't be simulated is left out."""
    out, times = [], STRIDE if experiment.chance else 1.0
    on = [c for c in experiment.candidates if c.kind == "physics" and c.name in point.directions]
    for candidate, parameter in ((c, p) for c in on for p in c.shapes if p.log):
        for factor in (1.0 / DECADE, DECADE):
            shape = {parameter.name: float(np.clip(factor * parameter.default, parameter.lower, parameter.upper))}
            visits: list[Visit] = []

            def visit(
                purpose: str, at: Mapping[str, float], effects: tuple[str, ...], visits: list[Visit] = visits
            ) -> FloatArray:
                visits.append(Visit(dict(at), effects, run(purpose, at, effects)))
                return visits[-1].table

            try:
                directions = directions_of(
                    candidate, {**point.values, **shape}, point.prediction, visit, {}, times, sides=1
                )
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
