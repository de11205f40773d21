"""What has to be simulated before anything can be said: repeats, other numerics, derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Calibration, Candidate, Experiment
from splatsoil.parameters import Parameter, distance

from .derivatives import Run, around, derivatives, directions_of

FloatArray = npt.NDArray[np.float64]
Numerics = tuple[dict[str, FloatArray], dict[str, FloatArray]]

STRIDE = 2.0
"""By how much longer steps of an effect are whose simulations have chance, to stand above it."""


@dataclass(frozen=True)
class Visit:
    """One simulation.

    Attributes:
        values: its parameters, by name.
        effects: names of the candidates that were on.
        table: (t, s) features.
        seed: of what is chance in it.
    """

    values: Mapping[str, float]
    effects: tuple[str, ...]
    table: FloatArray
    seed: int = 0


def joined(visits: Iterable[Visit], more: Iterable[Visit]) -> tuple[Visit, ...]:
    """Visits, and those of some more that aren't among them: to count a simulation twice is to believe its chance."""
    there = tuple(visits)
    return (*there, *(v for v in more if not any(np.array_equal(v.table, known.table) for known in there)))


@dataclass(frozen=True)
class Vantage:
    """Predictions around one point.

    Attributes:
        values: the model's parameters there.
        prediction: (t, s) features there.
        slopes: (t, s) derivative by each parameter of the model.
        curves: (t, s) half the second derivative by each parameter where it was measured.
        widths: the step of each parameter's derivative.
        directions: (k, t, s) derivatives by each candidate's parameters, at off.
        steps: the step of each of these.
        failed: candidates whose simulation could not go on, with the reason.
        visits: all simulations that were made.
        shapes: by candidate, what shapes it where its directions were measured, if not the defaults.
        doubts: by parameter of the model (t, s) and by candidate (k, t, s), half the difference between the derivatives
            of two seeds, of which those above are the mean: as large as the chance in these. Empty with one seed.
    """

    values: Mapping[str, float]
    prediction: FloatArray
    slopes: Mapping[str, FloatArray]
    curves: Mapping[str, FloatArray]
    widths: Mapping[str, float]
    directions: Mapping[str, FloatArray]
    steps: Mapping[str, float]
    failed: Mapping[str, str]
    visits: tuple[Visit, ...]
    shapes: Mapping[str, Mapping[str, float]] = field(default_factory=dict, kw_only=True)
    doubts: Mapping[str, FloatArray] = field(default_factory=dict, kw_only=True)

    def doubt(self, name: str, like: FloatArray) -> FloatArray:
        """Of one name, in the shape of its derivatives; 0 where there is none."""
        return self.doubts[name] if name in self.doubts else np.zeros_like(like)


@dataclass(frozen=True)
class Evidence(Vantage):
    """Predictions around a fit, and how far they can be believed.

    Attributes:
        mean: (t, s) mean prediction over seeds that derivatives don't share.
        repeats: (r, t, s) deviations of those seeds from their mean, scaled to have the variance of one seed.
        numerics: (t, s) what other numerics change, by name: the mean over two seeds where there is chance in it.
        numerics_doubts: (t, s) half the difference between these two, as large as the chance that is left; by name.
        guesses: (g, t, s) the same of other guesses of what no instrument shows, all drawn of one simulation.
        replays: (k, t, s) residuals of known soils that went through the whole chain of pictures and reconstruction;
            NaN where these don't tell.
        calibration: what pictures say of cameras, light, clock and tool where soil plays no part.
    """

    mean: FloatArray
    repeats: FloatArray
    numerics: Mapping[str, FloatArray]
    guesses: FloatArray
    replays: FloatArray | None = None
    calibration: Calibration | None = None
    numerics_doubts: Mapping[str, FloatArray] = field(default_factory=dict, kw_only=True)

    def with_effects(
        self,
        candidates: Sequence[Candidate],
        directions: Mapping[str, FloatArray],
        *,
        steps: Mapping[str, float],
        failed: Mapping[str, str],
        visits: tuple[Visit, ...] = (),
        doubts: Mapping[str, FloatArray] | None = None,
    ) -> Evidence:
        """The same with more effects' derivatives, all in the order of ``candidates``; see :class:`Vantage`."""
        both = {**self.directions, **directions}
        return replace(
            self,
            directions={c.name: both[c.name] for c in candidates if c.name in both},
            steps={**self.steps, **steps},
            failed={**self.failed, **failed},
            visits=(*self.visits, *visits),
            doubts={**self.doubts, **(doubts or {})},
        )


