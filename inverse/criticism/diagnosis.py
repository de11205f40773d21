"""A comparison of models from beginning to end: simulations, evidence, predictive checks, what was set aside."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment

from .checks import Check, Expected, checks, passes
from .design import Prior, Run, effect_runs
from .evidence import AS_IT_IS, ELSE, PRIOR, Comparison, Evidence
from .noise import REMAINING, Noise, Tables, compared, noise_of, trend_of
from .power import NAMED, detectable
from .simulations import Simulate, Simulations

FloatArray = npt.NDArray[np.float64]
Verdict = Literal["adequate", "missing", "one of", "something else", "undecided"]

FINE = "fine"
"""Numerics that make the fine run of a pair."""
BASE, PAIRS, SCREENED = 10, 3, 2
"""Simulations of the base model (half as many again for each parameter more), pairs, and of each effect beside one for
each free parameter."""
REFINED, AGAIN = 3, 4
"""Effects, the most probable ones, that are simulated again at their posterior, and simulations of each and of the base
model."""
FEWEST_ROUNDS, MOST_ROUNDS = 2, 4
"""Times that this is done: until the most probable effect's parameters move by less than their standard deviation."""
STEP = 4.0
"""Of an observation effect's parameter, over its smallest meaningful size, at which it is drawn."""
SHOWN = 0.05
"""Probability from which an effect is worth a line of its own."""
MENTIONED = 10.0**0.5
"""Bayes factor from which evidence against the base model is worth more than a bare mention (Jeffreys 1961, Theory of
Probability, app. B)."""


