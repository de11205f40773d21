"""Refits side by side, of the model as it is and with each effect that is tried.

All take their first steps. Those that might still be the best, or its equal, then look farther; see :mod:`.reading`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .dilution import undiluted
from .evidence import Evidence, Vantage, Visit, pair_of
from .floor import Floor
from .joint import precision_of
from .reading import MOST, explored
from .refit import ROUNDS, Known, Refit, Start, settle
from .sight import Sight
from .simulations import Simulations
from .verdicts import CERTAIN, EQUIVALENT, ruled_out

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str, float], None]

SHARED = 0
"""Seed of the simulation where a refit ends."""
MORE_SEEDS = 4
"""Seeds of refits beside those of the evidence."""
LEAST_SHARE = 0.5
"""Of what the best effect takes off χ² in its first steps: what takes less off isn't its equal in the end. (Of 348
emulated refits 132 stop by this and the next, none that would have ended as the best or its equal.)"""
CLEARLY = 4.0 * EQUIVALENT
"""Difference of χ², over what each number still holds, below which first steps tell nothing apart."""


@dataclass
class Trial:
    """One refit on the way.

    Attributes:
        experiment: asked for predictions.
        candidate: the effect that is on, or None.
        known: what a calibration says of the free parameters.
        simulate: where predictions come from.
        seeds: taken in turn: one alone would have its chance in all that is said.
        visits: the simulations at hand, the model's own among them.
        fit: how far the refit has come.
        stopped: whether it went no further than its first steps.
    """

    experiment: Experiment
    candidate: Candidate | None
    known: Known
    simulate: Simulations
    seeds: Sequence[int]
    visits: list[Visit]
    fit: Refit = field(init=False)
    stopped: bool = False
    _asked: int = field(default=0, init=False)

    @property
    def name(self) -> str:
        """Of the effect, empty for the model as it is."""
        return "" if self.candidate is None else self.candidate.name

    @property
    def left_behind(self) -> bool:
        """Whether it is an effect's that stopped."""
        return self.stopped and self.candidate is not None

    @property
    def on(self) -> tuple[str, ...]:
        """Effects that are."""
        return () if self.candidate is None else (self.candidate.name,)

    @property
    def free(self) -> list[Parameter]:
        """Parameters that are refitted."""
        return free_in(self.experiment, self.candidate)

    @property
    def emulated(self) -> bool:
        """See :func:`has_surface`."""
        return has_surface(self.experiment, self.candidate)

    @property
    def explored_alone(self) -> bool:
        """Whether it is the model as it is, with parameters that make up for each other: steps by derivatives would be
        led by chance there, so it is only, and always, explored.

        A fit weighs otherwise than a refit does, and what that alone changes is no effect's doing: a model without such
        parameters takes steps like any other.
        """
        return self.candidate is None and self.emulated and len(self.free) > 1

    @property
    def off(self) -> FloatArray:
        """(k,) the free parameters' off values."""
        return np.array([p.off or 0.0 for p in self.free])

    @property
    def at(self) -> FloatArray:
        """(k,) the free parameters as refitted."""
        return np.array([self.fit.values.get(p.name, p.off or 0.0) for p in self.free])

    @property
    def told(self) -> float:
        """Chance of what other pictures say of the parameters if they were off."""
        return self.known.chance(self.off)

    @property
    def agrees(self) -> float:
        """The same, if they were as refitted."""
        return self.known.chance(self.at)

    def predict(self, values: Mapping[str, float], seed: int | None = None) -> FloatArray:
        """(t, s) features by parameters, of the next seed unless told which; adds a visit."""
        what = self._next(values, 0) if seed is None else self._what(values, seed)
        self._asked += seed is None
        self.visits.append(Visit(dict(values), self.on, self.simulate(**what), what["seed"]))
        return self.visits[-1].table

    def ahead(self, points: Sequence[Mapping[str, float]]) -> None:
        """Have what is predicted next made side by side."""
        jobs = [self._next(values, k) for k, values in enumerate(points)]
        self.simulate.ahead(lambda ask: [ask(**job) for job in jobs], apart=True)

    def _next(self, values: Mapping[str, float], later: int) -> dict[str, Any]:
        return self._what(values, self.seeds[(self._asked + later) % len(self.seeds)])

    def _what(self, values: Mapping[str, float], seed: int) -> dict[str, Any]:
        return {"values": values, "effects": self.on, "seed": seed, "purpose": f"refit {self.name or 'of the model'}"}


