"""Hidden effects in an independent solver's worlds: does the whole chain name the right one?

Each world is one run of Newton's implicit MPM (extra ``independent``) with one thing that its measurement set doesn't
tell, or with nothing, photographed by the path tracer, or by Mitsuba 3 (``--renderer mitsuba``). ``splatsoil fit`` and
``diagnose`` then get the set alone. Truths (what is hidden, how much, the friction angle, bed, tool, looks) are drawn
by a stream of random numbers of their own, and opened only to score. What was made is kept in the folder, and a second
call goes on from there. With ``--refine`` the first world of each kind is ploughed once more with finer voxels, which
says whether the other solver has converged on such soil; the result stays beside the worlds.

The same truths ploughed by this project's own solver (``--solver small``, or another preset) tell what of an error is
the solvers' difference, and what the photographs' or the estimates' fault.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks._common import at_least, here, keep_to_one_protocol, sources, stamp
from splatsoil.benchmarks._mitsuba import MitsubaStage, load_mitsuba
from splatsoil.benchmarks._newton import Numerics, World, plough
from splatsoil.benchmarks._tally import confusion, wilson
from splatsoil.benchmarks._truths import KINDS, NOTHING, OBSERVATION, OUTSIDE, Hidden, draw
from splatsoil.benchmarks.numerics import FloatArray
from splatsoil.benchmarks.solvers import FRAMES, moved, read_particles, refinement_table, surfaces

from splatsoil.errors import ParameterError
from splatsoil.files import plain, read_json, write_json
from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution, Trajectory, frames_around, simulate
from splatsoil.quiet import hush
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.synthetic import Appearance, Renderer, Setup, Stage, photograph_run

OWN = ("_mitsuba", "_newton", "_scenes", "_truths", "hidden_worlds")
"""Modules beside the package by which worlds are made."""
AT_A_TIME = 4
"""Worlds that the independent solver ploughs side by side."""
RENDERERS: dict[str, Callable[..., Renderer]] = {"own": Stage, "mitsuba": MitsubaStage}
NEWTON = "newton"
"""The other solver; ours go by their presets."""


def soil_of(hidden: Hidden, setup: Setup, spacing: float) -> World:
    """What the solver ploughs, of particles so far apart."""
    told = dict(hidden.soil)
    x = fill(setup.surface, setup.bed, spacing, seed=hidden.seed)
    angle: float | FloatArray = hidden.angle
    if "layer" in told:
        excess, below = told.pop("layer")
        angle = hidden.angle + np.where(setup.surface.sample(x[:, :2]) - x[:, 2] > below, excess, 0.0)
    if "across" in told:
        middle, half = setup.bed.lower[1] + 0.5 * setup.bed.extents[1], 0.5 * setup.bed.extents[1]
        angle = hidden.angle + told.pop("across") * (x[:, 1] - middle) / half
    if "crust" in told:
        cohesion, thick = told.pop("crust")
        told["cohesion"] = np.where(setup.surface.sample(x[:, :2]) - x[:, 2] < thick, cohesion, 0.0)
    if "obstacle" in told:
        keep = np.linalg.norm(x - np.array(told["obstacle"][:3]), axis=1) > told["obstacle"][3]
        x = x[keep]
    return World(hidden.name, setup.experiment(), angle, x, spacing, gravity=hidden.gravity, **told)


def ploughed_by_newton(
    group: Sequence[Hidden], setups: Sequence[Setup], frames: Sequence[int], device: str, numerics: Numerics
) -> list[Trajectory]:
    """Worlds side by side."""
    soils = [soil_of(h, s, numerics.spacing) for h, s in zip(group, setups, strict=True)]
    runs = plough(soils, numerics, frames, device)
    found = []
    for setup, soil, run in zip(setups, soils, runs, strict=True):
        positions = np.stack([soil.particles, *(run.particles[f] for f in frames if f > 0)]).astype(np.float32)
        found.append(
            Trajectory(
                frames=tuple(frames),
                positions=positions,
                deformations=np.broadcast_to(np.eye(3, dtype=np.float32), (*positions.shape, 3)),
                force=run.force[: max(setup.frames)],
                spacing=soil.spacing,
                resolution=Resolution.derive(setup.experiment(), "small"),
            )
        )
    return found


def ploughed_by_us(hidden: Hidden, setup: Setup, frames: Sequence[int], preset: str, device: str) -> Trajectory:
    """A world of our own solver, of particles that no fit starts from."""
    experiment = setup.experiment()
    law = Law(effect.for_measurement(experiment) for effect in find_effects([hidden.kind] if hidden.values else []))
    resolution = Resolution.derive(experiment, preset)
    return simulate(
        experiment,
        fill(setup.surface, setup.bed, resolution.spacing, seed=hidden.seed),
        law.require_on({**hidden.values, "friction_angle": hidden.angle}),
        law=law,
        resolution=resolution,
        frames=frames,
        device=device,
    )[0]


def make_worlds(
    truths: Sequence[Hidden],
    out: Path,
    device: str,
    say: Callable[[str], None],
    solver: str | Numerics,
    renderer: Callable[..., Renderer] = Stage,
    at_a_time: int = AT_A_TIME,
) -> None:
    """Simulate and photograph the worlds that the folder doesn't have, so many at a time."""
    missing = [h for h in truths if not (out / "sets" / h.name / "truth.json").is_file()]
    for first in range(0, len(missing), at_a_time):
        group = missing[first : first + at_a_time]
        setups = [h.scene.setup() for h in group]
        seen = [h.observation() for h in group]
        rate = setups[0].frame_rate
        frames = sorted({f for o in seen for f in frames_around(setups[0].frames, o.time_offset * rate)})
        began = time.perf_counter()
        if isinstance(solver, Numerics):
            trajectories = ploughed_by_newton(group, setups, frames, device, solver)
        else:
            ours = zip(group, setups, strict=True)
            trajectories = [ploughed_by_us(h, setup, frames, solver, device) for h, setup in ours]
        say(f"{len(group)} worlds ploughed in {time.perf_counter() - began:.0f} s: {', '.join(h.name for h in group)}")
        for hidden, setup, trajectory, observation in zip(group, setups, trajectories, seen, strict=True):
            photograph_run(
                out / "sets" / hidden.name,
                setup,
                trajectory,
                plain(
                    {
                        "hidden": hidden.kind,
                        "size": hidden.size,
                        "values": hidden.values,
                        "scene": asdict(hidden.scene),
                        "solver": asdict(solver) if isinstance(solver, Numerics) else solver,
                    }
                ),
                appearance=Appearance.drawn(hidden.seed),
                observation=observation,
                seed=hidden.seed,
                device=device,
                renderer=renderer,
            )
            say(f"{hidden.name} photographed, {time.perf_counter() - began:.0f} s")


