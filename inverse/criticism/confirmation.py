"""Confirmation: the best effects refitted on part of the data, and what then remains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .evidence import Evidence, around, step_of
from .floor import Floor, floor_of
from .joint import precision_of
from .misfit import Omnibus, omnibus, smooth_basis
from .noise import Noise, Solver, orthonormal
from .refit import ROUNDS, Known, Refit, Start, settle
from .score import Scorer
from .simulations import Simulations
from .verdicts import CLEAN, LEVEL

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Confirmation:
    """An effect refitted on part of the times and judged on the others.

    Attributes:
        name: of the effect; empty for the model as it is.
        fit: the refit.
        stds: standard deviations of its estimates, by parameter.
        chi2: of all times, as far as these tell of anything; see :class:`Sight`.
        fall: by how much that is less than the model's as it is.
        held_out: root mean square of the residual on times the refit hasn't seen, in the features' unit.
        floor: what noise alone leaves there.
        remainder: what stands on slow waves.
    """

    name: str
    fit: Refit
    stds: Mapping[str, float]
    chi2: float
    fall: float
    held_out: float
    floor: float
    remainder: Omnibus


def confirm(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    chosen: Sequence[Candidate],
    simulate: Simulations,
    steps: int,
    basis: FloatArray,
    told: Report,
) -> dict[str, Confirmation]:
    """Refit the model as it is, and with each chosen effect, on every other time; judge on the rest.

    ``steps`` is the number of simulations from each point where a refit starts.
    """
    shown, hidden = _split(experiment)
    whiten = Sight.of(experiment, floor, basis, shown)
    out: dict[str, Confirmation] = {}
    jobs: list[Candidate | None] = [None, *chosen]
    for number, candidate in enumerate(jobs):
        name = "" if candidate is None else candidate.name
        told(f"refit {name or 'of the model'}", 0.75 + 0.2 * number / len(jobs))

        def predict(values: Mapping[str, float], name: str = name) -> FloatArray:
            return simulate(values, effects=(name,) if name else (), purpose=f"refit {name or 'of the model'}")

        free = [*experiment.parameters, *(() if candidate is None else candidate.parameters)]
        known = _known(evidence, free)
        fit = settle(
            predict,
            whiten,
            experiment.observed,
            free,
            _starts(experiment, evidence, candidate, simulate, predict),
            chance=experiment.chance,
            known=known,
            renewed=[p.name for p in experiment.parameters] + _renewed(candidate),
            most=steps if candidate is not None else max(steps - 2, 1),
            rounds=ROUNDS if candidate is not None else 0,
        )
        out[name] = _judged(experiment, floor, name, fit, hidden, basis, free, known, whiten(fit.slopes), out.get(""))
    return out


@dataclass(frozen=True)
class Sight:
    """Whitened features as far as they tell of parameters, effects and slow waves.

    Two simulations differ by chance in every feature. Their χ² over all of them, which is what a refit would compare,
    scatters by tens; in the directions in which anything acts, by few. Experiments without chance are looked at as a
    whole. Numerics are projected out.

    Attributes:
        noise: of the features looked at.
        solver: of that noise.
        directions: (n, d) orthonormal, in which to look; None for all of the features.
    """

    noise: Noise
    solver: Solver
    directions: FloatArray | None

    @classmethod
    def of(cls, experiment: Experiment, floor: Floor, basis: FloatArray, rows: npt.NDArray[np.bool_]) -> Sight:
        """For some times (t,)."""
        noise = floor.single.plus(floor.nuisance).rows(rows)
        solver = noise.solver()
        if not experiment.chance:
            return cls(noise, solver, None)
        inside = (experiment.seen & rows[:, None])[experiment.seen]
        columns = np.concatenate([floor.parameters, floor.directions, basis], axis=1)[inside]
        return cls(noise, solver, orthonormal(solver.whiten(columns)))

    def __call__(self, table: FloatArray) -> FloatArray:
        """Of a table (t, s, …): (d, …), of noise alone independent with variance 1."""
        white = self.solver.whiten(table[self.noise.seen])
        return white if self.directions is None else self.directions.T @ white


def _split(experiment: Experiment) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Times that a refit sees, and those hidden from it: every other one, or all where that leaves nothing."""
    shown = np.arange(experiment.layout.shape[0]) % 2 == 0
    if not experiment.seen[~shown].any() or not experiment.seen[shown].any():
        return np.ones_like(shown), np.ones_like(shown)
    return shown, ~shown


