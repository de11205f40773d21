"""The scene of a measurement set in Newton's implicit MPM (https://github.com/newton-physics/newton)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp
from splatsoil.benchmarks._common import FloatArray

from splatsoil.errors import RunError, SimulationError
from splatsoil.measurement import Measurement
from splatsoil.mpm import Resolution, Trajectory
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

    The defaults are converged for a blade 120 mm wide (docs/numerics.md). Particles matter more than voxels: with two
    along a voxel's edge, soil loses a sixth of what is heaped up, on finer voxels too; with three, nothing.

    Attributes:
        voxel: edge of the cells, m.
        substeps: in a frame.
        iterations: most of the Gauss-Seidel solver in a substep.
        tolerance: residual at which it ends earlier.
        particles_per_edge: of a voxel, where soil begins.
    """

    voxel: float = 0.04 / 3.0
    substeps: int = 3
    iterations: int = 1500
    tolerance: float = 1.0e-6
    particles_per_edge: int = 3

    @property
    def spacing(self) -> float:
        """Edge of the cube of soil that a particle stands for, m."""
        return self.voxel / self.particles_per_edge


@dataclass(frozen=True)
class Soil:
    """Soil to plough.

    Attributes:
        measurement: its bed, tool and motion.
        angle: friction angle, degrees; one, or (n,) one a particle.
        particles: (n, 3) at frame 0, m.
        spacing: edge of the cube of soil that a particle stands for, m.
        young: Young's modulus, Pa.
        cohesion: Pa; one, or (n,) one a particle; soil that has any has one friction angle.
        dilatancy: slope of the plastic potential over that of the yield surface: 1 is associated flow.
        viscosity: Pa s.
        tool_friction: None for the measurement's.
        tool_adhesion: Pa.
        obstacle: centre (x, y, z) and radius in m of a fixed sphere in the bed; None for none.
        gravity: (3,) m/s^2; None for the measurement's.
    """

    measurement: Measurement = field(repr=False)
    angle: float | FloatArray
    particles: FloatArray = field(repr=False)
    spacing: float
    young: float = 1.0e7
    cohesion: float | FloatArray = 0.0
    dilatancy: float = 0.0
    viscosity: float = 0.0
    tool_friction: float | None = None
    tool_adhesion: float = 0.0
    obstacle: tuple[float, float, float, float] | None = None
    gravity: tuple[float, float, float] | None = None

    @property
    def weight(self) -> npt.NDArray[np.float32]:
        """(3,) N, of one particle."""
        gravity = np.asarray(self.measurement.gravity if self.gravity is None else self.gravity, dtype=np.float64)
        return (self.measurement.bed.density * self.spacing**3 * gravity).astype(np.float32)


def load_newton() -> Any:
    """The package; RunError when it isn't installed."""
    try:
        return importlib.import_module("newton")
    except ModuleNotFoundError as error:
        raise RunError("the package newton is missing; install it: pip install 'splatsoil[independent]'") from error


def plough(
    soils: Sequence[Soil],
    numerics: Numerics,
    frames: Iterable[int],
    device: str = "cpu",
    *,
    begin: int = 0,
    progress: Callable[[int, int], None] = lambda frame, last: None,
) -> list[Trajectory]:
    """Plough soils side by side, each in a box of its own, to the last frame.

    Args:
        soils: with their beds, tools and motions.
        numerics: of the solver.
        frames: to keep, besides the first.
        device: Warp device name.
        begin: frame at which the soils' particles rest and the run begins.
        progress: called with (frame, last frame) after each.

    Returns:
        A trajectory of each soil, whose particles do not deform.

    Raises:
        RunError: the ``newton`` package is missing, or the soils' floors or frame rates differ.
        SimulationError: particles left the numbers.
    """
    newton = load_newton()
    measurements = [soil.measurement for soil in soils]
    rates, beds = {m.frame_rate for m in measurements}, [m.bed for m in measurements]
    if len(rates) > 1 or len({(float(bed.lower[2]), bed.floor_friction) for bed in beds}) > 1:
        raise RunError("beds side by side stand on one floor and share their frames: plough these one by one")
    # Along y, so that no walls meet; by whole voxels, so that every box lies on the grid as it would alone.
    span = max(bed.upper[1] for bed in beds) - min(bed.lower[1] for bed in beds) + 4.0 * WALL
    pitch = numerics.voxel * math.ceil(span / numerics.voxel)
    shifts = np.array([[0.0, pitch * k, 0.0] for k in range(len(beds))])
    model = _model(newton, soils, shifts, device)
    config = newton.solvers.SolverImplicitMPM.Config()
    config.voxel_size, config.max_iterations, config.tolerance = numerics.voxel, numerics.iterations, numerics.tolerance
    # The other kind of cells is laid anew around the soil in every substep: soil then loses half as much volume again.
    config.grid_type = "dense"
    solver = newton.solvers.SolverImplicitMPM(model, config=config)
    states = model.state(), model.state()
    for state in states:
        state.particle_f.assign(np.concatenate([np.tile(w.weight, (len(w.particles), 1)) for w in soils]))
    now, following = states
    frame_time = 1.0 / rates.pop()
    step = frame_time / numerics.substeps
    wanted = sorted(f for f in frames if f > begin)
    ends = np.cumsum([len(w.particles) for w in soils])[:-1]
    found = [[soil.particles] for soil in soils]
    force = np.zeros((len(soils), wanted[-1], 3))
    for frame in range(begin + 1, wanted[-1] + 1):
        start = (frame - 1) * frame_time
        ways = [step_poses(m.tool.motion, start, frame_time, numerics.substeps) for m in measurements]
        for poses in zip(*ways, strict=True):
            # Both calls carry the tool on by its velocity from its pose at the step's start.
            places = [[*(pose.position + shift), *pose.quaternion] for pose, shift in zip(poses, shifts, strict=True)]
            twists = [[*pose.velocity, *pose.spin] for pose in poses]
            for state in states:
                state.body_q.assign(np.array(places, dtype=np.float32))
                state.body_qd.assign(np.array(twists, dtype=np.float32))
            solver.step(now, following, None, None, step)
            force[:, frame - 1] += _impulses(solver, following, len(soils)) / frame_time
            # Soil is pushed out of where the tool stood when the substep began, as in the example sets: it stands up
            # to one substep's way deep in the moving tool, a tenth of a voxel.
            following.body_qd.zero_()
            solver.project_outside(following, following, step)
            now, following = following, now
        if frame in wanted:
            x = now.particle_q.numpy().astype(np.float64)
            if not np.isfinite(x).all():
                raise SimulationError(f"newton: particles are no numbers at frame {frame} with {numerics}")
            for kept, part, shift in zip(found, np.split(x, ends), shifts, strict=True):
                kept.append(part - shift)
        progress(frame, wanted[-1])
    return [
        Trajectory(
            frames=(begin, *wanted),
            positions=np.array(kept, dtype=np.float32),
            deformations=np.broadcast_to(np.eye(3, dtype=np.float32), (len(kept), len(kept[0]), 3, 3)),
            force=pushed,
            spacing=soil.spacing,
            resolution=Resolution.derive(soil.measurement, "small"),
        )
        for kept, pushed, soil in zip(found, force, soils, strict=True)
    ]


