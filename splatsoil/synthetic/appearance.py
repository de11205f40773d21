"""Random appearance of a synthetic experiment: sun and sky, albedo of sand, bin, ground and tool."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Bed
from splatsoil.synthetic.stage import Light

AZIMUTHS = (0.0, 360.0)
ELEVATIONS = (35.0, 60.0)
"""Of the sun, degrees."""
SKY_SHARES = (0.25, 0.45)
"""Share of the light on level ground that comes from the sky."""
SUN_TINT = (1.03, 1.0, 0.94)
SKY_TINT = (0.94, 1.0, 1.08)
SAND = (0.58, 0.43, 0.26)
"""Albedo times exposure, linear: what level, open sand shows."""
BLOTCHES = (0.06, 0.3)
"""Shortest and longest wavelength of the blotches, as shares of the bed's narrower side."""
BLOTCH_CONTRAST = 0.2
HUE_CONTRAST = 0.05
SPECKLE = 0.05
"""Standard deviations of the logarithm of the albedo: blotches, their blue, and particles on their own."""
_WAVES = 64


@dataclass(frozen=True)
class Appearance:
    """Looks of one world; colours are linear albedo (3,), exposure included.

    Attributes:
        azimuth: of the sun, degrees from +x towards +y.
        elevation: of the sun, degrees.
        sky_share: share of the light on level ground that comes from the sky.
        sand: mean of the soil.
        bin: walls and floor.
        ground: what the bin stands on.
        tool: the tool.
        seed: of the blotches and fine patterns.
    """

    azimuth: float
    elevation: float
    sky_share: float
    sand: tuple[float, float, float]
    bin: tuple[float, float, float]
    ground: tuple[float, float, float]
    tool: tuple[float, float, float]
    seed: int

    @classmethod
    def drawn(cls, seed: int) -> Appearance:
        """Looks by seed."""
        generator = np.random.default_rng([seed, 1])

        def colour(base: tuple[float, float, float], spread: float) -> tuple[float, float, float]:
            r, g, b = np.asarray(base) * np.exp(spread * generator.uniform(-1.0, 1.0, 3))
            return float(r), float(g), float(b)

        return cls(
            azimuth=float(generator.uniform(*AZIMUTHS)),
            elevation=float(generator.uniform(*ELEVATIONS)),
            sky_share=float(generator.uniform(*SKY_SHARES)),
            sand=colour(SAND, 0.06),
            bin=colour((0.42, 0.44, 0.44), 0.05),
            ground=colour((0.25, 0.27, 0.29), 0.05),
            tool=colour((0.04, 0.11, 0.46), 0.1),
            seed=int(generator.integers(2**31)),
        )

    @property
    def light(self) -> Light:
        """Sun and sky that light level, open ground with 1 together (green; tinted in red and blue)."""
        sun = (1.0 - self.sky_share) / math.sin(math.radians(self.elevation))
        return Light.from_angles(
            self.azimuth, self.elevation, sun * np.array(SUN_TINT), self.sky_share * np.array(SKY_TINT)
        )

    def sand_albedo(self, particles: FloatArray, bed: Bed) -> FloatArray:
        """Albedo (n, 3), linear, of particles by their places (n, 3) before anything moves."""
        generator = np.random.default_rng([self.seed, 2])
        width = float(bed.extents[:2].min())
        blotches, hue = (_random_field(particles, BLOTCHES[0] * width, BLOTCHES[1] * width, generator) for _ in "ab")
        speckle = generator.standard_normal(len(particles))
        tone = np.exp(BLOTCH_CONTRAST * np.clip(blotches, -2.5, 2.5) + SPECKLE * np.clip(speckle, -2.5, 2.5))
        colours = tone[:, None] * np.array(self.sand)
        colours[:, 2] *= np.exp(HUE_CONTRAST * hue)
        return np.clip(colours, 0.0, 0.95)


def _random_field(points: FloatArray, shortest: float, longest: float, generator: np.random.Generator) -> FloatArray:
    """A Gaussian random field of mean 0 and variance 1 at points (n, 3), of waves between two lengths in m."""
    lengths = np.exp(generator.uniform(math.log(shortest), math.log(longest), _WAVES))
    directions = generator.standard_normal((_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phases = generator.uniform(0.0, 2.0 * math.pi, _WAVES)
    out = np.zeros(len(points))
    for length, direction, phase in zip(lengths, directions, phases, strict=True):
        out += np.cos(points @ (2.0 * math.pi / length * direction) + phase)
    return out * math.sqrt(2.0 / _WAVES)
