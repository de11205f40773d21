"""A plate pressed into soil as an experiment: the force over depth, from the solver, no pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.errors import ParameterError
from splatsoil.experiment.base import candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.experiment.forces import SCALE, compressed
from splatsoil.experiment.plow import NUMERICS
from splatsoil.measurement import Bed, Measurement, Tool, ToolMotion
from splatsoil.mpm import Resolution, simulate
from splatsoil.parameters import Parameter
from splatsoil.reconstruction import HeightField, fill
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library

FloatArray = npt.NDArray[np.float64]

FROUDE = 0.1
"""Of the simulated plate's speed, by its diameter: its inertia is a hundredth of the weight of soil as deep as it is
wide, and the soil bears ten times that weight and more."""
FRAMES = 100
"""In which the plate goes as deep as it is wide."""
WIDE, DEEP = 2.0, 1.5
"""The quarter bed's width, and its depth below the deepest place of the plate, in plate diameters: what the plate moves
stays inside (Prandtl's mechanism)."""
ROOM = 0.25
"""Of the bed's depth, above its surface."""
GRAVITY = 9.81
CELLS = 8
"""Of the level surface, along each side."""
SMOOTH = 2
"""Frames on either side over which the simulated force is averaged: particles meet the plate one by one."""


class PlateExperiment:
    """A flat circular plate pressed straight down into level soil, of which a quarter is simulated.

    Features are forces at the depths that were measured, in % of the largest and relative where they are large, see
    :func:`~splatsoil.experiment.forces.compressed`.

    Args:
        diameter: of the plate, m.
        depths: (t,) of its underside below the surface, m, increasing.
        forces: (t,) measured upward force, N.
        spread: (t,) standard deviation of the measured force between trials, N.
        density: bulk density, kg/m³.
        effects: names of the effects that are on.
        friction: Coulomb coefficient between plate and soil.
        preset: resolution of the solver; cells are counted across the plate.
        device: ``cpu`` or ``cuda:N``.

    Raises:
        ParameterError: depths and forces don't match.
    """

    chance = True
    sensor_memory = 0.8
    numerics = tuple(NUMERICS)
    redrawn: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()

    def __init__(
        self,
        diameter: float,
        depths: npt.ArrayLike,
        forces: npt.ArrayLike,
        spread: npt.ArrayLike,
        *,
        density: float = 1600.0,
        effects: Iterable[str] = (),
        friction: float = 0.3,
        preset: str = "small",
        device: str = "cpu",
        name: str = "plate",
    ) -> None:
        depth, force = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (depths, forces))
        if depth.shape != force.shape or len(depth) < 2 or np.any(np.diff(depth) <= 0.0) or depth[0] <= 0.0:
            raise ParameterError("a plate test needs at least two increasing depths, each with its force")
        self.name, self.preset, self.device = name, preset, device
        self.diameter, self.depths = diameter, depth
        self.model = tuple(effects)
        law = Law(find_effects(self.model))
        self.parameters: tuple[Parameter, ...] = tuple(
            p for p in law.parameters if p.off is not None or p.name == "friction_angle"
        )
        acting = (e for e in library().values() if not (e.numerical or e.observes))
        self.candidates = candidates_of(acting, law.effects)
        half = 0.5 * float(depth[-1])
        self.layout = Layout(
            times=tuple(float(1e3 * d) for d in depth),
            sites=(Site("force"),),
            time_name="depth, mm",
            unit="% of the largest force, asinh",
            stages=tuple("shallow" if d <= half else "deep" for d in depth),
            regions=np.full((len(depth), 1), "plate"),
        )
        self._largest = float(np.abs(force).max())
        share = 100.0 * force[:, None] / self._largest
        self.observed = compressed(share)
        self.seen = np.ones(self.layout.shape, dtype=bool)
        self.quiet = np.zeros(self.layout.shape, dtype=bool)
        error = np.broadcast_to(np.asarray(spread, dtype=np.float64).reshape(-1), depth.shape)[:, None]
        self.sensor = 100.0 * error / self._largest / np.sqrt(1.0 + (share / SCALE) ** 2)
        self.experiment = _set_up(diameter, float(depth[-1]), density, friction)
        self.resolution = Resolution.derive(self.experiment, preset)

    def predict(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, 1) features; see :class:`~splatsoil.experiment.base.Experiment`."""
        force = self.forces(values, effects=effects, seed=seed, numerics=numerics)
        return compressed(100.0 * force[:, None] / self._largest)

    def forces(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t,) upward forces in N; arguments as for `predict`."""
        resolution = NUMERICS[numerics](self.resolution) if numerics else self.resolution
        bed = self.experiment.bed
        low, span = bed.lower, bed.upper - bed.lower
        x, y = (low[k] + span[k] * (np.arange(CELLS) + 0.5) / CELLS for k in (0, 1))
        surface = HeightField(x, y, np.full((CELLS, CELLS), _surface_of(bed)))
        last = int(self.experiment.tool.motion.frames[-1])
        run = simulate(
            self.experiment,
            fill(surface, bed, resolution.spacing, seed=seed),
            dict(values),
            law=Law(find_effects(dict.fromkeys((*self.model, *effects)))),
            resolution=resolution,
            frames=(0, last),
            device=self.device,
        )[0]
        upward = np.concatenate([[0.0], 4.0 * run.force[:, 2]])
        width = 2 * SMOOTH + 1
        smooth = np.convolve(np.pad(upward, SMOOTH, mode="edge"), np.full(width, 1.0 / width), mode="valid")
        # A frame's force is the mean over the frame that ends there.
        depth = (np.arange(len(smooth)) - 0.5) * self.diameter / FRAMES
        return np.interp(self.depths, depth, smooth)


def _surface_of(bed: Bed) -> float:
    """Height of the level soil: the rest of the bed's box is room for what rises."""
    return float(bed.lower[2] + (bed.upper[2] - bed.lower[2]) / (1.0 + ROOM))


def _set_up(diameter: float, deepest: float, density: float, friction: float) -> Measurement:
    """Bed and plate as the solver takes them; smooth walls stand for the symmetry, and there are no cameras."""
    width, depth = WIDE * diameter, DEEP * diameter + deepest
    bed = Bed(
        np.zeros(3),
        np.array([width, width, (1.0 + ROOM) * depth]),
        density=density,
        wall_friction=0.0,
        floor_friction=0.6,
    )
    thick = 0.25 * diameter
    plate = trimesh.creation.cylinder(radius=0.5 * diameter, height=thick, sections=48)
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
        name="plate",
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        frame_rate=frame_rate,
        bed=bed,
        tool=Tool(plate, motion, friction=friction),
        views=(),
        video=(),
    )
