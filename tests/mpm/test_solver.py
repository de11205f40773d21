"""The solver against closed forms: rest, sliding, momentum, and against a tool."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
import warp as wp
from splatsoil.benchmarks._validation.scene import STILL, lattice

from splatsoil.errors import SimulationError
from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings

DENSITY = 1600.0
RESOLUTION = Resolution(
    cell=0.02, spacing=0.01, frame_time=0.02, steps=2, courant=0.5, bulk=4.2e5, shear=1.9e5, density=DENSITY
)
LOWER, UPPER = np.zeros(3), np.array([0.4, 0.2, 0.2])
PLATE = trimesh.creation.box(extents=[0.012, 0.08, 0.08])
FAR_AWAY = Pose(np.array([9.0, 9.0, 9.0]), STILL, np.zeros(3), np.zeros(3))
block = partial(lattice, spacing=0.01, jitter=0.4)


def solver(
    x: npt.NDArray[np.float64],
    settings: Settings,
    values: Mapping[str, float] | None = None,
    effects: tuple[str, ...] = (),
    **options: Any,
) -> Solver:
    resolution = replace(RESOLUTION, **options)
    law = Law(find_effects(effects))
    given = {"friction_angle": settings.friction_angle, **(values or {})}
    return Solver(x[None], LOWER, UPPER, PLATE, resolution, law, settings, [given])


def poses(start: npt.NDArray[np.float64], speed: npt.NDArray[np.float64], frame: int) -> list[Pose]:
    """Both steps of a frame."""
    times = [(frame + step / 2) * RESOLUTION.frame_time for step in range(2)]
    return [Pose(start + t * speed, STILL, speed, np.zeros(3)) for t in times]


def test_a_bed_at_rest_stays_at_rest() -> None:
    x = block(LOWER, [0.4, 0.2, 0.1])
    run = solver(x, Settings(friction_angle=35.0))
    for _ in range(25):
        run.advance([FAR_AWAY, FAR_AWAY])
    moved = run.positions()[0] - x
    assert np.abs(moved.mean(axis=0)).max() < 2e-4
    assert np.abs(moved).max() < 2e-3
    assert np.abs(run.momentum()[0]).max() < 1e-3 * len(x) * DENSITY * 1e-6


def test_a_bed_released_without_stress_settles_by_its_own_weight_only() -> None:
    """Gravity x 1.5 on a bed at rest compresses it by the oedometric 0.25 rho g h^2 / (K + 4G/3) at the surface."""
    height = 0.1
    x = block(LOWER, [0.4, 0.2, height])
    run = solver(x, Settings(friction_angle=45.0, gravity=(0.0, 0.0, -9.81)))
    table = run._table.numpy()
    table[:, 7] *= 1.5
    run._table.assign(table)
    for _ in range(50):
        run.advance([FAR_AWAY, FAR_AWAY])
    surface = x[:, 2] > height - 0.01
    sunk = (x - run.positions()[0])[surface, 2].mean()
    stiff = 0.5 * DENSITY * 9.81 * height**2 / 2.0 / (RESOLUTION.bulk + 4.0 * RESOLUTION.shear / 3.0)
    soft = 0.5 * DENSITY * 9.81 * height**2 / 2.0 / RESOLUTION.bulk
    assert 0.8 * stiff < sunk < 1.2 * soft


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_block_slides_as_coulomb_says(friction: float) -> None:
    """x = g t^2 (sin theta - mu cos theta) / 2 for a coherent block on a floor tilted by 30 degrees."""
    slope, gravity, time = math.radians(30.0), 9.81, 0.2
    settings = Settings(
        friction_angle=45.0,
        gravity=(gravity * math.sin(slope), 0.0, -gravity * math.cos(slope)),
        floor_friction=friction,
    )
    x = block([0.04, 0.06, 0.0], [0.12, 0.14, 0.04])
    run = solver(x, settings, {"cohesion": 1500.0}, ("cohesion",))
    for _ in range(round(time / RESOLUTION.frame_time)):
        run.advance([FAR_AWAY, FAR_AWAY])
    way = (run.positions()[0] - x)[:, 0].mean()
    expected = 0.5 * gravity * time**2 * (math.sin(slope) - friction * math.cos(slope))
    assert way == pytest.approx(expected, rel=0.03)


def test_what_the_soil_gains_the_tool_gives() -> None:
    """Without gravity and walls, momentum gained by soil is the impulse of the tool's force, to 1e-3."""
    x = block([0.16, 0.06, 0.06], [0.24, 0.14, 0.14])
    run = solver(x, Settings(friction_angle=35.0, gravity=(0.0, 0.0, 0.0), tool_friction=0.4))
    impulse = np.zeros(3)
    speed = np.array([0.3, 0.0, 0.05])
    for frame in range(10):
        impulse -= run.advance(poses(np.array([0.14, 0.1, 0.1]), speed, frame))[0] * RESOLUTION.frame_time
    gained = run.momentum()[0]
    assert gained[0] > 0.1 * len(x) * DENSITY * 1e-6
    np.testing.assert_allclose(gained, impulse, atol=1e-3 * np.linalg.norm(gained))


