"""The library of effects: its table, what each does to a ploughed bed, or to the video of one.

Every effect has five times its smallest meaningful size; the others of its parameters have their defaults. The bed is
that of a measurement set which carries its true particles.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from splatsoil.benchmarks._common import FloatArray, markdown, parser_of, sized, write_figure
from splatsoil.benchmarks._truth import Truth

from splatsoil.errors import SimulationError
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.parameters import Parameter
from splatsoil.quiet import hush
from splatsoil.reconstruction import reconstruct
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import library

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIMES_MEANINGFUL = 5.0
ANGLE = 35.0
"""Of the soil in pictures, degrees."""
SEEDS = range(3)
"""Of the particles, that pictures average over."""


def table() -> str:
    """Markdown table of the whole library."""
    head = ("effect", "what it is", "parameters: default; bounds; smallest meaningful", "source")
    rows = [
        (f"`{name}`", effect.note, "<br>".join(map(_described, effect.parameters)), effect.source)
        for name, effect in library().items()
    ]
    return markdown(head, rows)


def _described(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit}"
    sign = {1: ", only larger", -1: ", only smaller"}.get(p.sign, "")
    off = "shape" if p.off is None else f"off at {p.off:g}{sign}"
    scale = ", log" if p.log else ""
    return f"`{p.name}`: {p.default:g}{unit} ({off}); {p.lower:g} … {p.upper:g}{scale}; {p.meaningful:g}"


def acting(effect: Effect) -> dict[str, float]:
    """The effect's size at five times its smallest meaningful one."""
    return {effect.size: sized(effect.parameters[0], TIMES_MEANINGFUL)}


def strong() -> list[str]:
    """Names of effects on strength that act together: of those that exclude each other, the first."""
    effects, chosen = library(), list[str]()
    for name, effect in effects.items():
        excluded = {*effect.conflicts, *(n for n in chosen if name in effects[n].conflicts)}
        if effect.strength is not None and not excluded.intersection(chosen):
            chosen.append(name)
    return chosen


def heights(truth: Truth, preset: str, device: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Heights (ny, nx), m, of the last frame by the base law, and what each effect changes; scatter is printed."""
    measurement = truth.measurement
    resolution = Resolution.derive(measurement, preset)

    def height(law: Law, values: Mapping[str, float], seed: int) -> FloatArray:
        x, given = truth.start(resolution.spacing, seed), {"friction_angle": ANGLE, **values}
        frames = [max(truth.particles)]
        run = simulate(measurement, x, given, law=law, resolution=resolution, frames=frames, device=device)[0]
        return truth.heights(run.positions[-1], resolution.spacing**3)

    base = np.array([height(Law(), {}, seed) for seed in SEEDS])
    print(f"seed-to-seed scatter: {1e3 * np.sqrt(base.var(axis=0, ddof=1).mean()):.1f} mm", flush=True)
    changes = {}
    for name, effect in library().items():
        if not effect.observes:
            law, values = Law([effect.for_measurement(measurement)]), acting(effect)
            try:
                found = [height(law, values, seed) for seed in SEEDS]
            except SimulationError as error:  # a coarse grid does not bear every size
                print(f"{name}: left out: {error}", file=sys.stderr)
                continue
            changes[name] = np.mean(found - base, axis=0)
            print(f"{name}: {1e3 * np.sqrt(np.mean(changes[name] ** 2)):.1f} mm", flush=True)
    return base.mean(axis=0), changes


def reported(measurement: Measurement, device: str) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Picture (h, w, 3) of the first camera while the tool is fast, in grey levels: as is, and what effects change."""
    motion = measurement.tool.motion
    speed = np.linalg.norm(np.gradient(motion.positions, motion.times, axis=0), axis=1)
    at = {int(f): float(np.interp(f / measurement.frame_rate, motion.times, speed)) for f in measurement.frames}
    frame = max(at, key=lambda f: (round(at[f], 3), f))
    camera = next(iter(measurement.cameras))
    scene = reconstruct(measurement, preset="tiny", device=device)
    names = [name for name, effect in library().items() if effect.observes]
    model = Model(measurement, scene, effects=names, preset="tiny", device=device, frames=[frame])
    trajectory = model.simulate({"friction_angle": ANGLE})

    def seen(values: Mapping[str, float]) -> FloatArray:
        return 255.0 * np.asarray(model.draw(trajectory, 0, values)[camera, frame], dtype=np.float64)

    base = seen({})
    return base, {name: seen(acting(library()[name].for_measurement(measurement))) - base for name in names}


def figure(first: FloatArray, title: str, changes: Mapping[str, FloatArray], limit: float, unit: str) -> Figure:
    """A map or picture as it is, and beside it what each effect changes, between ``limit`` downwards and upwards."""
    from matplotlib.figure import Figure

    rows = -(-(1 + len(changes)) // 4)
    drawn = Figure(figsize=(12.0, 2.1 * rows), layout="constrained")
    axes = drawn.subplots(rows, 4, squeeze=False).reshape(-1)
    for ax in axes:
        ax.set_axis_off()
    origin = "lower" if first.ndim == 2 else "upper"
    image = axes[0].imshow(first, origin=origin)
    axes[0].set_title(title, fontsize=9)
    if first.ndim == 2:
        drawn.colorbar(image, ax=axes[0], shrink=0.7, label=unit)
    for ax, (name, change) in zip(axes[1:], changes.items(), strict=False):
        image = ax.imshow(change, origin=origin, cmap="RdBu_r", vmin=-limit, vmax=limit)
        ((parameter, value),) = acting(library()[name]).items()
        ax.set_title(f"{name}: {parameter} {value:g}", fontsize=9)
        drawn.colorbar(image, ax=ax, shrink=0.7, label=f"change, {unit}")
    return drawn


def main(arguments: list[str] | None = None) -> int:
    """Print the table, or measure."""
    parser = parser_of(__doc__)
    parser.add_argument("set", type=Path, nargs="?", help="measurement set with its true particles")
    parser.add_argument("--table", action="store_true", help="print the table of all effects")
    parser.add_argument("--pictures", type=Path, metavar="FILE", help="draw what every effect does to the bed")
    parser.add_argument("--video", type=Path, metavar="FILE", help="draw what observation effects do to a frame")
    parser.add_argument("--preset", default="tiny", choices=sorted(PRESETS), help="of the bed's simulations")
    options = parser.parse_args(arguments)
    if (options.video or options.pictures) and options.set is None:
        parser.error("--video and --pictures need a measurement set")
    hush()
    if options.table:
        print(table())
    if options.video:
        base, changes = reported(Measurement.load(options.set), options.device)
        grey = {name: change.mean(axis=2) for name, change in changes.items()}
        write_figure(options.video, figure(np.clip(base / 255.0, 0.0, 1.0), "as it is", grey, 25.0, "grey levels"))
    if options.pictures:
        bed, changes = heights(Truth.load(options.set), options.preset, options.device)
        mm = {name: 1e3 * change for name, change in changes.items()}
        write_figure(options.pictures, figure(1e3 * bed, "base law", mm, 15.0, "mm"))
    return 0
