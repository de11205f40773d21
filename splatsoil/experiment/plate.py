"""A plate loading test as an experiment: force over depth from the solver, without pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.forces import SCALE, compressed
from splatsoil.experiment.laboratory import LaboratoryExperiment
from splatsoil.experiment.plow import FINER_RESOLUTIONS
from splatsoil.measurement import Bed, Measurement, Tool, ToolMotion
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.reconstruction import HeightField, fill
from splatsoil.soil.effect import Effect

FROUDE = 0.1
"""Froude number of the simulated plate: inertia is 1 % of the weight of soil of one diameter's depth."""
FRAMES = 100
"""Frames for a penetration of one diameter."""
WIDE, DEEP = 2.0, 1.5
"""Width of the quarter bed and its depth below the plate, in diameters: they contain Prandtl's mechanism."""
FINER = 4.0 / 3.0
"""Cells across a plate over the preset's across a tool."""
RIGID = 100.0
"""Minimum Young's modulus over the largest mean pressure: elastic settlement is 1 % of the diameter."""
ROOM = 0.25
"""Free height above the surface, as a share of the bed's depth."""
GRAVITY = 9.81
CELLS = 8
"""Cells of the level surface along each side."""
SMOOTH = 2
"""Frames on either side over which the simulated force is averaged."""


@dataclass(frozen=True, eq=False)
class Loading:
    """A measured plate loading test.

    Attributes:
        diameter: of the plate, m.
        depths: (t,) of its underside below the surface, m, increasing.
        forces: (t,) upward force, N.
        spread: (t,) or one standard deviation of the force between trials, N.
        density: bulk density of the soil, kg/m³.
        friction: Coulomb coefficient between plate and soil.
        name: of the test.

    Raises:
        ParameterError: depths do not increase, or forces do not match.
    """

    diameter: float
    depths: FloatArray
    forces: FloatArray
    spread: FloatArray
    density: float = 1600.0
    friction: float = 0.3
    name: str = "plate"

    def __post_init__(self) -> None:
        depth = self.depths
        if depth.shape != self.forces.shape or len(depth) < 2 or np.any(np.diff(depth) <= 0.0) or depth[0] <= 0.0:
            raise ParameterError("a plate test needs at least two increasing depths, each with its force")