def gather(
    experiment: Experiment,
    simulate: Callable[..., FloatArray],
    values: Mapping[str, float],
    *,
    repeats: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Evidence:
    """Simulate what a misfit is told by, and what cameras may report; :func:`switched_on` adds effects of physics.

    The residual's prediction is the mean over seeds 1, 2, …; derivatives are differences at seed 0 and one more, the
    same for both ends, so that a part of chance cancels in them. What is left of it looks like information: the two
    seeds tell how much there is (`Vantage.doubts`). Sharing a seed with the residual would correlate its chance with
    the derivatives' and raise false alarms that grow with the number of features. What other numerics change is told by
    the same two.
    """
    base = dict(values)
    seeds = range(1, 1 + (repeats if experiment.chance else 1))
    jobs = (
        len(seeds)
        + len(experiment.guesses)
        + (2 if experiment.chance else 1) * (1 + 2 * len(experiment.parameters) + len(experiment.numerics))
    )
    done = 0

    def run(
        purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        nonlocal done
        table = simulate(at, effects=effects, seed=seed, numerics=numerics, purpose=purpose)
        done += 1
        if progress is not None:
            progress(min(done / jobs, 1.0))
        return table

    runs = np.stack([run(f"repeat {seed} of {len(seeds)}", base, seed=seed) for seed in seeds])
    # Before the point itself: they are other drawings of its simulation.
    guesses = [run(f"guess: {name}", base, numerics=name) for name in experiment.guesses]
    for name in experiment.redrawn:
        run(f"numerics: {name}", base, numerics=name)
    pair = pair_of(experiment, len(seeds))
    reported = [c for c in experiment.candidates if c.kind == "observation"]
    found = look_from(experiment, base, reported, run, pair)
    numerics, doubts = other_numerics(
        experiment, lambda name, seed: run(f"numerics: {name or 'none'}", base, seed=seed, numerics=name), pair
    )
    at_the_point = tuple(Visit(base, (), table, seed) for table, seed in zip(runs, seeds, strict=True))
    return Evidence(
        **{**vars(found), "visits": (*found.visits, *at_the_point)},
        mean=runs.mean(axis=0),
        repeats=deviations(runs),
        numerics=numerics,
        guesses=deviations(guesses) if guesses else np.zeros((0, *experiment.layout.shape)),
        numerics_doubts=doubts,
    )


def deviations(tables: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """(k, t, s) of k tables from their mean, scaled to have the variance of one."""
    samples = np.asarray(tables)
    return np.asarray((samples - samples.mean(axis=0)) * np.sqrt(len(samples) / max(len(samples) - 1, 1)))


def pair_of(experiment: Experiment, repeats: int) -> tuple[int, ...]:
    """Two seeds that repeats don't have, or one where there is no chance."""
    return (0, repeats + 1) if experiment.chance else (0,)


def other_numerics(experiment: Experiment, ask: Callable[[str, int], FloatArray], pair: tuple[int, ...]) -> Numerics:
    """What other numerics change, by name: `Evidence.numerics` and their doubts.

    Args:
        experiment: whose numerics are tried; those that can't be simulated are left out.
        ask: called with a name, or "" for the usual way, and a seed; keeps what it has answered.
        pair: of seeds, or one.
    """
    means, doubts = dict[str, FloatArray](), dict[str, FloatArray]()
    # Other drawings of a simulation while it is at hand, before another seed's.
    for name in (*experiment.redrawn, *(n for n in experiment.numerics if n not in experiment.redrawn)):
        seeds = pair[:1] if name in experiment.redrawn else pair
        middles = [ask("", seed) for seed in seeds]
        try:
            changes = [ask(name, seed) - middle for seed, middle in zip(seeds, middles, strict=True)]
        except SimulationError:
            continue
        means[name] = np.mean(changes, axis=0)
        if len(changes) > 1:
            doubts[name] = 0.5 * (changes[0] - changes[1])
    return means, doubts


def look_from(
    experiment: Experiment,
    values: Mapping[str, float],
    candidates: Sequence[Candidate],
    run: Run,
    seeds: tuple[int, ...] = (0,),
) -> Vantage:
    """Simulate a point and its neighbours.

    Args:
        experiment: whose parameters are varied.
        values: of these, at the point.
        candidates: effects that are switched on there, one at a time, by the first seed.
        run: called with (purpose, parameters by name), the name of an effect that is on in a tuple, and a seed.
        seeds: one, or two whose mean derivatives are; the prediction is the first one's.

    Raises:
        SimulationError: the point or a neighbour without an effect can't be simulated.
    """
    base, failed = dict(values), dict[str, str]()
    looks = [_Look(seed, run) for seed in seeds]
    for look in looks:
        look.see(base)
        if look is looks[0]:
            # Other reports of the point's simulation come first, while it is at hand.
            look.switch_on([c for c in candidates if c.kind == "observation"], base, 1.0, failed)
        look.vary(experiment.parameters, base)
    times = STRIDE if experiment.chance else 1.0
    looks[0].switch_on([c for c in candidates if c.kind == "physics"], base, times, failed)
    slopes, doubts = _mean_of([look.slopes for look in looks])
    first = looks[0]
    return Vantage(
        base,
        first.middle,
        slopes,
        {name: np.mean([look.curves[name] for look in looks], axis=0) for name in first.curves},
        first.widths,
        {c.name: first.directions[c.name] for c in candidates if c.name not in failed},
        first.steps,
        failed,
        tuple(visit for look in looks for visit in look.visits),
        doubts=doubts,
    )


def switched_on(experiment: Experiment, simulate: Callable[..., FloatArray], evidence: Evidence) -> Evidence:
    """The evidence with the derivatives by effects of physics, switched on at the fit one at a time, by two seeds."""
    base, failed = dict(evidence.values), dict[str, str]()

    def run(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = (), seed: int = 0) -> FloatArray:
        return simulate(at, effects=effects, seed=seed, purpose=purpose)

    looks, times = [], STRIDE if experiment.chance else 1.0
    for seed in pair_of(experiment, len(evidence.repeats)):
        look = _Look(seed, run)
        look.see(base)
        look.visits.clear()  # these the evidence has
        physics = [c for c in experiment.candidates if c.kind == "physics" and c.name not in failed]
        look.switch_on(physics, base, times, failed)
        looks.append(look)
    directions, doubts = _mean_of([look.directions for look in looks])
    return evidence.with_effects(
        experiment.candidates,
        directions,
        steps=looks[0].steps,
        failed=failed,
        visits=tuple(visit for look in looks for visit in look.visits),
        doubts=doubts,
    )


def _mean_of(looks: Sequence[Mapping[str, FloatArray]]) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Mean derivatives of one or two looks, of what all of them tell, and half the difference where there are two."""
    names = [name for name in looks[0] if all(name in look for look in looks)]
    means = {name: np.mean([look[name] for look in looks], axis=0) for name in names}
    doubts = {name: 0.5 * (looks[0][name] - looks[1][name]) for name in names} if len(looks) > 1 else {}
    return means, doubts


@dataclass
class _Look:
    """A point and its neighbours by one seed, run by run; see :class:`Vantage`."""

    seed: int
    run: Run
    slopes: dict[str, FloatArray] = field(default_factory=dict)
    curves: dict[str, FloatArray] = field(default_factory=dict)
    widths: dict[str, float] = field(default_factory=dict)
    directions: dict[str, FloatArray] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)
    visits: list[Visit] = field(default_factory=list)
    middle: FloatArray = field(init=False)

    def visit(self, purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = ()) -> FloatArray:
        """(t, s) features by parameters."""
        self.visits.append(Visit(dict(at), effects, self.run(purpose, at, effects, self.seed), self.seed))
        return self.visits[-1].table

    def see(self, base: Mapping[str, float]) -> None:
        """The point itself, which comes first."""
        self.middle = self.visit("the point", base)

    def vary(self, parameters: Sequence[Parameter], base: Mapping[str, float]) -> None:
        """The model's own parameters, one at a time."""
        for parameter in parameters:
            value = base[parameter.name]
            ends = around(parameter, value)
            tables = [self.visit(parameter.name, {**base, parameter.name: end}) for end in ends]
            offsets = [distance(parameter, value, end) for end in ends]
            self.slopes[parameter.name], curve = derivatives(offsets, tables, self.middle)
            self.widths[parameter.name] = max(abs(offset) for offset in offsets)
            if curve is not None:
                self.curves[parameter.name] = curve

    def switch_on(
        self, candidates: Sequence[Candidate], base: Mapping[str, float], times: float, failed: dict[str, str]
    ) -> None:
        """Effects, one at a time, by steps ``times`` as long as where nothing is left to chance; ``failed`` gets those
        that can't be simulated."""
        for candidate in candidates:
            try:
                self.directions[candidate.name] = directions_of(
                    candidate, base, self.middle, self.visit, self.steps, times
                )
            except SimulationError as error:
                failed[candidate.name] = str(error)
