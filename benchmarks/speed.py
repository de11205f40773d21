"""How fast is a simulation? Times, each beside another in the same run; for the whole path see `whole-path`.

``splatsoil benchmark speed --page docs/performance.md`` writes the CPU's section, with ``--device cuda:0`` the GPU's.
Newton (extra ``independent``) is measured where it is installed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from splatsoil.benchmarks._common import FloatArray, at_least, sources, stamp
from splatsoil.benchmarks._newton import Numerics, Soil, plough
from splatsoil.benchmarks._parts import Row, Section, parts_parser, run_parts
from splatsoil.benchmarks._truth import Truth
from splatsoil.benchmarks.effects import acting, strong

from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.quiet import hush
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

BATCH = 16
"""Parameter sets of one batch on a GPU."""
WINDOWS, FRAMES = (0, 50, 150), 3
"""Frames at which pieces of Newton's run begin (soil at rest, pushed, tool drawn back), and how many of each count."""
FEW = 15
"""Frames that laws are compared by."""


def shown(times: FloatArray) -> str:
    """Median of repetitions (n,) in s, ± half of what lies between the least and the largest."""
    factor, unit = (1e3, "ms") if np.median(times) < 0.1 else (1.0, "s")
    spread = f" ± {0.5 * factor * np.ptp(times):.2g}" if len(times) > 1 else ""
    return f"{factor * np.median(times):.3g}{spread} {unit}"


def ratio(times: FloatArray, other: FloatArray, name: str) -> str:
    """A time, the other's by its name, and how many times as fast the first is."""
    faster = np.median(other) / np.median(times)
    return f"{shown(times)}; {name} {shown(other)}: {f'{faster:.0f}' if faster >= 100 else f'{faster:.3g}'} × as fast"


def timed(task: Callable[[], object], repeats: int, device: str) -> FloatArray:
    """The clock's times (repeats,) in s, after a call that compiles and does not count."""
    times = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        task()
        if device != "cpu":
            wp.synchronize_device(device)
        times.append(time.perf_counter() - began)
    return np.array(times[1:])


@dataclass(frozen=True)
class Task:
    """What parts are made with: a measurement set with true particles, a preset, a device, and repetitions."""

    folder: Path
    preset: str
    device: str
    repeats: int

    @cached_property
    def truth(self) -> Truth:
        """The set's."""
        return Truth.load(self.folder)

    @cached_property
    def resolution(self) -> Resolution:
        """Of our solver."""
        return Resolution.derive(self.truth.measurement, self.preset)

    @cached_property
    def x(self) -> FloatArray:
        """(n, 3) particles in m."""
        return self.truth.start(self.resolution.spacing, 0)

    @property
    def last(self) -> int:
        """The run ends with this frame."""
        return max(self.truth.particles)

    def run(self, device: str, batch: int = 1, effects: Sequence[Effect] = (), last: int = 0) -> None:
        """The whole run, or up to a frame, with effects on; the sets of a batch differ by their friction angles."""
        angle, values = self.truth.values["friction_angle"], {k: v for e in effects for k, v in acting(e).items()}
        each = [{**values, "friction_angle": angle + 0.5 * k} for k in range(batch)]
        given, frames, law = self.truth.measurement, (last or self.last,), Law(effects)
        simulate(given, self.x, each, law=law, resolution=self.resolution, frames=frames, device=device)


def simulation(task: Task) -> Section:
    """Whole runs: one alone, and several at a time. A particle-step is a particle times a substep of the grid."""
    device, name, r = task.device, task.truth.measurement.name, task.resolution
    alone = timed(partial(task.run, device), task.repeats, device)
    steps = 1e-6 * len(task.x) * task.last * r.steps * r.substeps(r.steps) / np.median(alone)
    what = f"{name}: {len(task.x)} particles, {task.last} frames"
    rows = [Row(what, f"{shown(alone)}; {steps:.3g} M particle-steps/s")]
    if device == "cpu":
        with ThreadPoolExecutor(2) as pool:
            several = timed(lambda: list(pool.map(task.run, ["cpu"] * 2)), task.repeats, "cpu")
        count, what = 2, "two runs side by side on two cores"
    else:
        several = timed(partial(task.run, device, BATCH), task.repeats, device)
        count, what = BATCH, f"{BATCH} parameter sets as one batch"
    return Section("Simulation", [*rows, Row(what, ratio(several, count * alone, "one after the other"))])


def newton(task: Task) -> Section:
    """The whole run with ours, and in Newton's implicit MPM by pieces of it, from the true particles there."""
    truth, spacing = task.truth, task.resolution.spacing
    numerics = Numerics(voxel=task.resolution.cell, substeps=2, iterations=120, tolerance=1e-4)
    rng, seconds = np.random.default_rng(0), []
    for start in (w for w in WINDOWS if w in truth.particles):
        # as many particles as ours, which stand for as much soil
        x = rng.permutation(truth.particles[start])[: len(task.x)]
        soil = Soil(truth.measurement, truth.values["friction_angle"], x, spacing)
        ends: list[float] = []
        plough(
            [soil], numerics, (start + 1 + FRAMES,), task.device, begin=start,
            progress=lambda *_, ends=ends: ends.append(time.perf_counter()),
        )  # fmt: skip
        seconds.append(np.diff(ends))  # the first frame compiles, and lets stress build up
    whole = task.last * np.mean(seconds, axis=0)
    ours = timed(partial(task.run, task.device), task.repeats, task.device)
    held = bool(np.median(whole) >= 20.0 * np.median(ours))
    row = Row(f"{truth.measurement.name}, {task.last} frames", ratio(ours, whole, "Newton"), "≥ 20 ×", held)
    return Section("Against Newton's implicit MPM", [row])


def effects(task: Task) -> Section:
    """Steps with all effects on strength that act together, over the base law's: least times, on the CPU."""
    names = strong()
    base, whole = (
        timed(partial(task.run, "cpu", effects=on, last=FEW), task.repeats, "cpu").min()
        for on in ((), find_effects(names))
    )
    found, what = whole / base, f"{FEW} frames with {len(names)} effects on strength, over the base law's"
    return Section("What effects cost", [Row(what, f"{found:.2f}", "≤ 2", bool(found <= 2.0))])


PARTS = (simulation, newton, effects)
"""In the page's order."""


def main(arguments: list[str] | None = None) -> int:
    """Measure the parts that are asked for, print their tables, and write the device's section of a page."""
    parser = parts_parser(__doc__, "runs/speed")
    parser.add_argument("--set", type=Path, default=Path("examples/plow-dry"), help="with true particles")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS), help="of the solver")
    parser.add_argument("--repeats", type=at_least(1), default=3, help="of what takes seconds")
    options = parser.parse_args(arguments)
    hush()
    task = Task(options.set, options.preset, options.device, options.repeats)
    made = stamp(options.device)
    key: dict[str, Any] = {name: made.get(name) for name in ("processor", "cores", "gpu")}
    key |= {"code": sources("speed", "_newton", "effects"), "set": task.truth.measurement.hash}
    key |= {"preset": task.preset, "repeats": task.repeats}
    options.out = options.out / made["device"]
    measured = [part for part in PARTS if part is not newton or find_spec("newton")]
    parts = {part.__name__.replace("_", "-"): partial(part, task) for part in measured}
    return run_parts(options, parts, lambda _: key, f"speed {made['device']}")
