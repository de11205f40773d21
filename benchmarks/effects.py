"""The library of effects: its table, what each does to a ploughed bed, or to the video of one.

Every effect has five times its smallest meaningful size; the others of its parameters have their defaults. The bed is
that of a measurement set which carries its true particles.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from splatsoil.benchmarks._common import here
from splatsoil.benchmarks.numerics import Truth

from splatsoil.files import write_bytes
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import Resolution, simulate
from splatsoil.parameters import Parameter
from splatsoil.reconstruction import reconstruct
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
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
    return {n: e for n, e in library().items() if not e.observes}


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


def reported(measurement: Measurement, angle: float, device: str) -> dict[str, Any]:
    """Pictures (h, w, 3) of the first camera while the tool is fast, in grey levels: as is, and what effects change."""
    motion = measurement.tool.motion
    speed = np.linalg.norm(np.gradient(motion.positions, motion.times, axis=0), axis=1)
    at = {int(f): float(np.interp(f / measurement.frame_rate, motion.times, speed)) for f in measurement.frames}
    frame = max(at, key=lambda f: (round(at[f], 3), f))
    camera = next(iter(measurement.cameras))
    scene = reconstruct(measurement, preset="tiny", device=device)
    names = [name for name, effect in library().items() if effect.observes]
    model = Model(measurement, scene, effects=names, preset="tiny", device=device, frames=[frame])
    trajectory = model.simulate({"friction_angle": angle})

    def seen(values: Mapping[str, float]) -> Any:
        return 255.0 * np.asarray(model.draw(trajectory, 0, values)[camera, frame], dtype=np.float64)

    base = seen({})
    effects = {name: library()[name].for_measurement(measurement) for name in names}
    return {"base": base, "changes": {name: seen(acting(effect)) - base for name, effect in effects.items()}}


def film(result: Mapping[str, Any]) -> Figure:
    """The picture as it is, and beside it what each observation effect changes in brightness."""
    from matplotlib.figure import Figure

    changes = result["changes"]
    rows = -(-(1 + len(changes)) // 4)
    drawn = Figure(figsize=(12.0, 2.2 * rows), layout="constrained")
    axes = drawn.subplots(rows, 4, squeeze=False).reshape(-1)
    for ax in axes:
        ax.set_axis_off()
    axes[0].imshow(np.clip(result["base"] / 255.0, 0.0, 1.0))
    axes[0].set_title("as it is", fontsize=9)
    for ax, (name, change) in zip(axes[1:], changes.items(), strict=False):
        image = ax.imshow(change.mean(axis=2), cmap="RdBu_r", vmin=-25.0, vmax=25.0)
        p = library()[name].parameters[0]
        (value,) = acting(library()[name]).values()
        ax.set_title(f"{name}: {p.name} {value:g}" + ("" if p.unit == "1" else f" {p.unit}"), fontsize=9)
        drawn.colorbar(image, ax=ax, shrink=0.7, label="change, grey levels")
    return drawn


def main(arguments: list[str] | None = None) -> int:
    """Print the table, or measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path, nargs="?", help="measurement set with its true particles")
    parser.add_argument("--table", action="store_true", help="print the table of all effects")
    parser.add_argument("--pictures", type=Path, metavar="FILE", help="draw what every effect does to the bed")
    parser.add_argument("--video", type=Path, metavar="FILE", help="draw what observation effects do to a frame")
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--angle", type=float, default=35.0, help="friction angle of the pictures, degrees")
    parser.add_argument("--seeds", type=int, default=3, help="particle seeds that the pictures average over")
    parser.add_argument("--device", type=here, default="cpu", help="of the pictures")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    if options.table:
        print(table())
    if (options.video or options.pictures) and options.set is None:
        parser.error("--video and --pictures need a measurement set")
    if options.video:
        _save(film(reported(Measurement.load(options.set), options.angle, options.device)), options.video)
    if options.pictures:
        truth = Truth.load(options.set)
        result = pictures(truth, options.preset, options.angle, options.device, options.seeds)
        print(f"chance: {1e3 * result['chance']:.1f} mm")
        _save(figure(result, truth), options.pictures)
    return 0


def _save(drawn: Figure, file: Path) -> None:
    stream = io.BytesIO()
    drawn.savefig(stream, format=file.suffix[1:] or "png", dpi=110)
    write_bytes(file, stream.getvalue())


if __name__ == "__main__":
    raise SystemExit(main())
