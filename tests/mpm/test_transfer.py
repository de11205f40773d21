"""The exchange between particles and grid: what it keeps, how fast it damps what it is told to, where it moves soil."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.solver import STRETCH
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.settings import Settings

CELL = 0.02
RESOLUTION = Resolution(
    cell=CELL, spacing=0.01, frame_time=0.02, steps=2, courant=0.5, bulk=4.2e5, shear=1.9e5, density=1600.0
)
AMPLITUDE = 1e-3
"""m/s; nothing moves by more than a thousandth of a cell."""
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
STILL = Settings(friction_angle=35.0, gravity=(0.0, 0.0, 0.0))


def solver(x: np.ndarray, size: np.ndarray, mesh: Any = None, settings: Settings = STILL, **changes: float) -> Solver:
    """Of particles (n, 3) in a box that begins at zero."""
    values = [{"friction_angle": settings.friction_angle}]
    return Solver(x[None], np.zeros(3), size, mesh, replace(RESOLUTION, **changes), Law(), settings, values)  # type: ignore[arg-type]


def cube(**changes: float) -> tuple[Solver, np.ndarray]:
    """A lump that touches no wall: eight particles in each of 4 x 4 x 4 cells."""
    axis = np.arange(0.045, 0.12, 0.01)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return solver(x, np.full(3, 0.16), **changes), x


def amplitude_after_a_frame(steps: int, relaxation: float) -> float:
    """What is left, after 0.02 s without weight, of velocities along x of ± 1 mm/s that alternate from node to node
    in y and z: a field no cell's mean gradient sees, so that no stress resists it."""
    run, x = cube(steps=steps, relaxation=relaxation)
    cell = np.floor(x / CELL).astype(int)
    f = x / CELL - cell
    sign = AMPLITUDE * (1.0 - 2.0 * ((cell[:, 1] + cell[:, 2]) % 2))
    along = (1.0 - 2.0 * f[:, 1]) * (1.0 - 2.0 * f[:, 2])
    velocity, affine, bilinear = np.zeros((len(x), 3)), np.zeros((len(x), 3, 3)), np.zeros((len(x), 3, 3))
    velocity[:, 0] = sign * along
    affine[:, 0, 1] = -2.0 * sign * (1.0 - 2.0 * f[:, 2]) / CELL
    affine[:, 0, 2] = -2.0 * sign * (1.0 - 2.0 * f[:, 1]) / CELL
    bilinear[:, 0, 0] = 4.0 * sign
    particles = run._particles
    for array, values in ((particles.velocity, velocity), (particles.affine, affine), (particles.bilinear, bilinear)):
        array.assign(values.astype(np.float32))
    run.advance(steps)
    pattern = sign * along
    return float(pattern @ run.velocities()[0][:, 0] / (pattern @ pattern))


@pytest.mark.parametrize(
    ("steps", "relaxation", "left"),
    [
        # an exchange loses nothing by itself
        *((steps, 1e-6, 1.0) for steps in (1, 4, 16)),
        # by the second, not by the step: 25 plain exchanges of the damping 2 * 9/23; the last step's own is undamped
        *((steps, 25.0, math.exp(-2 * 9 / 23 * 25.0 * 0.02 * (steps - 1) / steps)) for steps in (4, 16)),
        # steps as long as several exchanges: the trapezoidal rule with 9/23, below the 7/16 of affine particles
        *((2, share / 0.01, (23.0 - 9.0 * share) / (23.0 + 9.0 * share)) for share in (1.5, 2.5)),
        # without a rate, as affine particles at 1/4 and 3/4 of a cell
        *((steps, 0.0, (7.0 / 16.0) ** (steps - 1)) for steps in (2, 3)),
    ],
)
def test_hourglass_modes_are_damped_by_the_rate_that_is_asked_for(steps: int, relaxation: float, left: float) -> None:
    assert amplitude_after_a_frame(steps, relaxation) == pytest.approx(left, rel=0.01, abs=0.002)


