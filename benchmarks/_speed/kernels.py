"""Where the time of a simulation goes, kernel by kernel."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import warp as wp
from splatsoil.benchmarks._speed.clock import synchronise
from splatsoil.benchmarks._speed.rows import Group, Row, Sample
from splatsoil.benchmarks._speed.scenes import Plough
from splatsoil.benchmarks._validation.costs import _lawless

from splatsoil.mpm import Solver
from splatsoil.soil.law import Law

START, FRAMES = 40, 10
"""First frame that is timed, in the push, and how many."""
SMALLEST = 0.01
"""Share of the whole below which kernels are put together."""

NAMES = {
    "stress_forces": "law, and stress to nodal forces",
    "move_nodes": "motion of the nodes",
    "contact_forces": "contact with the tool",
    "find_gaps": "distances to the tool",
    "particles_to_grid": "particles to grid",
    "grid_to_particles": "grid to particles",
}
OFTEN = ("stress_forces", "move_nodes", "contact_forces")
"""Kernels of a substep; the others run once a step of the particles."""


ALL = (*NAMES, "average_cells", "momentum_to_velocity", "mark_cells", "list_cells", "number_cells", "bound_stretch")


def known(name: str) -> str:
    """Our name of a kernel for the compiler's."""
    return next((key for key in ALL if key in name), name)


class _Recorded:
    """A recorded launch that is timed whenever it runs."""

    def __init__(self, launch: Any, name: str, spent: dict[str, float]) -> None:
        self._launch, self._name, self._spent = launch, name, spent

    def launch(self, *args: Any, **kwargs: Any) -> None:
        began = time.thread_time()
        self._launch.launch(*args, **kwargs)
        self._spent[self._name] += time.thread_time() - began


@contextmanager
def launches() -> Iterator[dict[str, float]]:
    """CPU seconds by kernel of what is launched on a CPU meanwhile."""
    spent: dict[str, float] = defaultdict(float)
    plain = wp.launch

    def timed(kernel: Any, *args: Any, **kwargs: Any) -> Any:
        began = time.thread_time()
        result = plain(kernel, *args, **kwargs)
        if kwargs.get("record_cmd"):
            return _Recorded(result, known(kernel.key), spent)
        spent[known(kernel.key)] += time.thread_time() - began
        return result

    with patch.object(wp, "launch", timed):
        yield spent


def _advance(scene: Plough, solver: Solver, frames: range, device: str) -> float:
    clock = time.thread_time if device == "cpu" else time.perf_counter
    synchronise(device)
    began = clock()
    for frame in frames:
        solver.advance(scene.poses(frame))
    synchronise(device)
    return clock() - began


def kernels(scene: Plough, device: str, law: Law | None = None) -> tuple[float, dict[str, float]]:
    """Seconds of some frames of the push, and of each kernel in them.

    On a GPU the whole is measured without the kernels' own clocks, which slow it.
    """
    # without a law soil doesn't hold: that run starts at rest and takes the window's share of time as it is there
    first = min(START, scene.last // 2)
    window = range(first, min(first + FRAMES, scene.last))
    solver = scene.solver(device, law)
    _advance(scene, solver, range(0 if law is None else first, first), device)
    if device == "cpu":
        with launches() as spent:
            return _advance(scene, solver, window, device), dict(spent)
    whole = _advance(scene, solver, window, device)
    solver = scene.solver(device, law)
    _advance(scene, solver, range(0 if law is None else first, first), device)
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL | wp.TIMING_MEMSET | wp.TIMING_MEMCPY)
    _advance(scene, solver, window, device)
    found: dict[str, float] = defaultdict(float)
    for result in wp.timing_end():
        found[known(result.name)] += 1e-3 * result.elapsed
    return whole, dict(found)


def profile(scene: Plough, device: str) -> Group:
    """The rows: kernels from the most expensive on, what is left between them, and the law's share of all."""
    whole, spent = kernels(scene, device)
    frames = min(FRAMES, scene.last - min(START, scene.last // 2))
    rows, small = [], 0.0
    for name, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        if seconds < SMALLEST * whole:
            small += seconds
            continue
        runs = "every substep" if name in OFTEN else "every exchange"
        rows.append(_row(f"`{name}`" + (f", {NAMES[name]}" if name in NAMES else "") + f" ({runs})", seconds, whole))
    rows.append(_row("all other kernels", small, whole))
    between = whole - sum(spent.values())
    rows.append(_row("between kernels: launches, clearing, the tool's poses", max(between, 0.0), whole))
    notes = [
        f"{scene.name}, {len(scene.x)} particles, frames {min(START, scene.last // 2)} and on: "
        f"{1e3 * whole / frames:.1f} ms a frame of {scene.resolution.steps} exchanges and "
        f"{scene.substeps // scene.last} substeps."
    ]
    if device == "cpu":
        bare = kernels(scene, device, _lawless())[1]
        law = max(0.0, spent["stress_forces"] - bare["stress_forces"])
        rows.append(
            _row("the law alone: what `stress_forces` saves with a law that leaves stress as it is", law, whole)
        )
    else:
        notes.append(
            "Kernels' times are from a second run with clocks around each; between kernels the GPU waits for launches."
        )
    return Group("Where a simulation's time goes", tuple(rows), tuple(notes))


def _row(what: str, seconds: float, whole: float) -> Row:
    return Row(what, "%", Sample((100.0 * seconds / whole,)))
