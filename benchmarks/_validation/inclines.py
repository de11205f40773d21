"""Part ``inclines``: steady flow down an incline with the mu(I) law, against the Bagnold profile."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from splatsoil.benchmarks._common import FloatArray
from splatsoil.benchmarks._parts import Row, Section, curves_of
from splatsoil.benchmarks._validation.scene import GRAVITY, Scene, lattice, resolution

from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

STATIC, FAST, INERTIAL = math.tan(math.radians(20.9)), math.tan(math.radians(32.8)), 0.279
WAY = 0.2
"""Cells that the fastest soil goes between two exchanges with the grid, and while hourglass modes are damped."""
GRAIN, GRAIN_DENSITY, SOLID = 0.002, 2500.0, 0.6
HEIGHT = 0.02
"""Of the layer, m."""
LOWER = 0.75
"""Share of the layer's height that is judged; above it particles hop."""
ALLOWED = 0.15


@dataclass(frozen=True)
class Chute:
    """A layer on a rough incline, released everywhere at once; m, degrees, s."""

    slope: float = 24.0
    layers: int = 8
    length: float = 0.7
    seconds: float = 0.8
    transport: float = WAY
    rate: bool = True

    @property
    def inertial_number(self) -> float:
        """I at which mu(I) bears the slope."""
        tangent = math.tan(math.radians(self.slope))
        return INERTIAL * (tangent - STATIC) / (FAST - tangent)

    def friction_error(self, ratio: float) -> float:
        """Relative error of friction that makes the layer flow ``ratio`` times as fast."""
        number = ratio * self.inertial_number
        return math.tan(math.radians(self.slope)) / (STATIC + (FAST - STATIC) / (1.0 + INERTIAL / number)) - 1.0

    def expected(self, z: FloatArray) -> FloatArray:
        """Bagnold's steady velocity in m/s at heights ``z`` in m above the base."""
        fall = SOLID * GRAVITY * math.cos(math.radians(self.slope))
        shape = HEIGHT**1.5 - (HEIGHT - np.clip(z, 0.0, HEIGHT)) ** 1.5
        return 2.0 * self.inertial_number / (3.0 * GRAIN) * math.sqrt(fall) * shape

    def measure(self, device: str) -> tuple[FloatArray, FloatArray]:
        """Heights (n,) in m, and mean velocities along the slope (n,) of the middle fifth, m/s."""
        cell, turn = HEIGHT / self.layers, math.radians(self.slope)
        settings = Settings(
            friction_angle=20.9,
            gravity=(GRAVITY * math.sin(turn), 0.0, -GRAVITY * math.cos(turn)),
            wall_friction=0.0,
            floor_friction=10.0,
            matching=Matching.SIMPLE_SHEAR,
        )
        fastest, density = float(self.expected(np.array([HEIGHT]))[0]), SOLID * GRAIN_DENSITY
        scene = Scene(
            lattice([0.0, 0.0, 0.0], [self.length, cell, HEIGHT], 0.5 * cell),
            (self.length, cell, 3.0 * HEIGHT),
            resolution(cell, fastest, density=density, young=1.0e5, transport=self.transport, way=WAY),
            settings,
            ("rate_dependence",) if self.rate else (),
            {"rate_gain": FAST / STATIC - 1.0, "rate_grain_size": GRAIN} if self.rate else {},
        )
        run = scene.rest(self.seconds, device)
        x, speed = run.positions()[0], run.velocities()[0][:, 0]
        middle = np.abs(x[:, 0] - 0.6 * self.length) < 0.1 * self.length
        layers = [middle & (np.floor(x[:, 2] / cell) == k) for k in range(self.layers)]
        means = [speed[layer].mean() if layer.any() else np.nan for layer in layers]
        return np.linspace(0.5 * cell, HEIGHT - 0.5 * cell, self.layers), np.array(means)

    def ratio(self, device: str) -> float:
        """Mean of speed over Bagnold's in the lower part of the layer."""
        return self.over_bagnold(*self.measure(device))

    def over_bagnold(self, z: FloatArray, speed: FloatArray) -> float:
        """The same of speeds (n,) in m/s at heights (n,) in m."""
        low = z < LOWER * HEIGHT
        return float(np.nanmean(speed[low] / self.expected(z[low])))


def validate(device: str) -> Section:
    """Three slopes, one of them with the grid, the step and the layer changed, and what happens without the effect."""
    rows, curves = [], dict[str, tuple[FloatArray, FloatArray]]()
    for slope in (23.0, 24.0, 25.0):
        chute = Chute(slope)
        z, speed = chute.measure(device)
        found, fine = chute.over_bagnold(z, speed), np.linspace(0.0, HEIGHT, 60)
        bagnold = chute.expected(fine)
        curves |= {f"{slope:g}°, Bagnold": (bagnold, fine / HEIGHT), f"{slope:g}°": (speed, z / HEIGHT)}
        case = f"{slope:g}° (I = {chute.inertial_number:.3f}, surface {bagnold[-1]:.2f} m/s)"
        text = f"u / u_Bagnold = {found:.2f}, as if friction were {100.0 * chute.friction_error(found):+.1f} %"
        rows.append(Row(case, text, f"1 ± {ALLOWED:g}", abs(found - 1.0) <= ALLOWED))
    for case, chute in (
        ("23° on cells of two thirds", Chute(23.0, layers=12)),
        ("23°, half the step of the particles", Chute(23.0, transport=0.1)),
        ("23°, half as long again, layer and time", Chute(23.0, length=1.0, seconds=1.2)),
    ):
        rows.append(Row(case, f"u / u_Bagnold = {chute.ratio(device):.2f}", "reported"))
    control = Chute(rate=False).ratio(device)
    rows.append(Row.near("control: 24° without rate dependence", control, 1.0, ALLOWED, inside=False))
    figure, _ = curves_of(curves, "speed along the slope, m/s", "height / h")
    return Section("Flow down an incline", rows, figure)