def refine(
    truths: Sequence[Hidden], out: Path, device: str, say: Callable[[str], None], numerics: Numerics, at_a_time: int
) -> None:
    """Plough the first world of each kind of soil once more with finer voxels, unless that is done; what they change is
    kept in ``refinement.json``, by world."""
    file = out / "refinement.json"
    done: dict[str, Any] = read_json(file) if file.is_file() else {}
    missing = [h for h in truths if h.number == 0 and h.kind not in OBSERVATION and h.name not in done]
    finer = numerics.refined()
    for begin in range(0, len(missing), at_a_time):
        group = missing[begin : begin + at_a_time]
        began = time.perf_counter()
        soils = [soil_of(h, h.scene.setup(), finer.spacing) for h in group]
        for hidden, soil, run in zip(group, soils, plough(soils, finer, FRAMES, device), strict=True):
            measurement = Measurement.load(out / "sets" / hidden.name)
            made, spacing = read_particles(measurement.folder / "truth_particles.npz")
            force = measurement.tool.force
            assert force is not None  # of every world that the other solver made
            heights = [
                surfaces(measurement, particles, size)
                for particles, size in ((made, spacing), (run.particles, soil.spacing))
            ]
            done[hidden.name] = moved(measurement, (heights[0], force[:, 2:]), (heights[1], run.force))
        write_json(file, plain(done))
        names = ", ".join(h.name for h in group)
        say(f"{names} ploughed with voxels of {1e3 * finer.voxel:.1f} mm in {time.perf_counter() - began:.0f} s")


def criticise(name: str, out: Path, preset: str, device: str, say: Callable[[str], None]) -> None:
    """Fit and diagnose by the command line, unless that is done; what it says is kept beside its run."""
    run = out / "runs" / name
    if (run / "diagnosis.json").is_file():
        return
    run.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    commands = (
        ["fit", str(out / "sets" / name), "--run", str(run), "--preset", preset, "--device", device],
        ["diagnose", str(run), "--device", device],
    )
    with (out / "runs" / f"{name}.log").open("a") as log:
        codes = [
            subprocess.run([sys.executable, "-m", "splatsoil", *words], stdout=log, stderr=log, check=False).returncode
            for words in commands
        ]
    say(f"{name}: {'done' if not any(codes) else f'exit codes {codes}'}, {time.perf_counter() - began:.0f} s")