def _impulses(solver: Any, state: Any, bodies: int) -> FloatArray:
    """(b, 3) N s that soil gave each body, a tool, in the last step."""
    impulses, _, colliders = (array.numpy() for array in solver.collect_collider_impulses(state))
    body_of = solver.collider_body_index.numpy()
    there = (colliders >= 0) & (colliders < len(body_of))
    body = np.where(there, body_of[np.where(there, colliders, 0)], -1)
    given = np.zeros((bodies, 3))
    np.add.at(given, body[body >= 0], impulses[body >= 0].astype(np.float64))
    return given


def _model(newton: Any, soils: Sequence[Soil], shifts: FloatArray, device: str) -> Any:
    """Newton's model: one floor; walls, a tool and particles for every soil. Their weight is not in it."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
    surface = newton.ModelBuilder.ShapeConfig
    ground = soils[0].measurement.bed
    builder.add_ground_plane(height=float(ground.lower[2]), cfg=surface(mu=ground.floor_friction, density=0.0))
    for soil, shift in zip(soils, shifts, strict=True):
        bed, tool = soil.measurement.bed, soil.measurement.tool
        for centre, half in _walls(bed.lower + shift, bed.upper + shift):
            place = wp.transform(wp.vec3(*centre), wp.quat_identity())
            smooth = surface(mu=bed.wall_friction, density=0.0)
            builder.add_shape_box(body=-1, cfg=smooth, xform=place, hx=half[0], hy=half[1], hz=half[2])
        if soil.obstacle is not None:
            place = wp.transform(wp.vec3(*(np.array(soil.obstacle[:3]) + shift)), wp.quat_identity())
            builder.add_shape_sphere(body=-1, cfg=surface(mu=ROUGH, density=0.0), xform=place, radius=soil.obstacle[3])
        friction = tool.friction if soil.tool_friction is None else soil.tool_friction
        sticky = {"mpm:collider_adhesion": soil.tool_adhesion}
        body = builder.add_body()
        mesh = newton.Mesh(np.asarray(tool.mesh.vertices), np.asarray(tool.mesh.faces).ravel(), compute_inertia=False)
        builder.add_shape_mesh(body=body, mesh=mesh, cfg=surface(mu=friction, density=0.0), custom_attributes=sticky)
        n = len(soil.particles)
        builder.add_particles(
            pos=(soil.particles + shift).tolist(),
            vel=[(0.0, 0.0, 0.0)] * n,
            mass=[bed.density * soil.spacing**3] * n,
            radius=[soil.spacing / 2.0] * n,
        )
    model = builder.finalize(device=device)
    model.set_gravity((0.0, 0.0, 0.0))

    def each(values: Sequence[float | FloatArray]) -> npt.NDArray[np.float32]:
        parts = [np.broadcast_to(value, len(w.particles)) for value, w in zip(values, soils, strict=True)]
        return np.concatenate(parts).astype(np.float32)

    material = model.mpm
    material.young_modulus.assign(each([w.young for w in soils]))
    material.poisson_ratio.fill_(0.3)
    material.friction.assign(each([np.vectorize(cone_slope)(w.angle) for w in soils]))
    material.dilatancy.assign(each([w.dilatancy for w in soils]))
    material.viscosity.assign(each([w.viscosity for w in soils]))
    if any(np.any(w.cohesion) for w in soils):
        # Newton's strength is yield_stress + friction (p + tension): the cone's apex alone makes the whole cohesion,
        # and a yield stress beside it would double that.
        material.yield_pressure.fill_(YIELD_PRESSURE)
        material.tensile_yield_ratio.assign(each([_tension(w) / YIELD_PRESSURE for w in soils]))
    return model


def _tension(soil: Soil) -> float | FloatArray:
    """Pressure of the cone's apex, Pa; one, or (n,)."""
    if not np.any(soil.cohesion):
        return 0.0
    angle = float(soil.angle)
    return soil.cohesion * cone_intercept(angle, 1.0) / cone_slope(angle)


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
