"""How fast is a simulation? Times, each beside another in the same run; for the whole path see `whole-path`.

``splatsoil benchmark speed --page docs/performance.md`` writes the CPU's section, with ``--device cuda:0`` the GPU's.
Newton (extra ``independent``) is measured where it is installed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
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

from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.quiet import hush
from splatsoil.reconstruction import fill
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.synthetic import paper

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
class Scene:
    """A bed that our solver ploughs.

    Attributes:
        measurement: bed, tool and motion.
        resolution: of the solver.
        x: particles (n, 3) in m.
        values: parameters by name.
        last: the run ends with this frame.
    """

    measurement: Measurement
    resolution: Resolution
    x: FloatArray
    values: Mapping[str, float]
    last: int

    @property
    def particle_steps(self) -> float:
        """Particles times substeps of the grid in the whole run."""
        r = self.resolution
        return float(len(self.x)) * self.last * r.steps * r.substeps(r.steps)

    def run(self, device: str, batch: int = 1, effects: Sequence[Effect] = (), last: int = 0) -> None:
        """The whole run, or up to a frame, with effects on; the sets of a batch differ by their friction angles."""
        values = {**self.values, **{key: value for effect in effects for key, value in acting(effect).items()}}
        each = [{**values, "friction_angle": values["friction_angle"] + 0.5 * k} for k in range(batch)]
        law, frames = Law(effects), (last or self.last,)
        simulate(self.measurement, self.x, each, law=law, resolution=self.resolution, frames=frames, device=device)


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
    def scene(self) -> Scene:
        """The set with its true angle."""
        truth, resolution = self.truth, Resolution.derive(self.truth.measurement, self.preset)
        x, angle = truth.start(resolution.spacing, 0), {"friction_angle": truth.values["friction_angle"]}
        return Scene(truth.measurement, resolution, x, angle, max(truth.particles))


def published_scene() -> Scene:
    """The scene of the published table on cells of its size; its plate's thickness and frictions are the example's."""
    setup, measurement = paper(), paper().experiment()
    resolution = Resolution.derive(measurement, "paper")
    x = fill(setup.surface, setup.bed, resolution.spacing, seed=0)
    return Scene(measurement, resolution, x, {"friction_angle": 35.0}, max(setup.frames))


def simulation(task: Task) -> Section:
    """Whole runs: one alone, and several at a time. A particle-step is a particle times a substep of the grid."""
    scene, device, rows = task.scene, task.device, []
    cases = {scene.measurement.name: scene}
    if device != "cpu":
        cases["the published scene"] = published_scene()
    for name, one in cases.items():
        alone = timed(partial(one.run, device), task.repeats, device)
        what = f"{name}: {len(one.x)} particles, {one.last} frames"
        rows.append(Row(what, f"{shown(alone)}; {1e-6 * one.particle_steps / np.median(alone):.3g} M particle-steps/s"))
        if device != "cpu":
            batch = timed(partial(one.run, device, BATCH), task.repeats, device)
            each = ratio(batch, BATCH * alone, "one after the other")
            rows.append(Row(f"{name}: {BATCH} parameter sets as one batch", each))
    if device == "cpu":
        with ThreadPoolExecutor(2) as pool:
            pair = timed(lambda: list(pool.map(scene.run, ["cpu"] * 2)), task.repeats, "cpu")
        rows.append(Row("two runs side by side on two cores", ratio(pair, 2.0 * alone, "one after the other")))
    return Section("Simulation", rows)


def newton(task: Task) -> Section:
    """The whole run with ours, and in Newton's implicit MPM by pieces of it, from the true particles there."""
    scene, truth = task.scene, task.truth
    numerics = Numerics(voxel=scene.resolution.cell, substeps=2, iterations=120, tolerance=1e-4)
    rng, seconds = np.random.default_rng(0), []
    for start in (w for w in WINDOWS if w in truth.particles):
        # as many particles as ours, which stand for as much soil
        x = rng.permutation(truth.particles[start])[: len(scene.x)]
        soil = Soil(truth.measurement, scene.values["friction_angle"], x, scene.resolution.spacing)
        ends: list[float] = []
        plough(
            [soil], numerics, (start + 1 + FRAMES,), task.device, begin=start,
            progress=lambda *_, ends=ends: ends.append(time.perf_counter()),
        )  # fmt: skip
        seconds.append(np.diff(ends))  # the first frame compiles, and lets stress build up
    whole = scene.last * np.mean(seconds, axis=0)
    ours = timed(partial(scene.run, task.device), task.repeats, task.device)
    held = bool(np.median(whole) >= 20.0 * np.median(ours))
    row = Row(f"{scene.measurement.name}, {scene.last} frames", ratio(ours, whole, "Newton"), "≥ 20 ×", held)
    return Section("Against Newton's implicit MPM", [row])


def effects(task: Task) -> Section:
    """Steps with all effects on strength that act together, over the base law's: least times, on the CPU."""
    names = strong()
    base, whole = (
        timed(partial(task.scene.run, "cpu", effects=on, last=FEW), task.repeats, "cpu").min()
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
