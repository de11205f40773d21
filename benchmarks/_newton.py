"""The scene of a measurement set in Newton's implicit MPM (https://github.com/newton-physics/newton)."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp
from splatsoil.benchmarks.numerics import FloatArray

from splatsoil.errors import MeasurementError, RunError, SimulationError
from splatsoil.measurement import Measurement
from splatsoil.mpm.simulate import step_poses
from splatsoil.soil.matching import cone_intercept, cone_slope

YIELD_PRESSURE = 1.0e8
"""Pa; high enough never to be met, low enough that single precision still resolves the cohesion's share of it."""
ROUGH = 1.0
"""Friction of an obstacle: soil sticks to it and shears within itself."""
WALL = 0.1
"""Half the thickness of a wall, m."""


@dataclass(frozen=True)
class Numerics:
    """Of a run.

    Attributes:
        voxel: edge of the cells, m.
        substeps: in a frame.
        iterations: most of the Gauss-Seidel solver in a substep.
        late: soil is pushed out of where the tool stood when the substep began, not of where it ends. In the example
            sets soil stands one substep's way deep in the moving tool, so they were made so.
        grid: "dense", whose cells stay, or "sparse", whose cells are laid anew around the soil in every substep: soil
            then loses up to half as much volume again. The example sets were made with the first: their particles come
            out eight times closer by it (`splatsoil.benchmarks.independent`).
    """

    voxel: float
    substeps: int
    iterations: int
    late: bool = True
    grid: str = "dense"

    @classmethod
    def of(cls, folder: Path) -> Numerics:
        """Those that made the measurement set; MeasurementError when ``truth.json`` doesn't tell."""
        file = folder / "truth.json"
        told = json.loads(file.read_text())
        try:
            return cls(float(told["voxel"]), int(told["sub"]), int(told["iterations"]))
        except KeyError as error:
            raise MeasurementError(
                "the benchmark needs the numerics that the set was made with", file=file, field=str(error)
            ) from error


@dataclass(frozen=True)
class World:
    """Soil to plough.

    Attributes:
        label: what it is called in the table.
        angle: friction angle, degrees; one, or (n,) one a particle.
        particles: (n, 3) at frame 0, m.
        spacing: edge of the cube of soil that a particle stands for, m.
        young: Young's modulus, Pa.
        cohesion: Pa; of the whole soil, with one friction angle.
        yield_stress: strength beside what friction and cohesion make, as the root of J2, Pa.
        dilatancy: slope of the plastic potential over that of the yield surface: 1 is associated flow.
        viscosity: Pa s.
        tool_friction: None for the measurement's.
        tool_adhesion: Pa.
        obstacle: centre (x, y, z) and radius in m of a fixed sphere in the bed; None for none.
    """

    label: str
    angle: float | FloatArray
    particles: FloatArray = field(repr=False)
    spacing: float
    young: float = 1.0e7
    cohesion: float = 0.0
    yield_stress: float = 0.0
    dilatancy: float = 0.0
    viscosity: float = 0.0
    tool_friction: float | None = None
    tool_adhesion: float = 0.0
    obstacle: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Run:
    """What became of a world.

    Attributes:
        particles: (n, 3) in m, by frame.
        force: (f, 3) of the soil on the tool in N: mean over the time that leads to frames 1, 2, …, f.
    """

    particles: dict[int, FloatArray]
    force: FloatArray


def load_newton() -> Any:
    """The package; RunError when it isn't installed."""
    try:
        return importlib.import_module("newton")
    except ModuleNotFoundError as error:
        raise RunError("the package newton is missing; install it: pip install 'splatsoil[independent]'") from error


def plough(
    measurement: Measurement,
    worlds: Sequence[World],
    numerics: Numerics,
    frames: Iterable[int],
    device: str = "cpu",
    *,
    gravity: Sequence[float] | None = None,
) -> list[Run]:
    """Run the worlds side by side, in boxes of their own, to the last frame.

    Args:
        measurement: bed, tool and motion.
        worlds: their soil.
        numerics: of the solver.
        frames: to keep, of those from 1 on.
        device: Warp device name.
        gravity: (3,) m/s^2; the measurement's by default.

    Returns:
        What became of each world.

    Raises:
        RunError: the ``newton`` package is missing.
        SimulationError: particles left the numbers.
    """
    newton = load_newton()
    # whole voxels, so that every box lies on the grid as the first one does
    pitch = math.ceil((measurement.bed.upper - measurement.bed.lower)[1] / numerics.voxel + 4.0 * WALL / numerics.voxel)
    shifts = np.array([[0.0, k * pitch * numerics.voxel, 0.0] for k in range(len(worlds))])
    model = _model(newton, measurement, worlds, shifts, device, gravity)
    config = newton.solvers.SolverImplicitMPM.Config()
    config.voxel_size, config.max_iterations, config.tolerance = numerics.voxel, numerics.iterations, 1.0e-4
    config.grid_type = numerics.grid
    solver = newton.solvers.SolverImplicitMPM(model, config=config)
    now, following = model.state(), model.state()
    frame_time = 1.0 / measurement.frame_rate
    step = frame_time / numerics.substeps
    wanted = sorted(f for f in frames if f > 0)
    ends = np.cumsum([len(w.particles) for w in worlds])[:-1]
    found: list[dict[int, FloatArray]] = [{} for _ in worlds]
    force = np.zeros((len(worlds), wanted[-1], 3))
    for frame in range(1, wanted[-1] + 1):
        for pose in step_poses(measurement.tool.motion, (frame - 1) * frame_time, frame_time, numerics.substeps):
            # Both calls carry the tool on by its velocity from its pose at the step's start.
            places = np.array([[*(pose.position + shift), *pose.quaternion] for shift in shifts], dtype=np.float32)
            twists = np.array([[*pose.velocity, *pose.spin]] * len(worlds), dtype=np.float32)
            for state in (now, following):
                state.body_q.assign(places)
                state.body_qd.assign(twists)
            solver.step(now, following, None, None, step)
            force[:, frame - 1] += _impulses(solver, following, len(worlds)) / frame_time
            if numerics.late:
                following.body_qd.zero_()
            solver.project_outside(following, following, step)
            now, following = following, now
        if frame in wanted:
            x = now.particle_q.numpy().astype(np.float64)
            if not np.isfinite(x).all():
                raise SimulationError(f"newton: particles are no numbers at frame {frame} with {numerics}")
            for k, part in enumerate(np.split(x, ends)):
                found[k][frame] = part - shifts[k]
    return [Run(particles, of_world) for particles, of_world in zip(found, force, strict=True)]


