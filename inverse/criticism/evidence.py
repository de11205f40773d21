"""What has to be simulated before anything can be said: repeats, other numerics, derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Calibration, Candidate, Experiment
from splatsoil.parameters import Parameter, distance

FloatArray = npt.NDArray[np.float64]
Run = Callable[..., FloatArray]
Numerics = tuple[dict[str, FloatArray], dict[str, FloatArray]]

STEP = 4.0
"""Steps of derivatives in smallest meaningful sizes."""
STRIDE = 2.0
"""By how much longer steps of an effect are whose simulations have chance, to stand above it."""
REACH = 0.5
"""Most of the way to a bound that such a step may go."""


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
        replays: (k, t, s) residuals of known soils that went through the whole chain of pictures and reconstruction.
        calibration: what pictures say of cameras, light, clock and tool where soil plays no part.
    """

    mean: FloatArray
    repeats: FloatArray
    numerics: Mapping[str, FloatArray]
    guesses: FloatArray
    replays: FloatArray | None = None
    calibration: Calibration | None = None
    numerics_doubts: Mapping[str, FloatArray] = field(default_factory=dict, kw_only=True)


def gather(
    experiment: Experiment,
    simulate: Callable[..., FloatArray],
    values: Mapping[str, float],
    *,
    repeats: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Evidence:
    """Simulate what a diagnosis needs.

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
        + (2 if experiment.chance else 1)
        * (2 + 2 * len(experiment.parameters) + len(experiment.candidates) + len(experiment.numerics))
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
    found = look_from(experiment, base, experiment.candidates, run, pair)
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
        candidates: effects that are switched on there, one at a time.
        run: called with (purpose, parameters by name), the name of an effect that is on in a tuple, and a seed.
        seeds: one, or two whose mean derivatives are; the prediction is the first one's.

    Raises:
        SimulationError: the point or a neighbour without an effect can't be simulated.
    """
    base, failed = dict(values), dict[str, str]()
    # Other reports of the point's simulation come first, while it is at hand.
    ordered = sorted(candidates, key=lambda c: c.kind == "physics")
    looks = [_look(experiment, base, ordered, run, seeds[0], failed)]
    for seed in seeds[1:]:
        rest = [c for c in ordered if c.kind == "physics" and c.name not in failed]
        looks.append(_look(experiment, base, rest, run, seed, failed))
    first, doubts = looks[0], dict[str, FloatArray]()
    slopes, directions = dict(first.slopes), dict(first.directions)
    for other in looks[1:]:
        for mine, theirs in ((slopes, other.slopes), (directions, other.directions)):
            for name in theirs:
                doubts[name] = 0.5 * (mine[name] - theirs[name])
                mine[name] = 0.5 * (mine[name] + theirs[name])
    curves = {name: np.mean([look.curves[name] for look in looks], axis=0) for name in first.curves}
    directions = {c.name: directions[c.name] for c in candidates if c.name not in failed}
    return Vantage(
        base,
        first.middle,
        slopes,
        curves,
        first.widths,
        directions,
        first.steps,
        failed,
        tuple(visit for look in looks for visit in look.visits),
        doubts=doubts,
    )


@dataclass(frozen=True)
class _Look:
    """A point and its neighbours by one seed; see :class:`Vantage`."""

    middle: FloatArray
    slopes: dict[str, FloatArray] = field(default_factory=dict)
    curves: dict[str, FloatArray] = field(default_factory=dict)
    widths: dict[str, float] = field(default_factory=dict)
    directions: dict[str, FloatArray] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)
    visits: list[Visit] = field(default_factory=list)


def _look(
    experiment: Experiment,
    base: Mapping[str, float],
    candidates: Sequence[Candidate],
    run: Run,
    seed: int,
    failed: dict[str, str],
) -> _Look:
    """By one seed; candidates that can't be simulated are noted."""
    visits: list[Visit] = []

    def visit(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = ()) -> FloatArray:
        visits.append(Visit(dict(at), effects, run(purpose, at, effects, seed), seed))
        return visits[-1].table

    look = _Look(visit("the point", base), visits=visits)

    def switch_on(chosen: Iterable[Candidate]) -> None:
        for candidate in chosen:
            times = STRIDE if experiment.chance and candidate.kind == "physics" else 1.0
            try:
                look.directions[candidate.name] = directions_of(candidate, base, look.middle, visit, look.steps, times)
            except SimulationError as error:
                failed[candidate.name] = str(error)

    switch_on(c for c in candidates if c.kind == "observation")
    for parameter in experiment.parameters:
        value = base[parameter.name]
        ends = around(parameter, value)
        tables = [visit(parameter.name, {**base, parameter.name: end}) for end in ends]
        offsets = [distance(parameter, value, end) for end in ends]
        look.slopes[parameter.name], curve = derivatives(offsets, tables, look.middle)
        look.widths[parameter.name] = max(abs(offset) for offset in offsets)
        if curve is not None:
            look.curves[parameter.name] = curve
    switch_on(c for c in candidates if c.kind == "physics")
    return look


