"""Synthetic experiments with a hidden effect, by an independent solver: does the whole chain name the right one?

Each is one run of Newton's implicit MPM (extra ``independent``) with one thing that its measurement set does not state,
or with nothing, photographed by the path tracer. ``splatsoil fit`` and ``diagnose`` then get the set alone. Truths are
drawn by a stream of random numbers of their own (what is hidden, how much, the friction angle, bed, tool, appearance),
and opened only to score. What was made is kept in the folder, and a second call continues from there.

The same truths simulated by this project's own solver (``--solver small``, or another preset) show which part of an
error is the model discrepancy, and which the photographs' or the estimates' fault.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from splatsoil.benchmarks._common import (
    Clock,
    at_least,
    keep_to_one_protocol,
    markdown,
    parser_of,
    sources,
    stamp,
    tell,
)
from splatsoil.benchmarks._hidden import KINDS, NOTHING, OUTSIDE, TIMES, Hidden, draw
from splatsoil.benchmarks._newton import Numerics, plough
from splatsoil.inverse.criticism.evidence import BASE_MODEL, DISCREPANCY

from splatsoil.errors import ParameterError
from splatsoil.files import plain, read_json
from splatsoil.mpm import PRESETS, frames_around
from splatsoil.quiet import hush
from splatsoil.synthetic import Appearance, Recipe, Recorder, make_set, photograph_run

OWN = ("_hidden", "_newton", "_scenes", "hidden_worlds")
"""Modules beside the package by which the experiments are made."""
NEWTON = "newton"
"""The other solver; ours go by their presets."""
ELSE = DISCREPANCY
"""The model of what no effect explains, and its verdict."""
OPEN = (ELSE, "undecided")
LEAST = 1e-6
"""Probability from which on down the log score falls no further."""


@dataclass(frozen=True)
class Study:
    """How experiments are made and judged: folder, solver that ploughs, preset of the fits, device, and progress."""

    out: Path
    solver: str
    preset: str
    device: str
    say: Clock

    def made(self, truths: Sequence[Hidden], side_by_side: int) -> Iterator[Hidden]:
        """Simulate and photograph the experiments that the folder lacks, so many at a time; each that is there."""
        missing = [h for h in truths if not (self.folder(h) / "truth.json").is_file()]
        yield from (h for h in truths if h not in missing)
        make = self.by_newton if self.solver == NEWTON else self.by_ours
        groups = [missing[k : k + side_by_side] for k in range(0, len(missing), side_by_side)]
        while groups:
            group = groups.pop(0)
            names = ", ".join(hidden.name for hidden in group)
            try:
                make(group)
            except ValueError as error:  # a particle that flies off makes Newton ask for a grid of any size
                self.say(f"{names}: the other solver failed ({error})")
                groups += [[hidden] for hidden in group if len(group) > 1]
            else:
                self.say(f"{names}: simulated and photographed")
                yield from group

    def by_newton(self, group: Sequence[Hidden]) -> None:
        """Make the measurement sets of experiments that Newton ploughs side by side."""
        setups, seen = [h.scene.setup() for h in group], [h.observation() for h in group]
        rate = setups[0].frame_rate
        frames = {f for o in seen for f in frames_around(setups[0].frames, o.time_offset * rate)}
        soils = [h.soil(setup, Numerics().spacing) for h, setup in zip(group, setups, strict=True)]
        runs = plough(soils, Numerics(), frames, self.device)
        for hidden, setup, run, observation in zip(group, setups, runs, seen, strict=True):
            filmed, seed = replace(run, force=run.force[: max(setup.frames)]), hidden.scene.seed
            recorder = Recorder(setup, filmed, Appearance.drawn(seed), seed, self.device, observation)
            photograph_run(self.folder(hidden), recorder, plain({**asdict(hidden), "solver": asdict(Numerics())}))

    def by_ours(self, group: Sequence[Hidden]) -> None:
        """The same by our own solver, of particles that no fit starts from."""
        for hidden in group:
            seed, values = hidden.scene.seed, hidden.values
            recipe = Recipe(hidden.angle, hidden.effects, values, self.solver, seed, seed, self.device)
            make_set(self.folder(hidden), hidden.scene.setup(), recipe)

    def folder(self, hidden: Hidden) -> Path:
        """The measurement set."""
        return self.out / "sets" / hidden.name

    def run(self, hidden: Hidden) -> Path:
        """The run folder."""
        return self.out / "runs" / hidden.name

    def judge(self, hidden: Hidden) -> None:
        """Fit and diagnose by the command line, unless that is done; its output is kept beside the run."""
        run = self.run(hidden)
        if (run / "diagnosis.json").is_file():
            return
        run.mkdir(parents=True, exist_ok=True)
        commands = (
            ["fit", str(self.folder(hidden)), "--run", str(run), "--preset", self.preset],
            ["diagnose", str(run)],
        )
        with run.with_suffix(".log").open("a") as log:
            command = [sys.executable, "-m", "splatsoil"]
            codes = [
                subprocess.run([*command, *words, "--device", self.device], stdout=log, stderr=log).returncode
                for words in commands
            ]
        self.say(f"{hidden.name}: {'done' if not any(codes) else f'exit codes {codes}'}")

    def rows(self, truths: Iterable[Hidden]) -> list[dict[str, Any]]:
        """Scores of those that were judged."""
        there = [h for h in truths if (self.run(h) / "diagnosis.json").is_file()]
        return [score(h, read_json(self.run(h) / "fit.json"), read_json(self.run(h) / "diagnosis.json")) for h in there]


def score(hidden: Hidden, fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """What fit and diagnosis report of a synthetic experiment, beside the truth.

    ``size`` is that of the effect's parameter, ``times`` and ``detectable`` are over its smallest meaningful change.
    """
    models = {model["name"]: model for model in diagnosis["models"]}
    truth = {NOTHING: BASE_MODEL, **dict.fromkeys(OUTSIDE, ELSE)}.get(hidden.kind, hidden.kind)
    best, angle, verdict = diagnosis["models"][0], diagnosis["estimates"]["friction_angle"], diagnosis["verdict"]
    named = diagnosis["class"] if verdict in ("missing", "one of") else []
    row = {
        "hidden": hidden.kind,
        "truth": truth,
        "size": next(iter(hidden.values.values()), 0.0),
        "angle": hidden.angle,
        "verdict": verdict,
        "class": diagnosis["class"],
        "named": named,
        "right": truth in {"adequate": [BASE_MODEL], ELSE: [ELSE]}.get(verdict, named),
        "best": best["name"],
        "probabilities": {name: model["probability"] for name, model in models.items()},
        "angle_found": [angle["value"], angle["std"]],
        "z": (angle["value"] - hidden.angle) / angle["std"],
        "seconds": [fit["seconds"], diagnosis["seconds"]],
    }
    if hidden.effects and truth in models:
        model = models[truth]
        size, meaningful = hidden.values[model["parameter"]], model["meaningful"]
        row |= {"size": size, "times": abs(size - model["off"]) / meaningful}
        row["detectable"] = model["detectable"] and model["detectable"] / meaningful
        if best is model:
            row["size_found"] = [model["estimate"], model["std"]]
            row["size_error"] = (model["estimate"] - size) / abs(size - model["off"])
    return row


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """All experiments, those whose truth was missed first, and what they come to, as Markdown."""
    head = ["hidden", "size (over the smallest meaningful)", "verdict", "class", "probability: truth, base law"]
    head += ["angle: true; found (error over ±)", "size found", "fit, diagnosis"]
    lines = []
    for r in sorted(rows, key=lambda r: (r["right"], r["hidden"])):
        size = f"{r['size']:.3g}" + (f" ({r['times']:.1f})" if "times" in r else "") if r["truth"] else "–"
        shares = f"{_probability(r, [r['truth']]):.2f}, {_probability(r, [BASE_MODEL]):.2f}"
        angle = f"{r['angle']:.1f}°; {r['angle_found'][0]:.1f} ± {r['angle_found'][1]:.1f}° ({r['z']:+.1f})"
        found = "{:.3g} ± {:.2g}".format(*r["size_found"]) if "size_found" in r else "–"
        seconds = "{:.0f}, {:.0f} s".format(*r["seconds"])
        lines.append([r["hidden"], size, r["verdict"], ", ".join(r["class"]) or "–", shares, angle, found, seconds])
    return markdown(head, lines) + "\n\n" + "\n".join(f"- {line}" for line in _counts(rows))


def _counts(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    dry = [r for r in rows if r["hidden"] == NOTHING]
    outside = [r for r in rows if r["hidden"] in OUTSIDE]
    library = [r for r in rows if r["hidden"] not in (NOTHING, *OUTSIDE)]
    large = [r for r in library if r.get("detectable") and r["times"] >= r["detectable"]]
    yield from _share("nothing hidden: some effect named", [bool(r["named"]) for r in dry])
    yield from _share("an effect hidden: it alone named", [r["named"] == [r["truth"]] for r in library])
    same = "the same, of what is at least as large as stated detectable"
    yield from _share(same, [r["named"] == [r["truth"]] for r in large])
    yield from _share("an effect hidden: named, or in the set", [r["right"] for r in library])
    others = "hidden outside the library: something else, or undecided"
    yield from _share(others, [r["verdict"] in OPEN for r in outside])
    wrong = [bool(r["named"]) and not r["right"] for r in library + outside]
    yield from _share("named wrongly, of all with something hidden", wrong)
    for what, some in (("nothing hidden", dry), ("an effect hidden", library), ("outside the library", outside)):
        yield from _rms(f"{what}: error of the angle, degrees", [r["angle_found"][0] - r["angle"] for r in some])
        yield from _rms(f"{what}: error of the angle over its ±", [r["z"] for r in some])
    yield from _rms("relative error of the size", [r["size_error"] for r in rows if "size_error" in r])
    for what, claims in (
        ("effects named", [(r, r["named"]) for r in rows if r["named"]]),
        ("the most probable model", [(r, [r["best"]]) for r in rows]),
    ):
        mean = np.mean([_probability(*each) for each in claims]) if claims else math.nan
        right = [r["truth"] in names for r, names in claims]
        yield from _share(f"{what}, of probability {mean:.2f} on average: right", right)
    if rows:
        scores = [math.log(max(_probability(r, [r["truth"]]), LEAST)) for r in rows]
        yield f"log score of the true model, mean: {np.mean(scores):.2f}"


def _share(what: str, hits: Sequence[bool]) -> Iterator[str]:
    if hits:
        low, high = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
        yield f"{what}: {sum(hits)} of {len(hits)} ({100 * low:.0f}–{100 * high:.0f} %)"


def _rms(what: str, values: Sequence[float]) -> Iterator[str]:
    if values:
        yield f"{what}, root mean square of {len(values)}: {np.sqrt(np.mean(np.square(values))):.2f}"


def _probability(row: Mapping[str, Any], names: Iterable[str]) -> float:
    """Probability that one of these models is true; 0 for one that was not compared."""
    return float(sum(row["probabilities"].get(name, 0.0) for name in names))


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0 when every experiment was judged."""
    parser = parser_of(__doc__, "runs/hidden-worlds")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument(
        "--count", type=at_least(1), default=1, help="experiments of each kind; three times as many with nothing hidden"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the truths")
    sizes = "range of the effects' sizes over the smallest meaningful ones"
    parser.add_argument("--times", nargs=2, type=float, default=list(TIMES), metavar=("LOW", "HIGH"), help=sizes)
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS), help="of the fits")
    parser.add_argument("--side-by-side", type=at_least(1), default=1, help="fits and diagnoses at a time")
    solvers = "newton needs the package, the others are ours by preset (not friction_field, crust)"
    parser.add_argument("--solver", choices=[NEWTON, *PRESETS], default=NEWTON, help=solvers)
    parser.add_argument("--simulated-side-by-side", type=at_least(1), default=4, help="simulated at a time by Newton")
    parser.add_argument("--sets-only", action="store_true", help="make the sets and stop")
    options = parser.parse_args(arguments)
    foreign = [kind for kind in options.kinds if kind in OUTSIDE]
    if options.solver != NEWTON and foreign:
        raise ParameterError(
            f"{' and '.join(foreign)}: outside of our library; give --kinds without, or --solver {NEWTON}"
        )
    if not 0.0 < options.times[0] <= options.times[1] < math.inf:
        raise ParameterError("--times: give two positive numbers, the smaller one first")
    hush()
    decides = {name: getattr(options, name) for name in ("seed", "times", "preset", "solver")} | asdict(Numerics())
    decides["code"] = sources(*OWN)
    keep_to_one_protocol(options.out, decides)
    truths = [
        draw(kind, k, options.seed, tuple(options.times))
        for kind in options.kinds
        for k in range((3 if kind == NOTHING else 1) * options.count)
    ]
    study = Study(options.out, options.solver, options.preset, options.device, Clock())
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // options.side_by_side)))
    # an experiment is judged while the next ones are made
    with ThreadPoolExecutor(options.side_by_side) as pool:
        made = study.made(truths, options.simulated_side_by_side)
        judged = [pool.submit(study.judge, hidden) for hidden in made if not options.sets_only]
        for one in judged:
            one.result()
    if options.sets_only:
        return 0
    rows = study.rows(truths)
    tell(options, {"made_by": stamp(options.device), **decides, "rows": rows}, table(rows))
    return 0 if len(rows) == len(truths) else 1