def _noise_on(noise: Noise, mask: npt.NDArray[np.bool_]) -> float:
    """Root mean square of a noise over some features."""
    return float(np.sqrt(np.mean(noise.spread(noise.scale)[mask] ** 2)))


def _renewed(candidate: Candidate | None) -> list[str]:
    """Parameters of an effect whose derivatives change on the way; what cameras report is nearly linear."""
    if candidate is None:
        return []
    return [p.name for p in candidate.parameters] if candidate.kind == "physics" else [candidate.size]


def _known(evidence: Evidence, free: Sequence[Parameter]) -> Known:
    """What a calibration says of the parameters that a refit has."""
    precision, centre = precision_of(evidence.calibration, [p.name for p in free])
    told = np.flatnonzero(np.diag(precision) > 0.0)
    root = np.zeros((len(told), len(free)))
    if told.size:
        root[:, told] = np.linalg.cholesky(precision[np.ix_(told, told)]).T
    return Known(root, centre + np.array([p.off or 0.0 for p in free]))


def _starts(
    experiment: Experiment,
    evidence: Evidence,
    candidate: Candidate | None,
    simulate: Simulations,
    predict: Callable[[Mapping[str, float]], FloatArray],
) -> list[Start]:
    """Where a refit begins: at the fit, and at the defaults too where the fit has run into a bound.

    A fit on a bound is one that the missing effect has pushed there: its derivatives are those of another regime. From
    the defaults the effect starts at a plausible size instead of off.
    """
    extra = () if candidate is None else candidate.parameters
    off = {p.name: float(p.off) for p in extra if p.off is not None}
    model = np.stack([evidence.slopes[p.name] for p in experiment.parameters], axis=-1)
    added = [] if candidate is None else [np.moveaxis(evidence.directions[candidate.name], 0, -1)]
    middle = simulate(evidence.values, seed=0)
    starts = [Start({**evidence.values, **off}, middle, np.concatenate([model, *added], axis=-1))]
    bound = [p for p in experiment.parameters if len(around(p, evidence.values[p.name])) == 1]
    if candidate is None or not bound:
        return starts
    measure = candidate.measure
    there = {**evidence.values, **{p.name: p.default for p in bound}, **off}
    there[measure.name] = off[measure.name] + step_of(measure)
    try:
        fresh = predict(there)
        slopes = model.copy()
        for index, parameter in enumerate(experiment.parameters):
            end = around(parameter, there[parameter.name])[0]
            moved = predict({**there, parameter.name: end})
            slopes[..., index] = (moved - fresh) / (end - there[parameter.name])
    except SimulationError:
        return starts
    return [*starts, Start(there, fresh, np.concatenate([slopes, *added], axis=-1))]


def _judged(
    experiment: Experiment,
    floor: Floor,
    name: str,
    fit: Refit,
    hidden: npt.NDArray[np.bool_],
    basis: FloatArray,
    free: Sequence[Parameter],
    known: Known,
    columns: FloatArray,
    before: Confirmation | None,
) -> Confirmation:
    """Judge a refit of ``free`` parameters on the times hidden from it; ``columns`` (n, k) are its whitened slopes."""
    left = experiment.observed - fit.prediction
    mask = experiment.seen & hidden[:, None]
    tangent = np.concatenate([floor.nuisance, _tangent(floor.single, fit)], axis=1)
    whole = Sight.of(experiment, floor, basis, np.ones(len(left), dtype=bool))
    at, off = (np.array([values.get(p.name, p.off or 0.0) for p in free]) for values in (fit.values, {}))
    chi2, fall = float(np.sum(whole(left) ** 2)) + known.chi2(at), 0.0
    if before is not None:
        fall = float(np.sum(whole(experiment.observed - before.fit.prediction) ** 2)) + known.chi2(off) - chi2
    remainder = omnibus(floor.single, tangent, left[experiment.seen], basis)
    return Confirmation(
        name=name,
        fit=fit,
        stds=_stds(free, np.concatenate([columns, known.root]), remainder),
        chi2=chi2,
        fall=fall,
        held_out=float(np.sqrt(np.mean(left[mask] ** 2))),
        floor=_noise_on(floor.single, mask),
        remainder=remainder,
    )


