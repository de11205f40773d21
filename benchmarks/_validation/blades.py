"""Part ``blades``: pushing force on a flat blade, against the passive earth pressure of Reece and McKyes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.optimize import minimize_scalar
from splatsoil.benchmarks._common import FloatArray
from splatsoil.benchmarks._parts import Row, Section, curves_of, percent
from splatsoil.benchmarks._validation.scene import GRAVITY, Scene, lattice, resolution

from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

DENSITY = 1600.0
SPEED = 0.1
WINDOW = (0.1, 0.25)
"""Ways over depth between which a force is averaged: soil has failed, and what the blade heaps up is still small."""
STEEL = math.tan(math.radians(20.0))
"""Friction of a rough blade."""
SCATTER = 0.25
"""Allowed: straight slip planes and the sides of narrow blades are crude (McKyes 1985, ch. 4); our estimate."""


def mckyes(rake: float, tool_angle: float, friction_angle: float) -> tuple[float, float]:
    """N_gamma of cohesionless soil and the slip plane's angle, degrees: McKyes (1985), eq. 4.8 and 4.9.

    Args:
        rake: of the blade against the horizontal, degrees; 90 stands upright.
        tool_angle: angle of friction between blade and soil, degrees.
        friction_angle: of the soil, degrees.
    """
    alpha, delta, phi = (math.radians(v) for v in (rake, tool_angle, friction_angle))

    def factor(beta: float) -> float:
        below = math.cos(alpha + delta) + math.sin(alpha + delta) / math.tan(beta + phi)
        return (1.0 / math.tan(alpha) + 1.0 / math.tan(beta)) / (2.0 * below) if below > 0.0 else 1e9

    most = math.pi - alpha - delta - phi
    found = minimize_scalar(factor, bounds=(0.01, most - 1e-3), method="bounded", options={"xatol": 1e-8})
    return float(found.fun), math.degrees(float(found.x))


@dataclass(frozen=True)
class Blade:
    """A flat blade in a bed; angles in degrees, lengths in m. ``width`` None: a channel that the blade fills."""

    depth: float
    rake: float = 90.0
    tool_friction: float = 0.0
    friction_angle: float = 35.0
    width: float | None = None
    cells: float = 12.0
    seed: int = 0

    @property
    def expected(self) -> float:
        """McKyes' horizontal force in N per metre of width (in a channel) or in N."""
        return self.bearing(self.friction_angle)

    @property
    def isochoric(self) -> float:
        """The same for sand that keeps its volume: tan phi* = sin phi (Davis 1968, psi = 0)."""
        return self.bearing(math.degrees(math.atan(math.sin(math.radians(self.friction_angle)))))

    def bearing(self, friction_angle: float) -> float:
        """McKyes' horizontal force in the unit of ``expected``, with another friction angle of the soil in degrees."""
        tool_angle = math.degrees(math.atan(self.tool_friction))
        factor, beta = mckyes(self.rake, tool_angle, friction_angle)
        force = DENSITY * GRAVITY * self.depth**2 * factor
        along = force * math.sin(math.radians(self.rake + tool_angle))
        if self.width is None:
            return along
        cot_a, cot_b = (1.0 / math.tan(math.radians(v)) for v in (self.rake, beta))
        side = self.depth * math.sqrt(cot_b**2 + 2.0 * cot_a * cot_b)
        return along * self.width * (1.0 + 2.0 * side / (3.0 * self.width))

    def measure(self, device: str) -> tuple[FloatArray, FloatArray]:
        """Ways over depth (n,), and pushing forces (n,) of the blade on the soil in the unit of ``expected``."""
        d, rake = self.depth, math.radians(self.rake)
        cell = d / self.cells
        length, bed = (cell * round(share * self.cells) for share in (6.0, 2.0))
        wide = 2.0 * cell if self.width is None else cell * round((0.5 * self.width + 2.5 * d) / cell)
        span = 8.0 * wide if self.width is None else self.width
        plate = trimesh.creation.box(extents=[cell, span, 2.5 * d])
        # the front face's lower edge is the origin of the tool's frame; raked, it leans back on a flat foot
        plate.apply_translation([-0.5 * cell, 0.0, 1.25 * d])
        shear = np.eye(4)
        shear[0, 2] = -1.0 / math.tan(rake)
        plate.apply_transform(shear)
        start = np.array([2.0 * d, 0.0, bed - d])
        settings = Settings(
            friction_angle=self.friction_angle,
            tool_friction=self.tool_friction,
            wall_friction=0.0,
            floor_friction=0.6,
            matching=Matching.PLANE_STRAIN,
        )
        # rows of particles lean as the blade does, so that soil lies against both its faces from the start
        margin = 0.5 * cell * math.ceil(2.0 * bed / math.tan(rake) / cell)
        x = lattice([-margin, 0.0, 0.0], [length + margin, wide, bed], 0.5 * cell, self.seed)
        across = x[:, 0] - start[0]
        inside = (across < 0.0) & (across > -cell) & (x[:, 2] > start[2]) & (x[:, 1] < 0.5 * span)
        x[:, 0] -= (x[:, 2] - start[2]) / math.tan(rake)
        x = x[~inside & (x[:, 0] > 0.0) & (x[:, 0] < length)]
        fine = resolution(cell, SPEED, density=DENSITY, young=2.0e6, transport=0.05)
        scene = Scene(x, (length, wide, bed + 2.0 * d), fine, settings, mesh=plate)
        way, force = scene.push(start, SPEED, 0.5 * d, device)
        return way / d, -force[:, 0] / (wide if self.width is None else 0.5)

    def force(self, device: str) -> float:
        """Mean pushing force in ``WINDOW``, in the unit of ``expected``."""
        return in_window(*self.measure(device))


