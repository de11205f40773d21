"""A plate pressed into soil as an experiment: the force over depth, from the solver, no pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.errors import ParameterError
from splatsoil.experiment.forces import SCALE, compressed
from splatsoil.experiment.laboratory import FloatArray, LaboratoryExperiment
from splatsoil.experiment.plow import FINER_RESOLUTIONS
from splatsoil.measurement import Bed, Measurement, Tool, ToolMotion
from splatsoil.mpm import PRESETS, Preset, Resolution, simulate
from splatsoil.reconstruction import HeightField, fill
from splatsoil.soil.effect import Effect

FROUDE = 0.1
"""Of the simulated plate's speed, by its diameter: its inertia is a hundredth of the weight of soil as deep as it is
wide, and the soil bears ten times that weight and more."""
FRAMES = 100
"""In which the plate goes as deep as it is wide."""
WIDE, DEEP = 2.0, 1.5
"""The quarter bed's width, and its depth below the deepest place of the plate, in plate diameters: what the plate moves
stays inside (Prandtl's mechanism)."""
FINER = 4.0 / 3.0
"""Cells across a plate, of which a quarter is simulated, over those across a tool: 4, 8 and 12."""
RIGID = 100.0
"""Young's modulus over the largest mean pressure: it gives by 1 % of the diameter. Sand is stiffer."""
ROOM = 0.25
"""Of the bed's depth, above its surface."""
GRAVITY = 9.81
CELLS = 8
"""Of the level surface, along each side."""
SMOOTH = 2
"""Frames on either side over which the simulated force is averaged: particles meet the plate one by one."""


class PlateExperiment(LaboratoryExperiment):
    """A flat circular plate pressed straight down into level soil, of which a quarter is simulated.

    Features are forces at the depths that were measured, in % of the largest and relative where they are large, see
    :func:`~splatsoil.experiment.forces.compressed`. Forces wave by the cell; so the grid's offset is drawn by the seed.
    The skeleton is at least `RIGID` times as stiff as the largest mean
    pressure under the plate.

    Args:
        diameter: of the plate, m.
        depths: (t,) of its underside below the surface, m, increasing.
        forces: (t,) measured upward force, N.
        spread: (t,) standard deviation of the measured force between trials, N.
        density: bulk density, kg/m³.
        effects: that are on.
        candidates: effects to consider; all of physics by default.
        known: parameters that are not fitted.
        friction: Coulomb coefficient between plate and soil.
        preset: resolution of the solver: `FINER` times as many cells across the plate as across a tool.
        device: ``cpu`` or ``cuda:N``.

    Raises:
        ParameterError: depths and forces don't match.
    """

    kind = "plate"
    stochastic = True
    discretisations = tuple(FINER_RESOLUTIONS)

    def __init__(
        self,
        diameter: float,
        depths: npt.ArrayLike,
        forces: npt.ArrayLike,
        spread: npt.ArrayLike,
        *,
        density: float = 1600.0,
        effects: Iterable[str | Effect] = (),
        candidates: Iterable[str | Effect] | None = None,
        known: Mapping[str, float] | None = None,
        friction: float = 0.3,
        preset: str = "small",
        device: str = "cpu",
        name: str = "plate",
    ) -> None:
        depth, force = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (depths, forces))
        if depth.shape != force.shape or len(depth) < 2 or np.any(np.diff(depth) <= 0.0) or depth[0] <= 0.0:
            raise ParameterError("a plate test needs at least two increasing depths, each with its force")
        super().__init__(name, effects, candidates, known)
        self.device, self.diameter, self.depths = device, diameter, depth
        self._largest = float(np.abs(force).max())
        share = 100.0 * force[:, None] / self._largest
        error = np.broadcast_to(np.asarray(spread, dtype=np.float64).reshape(-1), depth.shape)[:, None]
        self._read(
            compressed(share),
            100.0 * error / self._largest / np.sqrt(1.0 + (share / SCALE) ** 2),
            1e3 * depth,
            "depth, mm",
            "% of the largest force, asinh",
            ("force",),
            "plate",
        )
        self.density, self.friction = density, friction
        chosen = _finer(preset)
        resolution = Resolution.derive(self.set_up(), chosen)
        pressure = self._largest / (0.25 * np.pi * diameter**2)
        stiffer = max(RIGID * pressure / chosen.young, 1.0)
        self.resolution = replace(resolution, bulk=stiffer * resolution.bulk, shear=stiffer * resolution.shear)

    def features(self, readings: FloatArray) -> FloatArray:
        """In % of the largest measured force, compressed."""
        return compressed(100.0 * readings / self._largest)

    def readings(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, variant: str = ""
    ) -> FloatArray:
        """(t, 1) upward forces in N; arguments as for `predict`."""
        resolution = FINER_RESOLUTIONS[variant](self.resolution) if variant else self.resolution
        # soil stops at a distance from the tool's faces: the plate is that much narrower than what the soil feels
        offset = float(np.random.default_rng([seed, 1]).random()) * resolution.cell
        experiment = self.set_up(resolution.skin * resolution.spacing, offset)
        bed = experiment.bed
        low, span = bed.lower, bed.upper - bed.lower
        x, y = (low[k] + span[k] * (np.arange(CELLS) + 0.5) / CELLS for k in (0, 1))
        surface = HeightField(x, y, np.full((CELLS, CELLS), _surface_of(bed)))
        last = int(experiment.tool.motion.frames[-1])
        run = simulate(
            experiment,
            fill(surface, bed, resolution.spacing, seed=seed),
            self.values(values),
            law=self.law(effects),
            resolution=resolution,
            frames=(0, last),
            device=self.device,
        )[0]
        upward = np.concatenate([[0.0], 4.0 * run.force[:, 2]])
        width = 2 * SMOOTH + 1
        smooth = np.convolve(np.pad(upward, SMOOTH, mode="edge"), np.full(width, 1.0 / width), mode="valid")
        # A frame's force is the mean over the frame that ends there.
        depth = (np.arange(len(smooth)) - 0.5) * self.diameter / FRAMES
        return np.interp(self.depths, depth, smooth)[:, None]

    def set_up(self, skin: float = 0.0, offset: float = 0.0) -> Measurement:
        """Bed and plate as the solver takes them; smooth walls stand for the symmetry, and there are no cameras.

        Args:
            skin: by how much the plate is narrower all around, m.
            offset: by how much the bed is deeper, m.
        """
        diameter, deepest = self.diameter, float(self.depths[-1])
        width, depth = WIDE * diameter, DEEP * diameter + deepest + offset
        bed = Bed(
            np.zeros(3),
            np.array([width, width, (1.0 + ROOM) * depth]),
            density=self.density,
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
            tool=Tool(plate, motion, friction=self.friction),
            views=(),
            video=(),
        )


def _finer(name: str) -> Preset:
    """A preset with cells for a plate.

    Raises:
        ParameterError: it is unknown.
    """
    if name not in PRESETS:
        raise ParameterError(f"preset {name!r} is unknown; known are {', '.join(PRESETS)}")
    return replace(PRESETS[name], cells_across_tool=FINER * PRESETS[name].cells_across_tool)


def _surface_of(bed: Bed) -> float:
    """Height of the level soil: the rest of the bed's box is room for what rises."""
    return float(bed.lower[2] + (bed.upper[2] - bed.lower[2]) / (1.0 + ROOM))
