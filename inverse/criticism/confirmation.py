"""Confirmation: the best effects refitted on part of the data, and what then remains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle, repeat

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .dilution import undiluted
from .estimates import bounded, prior, untried
from .evidence import Evidence, Vantage, Visit, pair_of
from .floor import Floor
from .joint import precision_of
from .misfit import Omnibus, omnibus
from .noise import Noise
from .reading import MOST, explored, read
from .refit import ROUNDS, Known, Refit, Start, settle
from .score import Scorer
from .sight import Sight
from .simulations import Simulations
from .verdicts import CERTAIN, CLEAN, LEVEL

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str, float], None]

SHARED = 0
"""Seed of the simulation where a refit ends."""
MORE_SEEDS = 4
"""Seeds of refits beside those of the evidence."""


@dataclass(frozen=True)
class Confirmation:
    """An effect refitted on part of the times and judged on the others.

    Attributes:
        name: of the effect; empty for the model as it is.
        fit: the refit, by which the effect is judged.
        values: the parameters by all times.
        stds: standard deviations of these.
        systematic: what of these is the model's own fault; see :mod:`.estimates`.
        chi2: of all times, against the mean of several seeds, as far as these tell of anything; see
            :class:`~splatsoil.inverse.criticism.sight.Sight`.
        freedom: numbers that this sums, but for one a parameter.
        fall: by how much that is less than the model's as it is.
        unseen: likewise, on times the refit hasn't seen alone.
        told: chance of what other pictures say of its parameters if they were off; see
            :class:`~splatsoil.experiment.base.Calibration`.
        agrees: likewise, if they were as refitted.
        held_out: root mean square of one simulation's residual on times the refit hasn't seen, of features in the
            layout's unit.
        floor: what noise alone leaves there; of soil that has the effect, where that was simulated.
        remainder: what of it stands on slow waves.
        visits: simulations that the parameters were read off; none where the last derivatives told them.
    """

    name: str
    fit: Refit
    values: Mapping[str, float]
    stds: Mapping[str, float]
    systematic: Mapping[str, float]
    chi2: float
    freedom: int
    fall: float
    unseen: float
    told: float
    agrees: float
    held_out: float
    floor: float
    remainder: Omnibus
    visits: tuple[Visit, ...] = ()

    @property
    def dispersion(self) -> float:
        """What is left over what noise leaves, 1 at least: where no model explains the data, what is no part of any of
        them changes χ² by as much more (McCullagh and Nelder 1989, Generalized Linear Models, section 4.5)."""
        return max(1.0, self.chi2 / self.freedom)

    @property
    def ruled_out(self) -> bool:
        """Other pictures deny the size that soil asks for, and don't ask for the effect themselves."""
        return self.agrees < CERTAIN <= self.told