def score(hidden: Hidden, fit: Mapping[str, Any], told: Mapping[str, Any]) -> dict[str, Any]:
    """What fit and diagnosis said of a world, beside the truth; the best effect's refit is what ``add`` keeps."""
    refits = told["refits"]
    weighed = told["estimates"]["friction_angle"]
    asis = {"values": {"friction_angle": weighed["value"]}, "stds": {"friction_angle": weighed["std"]}}
    # Without any significant effect nothing was refitted; without a named one the diagnosis tells the weighed estimate.
    base = refits.get("as it is", asis)
    last = refits[told["class"][0]] if told["class"] else {**base, **asis}
    named = told["class"] if told["verdict"] == "missing" else []
    off = [(last["values"]["friction_angle"] - hidden.angle) / last["stds"]["friction_angle"]]
    if told["class"][:1] == [hidden.kind] and hidden.kind not in OBSERVATION:
        size = next(e["parameter"] for e in told["effects"] if e["name"] == hidden.kind)
        off.append((last["values"][size] - hidden.size) / last["stds"][size])
    return {
        "hidden": hidden.kind,
        "size": hidden.size,
        "angle": hidden.angle,
        "verdict": told["verdict"],
        "class": told["class"],
        "explained": told["explained"],
        "right": hidden.kind in named if hidden.kind not in (NOTHING, *OUTSIDE) else not named,
        "nearest": hidden.kind in told["class"],
        "fit": [fit["parameters"]["friction_angle"][key] for key in ("estimate", "std")],
        "before": [base["values"]["friction_angle"], base["stds"]["friction_angle"]],
        "after": [last["values"]["friction_angle"], last["stds"]["friction_angle"]],
        "sizes": {k: [v, last["stds"][k]] for k, v in last["values"].items() if k != "friction_angle"},
        "off": off,
        # Each over what noise leaves in such soil.
        "errors": [refit["held_out"] / refit["floor"] for refit in (base, last) if "floor" in refit],
        # In all, without what numerics and parameters can make up for.
        "whole": [told[key]["ratio"] for key in ("whole", "whole_after") if told.get(key)],
        "z": {e["name"]: e["z"] for e in told["effects"]},
        "seconds": [fit["seconds"], told["seconds"]],
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """All worlds and what they come to, as Markdown."""
    lines = [
        "| hidden | size | verdict | class | share explained | size found | error over floor, before → after | "
        "angle: true; fit, refit → with the best effect |",
        "|---" * 8 + "|",
    ]
    for r in rows:
        size = "–" if r["hidden"] == NOTHING else f"{r['size']:.3g}"
        found = ", ".join(f"{k} {v:.3g} ± {std:.2g}" for k, (v, std) in r["sizes"].items()) or "–"
        errors = " → ".join(f"{e:.2f}" for e in r["errors"]) or "–"
        refit = f"{r['before'][0]:.1f} → " if r["sizes"] else ""
        angles = f"{r['angle']:.1f}°; {r['fit'][0]:.1f}, {refit}{r['after'][0]:.1f} ± {r['after'][1]:.1f}°"
        members = ", ".join(r["class"]) or "–"
        cells = (r["hidden"], size, r["verdict"], members, f"{100 * r['explained']:.0f} %", found, errors, angles)
        lines.append("| " + " | ".join(cells) + " |")

    def share(what: str, among: Sequence[Any], test: Callable[[Any], bool]) -> None:
        if among:
            hits = sum(map(test, among))
            low, high = wilson(hits, len(among))
            lines.append(f"- {what}: {hits} of {len(among)} ({100 * low:.0f}–{100 * high:.0f} %)")

    firsts = [(r["hidden"], r["class"][0] if r["verdict"] == "missing" else NOTHING) for r in rows]
    lines += ["", confusion(firsts), ""]
    library = [r for r in rows if r["hidden"] not in (NOTHING, *OUTSIDE)]
    right = [r for r in library if r["class"][:1] == [r["hidden"]] and r["hidden"] not in OBSERVATION]
    plain_sand = [r for r in rows if r["hidden"] == NOTHING]
    outside = [r for r in rows if r["hidden"] in OUTSIDE]
    share("some effect named where nothing is hidden", plain_sand, lambda r: not r["right"])
    share("the class of what is missing holds the truth", library, lambda r: r["right"])
    share("the same, or the truth is the nearest of the library", library, lambda r: r["nearest"])
    share("another effect named", library, lambda r: r["verdict"] == "missing" and not r["right"])
    share("something named that is outside the library", outside, lambda r: not r["right"])
    share("the right effect of soil or tool first: angle within 2.5° after", right, _near)
    share("the same: error ends within 1.2 × the floor", right, lambda r: r["errors"][-1] <= 1.2)
    judged = [r for r in right if len(r["whole"]) > 1]
    share("the same: the whole ends within 1.2 × noise", judged, lambda r: r["whole"][-1] <= 1.2)
    share("nothing hidden: angle within 2.5°", plain_sand, _near)
    if rows:
        stated = [r["off"] for r in rows if r["class"][:1] == [r["hidden"]] or (r["hidden"] == NOTHING and r["right"])]
        for times in (1.0, 2.0):
            inside = [abs(z) <= times for of_one in stated for z in of_one]
            share(f"last angles and right effects' sizes within {times:.0f} × their ±", inside, bool)
        off = np.array([r["after"][0] - r["angle"] for r in rows])
        lines.append(f"- error of the last angle: {off.mean():+.1f} ± {off.std(ddof=min(1, len(rows) - 1)):.1f}°")
    return "\n".join(lines)


def _near(row: Mapping[str, Any]) -> bool:
    return bool(abs(row["after"][0] - row["angle"]) <= 2.5)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0 when every world was judged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument(
        "--count", type=at_least(1), default=1, help="worlds of each kind; three times as many without anything"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the truths")
    parser.add_argument("--preset", default="small")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--side-by-side", type=int, default=1, help="chains at a time")
    parser.add_argument(
        "--renderer", choices=list(RENDERERS), default="own", help="takes the photographs; mitsuba needs the package"
    )
    parser.add_argument(
        "--solver",
        choices=[NEWTON, *PRESETS],
        default=NEWTON,
        help="ploughs the worlds: newton needs the package, the others are ours by preset (not friction_field)",
    )
    parser.add_argument("--voxel", type=float, default=Numerics.voxel, help="edge of the other solver's cells, m")
    parser.add_argument(
        "--iterations", type=int, default=Numerics.iterations, help="most of the other solver's in a substep"
    )
    parser.add_argument("--worlds-side-by-side", type=at_least(1), default=AT_A_TIME, help="ploughed at a time")
    parser.add_argument("--refine", action="store_true", help="check the first world of each kind with finer voxels")
    parser.add_argument("--worlds-only", action="store_true", help="make the sets and stop")
    parser.add_argument("--out", type=Path, default=Path("runs/hidden-worlds"))
    options = parser.parse_args(arguments)
    hush()
    began = time.perf_counter()

    def say(what: str) -> None:
        print(f"{time.perf_counter() - began:6.0f} s  {what}", file=sys.stderr, flush=True)

    foreign = [kind for kind in options.kinds if kind in OUTSIDE]
    if options.solver != NEWTON and foreign:
        said = " and ".join(foreign)
        raise ParameterError(f"{said}: outside of our library; give --kinds without, or --solver {NEWTON}")
    if not options.voxel > 0.0 or options.iterations < 1:
        raise ParameterError("--voxel must be positive, and --iterations one at least")
    if options.refine and options.solver != NEWTON:
        raise ParameterError(f"--refine is of the other solver: leave it out, or give --solver {NEWTON}")
    if options.renderer == "mitsuba":
        load_mitsuba()  # says what is missing before worlds are made
    own = [Path(__file__).with_name(f"{name}.py") for name in OWN]
    decides = {name: getattr(options, name) for name in ("seed", "preset", "solver", "renderer", "voxel", "iterations")}
    decides["code"] = sources(own)
    keep_to_one_protocol(options.out, decides)
    truths = [
        draw(kind, k, options.seed)
        for kind in options.kinds
        for k in range((3 if kind == NOTHING else 1) * options.count)
    ]
    other = Numerics(voxel=options.voxel, iterations=options.iterations)
    solver = other if options.solver == NEWTON else options.solver
    at_a_time = options.worlds_side_by_side
    make_worlds(truths, options.out, options.device, say, solver, RENDERERS[options.renderer], at_a_time)
    if options.refine:
        refine(truths, options.out, options.device, say, other, at_a_time)
    if options.worlds_only:
        return 0
    threads = max(1, (os.cpu_count() or 1) // options.side_by_side)
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    with ThreadPoolExecutor(options.side_by_side) as pool:
        for future in [
            pool.submit(criticise, h.name, options.out, options.preset, options.device, say) for h in truths
        ]:
            future.result()
    rows = []
    for hidden in truths:
        run = options.out / "runs" / hidden.name
        if (run / "diagnosis.json").is_file():
            fit, told = (json.loads((run / file).read_text()) for file in ("fit.json", "diagnosis.json"))
            rows.append(score(hidden, fit, told))
    file = options.out / "refinement.json"
    checked = read_json(file) if file.is_file() else {}
    result = {"made_by": stamp(options.device), **decides, "rows": rows, "refinement": checked}
    write_json(options.out / "result.json", plain(result))
    print(table(rows), *(["", *refinement_table(checked)] if checked else ()), sep="\n")
    return 0 if len(rows) == len(truths) else 1


if __name__ == "__main__":
    raise SystemExit(main())
