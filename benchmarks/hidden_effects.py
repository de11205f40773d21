"""How often is the missing effect named, and how often a wrong one? Diagnoses of experiments whose truth is sealed.

``python -m splatsoil.benchmarks.hidden_effects`` judges emulated plow experiments: patterns of parameters and effects
over time and space, chance drawn for every seed, a diagnosis from nothing but its own repeated "simulations". The truth
is drawn by a stream of random numbers of its own and opened only to score. What was judged is kept in the folder, and a
second call goes on from there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import at_least, keep_to_one_protocol, sources, stamp
from splatsoil.benchmarks._hidden import NOTHING, Kind, Truth, count_up, draw, judge_all, kept
from splatsoil.benchmarks._tally import Found, entry, table
from splatsoil.inverse.criticism.confirmation import confirm
from splatsoil.inverse.criticism.diagnosis import Diagnosis, Options, judge
from splatsoil.inverse.criticism.evidence import gather
from splatsoil.inverse.criticism.misfit import smooth_basis
from splatsoil.inverse.criticism.noise import Noise, Part
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.executors import executor

from splatsoil.errors import ParameterError
from splatsoil.experiment.base import Candidate
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.experiment.features import Layout, Site
from splatsoil.files import plain, write_json
from splatsoil.parameters import Parameter

FloatArray = npt.NDArray[np.float64]

EFFECTS = 8
OBSERVATIONS = 2
ANGLES = (-2.0, 2.0)
"""Range of the true angle, whose home is 0."""
KINDS = (
    NOTHING,
    *(Kind(f"one effect, {times:g} × smallest detectable", times, 1) for times in (0.5, 1.0, 2.0, 4.0)),
    Kind("observation only, 3 ×", 3.0, 1, "observation"),
    Kind("two effects, 3 × each", 3.0, 2),
    Kind("outside the library, 1 × noise", beyond=1.0),
    Kind("outside the library, 2 × noise", beyond=2.0),
    Kind("control: the truth taken out of the library, 4 ×", 4.0, 1, dropped=True),
    Kind("control: the truth taken out of the library, 2 ×", 2.0, 1, dropped=True),
    Kind("control: the library's traces shuffled, 4 ×", 4.0, 1, shuffled=True),
    Kind("control: effect 1 there twice, 4 ×", 4.0, 1, "effect 1", twin=True),
)
LARGEST = 50.0
"""Size of an effect."""
MEMORY, LENGTH, NUGGET = 0.7, 0.12, 0.1
"""Of the emulated chance."""
CHAOS = 0.4
"""Share of its variance that is another one in soil that differs at all. Of the plow's (`small`) 0.1 to 0.9 is, by how
much soil differs."""


def layout_of(times: int = 12, cameras: int = 2, across: int = 4) -> Layout:
    """A small plow experiment: a grid of patches seen by each camera."""
    sites = tuple(
        Site(f"camera {c}", 0.1 * i, 0.1 * j) for c in range(cameras) for i in range(across) for j in range(across)
    )
    stages = tuple("pushing" if t < times // 2 else "withdrawal" for t in range(times))
    regions = np.array([["trench" if s.x < 0.15 else "berm" for s in sites]] * times)
    return Layout(tuple(float(t) for t in range(times)), sites, "frame", "grey levels", stages, regions)


def emulated(seed: int, *, duplicate: bool = False, chaos: float = 0.0) -> EmulatedExperiment:
    """A world of smooth patterns.

    Args:
        seed: of the patterns.
        duplicate: the second effect is the first one under another name.
        chaos: share of chance that is another one in soil that differs at all.
    """
    layout = layout_of()
    generator = np.random.default_rng([seed, 7])
    x = np.array([s.x for s in layout.sites])
    y = np.array([s.y for s in layout.sites])
    time_axis = np.linspace(0.0, 1.0, layout.shape[0])[:, None]
    # Chance grows where and when soil has moved.
    moved = 0.3 + 2.0 * np.exp(-(((x - 0.15) / 0.12) ** 2))[None] * time_axis
    chance = Part(moved, MEMORY, LENGTH, NUGGET, np.array([[1.0, 0.4], [0.4, 1.0]]))
    covariance = Noise.of(layout, [(1.0, chance)], np.ones(layout.shape, dtype=bool)).covariance
    root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)

    def pattern() -> FloatArray:
        phase = generator.uniform(0.0, 2.0 * np.pi, 4)
        wave = generator.uniform(4.0, 12.0, 2)
        table = (
            (0.4 + time_axis ** generator.uniform(0.5, 2.0))
            * np.sin(wave[0] * x + phase[0])
            * np.cos(wave[1] * y + phase[1])
        )
        return table * (1.0 + 0.3 * np.sin(phase[2] + 3.0 * time_axis)) * moved

    slopes = {"angle": 0.5 * pattern()}
    curves = {"angle": 0.02 * pattern()}
    candidates = []
    for k in range(EFFECTS):
        kind = "observation" if k >= EFFECTS - OBSERVATIONS else "physics"
        name = f"effect {k + 1}"
        parameter = Parameter(name, "1", 0.0 if k % 2 else -LARGEST, LARGEST, 0.0, off=0.0, meaningful=0.25, sign=k % 2)
        candidates.append(Candidate(name, kind, (parameter,), name))  # type: ignore[arg-type]
        twin = duplicate and k == 1
        slopes[name] = slopes["effect 1"] if twin else pattern()
        curves[name] = curves["effect 1"] if twin else 0.02 * pattern()
    angle = Parameter("angle", "deg", -10.0, 10.0, 0.0, meaningful=0.5)
    return EmulatedExperiment(
        layout=layout,
        middle=4.0 * pattern(),
        home={"angle": 0.0},
        slopes=slopes,
        curves=curves,
        parameters=(angle,),
        candidates=tuple(candidates),
        chance_root=root,
        sensor=np.full(layout.shape, 0.1),
        observed=np.zeros(layout.shape),
        patterns={"grid": pattern(), "step": 0.5 * pattern()},
        chaos=chaos,
    )


def outside(experiment: EmulatedExperiment, generator: np.random.Generator, size: float) -> FloatArray:
    """(t, s) a smooth pattern that no effect has, ``size`` times the noise."""
    layout = experiment.layout
    x, y = (np.array([getattr(s, a) for s in layout.sites]) for a in "xy")
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    when = np.cos(np.linspace(0.0, np.pi, layout.shape[0]) + phase[0])[:, None]
    table = (
        when * np.cos(generator.uniform(4.0, 12.0) * x + phase[1]) * np.sin(generator.uniform(4.0, 12.0) * y + phase[2])
    )
    scale = np.sqrt(np.diag(experiment.chance_root @ experiment.chance_root.T)).reshape(layout.shape)
    return size * table * scale


def one(
    world: int,
    truth: dict[str, float],
    extra: FloatArray | None,
    options: Options,
    base: EmulatedExperiment | None = None,
) -> Diagnosis:
    """Diagnose one experiment with a hidden truth; the analysis sees the observation and its own simulations only."""
    experiment = base or emulated(world)
    return diagnosed(replace(experiment, observed=experiment.measured(truth, [world, 99], extra)), options)


def diagnosed(experiment: EmulatedExperiment, options: Options) -> Diagnosis:
    """A diagnosis from where least squares over the one parameter would end."""
    simulate = Simulations(experiment)
    evidence = gather(experiment, simulate, {"angle": fitted(experiment)}, repeats=options.repeats)
    return judge(experiment, evidence, simulate, options=options)


def fitted(experiment: EmulatedExperiment) -> float:
    """Where a fit to images would end: least squares over the angle, in units of chance."""
    scale = np.sqrt(np.diag(experiment.chance_root @ experiment.chance_root.T)).reshape(experiment.layout.shape)
    angles = np.linspace(-9.5, 9.5, 191)
    losses = [np.sum(((experiment.observed - experiment.predict({"angle": a}, seed=0)) / scale) ** 2) for a in angles]
    return float(angles[int(np.argmin(losses))])


def detectable(world: int, options: Options, chaos: float = 0.0) -> dict[str, float]:
    """Smallest detectable size of each effect, from a diagnosis of data with nothing hidden."""
    found = one(world, {"angle": 0.0}, None, options, emulated(world, chaos=chaos))
    return {name: score.detectable for name, score in found.scores.items()}


def shuffled(experiment: EmulatedExperiment, generator: np.random.Generator) -> EmulatedExperiment:
    """The same world in which effects leave their traces at each camera's places in another order."""
    channel = experiment.layout.channel_numbers
    order = np.arange(len(channel))
    for number in np.unique(channel):
        order[channel == number] = generator.permutation(order[channel == number])

    def moved(tables: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        effects = {c.name for c in experiment.candidates}
        return {name: table[:, order] if name in effects else table for name, table in tables.items()}

    return replace(experiment, slopes=moved(experiment.slopes), curves=moved(experiment.curves))


def smallest_error(experiment: EmulatedExperiment, diagnosis: Diagnosis, options: Options) -> str:
    """What one would say without criticism, from a diagnosis' evidence: the effect whose refit ends with the smallest
    error on hidden frames, or "" where the model as it is does."""
    refits = confirm(
        experiment,
        diagnosis.evidence,
        diagnosis.floor,
        experiment.candidates,
        Simulations(experiment),
        options.refit_steps,
        smooth_basis(experiment.layout, diagnosis.floor.noise),
        lambda what, share: None,
    )
    return min(refits, key=lambda name: refits[name].held_out)


def judge_one(keep: Path, kind: Kind, number: int, seed: int, repeats: int, blindly: bool) -> tuple[Truth, Found]:
    """Hide a truth in a world of its own, and diagnose it from nothing but the observation; ``blindly`` also says what
    the smallest error would name."""

    def make() -> tuple[Truth, Found]:
        options = Options(repeats=repeats)
        world = int(np.random.SeedSequence([seed, kind.number, number]).generate_state(1)[0])
        base = emulated(world, duplicate=kind.twin, chaos=CHAOS)
        least = {n: s for n, s in detectable(world, options, CHAOS).items() if np.isfinite(s)} if kind.effects else {}
        truth = draw(kind, number, seed, base.candidates, least, ANGLES)
        sealed = np.random.default_rng([world, 2])
        extra = outside(base, sealed, kind.beyond) if kind.beyond else None
        observed = base.measured({"angle": truth.angle, **truth.sizes}, [world, truth.seed], extra)
        known = shuffled(base, sealed) if kind.shuffled else base
        if kind.dropped:
            known = replace(known, candidates=tuple(c for c in known.candidates if c.name not in truth.sizes))
        known = replace(known, observed=observed)
        diagnosis = diagnosed(known, options)
        blind = smallest_error(known, diagnosis, options) if blindly else None
        return truth, replace(Found.of(diagnosis, "angle"), blind=blind)

    return kept(keep, kind, number, make)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=at_least(1), default=40, help="experiments of each kind")
    parser.add_argument("--only", default="", help="only the kinds whose name has this in it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument("--blindly", action="store_true", help="count what the smallest error of all refits names, too")
    parser.add_argument("--executor", default="serial", help="serial, or processes:N")
    parser.add_argument("--out", type=Path, default=Path("runs/hidden-effects"), help="folder for what is finished")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    kinds = [kind for kind in KINDS if options.only in kind.name]
    if not kinds:
        raise ParameterError(f"--only {options.only}: no kind has this in its name")
    own = [Path(__file__).with_name(f"{name}.py") for name in ("hidden_effects", "_hidden", "_tally")]
    decides = {"seed": options.seed, "repeats": options.repeats, "blindly": options.blindly, "code": sources(own)}
    keep = options.out.resolve()
    keep_to_one_protocol(keep, decides)
    candidates = emulated(0).candidates
    with executor(options.executor) as pool:
        rows = judge_all(
            pool,
            judge_one,
            [(kind, number) for kind in kinds for number in range(options.count)],
            lambda kind, number: (keep, kind, number, options.seed, options.repeats, options.blindly),
        )
    result = {"rows": [entry(count_up(kind, judged, candidates, "angle")) for kind, judged in rows.items()]}
    told = plain({"made_by": stamp("cpu"), **decides, "count": options.count, **result})
    write_json(keep / "result.json", told)
    print(json.dumps(told, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