def confirm(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    chosen: Sequence[Candidate],
    simulate: Simulations,
    steps: int,
    basis: FloatArray,
    told: Report,
    vantage: Vantage | None = None,
) -> dict[str, Confirmation]:
    """Refit the model as it is, and with each chosen effect, on every other time; judge on the rest.

    ``steps`` is the number of simulations from each point where a refit starts; ``vantage`` is another such point.
    Effects that no seed of the model's own simulates where their refit ended are left out.

    Raises:
        SimulationError: the model can't be simulated where its own ended.
    """
    shown, hidden = split_times(experiment)
    whiten = Sight.of(experiment, floor, basis, vantage, shown)
    # A surface through many simulations has hardly any of one's chance, and its own doubt beside.
    through, whole = (Sight.of(experiment, floor, basis, vantage, rows, averaged=True) for rows in (shown, None))
    apart = whole if shown.all() else Sight.of(experiment, floor, basis, vantage, hidden, averaged=True)
    jobs: list[Candidate | None] = [None, *chosen]
    starting = undiluted(evidence, floor.single.plus(floor.nuisance))
    done = 0

    def refitted(candidate: Candidate | None) -> tuple[Refit, list[Visit]]:
        nonlocal done
        on = () if candidate is None else (candidate.name,)
        purpose = f"refit {candidate.name if candidate else 'of the model'}"
        told(purpose, 0.75 + 0.2 * done / len(jobs))
        free = free_in(experiment, candidate)
        known, emulated = known_of(evidence, free), has_surface(experiment, candidate)
        seeds = cycle(seeds_of(experiment, len(evidence.repeats))) if emulated else repeat(SHARED)

        def predict(values: Mapping[str, float], seed: int | None = None) -> FloatArray:
            seed = next(seeds) if seed is None else seed
            visits.append(Visit(dict(values), on, simulate(values, effects=on, seed=seed, purpose=purpose), seed))
            return visits[-1].table

        visits = [v for p in (evidence, vantage) if p is not None for v in p.visits if v.effects in ((), on)]
        fit = settle(
            predict,
            whiten,
            experiment.observed,
            free,
            _starts(experiment, starting, candidate, vantage),
            chance=experiment.chance,
            known=known,
            renewed=_renewed(experiment, candidate),
            most=steps if candidate is not None else max(steps - 2, 1),
            rounds=0 if candidate is None or emulated else ROUNDS,
        )
        if emulated:
            shapes = () if candidate is None else candidate.shapes
            fit = explored(predict, visits, through, experiment.observed, free, known, fit, shapes)
            with suppress(SimulationError):
                fit = replace(fit, prediction=predict(fit.values, SHARED))
        done += 1
        return fit, visits

    refits = simulate.side_by_side([partial(refitted, candidate) for candidate in jobs])
    ends = repeated(simulate, jobs, [fit for fit, _ in refits], len(evidence.repeats))
    if not ends[0]:
        raise SimulationError("the model can't be simulated where its refit ended")
    out: dict[str, Confirmation] = {}
    for candidate, (fit, visits), end in zip(jobs, refits, ends, strict=True):
        if candidate is not None and not ends[0].keys() & end.keys():
            continue  # nothing to compare them by
        free = free_in(experiment, candidate)
        known = known_of(evidence, free)
        at, off = (np.array([values.get(p.name, p.off or 0.0) for p in free]) for values in (fit.values, {}))
        left, mask = experiment.observed - fit.prediction, judged(experiment, hidden)
        before, after = (experiment.observed - table for table in means(ends[0], end))
        apart_from = np.concatenate([floor.nuisance, reach_of(floor.single, fit.slopes)], axis=1)
        remainder = omnibus(floor.single, apart_from, left[experiment.seen], basis)
        white = whole(after)
        chi2 = float(np.sum(white**2)) + known.chi2(at)
        precision = beforehand(free, fit.values, known)
        values, stds = dict(fit.values), stds_of(free, whiten(fit.slopes), precision, remainder)
        emulated: tuple[Visit, ...] = ()
        if has_surface(experiment, candidate):
            # A surface that isn't one tells nothing more than the last derivatives do.
            with suppress(ValueError):
                there = [visit.table for visit in visits]
                visits += [v for v in end.values() if not any(np.array_equal(v.table, table) for table in there)]
                reading = read(visits, whole, experiment.observed, free, known)
                values, stds, emulated = dict(reading.values), dict(reading.stds), tuple(visits)
        name = "" if candidate is None else candidate.name
        solvers = [experiment.reproducibility(p, values[p.name], name) for p in free]
        own = np.hypot(untried(floor, fit.slopes, precision), solvers)
        stds, systematic = widened(stds, [bounded(s, p, fit.values[p.name]) for s, p in zip(own, free, strict=True)])
        out[name] = Confirmation(
            name=name,
            fit=fit,
            values=values,
            stds=stds,
            systematic=systematic,
            chi2=chi2,
            freedom=max(white.size - len(free), 1),
            fall=0.0 if candidate is None else _chi2(whole, before) + known.chi2(off) - chi2,
            unseen=_chi2(apart, before) - _chi2(apart, after),
            told=known.chance(off),
            agrees=known.chance(at),
            held_out=float(np.sqrt(np.mean(left[mask] ** 2))),
            floor=noise_on(floor.single, mask),
            remainder=remainder,
            visits=emulated,
        )
    return out