def in_window(way: FloatArray, force: FloatArray) -> float:
    """Mean of forces (n,) at ways over depth (n,) in ``WINDOW``."""
    return float(force[(way >= WINDOW[0]) & (way <= WINDOW[1])].mean())


CASES = {
    "upright, smooth, φ = 25°": Blade(0.08, friction_angle=25.0),
    "upright, smooth, φ = 35°": Blade(0.08),
    "upright, smooth, φ = 45°": Blade(0.08, friction_angle=45.0),
    "raked 60°, smooth": Blade(0.08, rake=60.0),
    "raked 45°, smooth": Blade(0.08, rake=45.0),
    "upright, δ = 20°": Blade(0.08, tool_friction=STEEL),
    "raked 60°, δ = 20°": Blade(0.08, rake=60.0, tool_friction=STEEL),
    "narrow (as wide as deep), upright, smooth": Blade(0.08, width=0.08, cells=8.0),
    "narrow (twice as wide as deep)": Blade(0.08, width=0.16, cells=8.0),
}


def validate(device: str) -> Section:
    """Single blades, the trends in depth, friction and rake, and one blade with the grid and the seed changed."""
    rows, curves, between = [], {}, 0
    for name, blade in CASES.items():
        way, force = blade.measure(device)
        count = max(1, len(way) // 40)
        smooth = np.convolve(force / blade.expected, np.ones(count) / count, mode="valid")
        curves[name] = np.linspace(way[0], way[-1], len(smooth)), smooth
        found, unit = in_window(way, force), "N/m" if blade.width is None else "N"
        between += blade.isochoric <= found <= blade.expected
        row = Row.near(name, found, blade.expected, SCATTER, f"{{:.1f}} {unit}")
        rows.append(replace(row, expected=f"{row.expected} (at φ*: {blade.isochoric:.1f})"))
    rows.append(Row("blades that bear between McKyes at φ* and at φ", f"{between} of {len(CASES)}", "reported"))
    for cell, depths in ((0.01, (0.04, 0.08, 0.16)), (0.005, (0.06, 0.08, 0.12))):
        forces = [Blade(d, cells=d / cell).force(device) for d in depths]
        power = float(np.polyfit(np.log(depths), np.log(forces), 1)[0])
        name = f"{', '.join(f'{100 * d:g}' for d in depths)} cm deep on one grid of {1000 * cell:g} mm"
        rows.append(Row(f"{name}: force ∝ depthⁿ", f"n = {power:.2f}", "2 ± 0.15", abs(power - 2.0) <= 0.15))
        slope, offset = np.polyfit(depths, np.sqrt(forces), 1)
        factor = DENSITY * GRAVITY * mckyes(90.0, 0.0, 35.0)[0]
        held, text = abs(slope**2 / factor - 1.0) <= SCATTER, f"extra = {offset / slope / cell:.2f} cells"
        what = "the same as A (d + extra)²"
        rows.append(Row(what, f"{text}, A {percent(slope**2, factor)}", "A: McKyes ± 25 %", held))
    control, wrong = Blade(0.08, friction_angle=50.0).force(device), CASES["upright, smooth, φ = 25°"].expected
    name = "control: sand of 50° judged as one of 25°"
    rows.append(Row.near(name, control, wrong, SCATTER, "{:.1f} N/m", inside=False))
    seeds = [Blade(0.08, seed=seed).force(device) for seed in range(5)]
    mean, scatter = float(np.mean(seeds)), float(np.std(seeds, ddof=1))
    rows.append(Row("upright, smooth, φ = 35°: mean of 5 seeds", f"{mean:.1f} N/m, scatter {scatter:.1f}", "reported"))
    rows.append(Row.near("half the cell", Blade(0.08, cells=24.0).force(device), mean, 0.1, "{:.1f} N/m"))
    figure, axes = curves_of(curves, "way / depth", "force / McKyes")
    axes.axhspan(1.0 - SCATTER, 1.0 + SCATTER, color="0.92", zorder=0)
    axes.axvspan(*WINDOW, color="0.85", zorder=0)
    axes.set_ylim(0.0, 1.8)
    return Section("Blade force", rows, figure)