def lump(seed: int, count: int = 400) -> tuple[Solver, np.ndarray]:
    """Soil at (n, 3) random places with random velocities, and a frame in which it neither moves nor is stressed."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.045, 0.115, (count, 3))
    run = solver(x, np.full(3, 0.16), steps=1, frame_time=1e-9, relaxation=1e-6)
    run._particles.velocity.assign(rng.uniform(-1.0, 1.0, x.shape).astype(np.float32))
    return run, x


def test_what_particles_take_from_nodes_they_give_back() -> None:
    """All of a cell's eight coefficients, of any field: a second exchange changes none of them."""
    run, _ = lump(0)
    names = ("velocity", "affine", "bilinear", "trilinear")
    run.advance(1)
    first = {name: getattr(run._particles, name).numpy().copy() for name in names}
    run.advance(1)
    for name, values in first.items():
        assert np.abs(values).max() > 0.1
        np.testing.assert_allclose(getattr(run._particles, name).numpy(), values, atol=1e-4 * np.abs(values).max())


def cells_of(run: Solver) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each cell with particles: its indices (n, 3), soil over its volume (n,), mean gradients (n, 8, 3)."""
    count = int(run._cells.count.numpy()[0])
    places = np.stack(np.unravel_index(run._cells.node.numpy()[:count], run.shape.nodes), axis=1)
    gradient = run._cells.gradient.numpy().reshape(-1, 8, 3)[:count]
    return places, run._cells.volume.numpy()[:count] / CELL**3, gradient


def test_a_cells_volume_and_gradient_are_those_of_its_soil() -> None:
    """Against 24³ points of each cell: soil where the nodes' density, worked out anew, is above half."""
    run, x = lump(1)
    run.advance(1)
    mass = np.zeros(run.shape.nodes)
    corners = np.array([[k >> 2, (k >> 1) & 1, k & 1] for k in range(8)])
    cell = np.floor(x / CELL).astype(int)
    for corner in corners:
        weight = np.where(corner, x / CELL - cell, 1.0 - x / CELL + cell).prod(axis=1)
        np.add.at(mass, tuple((cell + corner).T), weight * (RESOLUTION.spacing / CELL) ** 3)
    axis = (np.arange(24) + 0.5) / 24
    f = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    each = np.stack([np.where(corner, f, 1.0 - f) for corner in corners])
    places, filled, gradient = cells_of(run)
    whole = 0
    for place, own, slopes in zip(places, filled, gradient, strict=True):
        density = each.prod(axis=2).T @ mass[tuple((place + corners).T)]
        soil = density > 0.5
        assert own == pytest.approx(soil.mean(), abs=0.04)
        whole += soil.all()
        if soil.mean() < 0.2:
            continue
        for corner, w, slope in zip(corners, each[:, soil], slopes, strict=True):
            others = np.array([(w[:, 1] * w[:, 2]).mean(), (w[:, 0] * w[:, 2]).mean(), (w[:, 0] * w[:, 1]).mean()])
            np.testing.assert_allclose(slope, (2.0 * corner - 1.0) / CELL * others, atol=0.06 / CELL)
    assert 5 < whole < len(places) - 5


@pytest.mark.parametrize("beyond", [0.0, 0.25, 0.5, 0.75])
def test_a_level_bed_ends_where_its_soil_does(beyond: float) -> None:
    """Soil that fills the box to three cells and a part of the fourth."""
    high = (3.0 + beyond) * CELL
    spacing = 0.25 * CELL
    across, up = (np.arange(0.5 * spacing, size, spacing) for size in (4.0 * CELL, high))
    x = np.stack(np.meshgrid(across, across, up, indexing="ij"), axis=-1).reshape(-1, 3)
    run = solver(x, np.array([4.0, 4.0, 6.0]) * CELL, spacing=spacing, steps=1, frame_time=1e-9)
    run.advance(1)
    _, filled, _ = cells_of(run)
    assert filled.sum() / 16.0 == pytest.approx(3.0 + beyond, abs=0.1)


def test_an_even_stress_leaves_soil_alone_wherever_its_particles_are() -> None:
    """Within a body the forces of one stress everywhere cancel, as the divergence theorem says: at nodes amid soil
    whose particles are strewn at random, twelve in one cell and four in another."""
    run, _ = lump(4, 1200)
    run.advance(1)
    force, full = np.zeros((*run.shape.nodes, 3)), np.zeros(run.shape.nodes, dtype=int)
    for place, soil, slopes in zip(*cells_of(run), strict=True):
        for corner in range(8):
            node = tuple(place + np.array([corner >> 2, (corner >> 1) & 1, corner & 1]))
            force[node] += soil * slopes[corner]
            full[node] += soil > 0.9999
    assert (full == 8).sum() > 3
    np.testing.assert_allclose(force[full == 8], 0.0, atol=1e-4 / CELL)


