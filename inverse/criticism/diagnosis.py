"""Bayesian model comparison of an experiment: simulations, evidence, predictive checks and held-out data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment, Run

from .checks import Check, Expected, checks, passes
from .design import Prior, effect_runs
from .evidence import BASE_MODEL, BASE_PRIOR, DISCREPANCY, OBSERVATION_SIZE_STD, Comparison, Evidence
from .noise import FINE_ERROR_RATIO, Tables, compared, noise_of, nuisances, trend_of
from .power import NAMED, detectable
from .simulations import Simulations

Verdict = Literal["adequate", "missing", "one of", "something else", "undecided"]

FINE = "fine"
"""The variant of the fine simulations."""
BASE_RUNS, PAIRS, EFFECT_RUNS = 10, 3, 2
"""Simulations of the base model (half as many again for each further parameter), pairs of coarse and fine ones, and
simulations of each effect, besides one for each free parameter."""
REFINED_EFFECTS, REFINEMENT_RUNS = 3, 4
"""Most probable effects that are simulated again at draws from their posterior, and simulations of each and of the base
model."""
MIN_ROUNDS, MAX_ROUNDS = 2, 4
"""Rounds of this refinement: until the most probable model's parameters move by less than their standard deviation."""
OBSERVATION_STEP = 4.0
"""Size at which an observation effect is drawn, over its smallest meaningful size."""
LISTED = 0.05
"""Probability from which an effect is listed."""
SUBSTANTIAL = 10.0**0.5
"""Bayes factor from which evidence against the base model is substantial (Jeffreys 1961, Theory of Probability, app.
B)."""


@dataclass(frozen=True)
class HeldOut:
    """Prediction error of a model on data that it was not fitted to.

    Attributes:
        model: its name.
        error: root mean square of the residual, in the layout's unit.
        noise: the same for a correct model.
        log_score: mean log predictive density of a feature.
    """

    model: str
    error: float
    noise: float
    log_score: float


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of a comparison of models.

    Attributes:
        verdict: see :func:`verdict_of`.
        members: the effects that the verdict names; else those that are listed.
        evidence: of all models.
        estimates: mean and standard deviation of the base parameters, averaged over models, by name.
        determined: whether the posterior is less than half as wide as the prior, by name.
        detectable: detectable size in the parameter's unit, by effect; None for none.
        checks: predictive checks of the most probable model.
        residuals: (t, s) of the base model and of the best effect, by name.
        predictions: (t, s) theirs.
        expected: (t, s) variance of the residual of a correct model.
        mask: (t, s) features that were compared.
        held_out: errors on held-out data.
        held_out_data: description of these data.
        notes: for the reader.
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
    mask: BoolArray
    held_out: Sequence[HeldOut] = ()
    held_out_data: str = ""
    notes: Sequence[str] = ()

    @property
    def passes(self) -> bool:
        """Whether no predictive check fails."""
        return passes(list(self.checks))


