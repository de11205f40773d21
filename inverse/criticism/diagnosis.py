"""Diagnosis: from an experiment and a fit to a verdict, with everything that led to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Calibration, Candidate, Experiment

from .confirmation import Confirmation, confirm, remainder_of
from .derivatives import moved, rate
from .estimates import Estimate, weighed, weighed_there
from .evidence import Evidence, gather
from .floor import Floor
from .looks import Looks, foreseen, look, promising
from .misfit import Block, Omnibus, left_over, shares
from .naming import members_of
from .outside import StrengthReading, read_strength
from .own_floor import as_it_is, on_its_own_floor
from .score import Score, Scorer
from .sides import lopsided
from .sight import Sight
from .simulations import Simulations
from .strokes import StrokeAdvice, advise
from .verdicts import (
    GATE,
    LEVEL,
    WITHIN,
    EffectVerdict,
    Verdict,
    beyond,
    explained,
    explained_of_all,
    of_effect,
    overall,
)

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str, float], None]


MORE = 3
"""Effects that are refitted beyond those asked for where the model is off: a refit's first steps cost little."""


@dataclass(frozen=True)
class Options:
    """How thorough a diagnosis is.

    Attributes:
        level: family-wise chance of naming an effect when none is missing.
        repeats: simulations at the fit with other seeds.
        refits: effects, the best ones, that are refitted; :data:`MORE` where the model is off.
        refit_steps: a refit's first simulations at most; some ten to twenty more follow for what explains most.
        seed: of draws.
    """

    level: float = LEVEL
    repeats: int = 4
    refits: int = 3
    refit_steps: int = 5
    seed: int = 0


@dataclass(frozen=True)
class Diagnosis:
    """All that was found.

    Attributes:
        verdict: on the model.
        members: the equivalence class: effects that explain the misfit about equally well, the best first.
        effects: verdict on each effect.
        scores: of each effect, alone.
        given: of each effect, with the best one taken to be on; empty where none was named.
        confusion: correlation of each pair of effects' scores.
        estimates: the model's own parameters as it is, all of the floor and what is systematic counted, by name.
        misfit: of the model as it is, on slow waves.
        whole: how far it is off in all.
        remainder: after the best effect; None where none was named.
        whole_after: how far the model with it is off in all; None where none was named, where there is no chance, or
            none could be simulated.
        explained: share of the misfit beyond chance that the best effect explains, on slow waves where these show one.
        confirmations: refits by effect, the model as it is under the empty name.
        blocks: where the model fails.
        where: share of the best effect's evidence in each (stage, region, channel).
        residual: (t, s) what parameters and nuisances can't take up.
        floor: noise and nuisances.
        evidence: the simulations.
        strength: what a free strength says where something outside the library is missing, else None.
        strokes: which stroke would tell the class's members apart.
        simulations: how many the diagnosis needed, coarse ones of other strokes aside.
        unit: of the features.
        notes: what went otherwise than planned.
    """

    verdict: Verdict
    members: tuple[str, ...]
    effects: Mapping[str, EffectVerdict]
    scores: Mapping[str, Score]
    given: Mapping[str, Score]
    confusion: Mapping[tuple[str, str], float]
    estimates: Mapping[str, Estimate]
    misfit: Omnibus
    whole: Block
    remainder: Omnibus | None
    explained: float
    confirmations: Mapping[str, Confirmation]
    blocks: tuple[Block, ...]
    where: Mapping[tuple[str, str, str], float]
    residual: FloatArray
    floor: Floor
    evidence: Evidence
    whole_after: Block | None = None
    strength: StrengthReading | None = None
    strokes: tuple[StrokeAdvice, ...] = ()
    simulations: int = 0
    unit: str = ""
    notes: tuple[str, ...] = ()


def diagnose(
    experiment: Experiment,
    values: Mapping[str, float],
    *,
    simulate: Simulations | None = None,
    options: Options | None = None,
    replays: Callable[[], FloatArray] | None = None,
    calibration: Calibration | None = None,
    progress: Report | None = None,
) -> Diagnosis:
    """Criticise a model at its fitted parameters.

    Args:
        experiment: what was observed, and the model.
        values: the fitted parameters.
        simulate: where predictions come from; the experiment itself by default.
        options: how thorough.
        replays: gives those of :class:`~splatsoil.inverse.criticism.evidence.Evidence`; asked once all is simulated.
        calibration: likewise.
        progress: called with (what, share done).

    Raises:
        SimulationError: the fit itself can't be simulated.
    """
    options, simulate = options or Options(), simulate or Simulations(experiment)
    told = progress or (lambda what, share: None)
    evidence = gather(
        experiment, simulate, values, repeats=options.repeats, progress=lambda share: told("simulations", 0.4 * share)
    )
    foreseen(experiment, evidence, simulate)
    return judge(
        experiment,
        replace(evidence, replays=None if replays is None else replays(), calibration=calibration),
        simulate,
        options=options,
        progress=told,
    )