class PlateExperiment(LaboratoryExperiment):
    """A flat circular plate pressed straight down into level soil, of which a quarter is simulated.

    Features are forces at the measured depths, see :func:`~splatsoil.experiment.forces.compressed`. Forces oscillate
    with the period of a cell, so each seed has another offset of the grid.

    Args:
        test: the measurement.
        effects: that are on.
        candidates: effects to consider; all of physics by default.
        known: parameters that are not fitted.
        preset: resolution of the solver: `FINER` times as many cells across the plate as across a tool.
        device: ``cpu`` or ``cuda:N``.
    """

    kind = "plate"
    stochastic = True
    discretisations = tuple(FINER_RESOLUTIONS)

    def __init__(
        self,
        test: Loading,
        *,
        effects: Iterable[str | Effect] = (),
        candidates: Iterable[str | Effect] | None = None,
        known: Mapping[str, float] | None = None,
        preset: str = "small",
        device: str = "cpu",
    ) -> None:
        super().__init__(test.name, effects, candidates, known)
        self.test, self.device = test, device
        self._largest = float(np.abs(test.forces).max())
        share = 100.0 * test.forces[:, None] / self._largest
        error = np.broadcast_to(test.spread, test.depths.shape)[:, None]
        self._set_observation(
            compressed(share),
            100.0 * error / self._largest / np.sqrt(1.0 + (share / SCALE) ** 2),
            1e3 * test.depths,
            "depth, mm",
            "% of the largest force, asinh",
            ("force",),
            "plate",
        )
        if preset not in PRESETS:
            raise ParameterError(f"preset {preset!r} is unknown; known are {', '.join(PRESETS)}")
        chosen = replace(PRESETS[preset], cells_across_tool=FINER * PRESETS[preset].cells_across_tool)
        resolution = Resolution.derive(self.set_up(), chosen)
        pressure = self._largest / (0.25 * np.pi * test.diameter**2)
        stiffer = max(RIGID * pressure / chosen.young, 1.0)
        self.resolution = replace(resolution, bulk=stiffer * resolution.bulk, shear=stiffer * resolution.shear)

    def features(self, readings: FloatArray) -> FloatArray:
        """In % of the largest measured force, compressed."""
        return compressed(100.0 * readings / self._largest)

    def readings(self, run: Run) -> FloatArray:
        """(t, 1) upward forces in N."""
        resolution = FINER_RESOLUTIONS[run.variant](self.resolution) if run.variant else self.resolution
        # soil stays a skin's thickness away from the tool, so the plate is that much narrower
        offset = float(np.random.default_rng([run.seed, 1]).random()) * resolution.cell
        experiment = self.set_up(resolution.skin * resolution.spacing, offset)
        bed = experiment.bed
        low, span = bed.lower, bed.upper - bed.lower
        x, y = (low[k] + span[k] * (np.arange(CELLS) + 0.5) / CELLS for k in (0, 1))
        surface = HeightField(x, y, np.full((CELLS, CELLS), _surface_of(bed)))
        last = int(experiment.tool.motion.frames[-1])
        trajectory = simulate(
            experiment,
            fill(surface, bed, resolution.spacing, seed=run.seed),
            self.values(run.values),
            law=self.law(run.effects),
            resolution=resolution,
            frames=(0, last),
            device=self.device,
        )[0]
        upward = np.concatenate([[0.0], 4.0 * trajectory.force[:, 2]])
        width = 2 * SMOOTH + 1
        smooth = np.convolve(np.pad(upward, SMOOTH, mode="edge"), np.full(width, 1.0 / width), mode="valid")
        # A frame's force is the mean over the frame that ends there.
        depth = (np.arange(len(smooth)) - 0.5) * self.test.diameter / FRAMES
        return np.interp(self.test.depths, depth, smooth)[:, None]

    def set_up(self, skin: float = 0.0, offset: float = 0.0) -> Measurement:
        """Bed and plate for the solver; smooth walls are symmetry planes.

        Args:
            skin: by how much the plate is narrower all around, m.
            offset: by how much the bed is deeper, m.
        """
        diameter, deepest = self.test.diameter, float(self.test.depths[-1])
        width, depth = WIDE * diameter, DEEP * diameter + deepest + offset
        bed = Bed(
            np.zeros(3),
            np.array([width, width, (1.0 + ROOM) * depth]),
            density=self.test.density,
            wall_friction=0.0,
            floor_friction=0.6,
        )
        thick = 0.25 * diameter
        plate = trimesh.creation.cylinder(radius=0.5 * diameter - skin, height=thick, sections=48)
        step = diameter / FRAMES
        frame_rate = FROUDE * float(np.sqrt(GRAVITY * diameter)) / step
        count = int(np.ceil(deepest / step)) + SMOOTH + 2
        frames = np.arange(count)
        positions = np.zeros((count, 3))
        positions[:, 2] = _surface_of(bed) + 0.5 * thick - frames * step
        still = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        motion = ToolMotion(frames, frames / frame_rate, positions, still)
        return Measurement(
            folder=Path(),
            name=self.name,
            gravity=np.array([0.0, 0.0, -GRAVITY]),
            frame_rate=frame_rate,
            bed=bed,
            tool=Tool(plate, motion, friction=self.test.friction),
            views=(),
            video=(),
        )


def _surface_of(bed: Bed) -> float:
    """Height of the level soil."""
    return float(bed.lower[2] + (bed.upper[2] - bed.lower[2]) / (1.0 + ROOM))