@dataclass
class _Study:
    """The experiment, its models, and their simulations."""

    experiment: Experiment
    simulate: Simulations
    prior: Prior
    candidates: Sequence[Candidate]
    seed: int
    base: list[Run]
    fine: list[Run] = field(default_factory=list)
    effects: dict[str, list[Run]] = field(default_factory=dict)
    variants: Mapping[str, FloatArray] = field(default_factory=dict)
    reference: FloatArray = field(default_factory=lambda: np.zeros(0))
    failed: dict[str, str] = field(default_factory=dict)

    def design(self) -> None:
        """Choose the first simulations: of the base model, of pairs, and of each effect of physics."""
        prior, seed = self.prior, self.seed
        points = _spread(prior, BASE_RUNS + BASE_RUNS // 2 * (len(prior.space) - 1), seed)
        # An existing simulation replaces the nearest point of the design.
        for there in prior.unit(self.base)[: len(points)]:
            points = np.delete(points, np.argmin(np.sum((points - there) ** 2, axis=1)), axis=0)
        self.base += [Run(v, seed=seed + 1 + i) for i, v in enumerate(prior.values(points))]
        if FINE in self.experiment.discretisations:
            points = 0.7 * _spread(prior, PAIRS, seed + 1)
            self.fine = [Run(v, seed=seed + 101 + i, variant=FINE) for i, v in enumerate(prior.values(points))]
        for number, candidate in enumerate(c for c in self.candidates if c.kind == "physics"):
            count = EFFECT_RUNS + len(prior.space) + len(candidate.parameters) + len(candidate.shapes)
            self.effects[candidate.name] = effect_runs(candidate, prior, count, seed + 201 + 100 * number)
        self.prefetch()

    def refine(self, evidence: Evidence, number: int) -> None:
        """Add simulations of the base model and the most probable effects at draws from their posteriors."""
        rng = np.random.default_rng([self.seed, 19, number])
        first = 10_000 * (1 + number) + self.seed
        likely = sorted(self.effects, key=lambda name: -evidence.probability.get(name, 0.0))[:REFINED_EFFECTS]
        for name in (n for n in likely if n in evidence.models):
            draws = evidence.models[name].sample(REFINEMENT_RUNS, rng)
            self.effects[name] += [Run(v, (name,), first + i) for i, v in enumerate(draws)]
        draws = evidence.models[BASE_MODEL].sample(REFINEMENT_RUNS, rng)
        self.base += [Run(v, seed=first + 100 + i) for i, v in enumerate(draws)]
        self.prefetch()

    def prefetch(self) -> None:
        """Submit all simulations to the workers."""
        self.simulate.prefetch([*(run for runs in self.effects.values() for run in runs), *self.base, *self.fine])

    def simulate_variants(self, values: Mapping[str, float]) -> None:
        """One simulation, its renderings and albedo draws, and observation effects at their smallest meaningful
        sizes."""
        observed = [c for c in self.candidates if c.kind == "observation"]
        # A time offset needs more frames; simulated first, they serve all.
        observed.sort(key=lambda c: c.name != "time_offset")
        tables = {}
        for candidate in observed:
            for p in candidate.parameters:
                assert p.off is not None
                end = float(np.clip(p.off + OBSERVATION_STEP * p.meaningful, p.lower, p.upper))
                table = self.simulate(Run({**values, p.name: end}, (candidate.name,)))
                tables[p.name] = (table, (end - p.off) / p.meaningful)
        self.reference = self.simulate(Run(values))
        scaled = {name: self.reference + (table - self.reference) / step for name, (table, step) in tables.items()}
        others = (*self.experiment.albedo_draws, *self.experiment.renderings)
        self.variants = scaled | {name: self.simulate(Run(values, variant=name)) for name in others}

    def tables(self) -> Tables:
        """Tables of all simulations that succeeded."""
        effects = {name: self._simulated(runs) for name, runs in self.effects.items()}
        effects = {name: simulated for name, simulated in effects.items() if len(simulated[0]) > 1}
        return Tables(self._simulated(self.base), self._simulated(self.fine), effects, self.variants, self.reference)

    def _simulated(self, runs: Sequence[Run]) -> tuple[list[Run], FloatArray]:
        """The runs that succeeded, and their tables."""
        succeeded, tables = [], []
        for run in runs:
            try:
                tables.append(self.simulate(run))
            except SimulationError as error:
                self.failed.setdefault(", ".join(run.effects) or "the model as it is", str(error))
            else:
                succeeded.append(run)
        return succeeded, np.array(tables).reshape(len(succeeded), *self.experiment.layout.shape)

    def compare(self, held_out: BoolArray | None = None) -> _Compared:
        """All models against the observation, without held-out features (t, s)."""
        tables = self.tables()
        if len(tables.base[0]) < BASE_RUNS // 2:
            why = self.failed.get("the model as it is", "")
            raise SimulationError(f"the model as it is could be simulated {len(tables.base[0])} times only: {why}")
        noise = noise_of(self.experiment, self.prior, tables, self.candidates, held_out)
        simulated = {name: (runs, noise.scores(table)) for name, (runs, table) in tables.effects.items()}
        comparison = Comparison.of(noise, self.prior, self.candidates, simulated, self.seed)
        return _Compared(self, tables, comparison, comparison.evidence())


@dataclass
class _Compared:
    """A study's models, given the observation."""

    study: _Study
    tables: Tables
    comparison: Comparison
    evidence: Evidence

    def predicted(self, name: str) -> FloatArray:
        """(t, s) of a model at its posterior mean, corrected for the cell size: the trend of the base simulations, or a
        simulation of an effect."""
        study, noise, model = self.study, self.evidence.noise, self.evidence.models[name]
        values = {parameter: model.moments(parameter)[0] for parameter in model.values}
        if name in self.tables.effects:
            return study.simulate(Run(values, (name,), study.seed)) + noise.cell_correction
        point = study.prior.space.to_unit(study.prior.space.to_vector(values))[None]
        (trend,) = trend_of(point, noise.points)
        table = np.tensordot(trend, self.tables.base[1], axes=1)
        if name in noise.patterns:
            # at the posterior mean of the effect's sizes
            pattern, precision = noise.patterns[name], np.linalg.inv(noise.covariance(model.factors))
            residual = noise.observed - trend @ noise.base
            inner = pattern @ precision @ pattern.T + np.eye(len(pattern)) / OBSERVATION_SIZE_STD**2
            size = np.linalg.solve(inner, pattern @ precision @ residual)
            candidate = next(c for c in study.candidates if c.name == name)
            drawn = [self.tables.variants[p.name] for p in candidate.parameters if p.name in self.tables.variants]
            table = table + sum(s * (one - self.tables.reference) for s, one in zip(size, drawn, strict=True))
        return np.asarray(table + noise.cell_correction)

    def expected(self, factors: FloatArray) -> Expected:
        """The parts of the noise model for each feature, for factors (2,) of the discretisation error."""
        experiment, noise, tables = self.study.experiment, self.evidence.noise, self.tables
        placed, base = experiment.layout.placed, tables.base[1]

        def about_trend(runs: Sequence[Run], table: FloatArray) -> FloatArray:
            hat = trend_of(self.study.prior.unit(runs), noise.points)
            return np.asarray((table - np.tensordot(hat, base, axes=1)) / np.sqrt(max(len(table), 1)))

        rest = np.tensordot(np.eye(len(base)) - noise.trend, base, axes=1)
        rest /= np.sqrt(np.maximum(1.0 - np.diag(noise.trend), 1e-9) * len(base))[:, None, None]
        own = [rest] if experiment.stochastic else []
        fixed = np.concatenate([*own, nuisances(experiment, tables, self.study.candidates)])
        if len(tables.fine[0]):
            discretisation = [factors[0] * noise.ratio * np.where(placed, fixed, 0.0)]
            discretisation.append(factors[1] * FINE_ERROR_RATIO * np.where(placed, 0.0, about_trend(*tables.fine)))
        else:
            reachable = [*(about_trend(*runs) for runs in tables.effects.values())]
            reachable.append((base - base.mean(axis=0)) / np.sqrt(len(base)))
            size = factors[0] * noise.ratio / np.sqrt(len(reachable))
            discretisation = [size * np.where(placed, table, 0.0) for table in reachable]
        return Expected(np.asarray(experiment.sensor), fixed, np.concatenate(discretisation), noise.factor_std)


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
        experiment: observes and predicts.
        values: of a fit; variants of one simulation are made there.
        simulate: the experiment's simulations; new ones by default.
        effects: whether effects that are off are models, too; else only the base and the discrepancy model.
        seed: of the design.
        known: simulations of the base model that exist; the design adds what is missing.
        prior: of the base model's parameters; about ``values`` by default.
        progress: called with (what, share done).

    Raises:
        SimulationError: the base model could not be simulated.
    """
    prior = prior or Prior.of(experiment, values)
    candidates = experiment.candidates if effects else ()
    study = _Study(experiment, simulate or Simulations(experiment), prior, candidates, seed, prior.inside(known))
    study.design()
    progress("variants of a simulation", 0.0)
    study.simulate_variants(dict(values))
    progress("simulations", 0.1)
    now = study.compare()
    for number in range(MAX_ROUNDS if effects else 0):
        progress("simulations near the posterior", 0.7 + 0.05 * number)
        before = now.evidence
        study.refine(before, number)
        now = study.compare()
        if number + 1 >= MIN_ROUNDS and _settled(before, now.evidence):
            break
    progress("checks", 0.9)
    evidence, noise = now.evidence, now.evidence.noise
    shown = (BASE_MODEL, *_by_probability(evidence.probability)[:1])
    predictions = {name: now.predicted(name) for name in shown}
    residuals = {name: experiment.observed - table for name, table in predictions.items()}
    top = max(shown, key=lambda name: evidence.probability[name])
    expected = now.expected(evidence.models[top].factors)
    found = checks(experiment, residuals[top], expected, noise.mask, seed)
    held_out, held_out_data = _held_out(study, shown) if effects else ([], "")
    verdict, members = verdict_of(evidence.probability, fits=passes(found))
    power = {
        c.name: None if size is None else size * c.measure.meaningful
        for c in candidates
        if c.name in evidence.models
        for size in [detectable(now.comparison, evidence, c, seed)]
    }
    averaged = {p.name: evidence.marginal(p.name) for p in prior.space}
    return Diagnosis(
        verdict=verdict,
        members=members,
        evidence=evidence,
        estimates={name: (marginal.mean, marginal.std) for name, marginal in averaged.items()},
        determined={p.name: averaged[p.name].std < 0.5 * (p.upper - p.lower) / np.sqrt(12.0) for p in prior.space},
        detectable=power,
        checks=found,
        residuals=residuals,
        predictions=predictions,
        expected=expected.variance,
        mask=noise.mask,
        held_out=held_out,
        held_out_data=held_out_data,
        notes=[f"{what.replace('_', ' ')}: some simulations failed ({why})" for what, why in study.failed.items()],
    )


def verdict_of(probability: Mapping[str, float], *, fits: bool) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict and the effects that it names.

    Args:
        probability: of the models.
        fits: whether the most probable one passes its predictive checks.
    """
    effects = _by_probability(probability)
    listed = tuple(n for n in effects if probability[n] >= LISTED)
    if probability[DISCREPANCY] >= NAMED or not fits:
        return "something else", listed
    if effects and probability[effects[0]] >= NAMED:
        return "missing", (effects[0],)
    odds = max(p for name, p in probability.items() if name != BASE_MODEL) / max(probability[BASE_MODEL], 1e-300)
    if odds * (len(probability) - 1) * BASE_PRIOR / (1.0 - BASE_PRIOR) < SUBSTANTIAL:
        return "adequate", listed
    if len(listed) > 1 and sum(probability[n] for n in listed) >= NAMED:
        return "one of", listed
    return "undecided", listed


def _by_probability(probability: Mapping[str, float]) -> list[str]:
    """Effects, the most probable first."""
    return sorted((n for n in probability if n not in (BASE_MODEL, DISCREPANCY)), key=lambda n: -probability[n])


def _settled(before: Evidence, now: Evidence) -> bool:
    """Whether the most probable model's parameters have moved by less than their standard deviation."""
    model, old = now.models[now.best], before.models[now.best]
    return all(abs(model.moments(p)[0] - old.moments(p)[0]) < max(model.moments(p)[1], 1e-12) for p in model.values)


def _spread(prior: Prior, count: int, seed: int) -> FloatArray:
    """(count, n) points in [-1, 1]: equidistant for one parameter, else a Sobol sequence."""
    if len(prior.space) == 1:
        return (2.0 * (np.arange(count) + 0.5) / count - 1.0)[:, None]
    return prior.points(1 << (count - 1).bit_length(), seed)[:count]


def _held_out(study: _Study, names: Sequence[str]) -> tuple[list[HeldOut], str]:
    """Errors on held-out data of models that were compared without them, and a description of these data."""
    experiment = study.experiment
    held_out, what = held_out_mask(experiment)
    mask = compared(experiment)
    scored = mask & held_out & experiment.layout.common[None]
    if not scored.any() or not (mask & ~held_out).any():
        return [], ""
    now = study.compare(held_out)
    noise = float(np.sqrt(now.expected(np.ones(2)).variance[scored].mean()))
    out = []
    for name in names:
        variance = now.expected(now.evidence.models[name].factors).variance[scored]
        residual = (experiment.observed - now.predicted(name))[scored]
        score = -0.5 * float(np.mean(residual**2 / variance + np.log(2.0 * np.pi * variance)))
        out.append(HeldOut(name, float(np.sqrt(np.mean(residual**2))), noise, score))
    return out, what


def held_out_mask(experiment: Experiment) -> tuple[BoolArray, str]:
    """(t, s) features of the last of several cameras and of the last stage, and a description."""
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