def judge(
    experiment: Experiment,
    evidence: Evidence,
    simulate: Simulations,
    *,
    options: Options,
    progress: Report | None = None,
) -> Diagnosis:
    """From evidence to a verdict; simulates only to switch effects on and to refit the best of them."""
    told = progress or (lambda what, share: None)
    looks = look(experiment, evidence, simulate, level=options.level, seed=options.seed)
    evidence, bench, off, vantage = looks.evidence, looks.bench, looks.off, looks.vantage
    floor, scorer, seen = bench.floor, bench.scorer, experiment.seen
    residual = (experiment.observed - evidence.mean)[seen]
    misfit, (whole, parts) = bench.misfit(residual), bench.blocks(residual)
    sides = lopsided(experiment, evidence, floor)

    def scored(given: str | None = None) -> dict[str, Score]:
        found = {} if scorer is None else scorer.score(residual, given=given)
        return {n: s.on_the_weaker_side(sides.get(n, 1.0), candidates[n].measure.meaningful) for n, s in found.items()}

    candidates = {c.name: c for c in bench.candidates}
    scores = scored()
    notes = [f"{name} could not be simulated: {why}" for name, why in evidence.failed.items()]
    chosen = _chosen(experiment, looks, scores, residual, options)
    confirmations: dict[str, Confirmation] = {}
    members: tuple[str, ...] = ()
    given: Mapping[str, Score] = {}
    remainder, gone, before, left, whole_after = None, 0.0, misfit, False, None
    if chosen and scorer is not None:
        trials = [candidates[name] for name in chosen]
        confirmations = confirm(
            experiment, evidence, floor, trials, simulate, options.refit_steps, bench.basis, told, vantage
        )
        tried = {name: c for name, c in confirmations.items() if name}
        # Not by what is left of χ²: an effect that stays off leaves what other pictures say of it unexplained.
        costs = {name: scorer.price(candidates[name], refitted=True) - c.fall for name, c in tried.items()}
        measures = {name: c.measure for name, c in candidates.items()}
        members = members_of(confirmations, costs, off, scores, measures)
        before = confirmations[""].remainder
        if members:
            best = members[0]
            given = scored(best)
            own = None
            if experiment.chance:
                told("the floor with the effect on", 0.97)
                try:
                    own = on_its_own_floor(experiment, evidence, tried[best], candidates[best], simulate, residual)
                except SimulationError as error:
                    notes.append(f"with {best} on, its noise could not be simulated: {error}")
            if own is not None:
                confirmations[best], before, remainder = own.refit, own.before, own.after
                whole_after, left = own.whole, beyond(own.whole)
                errors = own.whole_before.ratio, own.whole.ratio
            else:
                remainder = remainder_of(experiment, floor, tried[best], candidates, evidence, bench.basis)
                asis, after = (c.held_out / c.floor for c in (confirmations[""], tried[best]))
                errors, left = (asis, after), after > WITHIN
            # Of slow waves there is no share where they show nothing, on either floor.
            shown = misfit.p < GATE and before.excess > 0.0
            gone = explained(before, remainder) if shown else explained_of_all(*errors)
    effects = _effects(experiment, candidates, scores, given, members, confirmations, looks.astray, options.level)
    # Where the best explanation is too small to matter, so is what is missing.
    named = bool(members) and effects[members[0]] == "missing"
    if chosen and not named:
        effects = {n: "cannot tell" if v == "missing" else v for n, v in effects.items()}
    verdict = overall(named, off, before, remainder, left=left)
    strength = None
    # Strength is told along slow waves: of what they don't show it explains nothing.
    if verdict == "outside the library" and misfit.p < GATE:
        try:
            strength = read_strength(
                experiment, evidence, floor, simulate, bench.basis, misfit, progress=lambda s: told("free strength", s)
            )
        except SimulationError as error:
            notes.append(f"the free strength could not be simulated: {error}")
    if verdict != "adequate":
        estimates = weighed(experiment, evidence, floor, bench.basis)
    elif experiment.model:
        found = confirmations.get("")
        estimates = as_it_is(experiment, evidence, floor, bench.basis, found, simulate, options.refit_steps, told)
    else:
        estimates = weighed_there(experiment, evidence, floor, bench.basis, simulate)
    strokes = _advice(experiment, members, candidates, confirmations, told)
    return Diagnosis(
        verdict=verdict,
        members=members,
        effects=effects,
        scores=scores,
        given=given,
        confusion=_pairs(scorer),
        estimates=estimates,
        misfit=misfit,
        whole=whole,
        remainder=remainder,
        whole_after=whole_after,
        explained=gone,
        confirmations=confirmations,
        blocks=parts,
        where=_where(experiment, floor, evidence, scores, members, residual),
        residual=floor.noise.spread(left_over(floor.noise, floor.free, residual)),
        floor=floor,
        evidence=evidence,
        strength=strength,
        strokes=strokes,
        simulations=simulate.asked,
        unit=experiment.layout.unit,
        notes=tuple(notes),
    )


