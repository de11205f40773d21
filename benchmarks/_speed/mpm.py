"""The solver on one core and on two; on a GPU one run, a batch, and how time and memory grow with particles."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from splatsoil.benchmarks._speed.clock import repeated, side_by_side, timed
from splatsoil.benchmarks._speed.rows import Group, Row, Sample, had, judged, missing
from splatsoil.benchmarks._speed.scenes import Plough, height_error, paper_scene

from splatsoil.errors import SimulationError
from splatsoil.threads import cores

RATE = 10.0
"""M particle-steps/s wanted of two cores."""
GPU_RATE = 4000.0
"""The same wanted of a GPU, at a million particles and more."""
PAPER_SECONDS, BATCH_SECONDS, BATCH = 1.0, 6.0, 16
PUBLISHED = Sample((192.0, 200.0), "the authors' engine, as measured elsewhere on an H200")
COUNTS = (1_000_000, 4_000_000, 10_000_000)
LINEAR = 1.2
"""Most that a particle may take at the largest count over what it takes at the smallest."""

COUNTED = (
    "A particle-step is a particle times a substep of the grid: what an explicit MPM of the same stiffness, whose "
    "particles and grid exchange state in every step, has to do. Here they exchange state once in many substeps; "
    "*exchanges* counts those alone."
)


def cpu(scene: Plough, repeats: int) -> Group:
    """One run on one core, two side by side on two."""
    n, work = len(scene.x), 1e-6 * len(scene.x) * scene.substeps
    frames = tuple(f for f in (scene.truth.particles if scene.truth else ()) if 0 < f < scene.last)
    alone = repeated(lambda: scene.run(), repeats, warm=0)
    results: dict[int, Any] = {}

    def run(k: int) -> None:
        results[k] = scene.run(frames=(*frames, scene.last))[0]

    pair = side_by_side([lambda k=k: run(k) for k in range(2)], max(1, repeats - 1), "two side by side")  # type: ignore[misc]
    same = bool(np.array_equal(results[0].positions, results[1].positions))
    states = dict(zip(results[0].frames, results[0].positions.astype(np.float64), strict=True))
    off = height_error(scene, states)
    rate = pair.inverted(2.0 * work)
    enough = cores() >= 2
    wanted = work / RATE
    rows = [
        Row(f"one simulation of {scene.name} on one core", "s", alone),
        Row("particle-steps on one core", "M/s", alone.inverted(work), faster="more"),
        Row("exchanges on one core", "M/s", alone.inverted(1e-6 * n * scene.steps), faster="more"),
        Row(
            "particle-steps on two cores",
            "M/s",
            rate,
            alone.inverted(work, "one alone on one core"),
            "more",
            f"≥ {RATE:g} M/s, or a run as short: two in {2.0 * wanted:.0f} s",
            judged(rate, RATE, "more", 2) if enough else None,
            note=had(pair, 2),
        ),
    ]
    notes = [
        f"The scene: {scene.words()}; cells of {1e3 * scene.resolution.cell:.3g} mm.",
        COUNTED,
        f"Both of the two side by side gave {'the same bits' if same else 'DIFFERENT results'}.",
    ]
    if off is not None:
        notes.append(f"Heights at the set's true frames: {off:.1f} mm off.")
    return Group(f"Solver: {scene.name}", tuple(rows), tuple(notes))


def gpu(scene: Plough, device: str, repeats: int, published: Plough | None = None) -> Group:
    """The published scene: one run, and sixteen as one batch; and the example set."""
    theirs = published is None
    published = published or paper_scene()
    one = repeated(lambda: published.run(device), repeats, device)
    batch = repeated(lambda: published.run(device, BATCH), max(1, repeats - 1), device)
    small = repeated(lambda: scene.run(device), repeats, device)
    sixteen = one.scaled(BATCH, f"{BATCH} of the first row one after the other")
    what = "the paper's scene" if theirs else published.name
    rows = (
        Row(
            f"{what} ({len(published.x)} particles, {published.last} frames)",
            "s",
            one,
            PUBLISHED if theirs else None,
            "less",
            f"≤ {PAPER_SECONDS:g} s",
            one.median <= PAPER_SECONDS,
        ),
        Row(
            f"{BATCH} parameter sets of it as one batch",
            "s",
            batch,
            sixteen,
            "less",
            f"≤ {BATCH_SECONDS:g} s",
            batch.median <= BATCH_SECONDS,
        ),
        Row(f"{scene.name} ({len(scene.x)} particles, {scene.last} frames)", "s", small),
    )
    work = 1e-6 * len(published.x) * published.substeps
    notes = [
        f"The first scene: {published.words()}; cells of {1e3 * published.resolution.cell:.3g} mm, two particles along "
        "an edge.",
        f"That is {work / one.median:.0f} M particle-steps/s for one run, {BATCH * work / batch.median:.0f} for the "
        "batch.",
        COUNTED,
    ]
    if theirs:
        notes.append(
            "Published are the bed, its surface, the plate's width and motion, the cells, the frames of 0.02 s and "
            "about 77 000 particles; the plate's thickness and the frictions of tool and floor are not: 1 cm and the "
            "example's are taken."
        )
    return Group("Solver: whole runs", rows, tuple(notes))


def held_bytes(solver: Any) -> tuple[float, float]:
    """Bytes a particle that the solver's arrays of particles take, and those of all its arrays.

    Counted from the arrays themselves, without what the allocator keeps beside them.
    """
    each = []
    for struct in (solver._particles, solver._nodes, solver._cells):
        arrays = [a for name in struct._cls.vars if isinstance(a := getattr(struct, name), wp.array)]
        each.append(sum(int(a.capacity) for a in arrays))
    near = int(solver._near.capacity)
    n = solver.simulations * solver.particles_each
    return (each[0] + near) / n, (sum(each) + near) / n


def large(scene: Plough, device: str, repeats: int, counts: Sequence[int] = COUNTS, steps: int = 3) -> Group:
    """The example's bed in finer cells: time and memory of a particle."""
    rows: list[Row] = []
    per_particle: list[float] = []
    notes = []
    for count in counts:
        what = f"about {count / 1e6:g} M particles"
        try:
            sample, words, rate = _steps(scene.refined(count), device, repeats, steps)
        except (SimulationError, RuntimeError, MemoryError) as error:
            rows.append(missing(what, str(error).splitlines()[0], f"≥ {GPU_RATE:g} M/s"))
            continue
        finally:
            gc.collect()
        per_particle.append(1.0 / rate)
        rows.append(
            Row(
                f"particle-steps, {words}",
                "M/s",
                sample,
                faster="more",
                target=f"≥ {GPU_RATE:g} M/s",
                met=sample.median >= GPU_RATE,
            )
        )
    if len(per_particle) == len(counts) > 1:
        growth = per_particle[-1] / per_particle[0]
        rows.append(
            Row(
                f"a particle-step's time at {counts[-1] / 1e6:g} M particles over that at {counts[0] / 1e6:g} M",
                "",
                Sample((growth,)),
                target=f"linear: ≤ {LINEAR:g}",
                met=growth <= LINEAR,
            )
        )
    notes.append(
        f"The example's bed in finer cells; {steps} exchanges with all their substeps in a repetition, one to a call, "
        "each of which waits for the device as a whole frame does. The run's first steps: the tool comes down on the "
        "soil, but the kernels of contact run all the same."
    )
    return Group("Solver: many particles", tuple(rows), tuple(notes))


def _steps(scene: Plough, device: str, repeats: int, steps: int) -> tuple[Sample, str, float]:
    """Particle-steps a second in M over some of the run's first steps, a description, and the median."""
    r = scene.resolution
    # a frame that is one step long, so that a few of them make a repetition
    short = replace(r, frame_time=r.frame_time / r.steps, steps=1)
    quick = replace(scene, resolution=short)
    solver = quick.solver(device)
    place = 0

    def advance() -> None:
        nonlocal place
        for _ in range(steps):
            solver.advance(quick.poses(place))
            place += 1

    advance()
    substeps = short.substeps(1)
    seconds = Sample(tuple(timed(advance, device) for _ in range(repeats)))
    sample = seconds.inverted(1e-6 * len(scene.x) * substeps * steps)
    own, whole = held_bytes(solver)
    words = (
        f"{len(scene.x) / 1e6:.2f} M in cells of {1e3 * r.cell:.2g} mm, {substeps} substeps to an exchange, {own:.0f} "
        f"bytes a particle, {whole:.0f} with the grid"
    )
    return sample, words, sample.median
