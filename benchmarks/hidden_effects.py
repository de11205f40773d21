"""How often is the missing effect named, and how often a wrong one? Diagnoses of experiments whose truth is sealed.

``python -m splatsoil.benchmarks.hidden_effects`` judges emulated plow experiments: patterns of parameters and effects
over time and space, chance drawn for every seed, a diagnosis from nothing but its own repeated "simulations". The truth
is drawn by a stream of random numbers of its own and opened only to score.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._tally import Found, Tally, entry, table, tally
from splatsoil.inverse.criticism.diagnosis import Bench, Diagnosis, Options, judge
from splatsoil.inverse.criticism.evidence import gather
from splatsoil.inverse.criticism.noise import Noise, Part
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.base import Candidate
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter

FloatArray = npt.NDArray[np.float64]

EFFECTS = 8
OBSERVATIONS = 2
STRENGTHS = (0.5, 1.0, 2.0, 4.0)
"""Sizes of single effects, in smallest detectable ones."""
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
    experiment = replace(experiment, observed=experiment.measured(truth, [world, 99], extra))
    # A fit of the base model: least squares over its one parameter.
    values = {"angle": fitted(experiment)}
    simulate = Simulations(experiment)
    evidence = gather(experiment, simulate, values, repeats=options.repeats)
    return judge(experiment, evidence, simulate, options=options, bench=Bench.of(experiment, evidence, options))


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


def run(count: int = 40, *, seed: int = 1, repeats: int = 4, only: str = "") -> dict[str, Any]:
    """All kinds of truth (or those with ``only`` in their name), ``count`` experiments each; a JSON-able result."""
    began = time.perf_counter()
    options = Options(repeats=repeats)
    kinds: dict[str, str] = {c.name: c.kind for c in emulated(0).candidates}
    physics = [name for name, kind in kinds.items() if kind == "physics"]
    reported = [name for name, kind in kinds.items() if kind == "observation"]
    rows: list[Tally] = []
    kind = 0

    def series(name: str, hide: Any, beyond: float = 0.0, *, drop: bool = False, twin: bool = False) -> None:
        nonlocal kind
        truths, found, angles = [], [], []
        kind += 1
        if only not in name:
            return
        for k in range(count):
            world = seed * 100_000 + (kind - 1) * 1_000 + k
            sealed = np.random.default_rng([world, 2])
            angle = float(sealed.uniform(-2.0, 2.0))
            hidden = hide(sealed, detectable(world, options, CHAOS)) if hide is not None else {}
            base = emulated(world, duplicate=twin, chaos=CHAOS)
            extra = outside(base, sealed, beyond) if beyond else None
            truth = {"angle": angle, **hidden}
            if drop:
                observed = base.measured(truth, [world, 99])
                base = replace(base, candidates=tuple(c for c in base.candidates if c.name not in hidden))
                extra = observed - base.measured({"angle": angle}, [world, 99])
                truth = {"angle": angle}
            found.append(Found.of(one(world, truth, extra, options, base), "angle"))
            truths.append(hidden)
            angles.append(angle)
        rows.append(tally(name, truths, found, angles, kinds))

    def single(names: Sequence[str], times: float) -> Any:
        def hide(sealed: np.random.Generator, sizes: dict[str, float]) -> dict[str, float]:
            name = str(sealed.choice(list(names)))
            return {name: min(times * sizes[name], LARGEST)}

        return hide

    def pair(sealed: np.random.Generator, sizes: dict[str, float]) -> dict[str, float]:
        return {str(n): min(3.0 * sizes[str(n)], LARGEST) for n in sealed.choice(physics, 2, replace=False)}

    series("nothing", None)
    for times in STRENGTHS:
        series(f"one effect, {times:g} × smallest detectable", single(physics, times))
    series("observation only, 3 ×", single(reported, 3.0))
    series("two effects, 3 × each", pair)
    series("outside the library, 1 × noise", None, 1.0)
    series("outside the library, 2 × noise", None, 2.0)
    series("control: the truth taken out of the library, 4 ×", single(physics, 4.0), drop=True)
    series("control: effect 1 there twice, 4 ×", single(["effect 1"], 4.0), twin=True)
    series("control: the truth taken out of the library, 2 ×", single(physics, 2.0), drop=True)
    return {
        "count": count,
        "seed": seed,
        "repeats": repeats,
        "seconds": time.perf_counter() - began,
        "rows": [entry(row) for row in rows],
    }


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="experiments of each kind")
    parser.add_argument("--only", default="", help="only the kinds whose name has this in it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    result = run(options.count, seed=options.seed, repeats=options.repeats, only=options.only)
    if options.json:
        from splatsoil.files import plain

        print(json.dumps(plain(result), indent=1))
    else:
        print(table(result))
        print(f"\n{options.count} of each kind, {result['repeats']} repeats, {result['seconds']:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