def repeated(
    simulate: Simulations, jobs: Sequence[Candidate | None], fits: Sequence[Refit], count: int
) -> list[dict[int, Visit]]:
    """Simulations by ``count`` seeds where each refit ended, by seed: two single ones differ in χ² by chance as much as
    an effect of twice the smallest detectable size takes away. Seeds that can't be simulated there are left out."""

    def again(ask: Callable[..., FloatArray]) -> list[dict[int, Visit]]:
        out = list[dict[int, Visit]]()
        for candidate, fit in zip(jobs, fits, strict=True):
            on, purpose = ((), "of the model") if candidate is None else ((candidate.name,), candidate.name)
            out.append({})
            for seed in range(SHARED, SHARED + count):
                with suppress(SimulationError):
                    table = ask(fit.values, effects=on, seed=seed, purpose=f"refit {purpose} once more")
                    out[-1][seed] = Visit(dict(fit.values), on, table, seed)
        return out

    simulate.ahead(again)
    return again(simulate)


def means(one: Mapping[int, Visit], other: Mapping[int, Visit]) -> tuple[FloatArray, FloatArray]:
    """(t, s) mean features of both over the seeds that both have: of as many, chance adds as much to either χ²."""
    shared = sorted(one.keys() & other.keys())
    both = [np.mean([visits[seed].table for seed in shared], axis=0) for visits in (one, other)]
    return both[0], both[1]


def seeds_of(experiment: Experiment, repeats: int) -> list[int]:
    """Those by which refits simulate in turn: one alone would have its chance in all that they say."""
    return [*(pair := pair_of(experiment, repeats)), *range(1 + pair[-1], 1 + pair[-1] + MORE_SEEDS)]


def free_in(experiment: Experiment, candidate: Candidate | None) -> list[Parameter]:
    """Parameters of a refit."""
    return [*experiment.parameters, *(() if candidate is None else candidate.refitted)]


def has_surface(experiment: Experiment, candidate: Candidate | None) -> bool:
    """Whether a refit reads the parameters off all simulations: where these have chance in them."""
    return experiment.chance and len(free_in(experiment, candidate)) <= MOST


def _chi2(sight: Sight, left: FloatArray) -> float:
    return float(np.sum(sight(left) ** 2))


def split_times(experiment: Experiment) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Times that a refit sees, and those hidden from it: every other one, or all where that leaves nothing."""
    shown = np.arange(experiment.layout.shape[0]) % 2 == 0
    if not experiment.seen[~shown].any() or not experiment.seen[shown].any():
        return np.ones_like(shown), np.ones_like(shown)
    return shown, ~shown


def judged(experiment: Experiment, hidden: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(t, s) hidden features whose errors can be put together: those in one unit."""
    return experiment.seen & hidden[:, None] & experiment.layout.common[None]


def noise_on(noise: Noise, mask: npt.NDArray[np.bool_]) -> float:
    """Root mean square of a noise over some features."""
    return float(np.sqrt(np.mean(noise.spread(noise.scale)[mask] ** 2)))


def _renewed(experiment: Experiment, candidate: Candidate | None) -> list[str]:
    """Parameters whose derivatives change on the way; what cameras report is nearly linear, and beside it those of soil
    are better known by two seeds than anew by one."""
    soil = [p.name for p in experiment.parameters]
    if candidate is None:
        return soil
    if candidate.kind == "observation":
        return [*([] if experiment.chance else soil), candidate.size]
    return [*soil, *(p.name for p in candidate.refitted)]