def _impulses(solver: Any, state: Any, bodies: int) -> FloatArray:
    """(b, 3) N s that soil gave each body, a world's tool, in the last step."""
    impulses, _, colliders = (array.numpy() for array in solver.collect_collider_impulses(state))
    body_of = solver.collider_body_index.numpy()
    there = (colliders >= 0) & (colliders < len(body_of))
    body = np.where(there, body_of[np.where(there, colliders, 0)], -1)
    given = np.zeros((bodies, 3))
    np.add.at(given, body[body >= 0], impulses[body >= 0].astype(np.float64))
    return given


def _model(
    newton: Any,
    measurement: Measurement,
    worlds: Sequence[World],
    shifts: FloatArray,
    device: str,
    gravity: Sequence[float] | None = None,
) -> Any:
    """Newton's model: one floor; walls, a tool and soil for every world."""
    bed, tool = measurement.bed, measurement.tool
    builder = newton.ModelBuilder()
    newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
    surface = newton.ModelBuilder.ShapeConfig
    builder.add_ground_plane(height=float(bed.lower[2]), cfg=surface(mu=bed.floor_friction, density=0.0))
    mesh = newton.Mesh(np.asarray(tool.mesh.vertices), np.asarray(tool.mesh.faces).ravel(), compute_inertia=False)
    for world, shift in zip(worlds, shifts, strict=True):
        for centre, half in _walls(bed.lower + shift, bed.upper + shift):
            place = wp.transform(wp.vec3(*centre), wp.quat_identity())
            smooth = surface(mu=bed.wall_friction, density=0.0)
            builder.add_shape_box(body=-1, cfg=smooth, xform=place, hx=half[0], hy=half[1], hz=half[2])
        if world.obstacle is not None:
            place = wp.transform(wp.vec3(*(np.array(world.obstacle[:3]) + shift)), wp.quat_identity())
            builder.add_shape_sphere(body=-1, cfg=surface(mu=ROUGH, density=0.0), xform=place, radius=world.obstacle[3])
        friction = tool.friction if world.tool_friction is None else world.tool_friction
        sticky = {"mpm:collider_adhesion": world.tool_adhesion}
        body = builder.add_body()
        builder.add_shape_mesh(body=body, mesh=mesh, cfg=surface(mu=friction, density=0.0), custom_attributes=sticky)
        n = len(world.particles)
        builder.add_particles(
            pos=(world.particles + shift).tolist(),
            vel=[(0.0, 0.0, 0.0)] * n,
            mass=[bed.density * world.spacing**3] * n,
            radius=[world.spacing / 2.0] * n,
        )
    model = builder.finalize(device=device)
    model.set_gravity(tuple(float(g) for g in (measurement.gravity if gravity is None else gravity)))

    def each(values: Sequence[float | FloatArray]) -> npt.NDArray[np.float32]:
        parts = [np.broadcast_to(value, len(w.particles)) for value, w in zip(values, worlds, strict=True)]
        return np.concatenate(parts).astype(np.float32)

    material = model.mpm
    material.young_modulus.assign(each([w.young for w in worlds]))
    material.poisson_ratio.fill_(0.3)
    material.friction.assign(each([np.vectorize(cone_slope)(w.angle) for w in worlds]))
    material.dilatancy.assign(each([w.dilatancy for w in worlds]))
    material.viscosity.assign(each([w.viscosity for w in worlds]))
    material.yield_stress.assign(each([w.yield_stress for w in worlds]))
    if any(w.cohesion for w in worlds):
        # Newton's strength is yield_stress + friction (p + tension): the cone's apex alone makes the whole cohesion,
        # and a yield stress beside it would double that.
        material.yield_pressure.fill_(YIELD_PRESSURE)
        material.tensile_yield_ratio.assign(each([_tension(w) / YIELD_PRESSURE for w in worlds]))
    return model


def _tension(world: World) -> float:
    """Pressure of the cone's apex, Pa."""
    if not world.cohesion:
        return 0.0
    angle = float(world.angle)
    return cone_intercept(angle, world.cohesion) / cone_slope(angle)


def _walls(lower: FloatArray, upper: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Centre and half extents (3,) of four walls, as high again as the box; each as long as the box outside: where they
    end with the soil, weak soil leaks between two."""
    middle, half = (upper + lower) / 2.0, (upper - lower) / 2.0 * np.array([1.0, 1.0, 3.0])
    found = []
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            centre, extent = middle.copy(), half + np.array([2.0 * WALL, 2.0 * WALL, 0.0])
            centre[axis] += side * (half[axis] + WALL)
            extent[axis] = WALL
            found.append((centre, extent))
    return found