@dataclass(frozen=True)
class HeldOut:
    """What a model says of data that it hasn't seen.

    Attributes:
        model: its name.
        error: root mean square of the residual, in the layout's unit.
        noise: what would be left with nothing wrong.
        log_score: mean logarithm of the predictive density of a feature.
    """

    model: str
    error: float
    noise: float
    log_score: float


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a comparison of models came to.

    Attributes:
        verdict: in one word.
        members: effects that are named; else the most probable ones, if any is worth a line.
        evidence: of all models.
        estimates: mean and standard deviation of the base model's parameters, averaged over models, by name.
        determined: whether the data say more of them than the prior.
        detectable: smallest size over the meaningful one that would have been named, by effect; None for none.
        checks: of the most probable model.
        residuals: (t, s) of the base model and of the best effect, by name.
        predictions: (t, s) theirs.
        expected: (t, s) variance with nothing wrong.
        mask: (t, s) features that were compared.
        held_out: on data set aside.
        aside: what these are.
        notes: for people.
    """

    verdict: Verdict
    members: tuple[str, ...]
    evidence: Evidence
    estimates: Mapping[str, tuple[float, float]]
    determined: Mapping[str, bool]
    detectable: Mapping[str, float | None]
    checks: Sequence[Check]
    residuals: Mapping[str, FloatArray]
    predictions: Mapping[str, FloatArray]
    expected: FloatArray
    mask: npt.NDArray[np.bool_]
    held_out: Sequence[HeldOut] = ()
    aside: str = ""
    notes: Sequence[str] = ()

    @property
    def passes(self) -> bool:
        """Whether no predictive check stands out."""
        return passes(list(self.checks))


@dataclass
class _Study:
    """Simulations so far, and what failed."""

    experiment: Experiment
    simulate: Simulate
    prior: Prior
    seed: int
    base: list[Run] = field(default_factory=list)
    fine: list[Run] = field(default_factory=list)
    effects: dict[str, list[Run]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def tables(self, drawn: Mapping[str, FloatArray], reference: FloatArray) -> Tables:
        made = {name: self._made(runs) for name, runs in self.effects.items()}
        enough = {name: found for name, found in made.items() if len(found[0]) > 1}
        return Tables(self._made(self.base), self._made(self.fine), enough, drawn, reference)

    def _made(self, runs: Sequence[Run]) -> tuple[list[Run], FloatArray]:
        """Those that could be made, and their tables."""
        kept, found = [], []
        for run in runs:
            try:
                found.append(self.simulate(**run.arguments(), purpose=", ".join(run.effects) or run.numerics or "base"))
            except SimulationError as error:
                self.failed.setdefault(", ".join(run.effects) or "the model as it is", str(error))
            else:
                kept.append(run)
        return kept, np.array(found).reshape(len(kept), *self.experiment.layout.shape)


def diagnose(
    experiment: Experiment,
    values: Mapping[str, float],
    *,
    simulate: Simulations | None = None,
    effects: bool = True,
    seed: int = 0,
    known: Sequence[Run] = (),
    prior: Prior | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> Diagnosis:
    """Compare models.

    Args:
        experiment: what was observed, and predicts.
        values: a fit's, where drawings are made.
        simulate: the experiment's simulations; new ones by default.
        effects: whether effects that are off are models, too; else only the base model and "something else".
        seed: of the design.
        known: simulations of the base model that a search has made; the design adds what is missing.
        prior: of the base model's parameters; about ``values`` by default.
        progress: called with (what, share done).

    Raises:
        SimulationError: the base model could not be simulated.
    """
    ask = Simulations(experiment) if simulate is None else simulate
    prior = Prior.of(experiment, values) if prior is None else prior
    candidates = experiment.candidates if effects else ()
    study = _design(experiment, ask, prior, candidates, seed, known)
    ask.ahead(lambda noted: _ask_through(study, noted))
    progress("drawings", 0.0)
    drawn, reference = _drawings(experiment, ask, values, candidates)
    progress("simulations", 0.1)
    evidence, comparison, noise, tables = _judged(study, drawn, reference, candidates)
    for number in range(MOST_ROUNDS if effects else 0):
        progress("simulations where models are most probable", 0.7 + 0.05 * number)
        before = evidence
        _refine(study, before, number)
        ask.ahead(lambda noted: _ask_through(study, noted))
        evidence, comparison, noise, tables = _judged(study, drawn, reference, candidates)
        if number + 1 >= FEWEST_ROUNDS and _settled(before, evidence):
            break
    progress("checks", 0.9)
    best = max(
        (n for n in evidence.probability if n not in (AS_IT_IS, ELSE)),
        key=lambda n: evidence.probability[n],
        default="",
    )
    predictions = {AS_IT_IS: _predicted(study, tables, evidence, AS_IT_IS, ask)}
    if best:
        predictions[best] = _predicted(study, tables, evidence, best, ask)
    residuals = {name: experiment.observed - table for name, table in predictions.items()}
    top = best if best and evidence.probability[best] > evidence.probability[AS_IT_IS] else AS_IT_IS
    expected = _expected(study, noise, tables, evidence.models[top].factors)
    found = checks(experiment, residuals[top], expected, noise.mask, seed)
    verdict, members = judged(evidence.probability, fits=passes(found))
    held_out, aside = _held_out(study, tables, candidates, tuple(predictions), ask) if effects else ([], "")
    power = {
        c.name: size if size is None else size * c.measure.meaningful
        for c in candidates
        if c.name in evidence.models
        for size in [detectable(comparison, evidence, c, seed)]
    }
    averaged = {p.name: evidence.marginal(p.name) for p in prior.space}
    return Diagnosis(
        verdict,
        members,
        evidence,
        {name: (marginal.mean, marginal.std) for name, marginal in averaged.items()},
        {p.name: averaged[p.name].std < 0.5 * (p.upper - p.lower) / np.sqrt(12.0) for p in prior.space},
        power,
        found,
        residuals,
        predictions,
        expected.variance,
        noise.mask,
        held_out,
        aside,
        [f"{what.replace('_', ' ')}: some simulations failed ({why})" for what, why in study.failed.items()],
    )


def judged(probability: Mapping[str, float], *, fits: bool) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict by the models' probabilities and whether the most probable one passes its predictive checks, and the
    effects that it names."""
    effects = sorted((n for n in probability if n not in (AS_IT_IS, ELSE)), key=lambda n: -probability[n])
    shown = tuple(n for n in effects if probability[n] >= SHOWN)
    if probability[ELSE] >= NAMED or not fits:
        return "something else", shown
    if effects and probability[effects[0]] >= NAMED:
        return "missing", (effects[0],)
    odds = max(p for name, p in probability.items() if name != AS_IT_IS) / max(probability[AS_IT_IS], 1e-300)
    if odds * (len(probability) - 1) * PRIOR / (1.0 - PRIOR) < MENTIONED:
        return "adequate", shown
    if len(shown) > 1 and sum(probability[n] for n in shown) >= NAMED:
        return "one of", shown
    return "undecided", shown


def _design(
    experiment: Experiment,
    simulate: Simulate,
    prior: Prior,
    candidates: Iterable[Candidate],
    seed: int,
    known: Sequence[Run] = (),
) -> _Study:
    count = BASE + BASE // 2 * (len(prior.space) - 1)
    study = _Study(experiment, simulate, prior, seed)
    study.base = prior.inside(known)
    points = _spread(prior, count, seed)
    # each simulation that is there stands for the nearest point of the design
    for there in prior.unit(study.base)[: len(points)]:
        points = np.delete(points, np.argmin(np.sum((points - there) ** 2, axis=1)), axis=0)
    study.base += [Run(v, seed=seed + 1 + i) for i, v in enumerate(prior.values(points))]
    if FINE in experiment.numerics:
        points = 0.7 * _spread(prior, PAIRS, seed + 1)
        study.fine = [Run(v, seed=seed + 101 + i, numerics=FINE) for i, v in enumerate(prior.values(points))]
    for number, candidate in enumerate(c for c in candidates if c.kind == "physics"):
        free = len(prior.space) + len(candidate.parameters) + len(candidate.shapes)
        study.effects[candidate.name] = effect_runs(candidate, prior, SCREENED + free, seed + 201 + 100 * number)
    return study


