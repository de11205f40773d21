"""The same scene in Newton's implicit MPM, for some of its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from splatsoil.benchmarks._newton import Numerics, World, _model, load_newton
from splatsoil.benchmarks._speed.clock import repeated, timed
from splatsoil.benchmarks._speed.rows import Group, Row, Sample, at_least, missing
from splatsoil.benchmarks._speed.scenes import Plough

from splatsoil.errors import RunError, SimulationError
from splatsoil.mpm.simulate import step_poses

TARGET = 20.0
"""Times as fast as the other that we want to be."""
WINDOWS = (0, 50, 150)
"""Frames whose true particles a piece of the run starts from: soil at rest, pushed, drawn back."""
FRAMES = 3
"""Frames of each window that count; the one before them compiles, and lets stress build up."""
STATED = "At least 333 s for 25 000 particles and 200 frames on one core were measured elsewhere"


def compare(scene: Plough, repeats: int) -> Group:
    """The whole run with ours, and what the windows come to for the whole run in Newton."""
    what, target = f"{scene.name}, {scene.last} frames", f"≥ {TARGET:g} times as fast"
    title = "Solver against Newton's implicit MPM"
    try:
        newton = load_newton()
    except RunError as error:
        return Group(title, (missing(what, str(error), target),))
    assert scene.truth is not None
    windows = [w for w in WINDOWS if w in scene.truth.particles]
    seconds = np.array([_window(scene, newton, start) for start in windows])
    # one value a repetition: the k-th frame of every window
    whole = Sample(tuple(scene.last * float(s) for s in seconds.mean(axis=0)), f"Newton {newton.__version__}")
    ours = repeated(lambda: scene.run(), max(1, repeats - 1), warm=0)
    row = Row(what, "s", ours, whole, target=target)
    numerics = Numerics.of(scene.truth.measurement.folder)
    each = ", ".join(f"{np.mean(s):.2f} s from frame {w}" for w, s in zip(windows, seconds, strict=True))
    notes = (
        f"Newton: {seconds.size} of {scene.last} frames, {FRAMES} from each of the frames "
        f"{', '.join(map(str, windows))} ({each}), with the true particles of these frames, "
        f"{len(scene.truth.particles[0])} (ours: {len(scene.x)}); the whole run is {scene.last} times their mean. "
        "Times of one thread each: both work serially on a CPU, and on two cores both can run two scenes side by side.",
        f"Newton's numerics are those that made the set: voxels of {1e3 * numerics.voxel:g} mm, {numerics.substeps} "
        f"substeps a frame, at most {numerics.iterations} iterations to 1e-4. {STATED}.",
    )
    return Group(title, (_judged(row),), notes)


def _judged(row: Row) -> Row:
    return replace(row, met=at_least(row.ratio, TARGET))


def _window(scene: Plough, newton: object, start: int) -> list[float]:
    """Seconds of each of the frames that follow frame ``start`` by one and more."""
    truth = scene.truth
    assert truth is not None
    measurement = truth.measurement
    numerics = Numerics.of(measurement.folder)
    angle = scene.values["friction_angle"]
    cohesion = scene.values.get("cohesion", 0.0)
    spacing = truth.volume ** (1.0 / 3.0)
    world = World("speed", measurement, angle, truth.particles[start], spacing, cohesion=cohesion)
    model = _model(newton, [world], np.zeros((1, 3)), "cpu")
    config = newton.solvers.SolverImplicitMPM.Config()  # type: ignore[attr-defined]
    config.voxel_size, config.max_iterations, config.tolerance = numerics.voxel, numerics.iterations, 1.0e-4
    solver = newton.solvers.SolverImplicitMPM(model, config=config)  # type: ignore[attr-defined]
    states = [model.state(), model.state()]
    for state in states:
        state.particle_f.assign(np.tile(world.weight, (len(world.particles), 1)))
    frame_time = 1.0 / measurement.frame_rate
    step = frame_time / numerics.substeps

    def frame(number: int) -> None:
        for pose in step_poses(measurement.tool.motion, number * frame_time, frame_time, numerics.substeps):
            for state in states:
                state.body_q.assign(np.array([[*pose.position, *pose.quaternion]], dtype=np.float32))
                state.body_qd.assign(np.array([[*pose.velocity, *pose.spin]], dtype=np.float32))
            solver.step(states[0], states[1], None, None, step)
            solver.project_outside(states[1], states[1], step)
            states.reverse()

    frame(start)
    found = [timed(lambda k=k: frame(start + k)) for k in range(1, FRAMES + 1)]  # type: ignore[misc]
    if not np.isfinite(states[0].particle_q.numpy()).all():
        raise SimulationError(f"newton: particles are no numbers at frame {start + FRAMES}")
    return found
