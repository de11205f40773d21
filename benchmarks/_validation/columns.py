"""Part ``columns``: collapse of a column of dry sand, against laboratory run-outs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from splatsoil.benchmarks._common import FloatArray
from splatsoil.benchmarks._parts import Row, Section, curves_of
from splatsoil.benchmarks._validation.scene import GRAVITY, Scene, lattice, resolution

from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

RADIUS = 0.1
PARTICLES = 8_000
WAY = 0.1
"""Cells that the fastest soil goes between two exchanges with the grid, and while hourglass modes are damped."""
THIN = 0.02 * RADIUS
"""Thickness in m under which a deposit has ended: a few grains in the laboratory."""
ANGLE = 31.0
"""Friction angle of dry sand near its angle of repose, degrees."""
GAIN, GRAIN = 0.69, 1.0e-3
"""Of friction that grows with the rate of shear: glass beads (Jop et al. 2006), and a grain's diameter in m."""
SCATTER = 0.2
"""Allowed around Lube's fit, our estimate: Warnett et al. (2014) find that run-out hangs on the column's size too."""
PLANAR = (2.4, 3.6)
"""Run-out of planar columns at a = 2: Lube et al. (2005) and Lajeunesse et al. (2005)."""


@dataclass(frozen=True)
class Column:
    """A quarter of a cylinder ``aspect`` radii high, or half of a planar column, between smooth walls of symmetry."""

    aspect: float = 1.0
    friction_angle: float = ANGLE
    matching: Matching = Matching.PLANE_STRAIN
    planar: bool = False
    rated: bool = False
    particles: float = PARTICLES
    transport: float = WAY
    young: float = 5.0e5
    seed: int = 0

    @property
    def lube(self) -> float:
        """(R - R0) / R0 of axisymmetric columns: Lube et al. (2004)."""
        return 1.24 * self.aspect if self.aspect < 1.7 else 1.6 * math.sqrt(self.aspect)

    def scene(self) -> Scene:
        """The column before it falls."""
        height, reach = self.aspect * RADIUS, RADIUS * (1.0 + 2.5 * self.aspect)
        if self.planar:
            # four particles across the channel
            spacing = math.sqrt(4.0 * RADIUS * height / self.particles)
        else:
            spacing = (0.25 * math.pi * RADIUS**2 * height / self.particles) ** (1.0 / 3.0)
        spacing = RADIUS / round(RADIUS / spacing)
        cell = 2.0 * spacing
        reach = cell * math.ceil(reach / cell)
        width = 2.0 * cell if self.planar else reach
        box = [RADIUS, width if self.planar else RADIUS, round(height / spacing) * spacing]
        x = lattice([0.0, 0.0, 0.0], box, spacing, self.seed)
        if not self.planar:
            centres = lattice([0.0, 0.0, 0.0], box, spacing, self.seed, 0.0)
            x = x[np.hypot(centres[:, 0], centres[:, 1]) < RADIUS]
        fastest = math.sqrt(2.0 * GRAVITY * height)
        return Scene(
            np.clip(x, 1e-6, None),
            (reach, width, height + 2 * cell),
            resolution(cell, fastest, density=1600.0, young=self.young, transport=self.transport, way=WAY),
            Settings(self.friction_angle, wall_friction=0.0, floor_friction=10.0, matching=self.matching),
            ("rate_dependence",) if self.rated else (),
            {"rate_gain": GAIN, "rate_grain_size": GRAIN} if self.rated else {},
        )

    def deposit(self, device: str) -> tuple[FloatArray, FloatArray]:
        """Radii and mean thicknesses (n,) in m in rings, or strips, long after the fall."""
        scene = self.scene()
        seconds = 6.0 * math.sqrt(self.aspect * RADIUS / GRAVITY) + 0.15
        x = scene.rest(seconds, device).positions()[0].astype(float)
        cell = scene.resolution.cell
        r = x[:, 0] if self.planar else np.hypot(x[:, 0], x[:, 1])
        edges = np.arange(0.0, r.max() + 2.0 * cell, 0.5 * cell)
        volume = np.histogram(r, edges)[0] * (0.5 * cell) ** 3
        area = np.diff(edges) * 2.0 * cell if self.planar else 0.25 * math.pi * np.diff(edges**2)
        return 0.5 * (edges[1:] + edges[:-1]), volume / area

    def run_out(self, device: str) -> float:
        """(R - R0) / R0."""
        return run_out(*self.deposit(device))


def run_out(radius: FloatArray, thickness: FloatArray) -> float:
    """(R - R0) / R0 of a deposit (n,), which ends where its thickness falls under ``THIN``."""
    k = int(np.argmax(thickness < THIN))
    share = (thickness[k - 1] - THIN) / (thickness[k - 1] - thickness[k])
    return float(radius[k - 1] + share * (radius[k] - radius[k - 1])) / RADIUS - 1.0


def validate(device: str) -> Section:
    """All columns, their controls, and one with the grid, the step, the stiffness and the seed changed."""
    rows, profiles = [], {}
    for aspect in (0.5, 1.0, 2.0, 4.0):
        column = Column(aspect)
        radius, thickness = column.deposit(device)
        profiles[f"a = {aspect:g}"] = radius / RADIUS, thickness / RADIUS
        rows.append(Row.near(f"axisymmetric, a = {aspect:g}", run_out(radius, thickness), column.lube, SCATTER))
        found = replace(column, rated=True).run_out(device)
        rows.append(Row.near(f"with `rate_dependence`, a = {aspect:g}", found, column.lube, SCATTER))
    strong, same = "control: friction far too large (√J₂/p = 1.30)", "the same sand matched in compression"
    pressed = Column(matching=Matching.COMPRESSION)
    for name, column, inside in (
        (f"{same}, a = 1", pressed, True),
        (f"{strong}, a = 1", replace(pressed, friction_angle=55.0), False),
    ):
        rows.append(Row.near(name, column.run_out(device), column.lube, SCATTER, inside=inside))
    low, high = PLANAR
    planar = Column(2.0, planar=True)
    for name, column, inside in (
        ("planar, a = 2", planar, True),
        (f"planar, {same}", replace(planar, matching=Matching.COMPRESSION), True),
        (f"{strong}, planar, a = 2", replace(planar, matching=Matching.COMPRESSION, friction_angle=55.0), False),
    ):
        found = column.run_out(device)
        wanted = f"{'' if inside else 'outside '}{low:.2f} … {high:.2f}"
        rows.append(Row(name, f"{found:.2f}", wanted, (low <= found <= high) is inside))
    runs = [Column(seed=seed).run_out(device) for seed in range(5)]
    base = float(np.mean(runs))
    rows.append(Row("a = 1: mean of 5 seeds", f"{base:.3f}, scatter {np.std(runs, ddof=1):.3f}", "reported"))
    for name, column in (
        ("half the cell (8 times the particles)", Column(particles=8.0 * PARTICLES)),
        ("half the step of the particles", Column(transport=0.5 * WAY)),
        ("double step", Column(transport=2.0 * WAY)),
        ("4 times as stiff", Column(young=2e6)),
    ):
        rows.append(Row.near(name, column.run_out(device), base, 0.1))
    figure, _ = curves_of(profiles, "radius / R₀", "thickness / R₀")
    return Section("Columns that collapse", rows, figure)
