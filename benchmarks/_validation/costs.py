"""Part ``costs``: what the law and its effects cost in time, and what an effect that is off leaves behind: nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import warp as wp
from splatsoil.benchmarks._validation.page import Row, Section
from splatsoil.benchmarks._validation.scene import STILL, Scene, lattice, resolution
from splatsoil.benchmarks.effects import acting

from splatsoil.errors import SimulationError
from splatsoil.mpm import Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law, Stress
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.settings import Settings

LAWS_SHARE = 0.4
"""Most of a step's time that the law may take."""
ALL_EFFECTS = 2.0
"""Most that a step with all effects on strength may take, over the base law's."""
COMPILING = 30.0
"""Most seconds that a new combination may take to compile."""
ELEMENT = 1.0
"""Most seconds for ``STEPS`` steps of a triaxial test on ``SETS`` sets of parameters."""
STEPS, SETS = 10_000, 100
SPEED = np.array([0.3, 0.0, 0.0])
ROUNDS = 15
EXCLUDED = ("compaction", "critical_state")
"""Effects that others exclude."""
TOGETHER = {
    "all but compaction and critical state": EXCLUDED,
    "all but dilatancy and critical state": ("dilatancy", "critical_state"),
}


def ploughed(cell: float = 0.015) -> Scene:
    """A bed of 60 x 36 x 12 cm with a plate in it, at the stiffness and step of the preset ``small``."""
    size = (0.6, 0.36, 0.12)
    x = lattice([0.0, 0.0, 0.0], size, 0.5 * cell)
    plate = trimesh.creation.box(extents=[cell, 0.09, 0.1])
    settings = Settings(friction_angle=35.0)
    return Scene(
        x,
        (size[0], size[1], 0.2),
        resolution(cell, float(SPEED[0]), density=1600.0, young=5e5, transport=0.1, way=1.0 / 15.0),
        settings,
        mesh=plate,
    )


def advance(run: Solver, step: int) -> float:
    """Seconds that one step of the plate's way takes."""
    place = np.array([0.15, 0.18, 0.12]) + step * run.resolution.frame_time * SPEED
    began = time.perf_counter()
    run.advance([Pose(place, STILL, SPEED, np.zeros(3))])
    return time.perf_counter() - began


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


@cache
def _lawless() -> Law:
    """A law that does no work: stress stays as it is, and bears the bed's weight."""
    law = Law()
    law.update = _unchanged
    return law


def strong(*without: str) -> tuple[str, ...]:
    """All effects on strength but those that others exclude."""
    return tuple(name for name, effect in library().items() if effect.strength is not None and name not in without)


def step_times() -> dict[str, float]:
    """Least seconds of a step, by what the law does, measured in turns; and the number of particles."""
    scene = ploughed()
    names = {"base": (), **{case: strong(*without) for case, without in TOGETHER.items()}}
    names |= {name: (name,) for name in strong()}
    runs = {}
    for case, effects in names.items():
        values: dict[str, float] = {}
        for effect in find_effects(effects):
            values |= acting(effect)
        runs[case] = replace(scene, effects=effects, values=values).solver("cpu")
    upper, low = scene.upper, np.zeros(3)
    runs["no law"] = Solver(
        scene.x[None], low, upper, scene.mesh, scene.resolution, _lawless(), scene.settings, [{}], "cpu"
    )
    spent: dict[str, list[float]] = {case: [] for case in runs}
    for step in range(ROUNDS):
        for case, run in runs.items():
            seconds = advance(run, step)
            if step > 1:
                spent[case].append(seconds)
    return {case: min(seconds) for case, seconds in spent.items()} | {"particles": float(len(scene.x))}


def element_seconds() -> float:
    """Least seconds of three triaxial tests of ``STEPS`` steps on ``SETS`` sets of parameters, all effects on."""
    law = Law(find_effects(strong(*EXCLUDED)))
    angles = np.linspace(25.0, 45.0, SETS)
    values: dict[str, float] = {}
    for effect in law.effects:
        values |= acting(effect)
    sets = [values | {"friction_angle": float(angle)} for angle in angles]
    strains = np.linspace(0.0, 0.2, STEPS + 1)[1:]
    best = np.inf
    for _ in range(3):
        began = time.perf_counter()
        test = triaxial(law, sets, confining=1e5, strains=strains)
        best = min(best, time.perf_counter() - began)
    assert test.q.shape == (SETS, STEPS + 1)
    return float(best)


def _cache() -> Path:
    """Folder of this process' compiled kernels."""
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    return Path(str(wp.config.kernel_cache_dir))