def test_a_thin_plate_keeps_soil_on_both_its_sides() -> None:
    """A plate thinner than a cell, pushed through a bed, lets no particle pass through its middle."""
    x = block(LOWER, [0.4, 0.2, 0.1])
    run = solver(x, Settings(friction_angle=35.0))
    speed = np.array([0.2, 0.0, 0.0])
    start = np.array([0.15, 0.1, 0.06])
    middle = (np.abs(x[:, 1] - 0.1) < 0.03) & (np.abs(x[:, 2] - 0.06) < 0.02)
    ahead = middle & (x[:, 0] > start[0] + 0.008) & (x[:, 0] < start[0] + 0.03)
    for frame in range(15):
        run.advance(poses(start, speed, frame))
    plate = start[0] + 15 * RESOLUTION.frame_time * speed[0]
    assert (run.positions()[0][ahead, 0] > plate).all()


def test_same_input_same_bits_and_batches_equal_single_runs() -> None:
    x = block([0.1, 0.05, 0.0], [0.2, 0.15, 0.08])
    settings = Settings(friction_angle=35.0)
    alone = []
    for _ in range(2):
        run = solver(x, settings, {"friction_angle": 28.0})
        for _ in range(5):
            run.advance([FAR_AWAY])
        alone.append(run.positions())
    np.testing.assert_array_equal(alone[0], alone[1])
    batch = Solver(
        np.stack([x, x]), LOWER, UPPER, PLATE, RESOLUTION, Law(), settings,
        [{"friction_angle": 40.0}, {"friction_angle": 28.0}],
    )  # fmt: skip
    for _ in range(5):
        batch.advance([FAR_AWAY])
    np.testing.assert_array_equal(batch.positions()[1], alone[0][0])
    assert not np.array_equal(batch.positions()[0], alone[0][0])


def test_a_grain_that_tumbled_wildly_can_still_be_drawn() -> None:
    x = block([0.1, 0.05, 0.0], [0.2, 0.15, 0.05])
    run = solver(x, Settings(friction_angle=35.0))
    # what a loose grain's velocity gradient comes to between two frames; its square is beyond single precision
    run._particles.deformation.fill_(wp.mat33(*(1.0e20 * np.arange(9.0))))
    run.advance([FAR_AWAY, FAR_AWAY])
    stretch = np.linalg.svd(run.deformations()[0], compute_uv=False)
    assert stretch.max() < 3.0


def test_bad_starts_and_broken_states_are_named() -> None:
    settings = Settings(friction_angle=35.0)
    x = block([0.1, 0.05, 0.0], [0.2, 0.15, 0.04])
    with pytest.raises(SimulationError, match="outside the bed"):
        solver(x + np.array([0.4, 0.0, 0.0]), settings)
    with pytest.raises(SimulationError, match="not finite"):
        solver(np.where(x > 0.19, np.nan, x), settings)
    with pytest.raises(SimulationError, match="shape"):
        Solver(x, LOWER, UPPER, PLATE, RESOLUTION, Law(), settings, [{"friction_angle": 35.0}])
    with pytest.raises(SimulationError, match="wave-speed limit"):
        solver(x, settings, courant=6.0)
    run = solver(x, settings)
    run._particles.velocity.fill_(float("nan"))
    with pytest.raises(SimulationError, match=r"of 400 particles 400 lost a finite state by frame 1 .*friction_angle"):
        run.advance([FAR_AWAY])