def known_of(evidence: Evidence, free: Sequence[Parameter]) -> Known:
    """What a calibration says of the parameters that a refit has."""
    precision, centre = precision_of(evidence.calibration, [p.name for p in free])
    told = np.flatnonzero(np.diag(precision) > 0.0)
    root = np.zeros((len(told), len(free)))
    if told.size:
        root[:, told] = np.linalg.cholesky(precision[np.ix_(told, told)]).T
    return Known(root, centre + np.array([p.off or 0.0 for p in free]))


def _starts(
    experiment: Experiment, evidence: Vantage, candidate: Candidate | None, vantage: Vantage | None
) -> list[Start]:
    """Where a refit begins: at the fit, and at the second look's point for an effect that was switched on there."""
    extra = () if candidate is None else candidate.refitted
    off = {p.name: p.off if p.off is not None else p.default for p in extra}

    def start(point: Vantage) -> Start:
        model = np.stack([point.slopes[p.name] for p in experiment.parameters], axis=-1)
        added = [] if candidate is None else [np.moveaxis(point.directions[candidate.name], 0, -1)]
        # While the effect is off, its shape changes nothing.
        shapes = np.zeros((*model.shape[:2], 0 if candidate is None else len(candidate.shapes)))
        shaped = {} if candidate is None else point.shapes.get(candidate.name, {})
        return Start(
            {**point.values, **off, **shaped}, point.prediction, np.concatenate([model, *added, shapes], axis=-1)
        )

    points: list[Vantage] = [evidence]
    if candidate is not None and vantage is not None and candidate.name in vantage.directions:
        points.append(vantage)
    return [start(point) for point in points]


def stds_of(
    free: Sequence[Parameter], columns: FloatArray, precision: FloatArray, remainder: Omnibus
) -> dict[str, float]:
    """Standard deviations of a refit's estimates by whitened slopes (d, k) and what is known beforehand (k, k).

    Where more than noise remains, they are widened by the root of its dispersion (Birge 1932).
    """
    covariance = np.linalg.inv(columns.T @ columns + precision)
    widened = math.sqrt(max(1.0, remainder.dispersion))
    return {p.name: widened * math.sqrt(float(v)) for p, v in zip(free, np.diag(covariance), strict=True)}


def widened(stds: Mapping[str, float], systematic: Sequence[float]) -> tuple[dict[str, float], dict[str, float]]:
    """Standard deviations by noise, by name, widened by what is systematic (k,) in the same order, and the latter."""
    named = dict(zip(stds, map(float, systematic), strict=True))
    return {name: math.hypot(std, named[name]) for name, std in stds.items()}, named


def beforehand(free: Sequence[Parameter], values: Mapping[str, float], known: Known) -> FloatArray:
    """(k, k) precision of parameters by their bounds and by what other measurements say."""
    return prior(free, values) + known.root.T @ known.root


def reach_of(noise: Noise, slopes: FloatArray) -> FloatArray:
    """(n, k) derivatives (t, s, k), each as large as a parameter's error could be: ten times the noise."""
    columns = slopes[noise.seen]
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
    free = np.concatenate([floor.nuisance, reach_of(floor.single, best.fit.slopes)], axis=1)
    others = [c for name, c in candidates.items() if name != best.name]
    if not others:
        return best.remainder
    columns = {c.name: evidence.directions[c.name][:, seen].T for c in others}
    doubts = {c.name: evidence.doubts[c.name][:, seen].T for c in others if c.name in evidence.doubts}
    scorer = Scorer.of(floor.single, free, columns, others, doubts=doubts, calibration=evidence.calibration)
    second = max(scorer.score(left).values(), key=lambda score: score.statistic)
    if second.adjusted >= LEVEL:
        return best.remainder
    size = columns[second.name]
    scale = 10.0 * math.sqrt(len(size)) / np.linalg.norm(size / floor.single.scale[:, None], axis=0)
    return omnibus(floor.single, np.concatenate([free, size * scale], axis=1), left, basis)