def compiling() -> dict[str, float]:
    """Run in a process of its own with an empty cache of kernels: seconds of first runs, and modules they compiled."""
    folder = _cache()

    def modules() -> int:
        return sum(1 for _ in folder.glob("*/*.meta"))

    def seconds(effects: Sequence[str], values: Mapping[str, float]) -> float:
        scene = replace(ploughed(0.06), effects=tuple(effects), values=values)
        began = time.perf_counter()
        advance(scene.solver("cpu"), 0)
        triaxial(Law(find_effects(effects)), values, confining=1e5, strains=[0.01])
        return time.perf_counter() - began

    result = {"base": seconds((), {}), "base, modules": float(modules())}
    names = strong(*EXCLUDED)
    values: dict[str, float] = {}
    for effect in find_effects(names):
        values |= acting(effect)
    result["all"] = seconds(names, values)
    before = modules()
    result["all, modules"] = before - result["base, modules"]
    other = {name: 0.5 * value for name, value in values.items()} | {"friction_angle": 28.0}
    result["all, other values"] = seconds(names[::-1], other)
    result["other values, modules"] = float(modules() - before)
    return result


def without_effects() -> dict[str, float]:
    """In a process that cannot import any effect: modules that the base law compiles beside those in the cache."""
    folder = _cache()
    before = set(folder.glob("*/*.meta"))
    scene = ploughed(0.06)
    advance(scene.solver("cpu"), 0)
    triaxial(Law(), {}, confining=1e5, strains=[0.01])
    return {
        "modules": float(len(set(folder.glob("*/*.meta")) - before)),
        "effects": float(sum(name.startswith("splatsoil.soil.effects.") for name in sys.modules)),
    }


#: Makes every effect of the library impossible to import.
BLOCK = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("splatsoil.soil.effects."):
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
"""


def apart(function: str, cache_folder: Path, before: str = "") -> dict[str, float]:
    """What a function of this module returns in a new process whose compiled kernels are kept in ``cache_folder``.

    Raises:
        SimulationError: the process failed.
    """
    code = f"{before}\nimport json\nfrom {__name__} import {function}\nprint('RESULT', json.dumps({function}()))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"WARP_CACHE_PATH": str(cache_folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SimulationError(f"{function} failed in a process of its own: {done.stderr.strip().splitlines()[-1:]}")
    line = next(line for line in done.stdout.splitlines() if line.startswith("RESULT "))
    result: dict[str, float] = json.loads(line.removeprefix("RESULT "))
    return result


def compiled() -> dict[str, Any]:
    """All that is known of compiling: see :func:`compiling` and :func:`without_effects`; and a second process' time."""
    with tempfile.TemporaryDirectory() as folder:
        first = apart("compiling", Path(folder))
        bare = apart("without_effects", Path(folder), BLOCK)
        second = apart("compiling", Path(folder))
    return {"first": first, "bare": bare, "second": second}


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown processor"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown processor")


def validate() -> Section:
    """Times against their targets."""
    times = step_times()
    base, made = times["base"], compiled()
    share = 1.0 - times["no law"] / base
    rows = [Row("the law's share of a step", f"{100 * share:.0f} %", "≤ 40 %", share <= LAWS_SHARE)]
    for case in TOGETHER:
        ratio = times[case] / base
        rows.append(
            Row(f"a step with all effects on strength ({case}) / base", f"{ratio:.2f}", "≤ 2", ratio <= ALL_EFFECTS)
        )
    single = {name: times[name] / base for name in strong()}
    least, most = min(single, key=lambda n: single[n]), max(single, key=lambda n: single[n])
    text = f"{single[least]:.2f} ({least}) to {single[most]:.2f} ({most})"
    rows.append(Row("a step with a single effect on strength / base", text, "reported"))
    first, second, bare = made["first"], made["second"], made["bare"]
    rows.append(
        Row(
            "all effects on strength, first use: kernels compiled, test and simulation",
            f"{first['all']:.1f} s",
            "≤ 30 s",
            first["all"] <= COMPILING,
        )
    )
    again = f"{first['all, other values']:.2f} s; {first['other values, modules']:.0f} modules compiled"
    kept = first["other values, modules"] == 0.0 and first["all, modules"] > 0.0
    rows.append(Row("the same effects in another order, with other values", again, "0 modules compiled", kept))
    rows.append(
        Row(
            "all effects, first use in a new process (kernels on disk)",
            f"{second['all']:.1f} s; {second['all, modules']:.0f} modules compiled",
            "0 modules compiled",
            second["all, modules"] == 0.0,
        )
    )
    rows.append(
        Row(
            "base law in a process that cannot import any effect",
            f"{bare['modules']:.0f} modules compiled that the base law beside the library does not share",
            "0: an effect that is off leaves the same kernel",
            bare["modules"] == 0.0 and bare["effects"] == 0.0,
        )
    )
    seconds = element_seconds()
    rows.append(
        Row(
            f"{STEPS} steps of a triaxial test on {SETS} sets of parameters, all effects",
            f"{seconds:.2f} s",
            "≤ 1 s",
            seconds <= ELEMENT,
        )
    )
    return Section(
        "What it costs",
        f"A plate ploughs a bed of {times['particles']:.0f} particles at the stiffness and step of the preset `small`, "
        f"one core of {processor()}; a step took {1e3 * base:.0f} ms. Least times of {ROUNDS - 2} steps taken in "
        "turns. The law's share is what a step saves when the law is replaced by one that leaves stress as it is.",
        tuple(rows),
        "Times are of the machine at that moment; ratios hang on it less.",
    )
