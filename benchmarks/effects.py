"""The library of effects: its table, what each effect does to a ploughed bed, and what it costs.

Every effect has five times its smallest meaningful size; the others of its parameters have their defaults. The bed is
that of a measurement set which carries its true particles.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from splatsoil.benchmarks.numerics import Truth

from splatsoil.files import write_bytes
from splatsoil.mpm import Resolution, simulate
from splatsoil.mpm.simulate import base_settings, step_poses
from splatsoil.mpm.solver import BULK_VISCOSITY, Solver
from splatsoil.mpm.substep import make_stress_kernel
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law, Stress
from splatsoil.soil.library import library

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIMES_MEANINGFUL = 5.0


def table() -> str:
    """Markdown table of the whole library."""
    lines = ["| effect | what it is | parameters: default; bounds; smallest meaningful | source |", "|---|---|---|---|"]
    for name, effect in library().items():
        parameters = "<br>".join(_described(p) for p in effect.parameters)
        lines.append(f"| `{name}` | {effect.note} | {parameters} | {effect.source} |")
    return "\n".join(lines)


def _described(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit}"
    sign = {1: ", only larger", -1: ", only smaller"}.get(p.sign, "")
    off = "shape" if p.off is None else f"off at {p.off:g}{sign}"
    scale = ", log" if p.log else ""
    return f"`{p.name}`: {p.default:g}{unit} ({off}); {p.lower:g} … {p.upper:g}{scale}; {p.meaningful:g}"


def acting(effect: Effect) -> dict[str, float]:
    """The effect's size at five times its smallest meaningful one."""
    p = effect.parameters[0]
    off = float(p.off or 0.0)
    return {p.name: float(np.clip(off + (p.sign or 1) * TIMES_MEANINGFUL * p.meaningful, p.lower, p.upper))}


def simulated() -> dict[str, Effect]:
    """Those that need a simulation."""
    return {n: e for n, e in library().items() if type(e).observe is Effect.observe}


def pictures(truth: Truth, preset: str, angle: float, device: str, seeds: int = 3) -> dict[str, Any]:
    """Height maps (ny, nx) in m at the last frame: the base law's, its scatter, and what each effect changes."""
    measurement = truth.measurement
    resolution = Resolution.derive(measurement, preset)
    last = max(truth.particles)

    def height(law: Law, values: Mapping[str, float], seed: int) -> Any:
        x = truth.start(resolution.spacing, seed)
        given = {"friction_angle": angle, **values}
        run = simulate(measurement, x, given, law=law, resolution=resolution, frames=[last], device=device)[0]
        return truth.heights(run.positions[-1], resolution.spacing**3)

    base = [height(Law(), {}, seed) for seed in range(seeds)]
    chance = np.sqrt(np.mean([np.mean((b - np.mean(base, axis=0)) ** 2) for b in base]) * seeds / max(seeds - 1, 1))
    changes = {}
    for name, effect in simulated().items():
        effect = effect.for_measurement(measurement)
        runs = [height(Law([effect]), acting(effect), seed) - base[seed] for seed in range(seeds)]
        changes[name] = np.mean(runs, axis=0)
        print(f"{name}: {1e3 * np.sqrt(np.mean(changes[name] ** 2)):.1f} mm", flush=True)
    return {"base": np.mean(base, axis=0), "chance": float(chance), "changes": changes}