def test_soil_shows_no_more_stretch_than_allowed() -> None:
    """Against singular values by numpy, of deformations of which some need no bounds and some do."""
    run, x = lump(2)
    rng = np.random.default_rng(3)
    shapes = (np.eye(3) + rng.normal(0.0, rng.uniform(0.0, 0.8, (len(x), 1, 1)), (len(x), 3, 3))).astype(np.float32)
    shapes = shapes[np.linalg.det(shapes) > 0.02]
    given = np.concatenate([shapes, np.broadcast_to(np.eye(3, dtype=np.float32), (len(x) - len(shapes), 3, 3))])
    run._particles.deformation.assign(given)
    u, sizes, v = np.linalg.svd(given.astype(np.float64))
    low, high = STRETCH
    bound = (sizes < low) | (sizes > high)
    assert 0.1 < bound.any(axis=1).mean() < 0.9
    expected = (u * np.clip(sizes, low, high)[:, None, :]) @ v
    np.testing.assert_allclose(run.deformations()[0], expected, atol=5e-3)


def test_a_step_turns_a_lump_without_swelling_it() -> None:
    """By 0.1 rad: where the step's displacement starts it would grow by 0.1^2 / 2 (explicit Euler)."""
    run, x = cube(steps=1, relaxation=1e-6)
    spin = np.zeros((3, 3))
    spin[0, 1], spin[1, 0] = -5.0, 5.0
    middle = np.full(3, 0.08)
    run._particles.velocity.assign(((x - middle) @ spin.T).astype(np.float32))
    run._particles.affine.assign(np.broadcast_to(spin, (len(x), 3, 3)).astype(np.float32))
    run.advance(1)
    before, after = (np.linalg.norm((y - middle)[:, :2], axis=1) for y in (x, run.positions()[0].astype(np.float64)))
    turned = run.positions()[0] - x
    assert np.linalg.norm(turned[:, :2], axis=1).mean() == pytest.approx(0.1 * before.mean(), rel=0.02)
    # explicit Euler: 5e-3 on average
    assert abs(float(np.mean(after / before)) - 1.0) < 1e-3


@pytest.mark.parametrize("steps", [1, 4, 16])
def test_soil_sunk_into_a_tool_comes_out_by_the_second(steps: int) -> None:
    """At twice the relaxation: exp(-2 * 25 / s * 0.02 s) of the depth is left; what is deeper than a quarter of the
    particles' spacing comes out at once. Springs as soft as these don't matter."""
    plate = trimesh.creation.box([0.04, 0.2, 0.2])
    depths = np.array([1.0e-3, 2.0e-3, 6.0e-3])
    x = np.array([[0.10 - d, 0.05 + 0.04 * k, 0.09] for k, d in enumerate(depths)])
    run = solver(x, np.full(3, 0.2), plate, steps=steps, relaxation=25.0, bulk=1.0, shear=0.5, skin=0.0)
    held = Pose(np.array([0.08, 0.1, 0.1]), UPRIGHT, np.zeros(3), np.zeros(3))
    run.advance([held] * steps)
    left = 0.10 - run.positions()[0][:, 0]
    share = np.exp(-2.0 * 25.0 * 0.02)
    np.testing.assert_allclose(left[:2], share * depths[:2], rtol=0.05)
    assert left[2] < 2.5e-3


def bed_on_a_plate(height: float) -> tuple[np.ndarray, np.ndarray]:
    """Particles (n, 3) between 6 cm and so much more, from wall to wall, and the box's upper corner."""
    spacing = RESOLUTION.spacing
    plane = np.arange(0.5 * spacing, 0.12, spacing)
    levels = np.arange(0.06 + 0.5 * spacing, 0.06 + height - 0.1 * spacing, spacing)
    grid = np.meshgrid(plane, plane, levels, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, 3), np.array([0.12, 0.12, 0.2])