def _refine(study: _Study, evidence: Evidence, number: int) -> None:
    """More simulations where the base model and the most probable effects are most probable."""
    rng = np.random.default_rng([study.seed, 19, number])
    first = 10_000 * (1 + number) + study.seed
    likely = sorted(study.effects, key=lambda name: -evidence.probability.get(name, 0.0))[:REFINED]
    for name in (n for n in likely if n in evidence.models):
        drawn = evidence.models[name].drawn(AGAIN, rng)
        study.effects[name] += [Run(v, (name,), first + i) for i, v in enumerate(drawn)]
    study.base += [Run(v, seed=first + 100 + i) for i, v in enumerate(evidence.models[AS_IT_IS].drawn(AGAIN, rng))]


def _settled(before: Evidence, now: Evidence) -> bool:
    """Whether the most probable model's parameters have moved by less than their standard deviation."""
    model, old = now.models[now.best], before.models[now.best]
    return all(abs(model.moments(p)[0] - old.moments(p)[0]) < max(model.moments(p)[1], 1e-12) for p in model.values)


def _spread(prior: Prior, count: int, seed: int) -> FloatArray:
    """(count, n) points in [-1, 1]: evenly for one parameter, else a Sobol sequence."""
    if len(prior.space) == 1:
        return (2.0 * (np.arange(count) + 0.5) / count - 1.0)[:, None]
    return prior.points(1 << (count - 1).bit_length(), seed)[:count]


def _ask_through(study: _Study, simulate: Simulate) -> None:
    """Ask for all that a study needs, through another function."""
    other = replace(study, simulate=simulate, failed={})
    other.tables({}, np.zeros(study.experiment.layout.shape))


def _drawings(
    experiment: Experiment, simulate: Simulate, values: Mapping[str, float], candidates: Iterable[Candidate]
) -> tuple[dict[str, FloatArray], FloatArray]:
    """One simulation reported or drawn otherwise, by guess or parameter (these for their smallest meaningful size), and
    as usual."""
    observed = [c for c in candidates if c.kind == "observation"]
    # What needs more frames of it comes first, so that one simulation serves all.
    observed.sort(key=lambda c: c.name != "time_offset")
    at, tables = dict(values), {}
    for candidate in observed:
        for p in candidate.parameters:
            assert p.off is not None
            end = float(np.clip(p.off + STEP * p.meaningful, p.lower, p.upper))
            table = simulate({**at, p.name: end}, effects=(candidate.name,), purpose=candidate.name)
            tables[p.name] = (table, (end - p.off) / p.meaningful)
    reference = simulate(at, purpose="as it is")
    drawn = {name: reference + (table - reference) / step for name, (table, step) in tables.items()}
    others = {name: simulate(at, numerics=name, purpose=name) for name in (*experiment.guesses, *experiment.redrawn)}
    return {**drawn, **others}, reference


def _judged(
    study: _Study,
    drawn: Mapping[str, FloatArray],
    reference: FloatArray,
    candidates: Sequence[Candidate],
) -> tuple[Evidence, Comparison, Noise, Tables]:
    tables = study.tables(drawn, reference)
    return (*_compared(study, tables, candidates, None), tables)


def _compared(
    study: _Study, tables: Tables, candidates: Sequence[Candidate], aside: npt.NDArray[np.bool_] | None
) -> tuple[Evidence, Comparison, Noise]:
    if len(tables.base[0]) < BASE // 2:
        why = study.failed.get("the model as it is", "")
        raise SimulationError(f"the model as it is could be simulated {len(tables.base[0])} times only: {why}")
    noise = noise_of(study.experiment, study.prior, tables, candidates, aside)
    simulated = {name: (runs, noise.scores(found)) for name, (runs, found) in tables.effects.items()}
    comparison = Comparison.of(noise, study.prior, candidates, simulated, study.seed)
    return comparison.judge(), comparison, noise


def _predicted(study: _Study, tables: Tables, evidence: Evidence, name: str, simulate: Simulate) -> FloatArray:
    """(t, s) of a model at its posterior mean, of finer cells: by the base simulations' trend, or a simulation of an
    effect."""
    model = evidence.models[name]
    values = {parameter: model.moments(parameter)[0] for parameter in model.values}
    if name in tables.effects:
        return simulate(values, effects=(name,), seed=study.seed, purpose=name) + evidence.noise.cell
    point = study.prior.space.to_unit(study.prior.space.to_vector(values))[None]
    table = np.tensordot(trend_of(point, study.prior.unit(tables.base[0]))[0], tables.base[1], axes=1)
    if name in evidence.noise.patterns:
        table = table + _observed_otherwise(study, tables, evidence, name)
    return np.asarray(table + evidence.noise.cell)