def figure(result: Mapping[str, Any], truth: Truth) -> Figure:
    """The base law's bed, and beside it how each effect changes it."""
    from matplotlib.figure import Figure

    bed = truth.measurement.bed
    extent = (bed.lower[0], bed.upper[0], bed.lower[1], bed.upper[1])
    panels = {"base law": result["base"], **result["changes"]}
    rows = -(-len(panels) // 4)
    drawn = Figure(figsize=(12.0, 2.0 * rows), layout="constrained")
    axes = drawn.subplots(rows, 4, squeeze=False).reshape(-1)
    for ax in axes:
        ax.set_axis_off()
    for ax, (name, data) in zip(axes, panels.items(), strict=False):
        base = name == "base law"
        image = ax.imshow(
            1e3 * data,
            extent=extent,
            origin="lower",
            cmap="viridis" if base else "RdBu_r",
            **({} if base else {"vmin": -15.0, "vmax": 15.0}),
        )
        size = "" if base else ", ".join(f"{v:g}" for v in acting(library()[name]).values())
        ax.set_title(f"{name} {size}", fontsize=9)
        drawn.colorbar(image, ax=ax, shrink=0.7, label="mm" if base else "change, mm")
    return drawn


@wp.func
def _unchanged(
    stress: Stress,
    gradient: wp.mat33,
    bulk: float,
    shear: float,
    dt: float,
    values: wp.array2d(dtype=float),  # type: ignore[valid-type]
    row: int,
) -> Stress:
    return stress


def costs(truth: Truth, preset: str, frames: int = 3) -> dict[str, float]:
    """On the CPU: share of the law in a step, and the step's time over the base law's with effects on."""
    measurement = truth.measurement
    resolution = Resolution.derive(measurement, preset)
    x = truth.start(resolution.spacing, 0)

    def solver(effects: Sequence[Effect]) -> Solver:
        values: dict[str, float] = {}
        for effect in effects:
            values |= acting(effect)
        bed = measurement.bed
        law, base = Law(effects), base_settings(measurement)
        return Solver(x[None], bed.lower, bed.upper, measurement.tool.mesh, resolution, law, base, [values])

    def advance(run: Solver) -> float:
        start = run.frame * resolution.frame_time
        poses = step_poses(measurement.tool.motion, start, resolution.frame_time, resolution.steps)
        began = time.perf_counter()
        run.advance(poses)
        return time.perf_counter() - began

    every = [e for n, e in simulated().items() if e.strength is not None and n != "compaction"]
    runs = {"base": solver([])} | {e.name: solver([e]) for e in every} | {"all": solver(every)}
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for k in range(frames + 1):
        for name, run in runs.items():
            seconds = advance(run)
            if k > 0:
                spent[name].append(seconds)
    least = {name: min(seconds) for name, seconds in spent.items()}

    run = runs["base"]
    substeps = resolution.steps * resolution.substeps(resolution.steps)
    with_law = _stress_seconds(run, run._stress_kernel)
    without = _stress_seconds(run, make_stress_kernel(_unchanged, False))
    result = {f"{name} / base": seconds / least["base"] for name, seconds in least.items() if name != "base"}
    return {
        "particles": float(len(x)),
        "base, ms a substep": 1e3 * least["base"] / substeps,
        "law's share of a step": (with_law - without) * substeps / least["base"],
    } | result


def _stress_seconds(run: Solver, kernel: Any) -> float:
    r, c = run.resolution, run._cells
    inputs = [c, run._nodes, run.grid, r.bulk, r.shear, BULK_VISCOSITY, 1.0e-9, run._table]
    count = int(c.count.numpy()[0])
    command = wp.launch(kernel, dim=count, inputs=inputs, device=run.device, record_cmd=True)
    best = np.inf
    for _ in range(7):
        began = time.perf_counter()
        for _ in range(20):
            command.launch()
        best = min(best, (time.perf_counter() - began) / 20)
    return float(best)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, or measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path, nargs="?", help="measurement set with its true particles")
    parser.add_argument("--table", action="store_true", help="print the table of all effects")
    parser.add_argument("--costs", action="store_true", help="measure what effects cost on the CPU")
    parser.add_argument("--pictures", type=Path, metavar="FILE", help="draw what every effect does to the bed")
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--angle", type=float, default=35.0, help="friction angle of the pictures, degrees")
    parser.add_argument("--seeds", type=int, default=3, help="particle seeds that the pictures average over")
    parser.add_argument("--device", default="cpu", help="of the pictures")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    if options.table:
        print(table())
    if (options.costs or options.pictures) and options.set is None:
        parser.error("--costs and --pictures need a measurement set")
    if options.costs:
        print(json.dumps(costs(Truth.load(options.set), options.preset), indent=1))
    if options.pictures:
        import io

        truth = Truth.load(options.set)
        result = pictures(truth, options.preset, options.angle, options.device, options.seeds)
        print(f"chance: {1e3 * result['chance']:.1f} mm")
        stream = io.BytesIO()
        figure(result, truth).savefig(stream, format=options.pictures.suffix[1:] or "png", dpi=110)
        write_bytes(options.pictures, stream.getvalue())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
