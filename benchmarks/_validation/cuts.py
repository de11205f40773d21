"""Part ``cuts``: how much cohesion holds a vertical cut upright, against limit analysis."""

from __future__ import annotations

import math

import numpy as np
from splatsoil.benchmarks._parts import Row, Section
from splatsoil.benchmarks._validation.scene import GRAVITY, Scene, lattice, resolution

from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

HEIGHT = 0.08
"""Of the cut, m: a small plough's trench."""
DENSITY = 1600.0
WAY = 0.1
"""Cells that falling soil goes between two exchanges with the grid, and while hourglass modes are damped."""
SECONDS = 0.4
"""In which soil falls ten heights."""
FALLEN = 0.05
"""Of its height that the crest of a cut sinks by that doesn't stand."""
STABILITY = 3.83
"""Taylor's stability number γ H / c of a vertical cut without friction."""
ROUNDS = 6
"""Of halving."""
EARLY = 0.1
"""Share by which a grid of eight cells may let less do: it hinders slip of less than a cell. Our estimate."""
CASES = ((25.0, 8), (33.0, 8), (40.0, 8), (33.0, 4), (33.0, 12))
"""Friction angles in degrees, and cells over the height."""


def expected(friction_angle: float) -> float:
    """Cohesion in Pa needed at least where flow is associated: by the upper bound (Taylor 1937; Chen 1975)."""
    return DENSITY * GRAVITY * HEIGHT / (STABILITY * math.tan(math.radians(45.0 + friction_angle / 2.0)))


def davis(friction_angle: float) -> float:
    """The same where soil keeps its volume: c and tan φ are worth cos φ times as much (Davis 1968)."""
    share = math.cos(math.radians(friction_angle))
    weaker = math.degrees(math.atan(share * math.tan(math.radians(friction_angle))))
    return expected(weaker) / share


def cut(cohesion: float, friction_angle: float, cells: int, matching: Matching = Matching.PLANE_STRAIN) -> Scene:
    """Soil with a free vertical face between smooth walls, on a floor that it cannot slide on, released at once."""
    cell = HEIGHT / cells
    length, reach = (cell * math.ceil(share * HEIGHT / cell) for share in (1.5, 3.0))
    fastest = 0.5 * math.sqrt(2.0 * GRAVITY * HEIGHT)
    return Scene(
        np.clip(lattice([0.0, 0.0, 0.0], [length, 2.0 * cell, HEIGHT], 0.5 * cell), 1e-6, None),
        (reach, 2.0 * cell, HEIGHT + 3.0 * cell),
        resolution(cell, fastest, density=DENSITY, young=1.0e6, transport=WAY, way=WAY),
        Settings(friction_angle=friction_angle, wall_friction=0.0, floor_friction=10.0, matching=matching),
        ("cohesion",),
        {"cohesion": cohesion},
    )


def sinks(scene: Scene, device: str) -> float:
    """How far the crest has sunk in the end, in heights of the cut."""
    start, cell = scene.x, scene.resolution.cell
    crest = (start[:, 0] > start[:, 0].max() - cell) & (start[:, 2] > HEIGHT - cell)
    end = scene.rest(SECONDS, device).positions()[0]
    return float(np.mean(start[crest, 2] - end[crest, 2])) / HEIGHT


def needed(friction_angle: float, cells: int, device: str, matching: Matching) -> float:
    """Cohesion in Pa at which the cut begins to stand, by halving."""
    low, high = 0.25 * expected(friction_angle), 2.0 * expected(friction_angle)
    for _ in range(ROUNDS):
        middle = math.sqrt(low * high)
        falls = sinks(cut(middle, friction_angle, cells, matching), device) > FALLEN
        low, high = (middle, high) if falls else (low, middle)
    return math.sqrt(low * high)


def validate(device: str) -> Section:
    """Three angles, three grids, and a cone that is too strong."""
    rows = []
    for angle, cells, inside in (*((a, n, True) for a, n in CASES), (*CASES[1], False)):
        found = needed(angle, cells, device, Matching.PLANE_STRAIN if inside else Matching.COMPRESSION)
        low, high = (1.0 - EARLY) * expected(angle), davis(angle)
        wanted = f"{expected(angle):.0f} (− {100.0 * EARLY:g} %) … {high:.0f} Pa"
        case = f"φ = {angle:g}°, {cells} cells high" if inside else f"control: matched in compression, φ = {angle:g}°"
        held = (low <= found <= high) is inside
        rows.append(Row(case, f"{found:.0f} Pa", wanted if inside else f"outside {wanted}", held))
    return Section("Cuts that stand", rows)