def _advice(
    experiment: Experiment,
    members: Sequence[str],
    candidates: Mapping[str, Candidate],
    confirmations: Mapping[str, Confirmation],
    told: Report,
) -> tuple[StrokeAdvice, ...]:
    """Which other stroke tells the members of a class apart, each in the size and shape that its refit found."""
    if len(members) < 2:
        return ()
    fitted = dict(confirmations[members[0]].values)
    for name in members[1:]:
        fitted |= {p.name: confirmations[name].values[p.name] for p in candidates[name].refitted}
    chosen = [candidates[name] for name in members]
    return advise(experiment, fitted, chosen, progress=lambda share: told("other strokes", share))


def _chosen(
    experiment: Experiment,
    looks: Looks,
    scores: Mapping[str, Score],
    residual: FloatArray,
    options: Options,
) -> list[str]:
    """Effects to refit: significant ones, those first that explain most for their parameters.

    Where the model is off, those too that would explain most if they were alone, in their best shapes, as seen from
    soil as one would guess it where the fit is far from that: at a fit that a missing effect has led astray, it needn't
    stand out.
    """
    evidence, bench, vantage, scorer = looks.evidence, looks.bench, looks.vantage, looks.bench.scorer
    if scorer is None:
        return []
    prices = {c.name: scorer.price(c) for c in scorer.candidates}
    found = [s for s in scores.values() if s.adjusted < options.level]
    strong = [s.name for s in sorted(found, key=lambda s: s.statistic - prices[s.name], reverse=True)]
    alone: list[str] = []
    if looks.astray and vantage is not None:
        sight = Sight.of(experiment, bench.floor, bench.basis, vantage)
        alone = promising(experiment, vantage, sight, bench.candidates, scorer.price)
    elif looks.off:
        shaped = {} if vantage is None else {name: vantage.directions[name] for name in vantage.shapes}
        best = bench.scored(experiment, evidence, {**evidence.directions, **shaped}) if shaped else scorer
        alone = best.ranked(residual)
    if not alone:
        return strong[: options.refits]
    # The two orders take turns, and more are tried than either would have: chance is in both.
    turns = [name for pair in zip_longest(strong, alone) for name in pair if name is not None]
    return list(dict.fromkeys(turns))[: options.refits + MORE]


def _effects(
    experiment: Experiment,
    candidates: Mapping[str, Candidate],
    scores: Mapping[str, Score],
    given: Mapping[str, Score],
    members: Sequence[str],
    confirmations: Mapping[str, Confirmation],
    astray: bool,
    level: float,
) -> dict[str, EffectVerdict]:
    """A verdict for each effect: members by their refits, the others by what the best one leaves for them.

    Where the fit was ``astray``, by one seed and of other soil than that which was fitted: that denies nothing.
    """
    out: dict[str, EffectVerdict] = {}
    for name, candidate in candidates.items():
        if name in members:
            out[name] = "missing" if _matters(candidate, confirmations[name].values) else "trivial"
        else:
            score = given.get(name, scores[name])
            out[name] = of_effect(candidate, score, level=level, apart=_apart(experiment, candidate, score))
            if out[name] == "missing" or (astray and candidate.kind == "physics"):
                # Significant beside the best one too, or because the best one's size is off: the next round tells.
                out[name] = "cannot tell"
    return out


def _apart(experiment: Experiment, candidate: Candidate, score: Score) -> float:
    """Standard deviation between solvers of the size from which an effect matters, on the side where it is scored."""
    size = candidate.measure
    off = float(size.off or 0.0)
    matters = moved(size, off, math.copysign(size.meaningful, score.estimate) / rate(size, off))
    return experiment.reproducibility(size, matters, candidate.name)


def _matters(candidate: Candidate, values: Mapping[str, float]) -> bool:
    """Whether any of an effect's parameters is at least of its smallest meaningful size."""
    sizes = [(abs(values[p.name] - float(p.off or 0.0)), p.meaningful) for p in candidate.parameters]
    return any(size >= least and size > 0.0 for size, least in sizes)


def _pairs(scorer: Scorer | None) -> dict[tuple[str, str], float]:
    if scorer is None:
        return {}
    matrix, names = scorer.confusion(), scorer.names
    return {(a, b): float(matrix[i, j]) for i, a in enumerate(names) for j, b in enumerate(names) if j < i}


def _where(
    experiment: Experiment,
    floor: Floor,
    evidence: Evidence,
    scores: Mapping[str, Score],
    members: Sequence[str],
    residual: FloatArray,
) -> dict[tuple[str, str, str], float]:
    """Share of the best effect's evidence in each part of the data."""
    if not members:
        return {}
    seen = experiment.seen
    direction = evidence.directions[members[0]][:, seen].T @ np.array(list(scores[members[0]].steps.values()))
    solver = floor.noise.solver.beside(floor.free)
    parts = shares(experiment.layout, floor.noise, direction * solver.solve(residual))
    whole = sum(parts.values())
    return {key: value / whole for key, value in parts.items()} if whole > 0.0 else {}
