"""The exchange between particles and grid: what it keeps, and how fast it damps what it is told to."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from splatsoil.mpm import Resolution, Solver
from splatsoil.soil.law import Law
from splatsoil.soil.settings import Settings

CELL = 0.02
RESOLUTION = Resolution(
    cell=CELL, spacing=0.01, frame_time=0.02, steps=2, courant=0.5, bulk=4.2e5, shear=1.9e5, density=1600.0
)
AMPLITUDE = 1e-3
"""m/s; nothing moves by more than a thousandth of a cell."""


def amplitude_after_a_frame(steps: int, relaxation: float) -> float:
    """What is left, after 0.02 s without weight, of velocities along x of ± 1 mm/s that alternate from node to node
    in y and z: a field no cell's mean gradient sees, so that no stress resists it."""
    # a lump that touches no wall: eight particles in each of 4 x 4 x 4 cells
    upper = np.full(3, 0.16)
    axis = np.arange(0.045, 0.12, 0.01)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    resolution = replace(RESOLUTION, steps=steps, relaxation=relaxation)
    still = Settings(friction_angle=35.0, gravity=(0.0, 0.0, 0.0))
    run = Solver(x[None], np.zeros(3), upper, None, resolution, Law(), still, [{"friction_angle": 35.0}])
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


@pytest.mark.parametrize("steps", [1, 4, 16])
def test_an_exchange_loses_nothing_by_itself(steps: int) -> None:
    assert amplitude_after_a_frame(steps, relaxation=1e-6) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("steps", [4, 8, 16])
def test_hourglass_modes_are_damped_by_the_second_and_not_by_the_step(steps: int) -> None:
    """As by 25 plain exchanges a second, each of the damping 2 * 9/23; the last step's own velocity is yet undamped."""
    time = 0.02 * (steps - 1) / steps
    assert amplitude_after_a_frame(steps, relaxation=25.0) == pytest.approx(
        math.exp(-2 * 9 / 23 * 25.0 * time), rel=0.01
    )


@pytest.mark.parametrize("steps", [2, 3])
def test_without_a_rate_they_are_damped_as_by_affine_particles(steps: int) -> None:
    """Affine particles at 1/4 and 3/4 of a cell leave 7/16 of a bilinear mode, but for the last step's own velocity."""
    left = amplitude_after_a_frame(steps, relaxation=0.0)
    assert left == pytest.approx((7.0 / 16.0) ** (steps - 1), rel=0.01)