def slide(run: Solver, speed: float, steps: int, frames: int) -> np.ndarray:
    """Force (frames, 3) on a plate whose upper face touches the lowest particles, and which moves along x."""
    force, velocity = [], np.array([speed, 0.0, 0.0])
    for frame in range(frames):
        times = (frame + np.arange(steps) / steps) * RESOLUTION.frame_time
        places = [np.array([0.06, 0.06, 0.045]) + t * velocity for t in times]
        force.append(run.advance([Pose(place, UPRIGHT, velocity, np.zeros(3)) for place in places])[0])
    return np.array(force)


@pytest.mark.parametrize(("steps", "stiffer", "slid"), [(1, 1.0, 0.0), (8, 3.0, 0.0), (8, 1.0, 0.004), (1, 3.0, 0.004)])
def test_a_tool_bears_a_bed_for_good(steps: int, stiffer: float, slid: float) -> None:
    """The contact bears the bed's weight, whose pressure p its springs balance at a depth of p * spacing / bulk, and
    the bed sinks no further, by any steps and stiffness, whether the tool stands or slides along."""
    height, spacing, frames = 0.08, RESOLUTION.spacing, 25
    x, upper = bed_on_a_plate(height)
    plate = trimesh.creation.box([0.2, 0.2, 0.04])
    smooth = Settings(friction_angle=35.0, wall_friction=0.0, tool_friction=0.0)
    bulk, shear = stiffer * RESOLUTION.bulk, stiffer * RESOLUTION.shear
    run = solver(x, upper, plate, smooth, steps=steps, relaxation=100.0, bulk=bulk, shear=shear, skin=0.0)
    force = slide(run, slid / (frames * RESOLUTION.frame_time), steps, frames)[:, 2]
    weight = len(x) * spacing**3 * RESOLUTION.density * 9.81
    assert np.mean(force[-5:]) == pytest.approx(-weight, rel=1e-3)
    sunk = float(np.mean((x - run.positions()[0])[x[:, 2] > 0.13, 2]))
    assert sunk == pytest.approx(RESOLUTION.density * 9.81 * height * spacing / bulk, rel=0.5)


@pytest.mark.parametrize("steps", [2, 8])
@pytest.mark.parametrize("speed", [0.003, 0.1])
def test_friction_on_a_tool_is_coulombs(steps: int, speed: float) -> None:
    """A plate slides beneath a bed that walls hold: quick or slow, by any steps, it feels friction times the weight."""
    spacing, friction = RESOLUTION.spacing, 0.3
    x, upper = bed_on_a_plate(0.08)
    plate = trimesh.creation.box([0.6, 0.6, 0.04])
    held = Settings(friction_angle=45.0, wall_friction=0.0, tool_friction=friction)
    run = solver(x, upper, plate, held, steps=steps, relaxation=100.0, skin=0.0)
    sideways = -float(np.mean(slide(run, speed, steps, 40)[-20:, 0]))
    weight = len(x) * spacing**3 * RESOLUTION.density * 9.81
    assert sideways == pytest.approx(friction * weight, rel=0.02)


@pytest.mark.parametrize("above", [0.002, 0.006])
def test_contact_acts_by_what_the_tool_covers(above: float) -> None:
    """A particle before an upright plate whose lower edge lies in the middle of a cell: of the way down to the nodes
    below the edge the plate covers ``above`` of ``above`` and half a cell; of that up to the nodes above it, all."""
    cell = RESOLUTION.cell
    edge = 4.5 * cell
    plate = trimesh.creation.box([0.012, 0.4, 0.1])
    x = np.array([[0.1 + 1e-4, 5.0 * cell + 1e-6, edge + above]])
    run = solver(x, np.full(3, 0.2), plate, skin=0.0)
    pose = Pose(np.array([0.094, 0.1, edge + 0.05]), UPRIGHT, np.zeros(3), np.zeros(3))
    run._pose.assign(pose.row().astype(np.float32))
    run._contact(1e-4, 1.0)
    weight = run._contacts.weight.numpy()[:8].reshape(2, 2, 2).sum(axis=(0, 1))
    high = 0.5 + above / cell
    low = (1.0 - high) * above / (above + 0.5 * cell)
    np.testing.assert_allclose(weight, np.array([low, high]) / (low + high), atol=0.06)
