"""Part ``basics``: a sliding block, conservation, and volume at rest."""

from __future__ import annotations

import math

import numpy as np
import trimesh
from scipy.ndimage import minimum_filter
from splatsoil.benchmarks._validation.columns import column, duration
from splatsoil.benchmarks._validation.page import Row, Section, percent
from splatsoil.benchmarks._validation.scene import GRAVITY, FloatArray, Scene, lattice, push, resolution, rest

from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

DENSITY = 1600.0


def slide(friction: float, device: str, slope: float = 30.0, seconds: float = 0.4) -> tuple[float, float]:
    """Way of a coherent block down a rough floor in a time, and Coulomb's g t^2 (sin - mu cos) / 2, m."""
    turn, cell = math.radians(slope), 0.02
    gravity = (GRAVITY * math.sin(turn), 0.0, -GRAVITY * math.cos(turn))
    settings = Settings(friction_angle=45.0, gravity=gravity, floor_friction=friction)
    x = lattice([0.04, 0.04, 0.0], [0.12, 0.12, 0.02], 0.5 * cell, jitter=0.0)
    scene = Scene(
        x,
        (1.2, 0.16, 0.12),
        resolution(cell, 2.0, density=DENSITY, young=1e6, transport=0.05, courant=0.125),
        settings,
        ("cohesion",),
        {"cohesion": 1500.0},
    )
    run = rest(scene, seconds, device)
    seconds = run.frame * scene.resolution.frame_time
    way = float((run.positions()[0] - x)[:, 0].mean())
    return way, 0.5 * GRAVITY * seconds**2 * (math.sin(turn) - friction * math.cos(turn))


def strike(device: str, courant: float, gravity: float = GRAVITY) -> tuple[float, float]:
    """A plate strikes a falling block: miss of momentum over what the tool gave, and of the nodes' mass."""
    cell, speed = 0.02, np.array([0.4, 0.0, 0.1])
    x = lattice([0.16, 0.06, 0.20], [0.24, 0.14, 0.28], 0.5 * cell)
    settings = Settings(friction_angle=35.0, tool_friction=0.4, gravity=(0.0, 0.0, -gravity))
    plate = trimesh.creation.box(extents=[0.012, 0.08, 0.08])
    scene = Scene(
        x,
        (0.4, 0.2, 0.4),
        resolution(cell, 0.5, density=DENSITY, young=5e5, transport=0.05, courant=courant),
        settings,
        mesh=plate,
    )
    _, force, run = push(scene, [0.14, 0.1, 0.22], speed, 0.06, device)
    seconds = run.frame * scene.resolution.frame_time
    mass = len(x) * DENSITY * scene.resolution.spacing**3
    tool = -force.sum(axis=0) * scene.resolution.frame_time
    gained = run.momentum()[0] - mass * seconds * np.array([0.0, 0.0, -gravity])
    return float(np.linalg.norm(gained - tool) / np.linalg.norm(tool)), abs(run.mass()[0] / mass - 1.0)


def packing(x: FloatArray, cell: float) -> float:
    """Particles in a cell inside the heap, over their number at the start: 1 is the soil's first density."""
    shift = 0.5 * cell
    edges = [np.arange(shift, float(x[:, k].max()) + cell, cell) for k in range(3)]
    count = np.histogramdd(x, edges)[0]
    inside = minimum_filter(count, 3, mode="constant", cval=0) >= 4
    return float(count[inside].mean() / 8.0)


def heap(device: str) -> tuple[float, float, float]:
    """Packing inside a column, inside the heap it becomes, and after as long a rest again."""
    scene = column(1.0, 31.0, planar=False, matching=Matching.PLANE_STRAIN)
    cell = scene.resolution.cell
    run = rest(scene, duration(1.0), device)
    first = packing(run.positions()[0].astype(float), cell)
    for _ in range(run.frame):
        run.advance(1)
    return packing(scene.x, cell), first, packing(run.positions()[0].astype(float), cell)


def validate(device: str) -> Section:
    """All of them."""
    rows = []
    for friction in (0.0, 0.3):
        way, wanted = slide(friction, device)
        held = abs(way / wanted - 1.0) <= 1e-3
        case = f"block on a slope of 30°, floor friction {friction:g}"
        rows.append(Row(case, f"{way:.5f} m ({percent(way, wanted)})", f"{wanted:.5f} m ± 0.1 %", held))
    for gravity, courant in ((GRAVITY, 0.5), (GRAVITY, 0.25), (0.0, 0.5)):
        momentum, mass = strike(device, courant, gravity)
        what = "falling" if gravity else "weightless"
        case = f"momentum given to a {what} block by a tool, Courant number {courant:g}"
        rows.append(Row(case, f"miss {momentum:.1e}", "≤ 1e-3", momentum <= 1e-3))
    rows.append(Row("mass on the grid", f"miss {mass:.1e}", "≤ 1e-5 (single precision)", mass <= 1e-5))
    before, first, second = heap(device)
    rows.append(Row("packing inside a column of height 1 R", f"{before:.4f}", "1 by definition"))
    rows.append(Row("inside the heap it becomes", f"{first:.4f}", "0.99 … 1.05: no gain", 0.99 <= first <= 1.05))
    rows.append(
        Row("after as long at rest again", f"{second:.4f}", "as before ± 0.5 %", abs(second / first - 1.0) <= 5e-3)
    )
    return Section(
        "Motion, conservation, volume",
        "A coherent block (cohesion 1500 Pa) slides down a rough floor, against g t² (sin θ − μ cos θ)/2. A "
        "plate strikes "
        "a block in free fall: what the soil gains beyond its weight's impulse is the sum of the forces recorded "
        "at the "
        "tool. A heap must not gain volume: particles are counted in cells inside it that do not fall on the "
        "solver's own.",
        tuple(rows),
        "Nodes that only the edge of a particle reaches resist stress with more than their mass, as far as the "
        "substep "
        "needs it for stability; so a ragged surface falls a little slower than the rest, in proportion to the "
        "square of the "
        "Courant number: without weight, tool and soil exchange momentum to a few 1e-4. Presets run at 0.5, the block "
        "at 0.125. A block taller than this one rocks on its "
        "elastic base when "
        "it is released, and misses the way by more (0.7 % at twice the height).",
    )
