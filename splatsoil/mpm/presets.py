"""Presets, and the resolution and time step that follow from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatsoil.errors import ParameterError, SimulationError
from splatsoil.measurement import Measurement

COURANT_LIMIT = 0.8
"""Of the substeps: a full cell becomes unstable at 1."""


@dataclass(frozen=True)
class Preset:
    """How finely to simulate.

    Attributes:
        name: what the command line calls it.
        cells_across_tool: cells along the tool's second longest edge (a blade's width).
        particles_per_edge: particles along a cell's edge at the start.
        young: Young's modulus in Pa. Sand is stiffer, but three times as much changes nothing (docs/numerics.md), and a
            softer skeleton allows longer steps.
        poisson: Poisson's ratio.
        courant: sound-wave Courant number of a substep.
        transport: most cells the tool may travel in one step of the particles.
        way: of the tool, in cells, over which hourglass modes are damped once, see :attr:`Resolution.relaxation`.
    """

    name: str
    cells_across_tool: float
    particles_per_edge: int = 2
    young: float = 5.0e6
    poisson: float = 0.3
    courant: float = 0.5
    transport: float = 0.1
    way: float = 1.0 / 15.0


PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("tiny", cells_across_tool=3.0, transport=0.2, way=0.2),
        Preset("small", cells_across_tool=6.0),
        Preset("fine", cells_across_tool=9.0),
        Preset("paper", cells_across_tool=3.2, young=1.0e6, poisson=0.2, way=0.1),
    )
}


@dataclass(frozen=True)
class Resolution:
    """Lengths, times and stiffness of one simulation.

    Attributes:
        cell: nominal edge of a grid cell in m.
        spacing: edge of the cube of soil that a particle stands for, in m.
        frame_time: time between frames in s.
        steps: steps of the particles in a frame.
        courant: sound-wave Courant number of a substep of the grid.
        bulk: bulk modulus in Pa.
        shear: shear modulus in Pa.
        density: bulk density in kg/m^3.
        relaxation: exchanges between particles and grid a second of which hourglass modes and the tool's contact shall
            know, whatever the number of ``steps``: the former are damped as that many plain APIC exchanges would, soil
            sunk into the tool comes out at twice the rate. 0 for as many as there are.
        skin: of the spacing, how far from a tool's faces particles stop, because they stand for soil half a spacing
            around them. The edges of a plate thinner than a cell need none: contact acts through the grid, which
            widens them.
    """

    cell: float
    spacing: float
    frame_time: float
    steps: int
    courant: float
    bulk: float
    shear: float
    density: float
    relaxation: float = 0.0
    skin: float = 0.5

    def __post_init__(self) -> None:
        for name in ("cell", "spacing", "frame_time", "steps", "courant", "bulk", "shear", "density"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SimulationError(f"resolution: {name} = {value} must be a positive number")
        if not (math.isfinite(self.relaxation) and self.relaxation >= 0.0):
            raise SimulationError(f"resolution: relaxation = {self.relaxation} must be 0 or a positive number")
        if not 0.0 <= self.skin <= 1.0:
            raise SimulationError(f"resolution: skin = {self.skin} must be between 0 and 1")
        if self.courant > COURANT_LIMIT:
            raise SimulationError(
                f"resolution: a Courant number of {self.courant} breaks the wave-speed limit of {COURANT_LIMIT}"
            )

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves in m/s."""
        return math.sqrt((self.bulk + 4.0 * self.shear / 3.0) / self.density)

    def substeps(self, steps: int) -> int:
        """Substeps in each of ``steps`` steps of a frame that keep the Courant limit."""
        return max(1, math.ceil(self.frame_time / steps * self.wave_speed / (self.courant * self.cell) - 1e-9))

    @classmethod
    def derive(cls, measurement: Measurement, preset: Preset | str = "small") -> Resolution:
        """Resolution for a measurement set: the cell from the tool's width, the steps from its speed.

        Raises:
            ParameterError: an unknown preset.
        """
        if isinstance(preset, str):
            if preset not in PRESETS:
                raise ParameterError(f"preset {preset!r} is unknown; known are {', '.join(PRESETS)}")
            preset = PRESETS[preset]
        extents = np.sort(measurement.tool.mesh.extents)
        cell = float(extents[1]) / preset.cells_across_tool
        motion = measurement.tool.motion
        travel = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)
        frame_time = 1.0 / measurement.frame_rate
        fastest = float(travel.max())
        steps = max(1, math.ceil(fastest * frame_time / (preset.transport * cell) - 1e-6))
        return cls(
            cell=cell,
            spacing=cell / preset.particles_per_edge,
            frame_time=frame_time,
            steps=steps,
            courant=preset.courant,
            bulk=preset.young / (3.0 * (1.0 - 2.0 * preset.poisson)),
            shear=preset.young / (2.0 * (1.0 + preset.poisson)),
            density=measurement.bed.density,
            relaxation=fastest / (preset.way * cell),
        )