def around(parameter: Parameter, value: float) -> list[float]:
    """Where a model's parameter is varied to: both sides of its value, or one where a bound is near."""
    whole = distance(parameter, parameter.lower, parameter.upper) / rate(parameter, parameter.lower)
    step = STEP * parameter.meaningful / rate(parameter, value) if parameter.meaningful > 0.0 else 0.05 * whole
    step = min(step, 0.25 * whole)
    ends = [moved(parameter, value, side * step) for side in (-1.0, 1.0)]
    return [end for end in ends if abs(distance(parameter, value, end)) > 0.3 * step * rate(parameter, value)]


def rate(parameter: Parameter, value: float) -> float:
    """How fast a parameter grows along its scale: 1, or the value itself on a logarithmic one."""
    return value if parameter.log else 1.0


def moved(parameter: Parameter, value: float, step: float) -> float:
    """A value moved along its scale (by a logarithm, where that is logarithmic), within the bounds."""
    end = value * math.exp(step) if parameter.log else value + step
    return min(max(end, parameter.lower), parameter.upper)


def ignorance(parameter: Parameter, value: float) -> float:
    """Standard deviation of a parameter of which only the bounds are known, in its unit at a value."""
    whole = distance(parameter, parameter.lower, parameter.upper) / rate(parameter, parameter.lower)
    return whole * rate(parameter, value) / math.sqrt(12.0)


def derivatives(
    offsets: Sequence[float], tables: Sequence[FloatArray], middle: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """First derivative and half the second from one or two neighbours."""
    if len(offsets) == 1:
        return (tables[0] - middle) / offsets[0], None
    matrix = np.array([[offset, offset**2] for offset in offsets])
    first, second = np.linalg.solve(matrix, np.stack([(t - middle).reshape(-1) for t in tables]))
    return first.reshape(middle.shape), second.reshape(middle.shape)


def step_of(parameter: Parameter, times: float = 1.0) -> float:
    """How far an effect's parameter is moved from off, in the direction in which there is room; ``times`` as far as
    where nothing is left to chance."""
    off = parameter.off if parameter.off is not None else parameter.default
    room = {1: parameter.upper - off, -1: off - parameter.lower}
    side = parameter.sign or (1 if room[1] >= room[-1] else -1)
    wanted = times * (STEP * parameter.meaningful if parameter.meaningful > 0.0 else 0.1 * room[side])
    return side * min(wanted, REACH * room[side])


def directions_of(
    candidate: Candidate,
    base: Mapping[str, float],
    middle: FloatArray,
    run: Run,
    steps: dict[str, float],
    times: float = 1.0,
) -> FloatArray:
    """(k, t, s) derivatives by a candidate's parameters at off, of predictions whose ``middle`` is that without it, by
    steps ``times`` as long as where nothing is left to chance; ``steps`` gets them."""
    return np.stack([_slope(candidate, p, base, middle, run, steps, times) for p in candidate.parameters])


def _slope(
    candidate: Candidate,
    parameter: Parameter,
    base: Mapping[str, float],
    middle: FloatArray,
    run: Run,
    steps: dict[str, float],
    times: float,
) -> FloatArray:
    """Derivative by one parameter of an effect, its others at off; from both sides where it has no sign."""
    off = {p.name: float(p.off or 0.0) for p in candidate.parameters}
    step = step_of(parameter, times)
    steps[parameter.name] = abs(step)
    tables = []
    # Drawing the same simulation otherwise has no chance in it: one side will do.
    both = (
        candidate.kind == "physics"
        and parameter.sign == 0
        and parameter.lower <= off[parameter.name] - step <= parameter.upper
    )
    for offset in (step, -step) if both else (step,):
        at = {**base, **off, parameter.name: off[parameter.name] + offset}
        tables.append(run(f"{candidate.name}: {parameter.name}", at, (candidate.name,)))
    return (tables[0] - tables[1]) / (2.0 * step) if both else (tables[0] - middle) / step