def _stds(free: Sequence[Parameter], columns: FloatArray, remainder: Omnibus) -> dict[str, float]:
    """Standard deviations of a refit's estimates, each parameter's range being its prior.

    Where more than noise remains, they are widened by the root of its dispersion (Birge 1932).
    """
    prior = np.array([math.sqrt(12.0) / (p.upper - p.lower) for p in free])
    covariance = np.linalg.inv(columns.T @ columns + np.diag(prior**2))
    widened = math.sqrt(max(1.0, remainder.dispersion))
    return {p.name: widened * math.sqrt(float(v)) for p, v in zip(free, np.diag(covariance), strict=True)}


def _tangent(noise: Noise, fit: Refit) -> FloatArray:
    """(n, k) a refit's derivatives, each as large as a parameter's error could be: ten times the noise."""
    columns = fit.slopes[noise.seen]
    size = np.linalg.norm(columns / noise.scale[:, None], axis=0)
    return columns * (10.0 * math.sqrt(len(columns)) / np.maximum(size, 1e-300))


def remainder_of(
    experiment: Experiment,
    floor: Floor,
    best: Confirmation,
    candidates: Mapping[str, Candidate],
    evidence: Evidence,
    basis: FloatArray,
) -> Omnibus:
    """What the library can't explain: after the best effect, or after it and a second one that is significant."""
    if best.remainder.p >= CLEAN:
        return best.remainder
    seen = experiment.seen
    left = (experiment.observed - best.fit.prediction)[seen]
    free = np.concatenate([floor.nuisance, _tangent(floor.single, best.fit)], axis=1)
    others = [c for name, c in candidates.items() if name != best.name]
    if not others:
        return best.remainder
    columns = {c.name: evidence.directions[c.name][:, seen].T for c in others}
    scorer = Scorer.of(floor.single, free, columns, others, calibration=evidence.calibration)
    second = max(scorer.score(left).values(), key=lambda score: score.statistic)
    if second.adjusted >= LEVEL:
        return best.remainder
    size = columns[second.name]
    scale = 10.0 * math.sqrt(len(size)) / np.linalg.norm(size / floor.single.scale[:, None], axis=0)
    return omnibus(floor.single, np.concatenate([free, size * scale], axis=1), left, basis)


def on_its_own_floor(
    experiment: Experiment,
    evidence: Evidence,
    best: Confirmation,
    simulate: Simulations,
    residual: FloatArray,
) -> tuple[Omnibus, Omnibus, float]:
    """Misfit of the model as it is and with its best effect, by the chance and numerics of soil that has the effect,
    and what these leave on times hidden from refits.

    Cohesive soil falls by chance where dry soil flows, and numerics move it farther: what remains after an effect is
    added has to be judged by what such soil leaves.
    """
    values, name = best.fit.values, best.name

    def run(seed: int = 0, numerics: str = "") -> FloatArray:
        purpose = f"floor with {name}"
        return simulate(values, effects=(name,), seed=seed, numerics=numerics, purpose=purpose)

    runs = np.stack([run(seed) for seed in range(1, 1 + len(evidence.repeats))])
    patterns = {}
    for kind in experiment.numerics:
        try:
            patterns[kind] = run(numerics=kind) - best.fit.prediction
        except SimulationError:
            continue
    deviations = (runs - runs.mean(axis=0)) * np.sqrt(len(runs) / max(len(runs) - 1, 1))
    there = replace(
        evidence, mean=runs.mean(axis=0), repeats=deviations, numerics=patterns, slopes={}, curves={}, widths={}
    )
    floor, seen = floor_of(experiment, there), experiment.seen
    basis = smooth_basis(experiment.layout, floor.noise)
    free = np.concatenate([floor.nuisance, _tangent(floor.noise, best.fit)], axis=1)
    left = (experiment.observed - there.mean)[seen]
    model = len(experiment.parameters)
    bare = replace(best.fit, slopes=best.fit.slopes[..., :model])
    without = np.concatenate([floor.nuisance, _tangent(floor.noise, bare)], axis=1)
    noise = _noise_on(floor.single, seen & _split(experiment)[1][:, None])
    return omnibus(floor.noise, without, residual, basis), omnibus(floor.noise, free, left, basis), noise