def refitted(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    chosen: Sequence[Candidate],
    simulate: Simulations,
    steps: int,
    told: Report,
    vantage: Vantage | None,
    whiten: Sight,
    through: Sight,
) -> list[Trial]:
    """The model as it is, then with each chosen effect, refitted.

    ``whiten`` is what one simulation's χ² is over, ``through`` that of a surface through many; the rest is as in
    :func:`~splatsoil.inverse.criticism.confirmation.confirm`.
    """
    starting = undiluted(evidence, floor.single, floor.nuisance)
    jobs: list[Candidate | None] = [None, *chosen]
    trials = [_trial(experiment, evidence, vantage, simulate, candidate) for candidate in jobs]
    done = 0

    def said(trial: Trial) -> None:
        nonlocal done
        told(f"refit {trial.name or 'of the model'}", 0.75 + 0.1 * done / len(trials))
        done += 1

    def begin(trial: Trial) -> None:
        said(trial)
        candidate = trial.candidate
        trial.fit = settle(
            trial.predict,
            whiten,
            experiment.observed,
            trial.free,
            starts_of(experiment, starting, candidate, vantage),
            chance=experiment.chance,
            known=trial.known,
            renewed=_renewed(experiment, candidate),
            most=steps if candidate is not None else 0 if trial.explored_alone else max(steps - 2, 1),
            rounds=0 if candidate is None or trial.emulated else ROUNDS,
            # In steps that bring less chance leads, not derivatives, and a surface goes on from there.
            least=CLEARLY if trial.emulated else -math.inf,
        )

    def explore(trial: Trial, shapes: Sequence[Parameter] = ()) -> None:
        trial.fit = explored(
            trial.predict,
            trial.visits,
            through,
            experiment.observed,
            trial.free,
            trial.known,
            trial.fit,
            shapes,
            ahead=trial.ahead,
        )

    def end(trial: Trial) -> None:
        with suppress(SimulationError):
            trial.fit = replace(trial.fit, prediction=trial.predict(trial.fit.values, SHARED))

    def go_on(trial: Trial) -> None:
        said(trial)
        if trial.left_behind:
            return
        if not trial.stopped:
            explore(trial, () if trial.candidate is None else trial.candidate.shapes)
        end(trial)

    simulate.side_by_side([partial(begin, trial) for trial in trials])
    emulated = [trial for trial in trials if trial.emulated]
    stop(trials, whiten(experiment.observed).size)
    simulate.side_by_side([partial(go_on, trial) for trial in emulated])
    far = [trial for trial in emulated if trial.candidate is not None and not trial.stopped]

    def left(trial: Trial) -> float:
        # by the same features and seed for all: a refit's own χ² is of those that it was last judged by
        remainder = through(experiment.observed - trial.fit.prediction)
        return float(np.sum(remainder**2)) + trial.known.chi2(trial.at)

    if far:
        # Chance of few simulations is most of what the estimates of the best one are off by.
        best = min(far, key=left)
        explore(best)
        end(best)
    return trials


def stop(trials: Sequence[Trial], count: int) -> None:
    """Stop those whose first steps say that they can't be the best effect's equals, of ``count`` numbers in χ²; the
    model as it is, too, which takes nothing off."""
    asis, *others = trials
    falls = {t.name: asis.fit.chi2 + t.known.chi2(t.off) - t.fit.chi2 for t in others}
    possible = [t for t in others if not ruled_out(t.told, t.agrees)]
    if not possible:
        return
    best = max(possible, key=lambda t: falls[t.name])
    dispersion = max(1.0, best.fit.chi2 / max(count - len(best.free), 1))
    least = min(LEAST_SHARE * falls[best.name], falls[best.name] - CLEARLY * dispersion)
    asis.stopped = asis.emulated and least > 0.0 and not asis.explored_alone
    for trial in others:
        trial.stopped = trial.emulated and trial.told >= CERTAIN and falls[trial.name] < least


