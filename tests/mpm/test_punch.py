"""A rigid strip pressed into soil in plane strain: exact plasticity, and the volume that it must push aside."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from splatsoil.benchmarks._validation.scene import STILL, Scene, lattice, resolution

from splatsoil.mpm.tool import Pose
from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

WIDTH = 0.1
CELLS = 8
SPEED = 0.05
SURFACE = 0.25
DEEP = 0.15
"""m: nothing moves below."""


def press(angle: float, cohesion: float, gravity: float, edge: int, way: float) -> tuple[np.ndarray, float, float]:
    """Press a rough strip ``way`` (m) deep; ``edge`` particles along a cell's edge.

    Returns:
        Pressures of the steps, Pa; packing beneath the strip at the end, over that at the start; way of a step, m.
    """
    cell = WIDTH / CELLS
    size = np.array([6.0 * WIDTH, cell, SURFACE])
    x = np.clip(lattice(np.zeros(3), size, cell / edge), 1e-6, None)
    settings = Settings(
        friction_angle=angle, gravity=(0.0, 0.0, -gravity), tool_friction=1.0, wall_friction=0.0, floor_friction=1.0,
        matching=Matching.PLANE_STRAIN,
    )  # fmt: skip
    fine = replace(resolution(cell, SPEED, density=1600.0, young=5e6, transport=0.05), spacing=cell / edge)
    strip = trimesh.creation.box(extents=[WIDTH, 8.0 * cell, 0.15])
    strip.apply_translation([0.0, 0.0, 0.075])
    upper = (size[0], cell, SURFACE + 0.2)
    run = Scene(x, upper, fine, settings, ("cohesion",), {"cohesion": cohesion}, strip).solver("cpu")
    velocity, step = np.array([0.0, 0.0, -SPEED]), fine.frame_time
    count = math.ceil(way / (SPEED * step))
    # soil ends half a particle's spacing before the strip
    start = np.array([0.5 * size[0], 0.5 * cell, SURFACE])
    forces = [run.advance([Pose(start + k * step * velocity, STILL, velocity, np.zeros(3))]) for k in range(count)]
    end = run.positions()[0]
    beneath = (abs(end[:, 0] - start[0]) < 0.5 * WIDTH) & (end[:, 2] > DEEP)
    lowest = SURFACE - count * step * SPEED - cell
    packing = (beneath & (end[:, 2] < lowest)).sum() * (cell / edge) ** 3 / (WIDTH * cell * (lowest - DEEP))
    return np.array(forces)[:, 0, 2] / (WIDTH * cell), float(packing), step * SPEED


def bearing(angle: float) -> float:
    """Prandtl's N_c."""
    phi = math.radians(angle)
    surcharge = math.exp(math.pi * math.tan(phi)) * math.tan(math.pi / 4.0 + phi / 2.0) ** 2
    return (surcharge - 1.0) / math.tan(phi)


@pytest.mark.parametrize("edge", [2, 3])
def test_weightless_soil_bears_what_prandtl_says(edge: int) -> None:
    """Between the load of soil that dilates by its friction angle and that of soil that keeps its volume (Davis 1968),
    and a tenth above: a cell of an eighth of the width hinders slip."""
    cohesion, angle = 1000.0, 20.0
    pressure, _, step = press(angle, cohesion, 1e-3, edge, 0.006)
    share = math.cos(math.radians(angle))
    weaker = math.degrees(math.atan(share * math.tan(math.radians(angle))))
    found = pressure[round(0.003 / step) :].mean() / cohesion
    assert share * bearing(weaker) < found < 1.1 * bearing(angle)


@pytest.mark.parametrize("edge", [2, 3])
def test_sand_beneath_a_strip_goes_aside_and_is_not_compacted(edge: int) -> None:
    """The base law keeps volume: as much leaves the soil beneath the strip as it sweeps, whatever the particles."""
    _, packing, _ = press(30.0, 0.0, 9.81, edge, 0.03)
    assert packing == pytest.approx(1.0, abs=0.04)