def _observed_otherwise(study: _Study, tables: Tables, evidence: Evidence, name: str) -> FloatArray:
    """(t, s) what an effect of observation adds, at the sizes that explain most of what the base model leaves."""
    noise = evidence.noise
    candidate = next(c for c in study.experiment.candidates if c.name == name)
    pattern = noise.patterns[name]
    precision = np.linalg.inv(noise.covariance(evidence.models[name].factors))
    model = evidence.models[name]
    values = {p: model.moments(p)[0] for p in model.values}
    point = study.prior.space.to_unit(study.prior.space.to_vector(values))[None]
    left = noise.observed - trend_of(point, noise.points)[0] @ noise.base
    size = np.linalg.solve(pattern @ precision @ pattern.T + np.eye(len(pattern)) / 16.0, pattern @ precision @ left)
    added = [
        s * (tables.drawn[p.name] - tables.reference)
        for s, p in zip(size, (p for p in candidate.parameters if p.name in tables.drawn), strict=True)
    ]
    return np.asarray(sum(added))


def _expected(study: _Study, noise: Noise, tables: Tables, factors: FloatArray) -> Expected:
    """The same parts as in the noise of scores, for each feature."""
    experiment, prior = study.experiment, study.prior
    placed, base = experiment.layout.placed, tables.base[1]

    def about_trend(runs: Sequence[Run], found: FloatArray) -> FloatArray:
        hat = trend_of(prior.unit(runs), noise.points)
        return np.asarray((found - np.tensordot(hat, base, axes=1)) / np.sqrt(max(len(found), 1)))

    rest = np.tensordot(np.eye(len(base)) - noise.trend, base, axes=1)
    rest /= np.sqrt(np.maximum(1.0 - np.diag(noise.trend), 1e-9) * len(base))[:, None, None]
    otherwise = [about_trend(*made) for made in tables.effects.values()]
    otherwise.append((base - base.mean(axis=0)) / np.sqrt(len(base)))
    numerics = [
        factors[0] * noise.share / np.sqrt(len(otherwise)) * np.where(placed, found, 0.0) for found in otherwise
    ]
    if len(tables.fine[0]):
        numerics.append(factors[1] * REMAINING * np.where(placed, 0.0, about_trend(*tables.fine)))
    chance = rest if experiment.chance else rest[:0]
    return Expected(np.asarray(experiment.sensor), chance, np.concatenate(numerics, axis=0), noise.factor_std)


def _held_out(
    study: _Study, tables: Tables, candidates: Sequence[Candidate], names: Sequence[str], simulate: Simulate
) -> tuple[list[HeldOut], str]:
    """Models fitted without one camera and the last stage, and their errors there."""
    experiment = study.experiment
    aside, what = set_aside(experiment)
    mask = compared(experiment)
    judged_on = mask & aside & experiment.layout.common[None]
    if not judged_on.any() or not (mask & ~aside).any():
        return [], ""
    evidence, _, noise = _compared(study, tables, candidates, aside)
    nothing_wrong = _expected(study, noise, tables, np.ones(2)).variance[judged_on]
    out = []
    for name in names:
        variance = _expected(study, noise, tables, evidence.models[name].factors).variance[judged_on]
        left = (experiment.observed - _predicted(study, tables, evidence, name, simulate))[judged_on]
        score = -0.5 * float(np.mean(left**2 / variance + np.log(2.0 * np.pi * variance)))
        out.append(HeldOut(name, float(np.sqrt(np.mean(left**2))), float(np.sqrt(nothing_wrong.mean())), score))
    return out, what


def set_aside(experiment: Experiment) -> tuple[npt.NDArray[np.bool_], str]:
    """(t, s) features of one camera (the last, where there are several) and of the last stage, and what they are."""
    layout = experiment.layout
    last = layout.stages[-1]
    rows = np.array(layout.stages) == last
    if rows.all():
        rows, last = np.arange(len(rows)) >= 2 * len(rows) // 3, f"last third of the {last}"
    out = np.zeros(layout.shape, dtype=bool)
    out[rows] = True
    cameras = [
        c
        for c in layout.channels
        if any(s.channel == c and p for s, p in zip(layout.sites, layout.placed, strict=True))
    ]
    if len(cameras) < 2:
        return out, f"the {last}"
    out[:, np.array([s.channel == cameras[-1] for s in layout.sites])] = True
    return out, f"camera {cameras[-1]} and the {last}"