def _trial(
    experiment: Experiment,
    evidence: Evidence,
    vantage: Vantage | None,
    simulate: Simulations,
    candidate: Candidate | None,
) -> Trial:
    """Before its first step."""
    emulated = has_surface(experiment, candidate)
    seeds = seeds_of(experiment, len(evidence.repeats)) if emulated else [SHARED]
    on = () if candidate is None else (candidate.name,)
    visits = [v for p in (evidence, vantage) if p is not None for v in p.visits if v.effects in ((), on)]
    known = known_of(evidence, free_in(experiment, candidate))
    return Trial(experiment, candidate, known, simulate, seeds, visits)


def repeated(simulate: Simulations, trials: Sequence[Trial], count: int) -> list[dict[int, Visit]]:
    """Simulations by ``count`` seeds where each refit ended, by seed: two single ones differ in χ² by chance as much as
    an effect of twice the smallest detectable size takes away. Seeds that can't be simulated there are left out; of an
    effect's that stopped early there is its last simulation, in place of the shared seed's."""

    def again(ask: Callable[..., FloatArray]) -> list[dict[int, Visit]]:
        out = list[dict[int, Visit]]()
        for trial in trials:
            at, purpose = trial.fit.values, f"refit {trial.name or 'of the model'} once more"
            out.append({})
            if trial.left_behind:
                out[-1][SHARED] = Visit(dict(at), trial.on, trial.fit.prediction, SHARED)
                continue
            for seed in range(SHARED, SHARED + count):
                with suppress(SimulationError):
                    table = ask(at, effects=trial.on, seed=seed, purpose=purpose)
                    out[-1][seed] = Visit(dict(at), trial.on, table, seed)
        return out

    simulate.ahead(again, apart=True)
    return again(simulate)


def seeds_of(experiment: Experiment, repeats: int) -> list[int]:
    """Those by which refits simulate in turn."""
    return [*(pair := pair_of(experiment, repeats)), *range(1 + pair[-1], 1 + pair[-1] + MORE_SEEDS)]


def free_in(experiment: Experiment, candidate: Candidate | None) -> list[Parameter]:
    """Parameters of a refit."""
    return [*experiment.parameters, *(() if candidate is None else candidate.refitted)]


def has_surface(experiment: Experiment, candidate: Candidate | None) -> bool:
    """Whether a refit reads the parameters off all simulations: where these have chance in them."""
    return experiment.chance and len(free_in(experiment, candidate)) <= MOST


def known_of(evidence: Evidence, free: Sequence[Parameter]) -> Known:
    """What a calibration says of the parameters that a refit has."""
    precision, centre = precision_of(evidence.calibration, [p.name for p in free])
    told = np.flatnonzero(np.diag(precision) > 0.0)
    root = np.zeros((len(told), len(free)))
    if told.size:
        root[:, told] = np.linalg.cholesky(precision[np.ix_(told, told)]).T
    return Known(root, centre + np.array([p.off or 0.0 for p in free]))


def starts_of(
    experiment: Experiment, evidence: Vantage, candidate: Candidate | None, vantage: Vantage | None
) -> list[Start]:
    """Where a refit begins: where the effect was switched on, and where that is the fit, in another shape, too."""
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

    if vantage is None or candidate is None or candidate.name not in vantage.directions:
        return [start(evidence)]
    if vantage.values != evidence.values:
        return [start(vantage)]
    return [start(point) for point in (evidence, vantage) if point is evidence or candidate.name in vantage.shapes]


def _renewed(experiment: Experiment, candidate: Candidate | None) -> list[str]:
    """Parameters whose derivatives change on the way; what cameras report is nearly linear, and beside it those of soil
    are better known by two seeds than anew by one."""
    soil = [p.name for p in experiment.parameters]
    if candidate is None:
        return soil
    if candidate.kind == "observation":
        return [*([] if experiment.chance else soil), candidate.size]
    return [*soil, *(p.name for p in candidate.refitted)]
