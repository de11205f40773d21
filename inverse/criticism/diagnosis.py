"""A comparison of models from beginning to end: simulations, evidence, predictive checks, what was set aside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment

from .checks import Check, Expected, checks, passes
from .design import Prior, Run, effect_runs
from .evidence import AS_IT_IS, ELSE, PRIOR, SLAB, Comparison, Evidence
from .noise import REMAINING, Tables, compared, drawings, noise_of, trend_of
from .power import NAMED, detectable
from .simulations import Simulations

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
    """An experiment, the models that could be true, what is simulated of each, and what failed."""

    experiment: Experiment
    simulate: Simulations
    prior: Prior
    candidates: Sequence[Candidate]
    seed: int
    base: list[Run]
    fine: list[Run] = field(default_factory=list)
    effects: dict[str, list[Run]] = field(default_factory=dict)
    drawn: Mapping[str, FloatArray] = field(default_factory=dict)
    reference: FloatArray = field(default_factory=lambda: np.zeros(0))
    failed: dict[str, str] = field(default_factory=dict)

    def design(self) -> None:
        """The first simulations: of the base model, of pairs, and of each effect of physics."""
        prior, seed = self.prior, self.seed
        points = _spread(prior, BASE + BASE // 2 * (len(prior.space) - 1), seed)
        # each simulation that is there stands for the nearest point of the design
        for there in prior.unit(self.base)[: len(points)]:
            points = np.delete(points, np.argmin(np.sum((points - there) ** 2, axis=1)), axis=0)
        self.base += [Run(v, seed=seed + 1 + i) for i, v in enumerate(prior.values(points))]
        if FINE in self.experiment.numerics:
            points = 0.7 * _spread(prior, PAIRS, seed + 1)
            self.fine = [Run(v, seed=seed + 101 + i, numerics=FINE) for i, v in enumerate(prior.values(points))]
        for number, candidate in enumerate(c for c in self.candidates if c.kind == "physics"):
            count = SCREENED + len(prior.space) + len(candidate.parameters) + len(candidate.shapes)
            self.effects[candidate.name] = effect_runs(candidate, prior, count, seed + 201 + 100 * number)
        self.ask_ahead()

    def refine(self, evidence: Evidence, number: int) -> None:
        """More simulations where the base model and the most probable effects are most probable."""
        rng = np.random.default_rng([self.seed, 19, number])
        first = 10_000 * (1 + number) + self.seed
        likely = sorted(self.effects, key=lambda name: -evidence.probability.get(name, 0.0))[:REFINED]
        for name in (n for n in likely if n in evidence.models):
            drawn = evidence.models[name].drawn(AGAIN, rng)
            self.effects[name] += [Run(v, (name,), first + i) for i, v in enumerate(drawn)]
        self.base += [Run(v, seed=first + 100 + i) for i, v in enumerate(evidence.models[AS_IT_IS].drawn(AGAIN, rng))]
        self.ask_ahead()

    def ask_ahead(self) -> None:
        """Have others simulate, too."""
        runs = [*(run for mine in self.effects.values() for run in mine), *self.base, *self.fine]
        self.simulate.ahead(lambda noted: [noted(**run.arguments()) for run in runs])

    def draw(self, values: Mapping[str, float]) -> None:
        """One simulation as usual, and reported or drawn otherwise: by guesses, and by effects of observation in their
        smallest meaningful sizes."""
        observed = [c for c in self.candidates if c.kind == "observation"]
        # What needs more frames of it comes first, so that one simulation serves all.
        observed.sort(key=lambda c: c.name != "time_offset")
        tables = {}
        for candidate in observed:
            for p in candidate.parameters:
                assert p.off is not None
                end = float(np.clip(p.off + STEP * p.meaningful, p.lower, p.upper))
                table = self.simulate({**values, p.name: end}, effects=(candidate.name,), purpose=candidate.name)
                tables[p.name] = (table, (end - p.off) / p.meaningful)
        self.reference = self.simulate(values, purpose="as it is")
        drawn = {name: self.reference + (table - self.reference) / step for name, (table, step) in tables.items()}
        others = (*self.experiment.guesses, *self.experiment.redrawn)
        self.drawn = drawn | {name: self.simulate(values, numerics=name, purpose=name) for name in others}

    def tables(self) -> Tables:
        """All simulations."""
        made = {name: self._made(runs) for name, runs in self.effects.items()}
        enough = {name: found for name, found in made.items() if len(found[0]) > 1}
        return Tables(self._made(self.base), self._made(self.fine), enough, self.drawn, self.reference)

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

    def compare(self, aside: npt.NDArray[np.bool_] | None = None) -> _Compared:
        """All models against the observation, without what is set aside."""
        tables = self.tables()
        if len(tables.base[0]) < BASE // 2:
            why = self.failed.get("the model as it is", "")
            raise SimulationError(f"the model as it is could be simulated {len(tables.base[0])} times only: {why}")
        noise = noise_of(self.experiment, self.prior, tables, self.candidates, aside)
        simulated = {name: (runs, noise.scores(found)) for name, (runs, found) in tables.effects.items()}
        comparison = Comparison.of(noise, self.prior, self.candidates, simulated, self.seed)
        return _Compared(self, tables, comparison, comparison.judge())


@dataclass
class _Compared:
    """A study's models against the observation."""

    study: _Study
    tables: Tables
    comparison: Comparison
    evidence: Evidence

    def predicted(self, name: str) -> FloatArray:
        """(t, s) of a model at its posterior mean, of finer cells: by the base simulations' trend, or a simulation of
        an effect."""
        study, noise, model = self.study, self.evidence.noise, self.evidence.models[name]
        values = {parameter: model.moments(parameter)[0] for parameter in model.values}
        if name in self.tables.effects:
            return study.simulate(values, effects=(name,), seed=study.seed, purpose=name) + noise.cell
        point = study.prior.space.to_unit(study.prior.space.to_vector(values))[None]
        (trend,) = trend_of(point, noise.points)
        table = np.tensordot(trend, self.tables.base[1], axes=1)
        if name in noise.patterns:
            # at the sizes that explain most of what the base model leaves
            pattern, precision = noise.patterns[name], np.linalg.inv(noise.covariance(model.factors))
            left = noise.observed - trend @ noise.base
            inner = pattern @ precision @ pattern.T + np.eye(len(pattern)) / SLAB**2
            size = np.linalg.solve(inner, pattern @ precision @ left)
            candidate = next(c for c in study.candidates if c.name == name)
            drawn = [self.tables.drawn[p.name] for p in candidate.parameters if p.name in self.tables.drawn]
            table = table + sum(s * (one - self.tables.reference) for s, one in zip(size, drawn, strict=True))
        return np.asarray(table + noise.cell)

    def expected(self, factors: FloatArray) -> Expected:
        """The same parts as in the noise of scores, for each feature, with numerics of factors (2,)."""
        experiment, noise, tables = self.study.experiment, self.evidence.noise, self.tables
        placed, base = experiment.layout.placed, tables.base[1]

        def about_trend(runs: Sequence[Run], found: FloatArray) -> FloatArray:
            hat = trend_of(self.study.prior.unit(runs), noise.points)
            return np.asarray((found - np.tensordot(hat, base, axes=1)) / np.sqrt(max(len(found), 1)))

        rest = np.tensordot(np.eye(len(base)) - noise.trend, base, axes=1)
        rest /= np.sqrt(np.maximum(1.0 - np.diag(noise.trend), 1e-9) * len(base))[:, None, None]
        own = [rest] if experiment.chance else []
        fixed = np.concatenate([*own, drawings(experiment, tables, self.study.candidates)])
        if len(tables.fine[0]):
            numerics = [factors[0] * noise.share * np.where(placed, fixed, 0.0)]
            numerics.append(factors[1] * REMAINING * np.where(placed, 0.0, about_trend(*tables.fine)))
        else:
            otherwise = [*(about_trend(*made) for made in tables.effects.values())]
            otherwise.append((base - base.mean(axis=0)) / np.sqrt(len(base)))
            size = factors[0] * noise.share / np.sqrt(len(otherwise))
            numerics = [size * np.where(placed, found, 0.0) for found in otherwise]
        return Expected(np.asarray(experiment.sensor), fixed, np.concatenate(numerics), noise.factor_std)


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
    prior = prior or Prior.of(experiment, values)
    candidates = experiment.candidates if effects else ()
    study = _Study(experiment, simulate or Simulations(experiment), prior, candidates, seed, prior.inside(known))
    study.design()
    progress("drawings", 0.0)
    study.draw(dict(values))
    progress("simulations", 0.1)
    now = study.compare()
    for number in range(MOST_ROUNDS if effects else 0):
        progress("simulations where models are most probable", 0.7 + 0.05 * number)
        before = now.evidence
        study.refine(before, number)
        now = study.compare()
        if number + 1 >= FEWEST_ROUNDS and _settled(before, now.evidence):
            break
    progress("checks", 0.9)
    evidence, noise = now.evidence, now.evidence.noise
    likely = sorted(
        (n for n in evidence.probability if n not in (AS_IT_IS, ELSE)), key=lambda n: -evidence.probability[n]
    )
    shown = (AS_IT_IS, *likely[:1])
    predictions = {name: now.predicted(name) for name in shown}
    residuals = {name: experiment.observed - table for name, table in predictions.items()}
    top = max(shown, key=lambda name: evidence.probability[name])
    expected = now.expected(evidence.models[top].factors)
    found = checks(experiment, residuals[top], expected, noise.mask, seed)
    held_out, aside = _held_out(study, shown) if effects else ([], "")
    verdict, members = judged(evidence.probability, fits=passes(found))
    power = {
        c.name: None if size is None else size * c.measure.meaningful
        for c in candidates
        if c.name in evidence.models
        for size in [detectable(now.comparison, evidence, c, seed)]
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


def _settled(before: Evidence, now: Evidence) -> bool:
    """Whether the most probable model's parameters have moved by less than their standard deviation."""
    model, old = now.models[now.best], before.models[now.best]
    return all(abs(model.moments(p)[0] - old.moments(p)[0]) < max(model.moments(p)[1], 1e-12) for p in model.values)


def _spread(prior: Prior, count: int, seed: int) -> FloatArray:
    """(count, n) points in [-1, 1]: evenly for one parameter, else a Sobol sequence."""
    if len(prior.space) == 1:
        return (2.0 * (np.arange(count) + 0.5) / count - 1.0)[:, None]
    return prior.points(1 << (count - 1).bit_length(), seed)[:count]


def _held_out(study: _Study, names: Sequence[str]) -> tuple[list[HeldOut], str]:
    """Models fitted without one camera and the last stage, and their errors there."""
    experiment = study.experiment
    aside, what = set_aside(experiment)
    mask = compared(experiment)
    judged_on = mask & aside & experiment.layout.common[None]
    if not judged_on.any() or not (mask & ~aside).any():
        return [], ""
    now = study.compare(aside)
    noise = float(np.sqrt(now.expected(np.ones(2)).variance[judged_on].mean()))
    out = []
    for name in names:
        variance = now.expected(now.evidence.models[name].factors).variance[judged_on]
        left = (experiment.observed - now.predicted(name))[judged_on]
        score = -0.5 * float(np.mean(left**2 / variance + np.log(2.0 * np.pi * variance)))
        out.append(HeldOut(name, float(np.sqrt(np.mean(left**2))), noise, score))
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
