"""The same scene in an explicit MLS-MPM written in Taichi, see :mod:`splatsoil.benchmarks._speed.sand_taichi`."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks._speed.clock import repeated, side_by_side
from splatsoil.benchmarks._speed.rows import BUSY, Group, Row, Sample, at_least, had, missing
from splatsoil.benchmarks._speed.scenes import FloatArray, Plough, explicit, height_error

from splatsoil.errors import RunError, SimulationError
from splatsoil.mpm import Trajectory

TARGET = 3.0
"""Times as fast as the other that we want to be."""
COURANT = 0.65
"""Of its step: half of the largest at which the example's bed lies still (1.3; at 1.4 it bounces), as our substeps are
half of the largest that ours allows."""
SHORT = 5
"""Frames of the rows that don't take the whole run."""


@dataclass(frozen=True)
class Run:
    """What a run left.

    Attributes:
        version: of Taichi.
        wall: seconds of each frame.
        used: CPU seconds of each frame.
        positions: particles by recorded frame, and at the end.
        state: what :func:`~splatsoil.benchmarks._speed.sand_taichi.build` tells at the end.
    """

    version: str
    wall: FloatArray
    used: FloatArray
    positions: dict[int, FloatArray]
    state: dict[str, Any]


def installed() -> bool:
    """Whether Taichi can be found."""
    return importlib.util.find_spec("taichi") is not None


def run(
    scene: Mapping[str, Any], frames: int, threads: int = 1, atomic: bool = False, record: Sequence[int] = ()
) -> Run:
    """Run a scene in a process of its own.

    Raises:
        RunError: Taichi is missing.
        SimulationError: the process failed, or particles left the numbers.
    """
    if not installed():
        raise RunError("the package taichi is missing; install it: pip install 'splatsoil[speed]'")
    # by its path, not as a module: so nothing of the package is imported there
    program = Path(__file__).with_name("sand_taichi.py")
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder) / "scene.npz", Path(folder) / "result.npz"
        np.savez(source, **scene)
        words = [str(program), str(source), str(result), "--threads", str(threads), "--frames", str(frames)]
        words += ["--atomic"] if atomic else []
        words += ["--record", *map(str, record)] if record else []
        paths = [place for place in sys.path if place]
        done = subprocess.run(
            [sys.executable, "-c", _START.format(paths=paths), *words], capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise SimulationError(f"the program in Taichi failed: {' '.join(done.stderr.strip().splitlines()[-1:])}")
        with np.load(result) as file:
            found = dict(file)
    positions = {int(name[1:]): x.astype(np.float64) for name, x in found.items() if name[1:].isdigit()}
    state = {k: found[k] for k in ("positions", "momentum", "mass", "grid_mass", "fastest")}
    positions[frames] = state["positions"].astype(np.float64)
    if not np.isfinite(positions[frames]).all():
        raise SimulationError("the program in Taichi: particles are no numbers")
    return Run(str(found["version"]), found["wall"], found["used"], positions, state)


#: Runs the file named first with the paths of this process behind its own, none of them the file's folder: a module
#: there has a name that others have, too.
_START = (
    "import runpy, sys; sys.path[1:] = {paths!r}; del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


def compare(scene: Plough, repeats: int) -> Group:
    """Whole runs on one core, and two at a time on two."""
    title, target = "Solver against an explicit MLS-MPM in Taichi", f"≥ {TARGET:g} times as fast"
    if not installed():
        why = "the package taichi is missing; install it: pip install 'splatsoil[speed]'"
        return Group(title, (missing(f"{scene.name}, {scene.last} frames", why, target),))
    told = explicit(scene, COURANT)
    n, last = len(scene.x), scene.last
    frames = tuple(sorted(f for f in (scene.truth.particles if scene.truth else ()) if 0 < f < last))
    steps = int(told["frame_steps"])
    label = f"explicit, {last * steps} steps"
    whole = run(told, last, record=frames)
    usual = run(told, SHORT, atomic=True)
    pair = run(told, SHORT, threads=2)
    found: list[Trajectory] = []
    ours = repeated(lambda: found.extend(scene.run(frames=(*frames, last))), max(1, repeats - 1), warm=0)
    both = side_by_side([lambda: scene.run()] * 2, 1, "two side by side")
    recorded = found[0]
    work = 1e-6 * n
    rows = [
        Row(
            f"{scene.name}, {last} frames, one core",
            "s",
            ours,
            Sample((float(whole.used.sum()),), label),
            target=target,
        ),
        Row(
            "the same, atomic additions on one grid as Taichi programs usually have them",
            "s",
            ours,
            Sample((last * float(np.median(usual.used)),), f"from {SHORT} frames"),
            target=target,
        ),
        Row("two such runs on two cores", "s", both, _two(whole, pair, last), target=target),
        Row(
            "particle-steps on one core",
            "M/s",
            ours.inverted(work * scene.substeps),
            Sample(tuple(work * steps / s for s in _blocks(whole.used)), "", None),
            "more",
        ),
    ]
    errors = [
        height_error(scene, states)
        for states in (
            dict(zip(recorded.frames, recorded.positions.astype(np.float64), strict=True)),
            whole.positions,
        )
    ]
    notes = [
        f"Taichi {whole.version}: {n} particles, the same grid, stiffness, law, motion and first stress, float32; "
        "quadratic splines, a stress point on every particle, an exchange in every step. Its step is "
        f"{1e6 * told['step']:.0f} µs: a wave goes {COURANT:g} cells in it, half of what still leaves the bed at rest; "
        "our substeps are half of their limit, too. Each thread gathers on a grid of its own, without atomic "
        "additions, except in the second row.",
    ]
    if None not in errors:
        notes.append(
            f"Not the same accuracy: heights at the set's true frames are {errors[0]:.1f} mm off with ours and "
            f"{errors[1]:.1f} mm with the other (why: docs/numerics.md)."
        )
    return Group(title, tuple(_judged(row) for row in rows), tuple(notes))


def _two(whole: Run, pair: Run, frames: int) -> Sample:
    """Seconds of two runs on two cores in the faster of two ways: on two threads one after the other, or one on each
    core, for which we take the time of one alone, though memory and cache are shared."""
    threads = 2 * frames * float(np.median(pair.wall))
    alone = float(whole.used.sum())
    if threads < alone:
        return Sample((threads,), f"one after the other on two threads, from {SHORT} frames")
    return Sample((alone,), "side by side, each as fast as one alone")


def _blocks(values: FloatArray, count: int = 5) -> list[float]:
    """Means of a run's frames in a few pieces."""
    return [float(part.mean()) for part in np.array_split(values, count) if len(part)]


def _judged(row: Row) -> Row:
    if not row.target or row.ours is None:
        return row
    held = at_least(row.ratio, TARGET)
    busy = row.ours.cores is not None and row.ours.cores < 2.0 * BUSY
    return replace(row, met=None if busy and not held else held, note=row.note or had(row.ours, 2))
