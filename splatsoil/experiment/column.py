"""The collapse of a soil column as an experiment: the solver without tool and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.laboratory import LaboratoryExperiment
from splatsoil.experiment.plow import FINER_RESOLUTIONS
from splatsoil.mpm import PRESETS, Resolution, Solver
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import FRICTION_ANGLE, Settings

ACROSS = 1.5
"""Cells along the radius, over the preset's along a tool's width."""
GRAVITY = 9.81
REACH = 2.5
"""Length for the run-out over the column's height; Lube et al. (2004) found at most 1.24."""
REST = 6.0
"""Time to rest, in free-fall times of the column's height."""
CHANNELS = ("radius", "height")
SCATTER = 0.05
"""Standard deviation between trials, in radii of the column, for fewer than three trials."""
THIN = 0.02
"""Thickness at the end of the deposit, as a share of the radius: a few grains."""


@dataclass(frozen=True, eq=False)
class Collapse:
    """Measured collapses of a column.

    Attributes:
        radius: of the column, m.
        height: of it, m.
        deposits: (trials, 2) radius and height of the deposit, m.
        density: bulk density, kg/m³.
        floor_friction: Coulomb coefficient of the floor.
        name: of the test.

    Raises:
        ParameterError: lengths are not positive, or there is no deposit.
    """

    radius: float
    height: float
    deposits: FloatArray
    density: float = 1600.0
    floor_friction: float = 0.6
    name: str = "column"

    def __post_init__(self) -> None:
        deposits = self.deposits
        if not (self.radius > 0.0 and self.height > 0.0 and deposits.size and deposits.shape[1] == len(CHANNELS)):
            raise ParameterError("a column test needs a radius, a height, and both of the deposit for each trial")


class ColumnExperiment(LaboratoryExperiment):
    """The sudden collapse of a circular column, of which a quarter is simulated.

    Args:
        test: the measurement.
        effects: that are on.
        candidates: effects to consider; all of physics by default.
        preset: resolution of the solver.
        device: ``cpu`` or ``cuda:N``.
    """

    kind = "column"
    stochastic = True
    discretisations = tuple(FINER_RESOLUTIONS)

    def __init__(
        self,
        test: Collapse,
        *,
        effects: Iterable[str | Effect] = (),
        candidates: Iterable[str | Effect] | None = None,
        preset: str = "small",
        device: str = "cpu",
    ) -> None:
        super().__init__(test.name, effects, candidates)
        self.test, self.device = test, device
        self.settings = Settings(FRICTION_ANGLE.default, wall_friction=0.0, floor_friction=test.floor_friction)
        table = self.features(test.deposits)
        spread = table.std(axis=0, ddof=1) if len(table) > 2 else np.full(len(CHANNELS), SCATTER)
        self._set_observation(
            table.mean(axis=0)[None], spread[None], (1.0,), "heap at rest", "radii of the column", CHANNELS, "heap"
        )
        chosen = PRESETS[preset]
        cell = test.radius / max(round(ACROSS * chosen.cells_across_tool), 2)
        fastest = math.sqrt(2.0 * GRAVITY * test.height)
        # pressures are low: a soft skeleton serves
        young = 0.1 * chosen.young
        self.resolution = Resolution(
            cell=cell,
            spacing=cell / chosen.particles_per_edge,
            frame_time=chosen.transport * cell / fastest,
            steps=1,
            courant=chosen.courant,
            bulk=young / (3.0 * (1.0 - 2.0 * chosen.poisson)),
            shear=young / (2.0 * (1.0 + chosen.poisson)),
            density=test.density,
            relaxation=fastest / (chosen.way * cell),
        )

    def features(self, readings: FloatArray) -> FloatArray:
        """In radii of the column."""
        return readings / self.test.radius

    def readings(self, run: Run) -> FloatArray:
        """(1, 2) radius and height of the deposit, m."""
        resolution = FINER_RESOLUTIONS[run.variant](self.resolution) if run.variant else self.resolution
        # one step a frame, limited by the path of falling soil
        resolution = replace(resolution, frame_time=resolution.frame_time / resolution.steps, steps=1)
        spacing, cell = resolution.spacing, resolution.cell
        wide, high = round(self.test.radius / spacing), max(round(self.test.height / spacing), 1)
        axes = [spacing * (np.arange(n) + 0.5) for n in (wide, wide, high)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        centres = centres[np.hypot(centres[:, 0], centres[:, 1]) < self.test.radius]
        jitter = np.random.default_rng(run.seed).uniform(-0.15, 0.15, centres.shape)
        reach = cell * math.ceil((self.test.radius + REACH * self.test.height) / cell)
        solver = Solver(
            (centres + spacing * jitter)[None],
            np.zeros(3),
            (reach, reach, self.test.height + 2.0 * cell),
            None,
            resolution,
            self.law(run.effects),
            self.settings,
            [self.values(run.values)],
            self.device,
        )
        for _ in range(math.ceil(REST * math.sqrt(self.test.height / GRAVITY) / resolution.frame_time)):
            solver.advance(1)
        x = solver.positions()[0]
        edges = np.arange(0.0, reach + 2.0 * cell, 0.5 * cell)
        counts, _ = np.histogram(np.hypot(x[:, 0], x[:, 1]), edges)
        # mean thickness of the deposit in rings, m
        thickness = counts * spacing**3 / (0.25 * math.pi * np.diff(edges**2))
        r, end = 0.5 * (edges[1:] + edges[:-1]), int(np.argmax(thickness < THIN * self.test.radius))
        share = (thickness[end - 1] - THIN * self.test.radius) / (thickness[end - 1] - thickness[end])
        return np.array([[r[end - 1] + share * (r[end] - r[end - 1]), thickness[:2].max()]])
