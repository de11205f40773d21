"""Scenes of synthetic experiments: beds, tools and soils drawn from one stream of random numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from splatsoil.measurement import Tool
from splatsoil.reconstruction import HeightField
from splatsoil.synthetic import Setup, plow
from splatsoil.synthetic.setups import FRAME_RATE, STAGES, drum, highest, plane, plate, staged_motion, waves

ANGLES = (22.0, 48.0)
"""Range of friction angles, degrees; estimates search 20 to 50."""
DENSITIES = (1400.0, 1700.0)
"""Bulk density of loose and of dense sand, kg/m³."""
BEDS = ("flat", "wavy", "sloping")
SLOPES = (3.0, 7.0)
"""Of a sloping bed, degrees."""
TOOLS = (("blade", 0.12, 20.0), ("blade", 0.16, 0.0), ("drum", 0.12, 0.0), ("blade", 0.12, 0.0), ("blade", 0.16, 20.0))
"""Kind, width in m and tilt in degrees."""
DEPTHS = {"blade": (0.05, 0.09), "drum": (0.03, 0.06)}
"""Of the tool's lowest point under the soil along its way, m: no wheel sinks in to its axle."""
RADIUS = 0.06
"""Of the drum, m."""
ROLLING = (0.7, 1.3)
"""Turn of the drum over that of a wheel that doesn't slip."""
SOIL = 0.12
"""Mean depth of the soil, m."""
START, WAY, SPEED = (0.2, 0.25), 0.3, 0.2
"""Of the tool: where it is lowered, m, how far it is pushed, m, and how fast, m/s."""
GAP = 0.01
"""Between the tool and the soil under it before it moves, m."""


@dataclass(frozen=True)
class Scene:
    """What is ploughed.

    Attributes:
        seed: of a wavy surface and of the particles.
        angle: friction angle, degrees.
        bed: "flat", "wavy" or "sloping".
        slope: of a sloping bed, degrees.
        towards: where it rises, degrees from +x to +y.
        density: bulk density, kg/m³.
        tool: "blade" or "drum".
        width: of the tool, m.
        tilt: of the blade, degrees.
        depth: of the tool's lowest point under the mean surface along its way, m.
        rolling: turn of the drum over that of a wheel that doesn't slip.
        tool_friction: Coulomb coefficient.
    """

    seed: int
    angle: float
    bed: str = "wavy"
    slope: float = 0.0
    towards: float = 0.0
    density: float = 1600.0
    tool: str = "blade"
    width: float = 0.12
    tilt: float = 20.0
    depth: float = 0.07
    rolling: float = 0.0
    tool_friction: float = 0.3

    def setup(self) -> Setup:
        """Bed, surface, tool and motion, before the cameras of `splatsoil.synthetic.plow`."""
        usual = plow()
        bed = replace(usual.bed, density=self.density)
        wavy = self.bed == "wavy"
        surface = waves(bed, SOIL, self.seed) if wavy else plane(bed, SOIL, self.slope, self.towards)
        mesh = plate(self.width) if self.tool == "blade" else drum(self.width, RADIUS)
        roll = self.rolling / RADIUS

        def motion(start: float, down: float) -> Tool:
            way = staged_motion((*START, start), tilt=self.tilt, down=down, push=SPEED, stages=STAGES, roll=roll)
            return Tool(mesh, way, friction=self.tool_friction)

        low, high = motion(0.0, 0.0).bounds(0.0)
        begin = highest(surface, low, high) + GAP
        down = (begin - self._level(surface) + self.depth) * FRAME_RATE / STAGES[0]
        return replace(usual, bed=bed, surface=surface, tool=motion(begin - float(low[2]), down))

    def _level(self, surface: HeightField) -> float:
        """Mean height of the surface along the tool's way, m."""
        x, y = np.linspace(START[0], START[0] + WAY, 31), START[1] + self.width * np.linspace(-0.5, 0.5, 13)
        return float(surface.sample(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).mean())


def draw(rng: np.random.Generator, bed: str, tool: tuple[str, float, float]) -> Scene:
    """A scene with the bed and the tool that are given; everything else at random."""
    kind, width, tilt = tool
    ranges = (ANGLES, DENSITIES, SLOPES, (0.0, 360.0), DEPTHS[kind], ROLLING)
    angle, density, slope, towards, depth, rolling = (float(rng.uniform(*limits)) for limits in ranges)
    seed = int(rng.integers(1000, 2**20))
    slope, towards = (slope, towards) if bed == "sloping" else (0.0, 0.0)
    rolling = rolling if kind == "drum" else 0.0
    return Scene(seed, angle, bed, slope, towards, density, kind, width, tilt, depth, rolling)


def scenes(seed: int) -> Iterator[Scene]:
    """Without end, from one stream; every bed comes in any three from the first on, every tool in any five."""
    rng = np.random.default_rng(seed)
    beds: list[str] = []
    tools: list[int] = []
    while True:
        beds = beds or list(rng.permutation(BEDS))
        tools = tools or list(rng.permutation(len(TOOLS)))
        yield draw(rng, str(beds.pop()), TOOLS[int(tools.pop())])
