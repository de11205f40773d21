"""The plow experiment: changes of image patches of a tool in soil, with heights and tool force where measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.batches import in_batches
from splatsoil.comparison import PATCH, Block, Comparator, Comparison
from splatsoil.errors import SimulationError, SplatsoilError
from splatsoil.experiment.base import Candidate, Run, candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.experiment.forces import REGION, UNIT, ToolForces, compressed
from splatsoil.experiment.heights import UNIT as MILLIMETRES
from splatsoil.experiment.heights import Heights
from splatsoil.experiment.scene_parts import UNDISTURBED, bins_of, regions_of, stages_of
from splatsoil.model import Model, Prediction
from splatsoil.mpm import Resolution, Trajectory, simulate_together
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.library import find_effects, library

MAX_ROWS = 10
MAX_FEATURES = 1800
"""Neighbouring patches and frames are correlated; more features add cost, not information."""

UNKNOWN_NOISE = 0.5
"""Noise of a patch in grey levels where there are no frames to measure it on."""
LEAST_NOISE = 0.05

FINE = 2.0 / 3.0
"""Cell size of a fine simulation over the model's."""
FINER_RESOLUTIONS: Mapping[str, Callable[[Resolution], Resolution]] = {
    "fine": lambda r: replace(
        r,
        cell=FINE * r.cell,
        spacing=FINE * r.spacing,
        steps=math.ceil(r.steps / FINE - 1e-6),
        relaxation=r.relaxation / FINE,
    ),
}
"""Finer discretisations of the same physics, by name."""
ROUNDING = "rounding"
"""The rendering of the same simulation with twice the variance of the surface's smoothing kernel. To first order, the
change is the error of the smoothing itself."""

MAX_BATCH, MAX_PARTICLES, MAX_CACHE = 8, 500_000, 2**29
"""Simulations in a GPU batch, particles in it, and bytes of its cached trajectories."""
_BYTES = 48
"""Memory of a particle in a recorded frame."""

ALBEDO_DRAWS = tuple(f"albedo {number}" for number in range(1, 7))
"""Random draws of the albedo of buried soil."""


class PlowExperiment:
    """A measurement set and a model of it.

    A feature is the change of a square of the bed since the first frame, as one camera sees it, averaged over
    neighbouring frames of one stage, in grey levels of 255. Measured heights and tool forces add columns;
    see :class:`~splatsoil.experiment.heights.Heights` and :class:`~splatsoil.experiment.forces.ToolForces`.

    Args:
        model: the forward model.
        parameters: names of its free parameters.
        candidates: effects that are off and could be on, by name or from a file; by default all of the library but
            those of laboratory tests.
        progress: called with (frame, last frame) while a simulation runs.
    """

    stochastic = True
    sensor_memory = 0.0
    discretisations = tuple(FINER_RESOLUTIONS)
    renderings = (ROUNDING,)
    albedo_draws = ALBEDO_DRAWS

    def __init__(
        self,
        model: Model,
        parameters: Iterable[str] | None = None,
        *,
        candidates: Iterable[str | Effect] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.base = model
        self.name = model.measurement.name
        self.model = tuple(effect.name for effect in model.law.effects)
        self.parameters: tuple[Parameter, ...] = tuple(model.space(parameters))
        self.progress = progress
        usual = (effect for effect in library().values() if not effect.laboratory)
        wanted = tuple(usual) if candidates is None else find_effects(candidates)
        self._wanted: dict[str, Effect] = {effect.name: effect for effect in wanted if not effect.numerical}
        self.candidates: tuple[Candidate, ...] = candidates_of(
            (e.for_measurement(model.measurement) for e in self._wanted.values()), model.law.effects
        )
        bed = model.measurement.bed
        rows = min(MAX_ROWS, len(model.frames) - 1)
        instruments = len(model.measurement.cameras) + bool(model.measurement.height_frames)
        area = float(np.prod((bed.upper - bed.lower)[:2])) * instruments * rows
        self.comparator = Comparator(
            model.measurement,
            surface=model.reconstruction.surface,
            frames=model.frames,
            patch=max(PATCH, math.sqrt(area / MAX_FEATURES)),
            surroundings=model.reconstruction.standing,
        )
        self._trajectories: dict[object, Trajectory] = {}
        self._bins = bins_of(model.measurement, self.comparator.frames, MAX_ROWS)
        rows_of_frames = [[self.comparator.frames[i] for i in group] for group in self._bins]
        self.forces = ToolForces.of(model.measurement, rows_of_frames)
        self.heights = Heights.of(model.measurement, self.comparator, self._bins)

    @cached_property
    def layout(self) -> Layout:
        """Labels of the features."""
        measurement = self.base.measurement
        frames = tuple(float(np.mean([self.comparator.frames[i] for i in group])) for group in self._bins)
        sites = self._sites
        regions = regions_of(measurement, self.base.reconstruction.surface, frames, sites)
        if self.forces is not None:
            channels = self.forces.channels
            sites += tuple(Site(channel, unit=UNIT, reading=self.forces.newtons) for channel in channels)
            regions = np.concatenate([regions, np.full((len(frames), len(channels)), REGION)], axis=1)
        unit = "grey levels" if self.comparator.cameras else MILLIMETRES
        return Layout(frames, sites, "frame", unit, stages_of(measurement, frames), regions)

    @cached_property
    def observed(self) -> FloatArray:
        """(t, s) measured changes and forces."""
        heights = None if self.heights is None else self.heights.observed
        return side_by_side(heights, self._pictured, None if self.forces is None else self.forces.features)

    @cached_property
    def _pictured(self) -> FloatArray:
        """Columns of ``observed`` from cameras."""
        still = {c: self.comparator.observed[c, self.comparator.reference] for c in self.comparator.cameras}
        frames = (self.comparator.reference, *self.comparator.frames)
        return self._table(self.comparator.blocks({(c, f): still[c] for c in still for f in frames}))

    @cached_property
    def quiet(self) -> BoolArray:
        """(t, s) patches that the tool's path does not disturb: only the light changes there."""
        return (self.layout.regions == UNDISTURBED) & self.seen

    @cached_property
    def seen(self) -> BoolArray:
        """(t, s) False where the tool hides most of a patch, or a height or force was not measured."""
        heights = None if self.heights is None else self.heights.seen
        shares = self._table(self.comparator.open_shares())
        return side_by_side(heights, shares, None if self.forces is None else self.forces.measured) > 0.5

    @cached_property
    def _sites(self) -> tuple[Site, ...]:
        """Columns with a place: heights, then cameras."""
        return (() if self.heights is None else self.heights.sites) + tuple(
            Site(camera, label.x, label.y, outline=tuple(map(tuple, corners)))
            for camera in self.comparator.cameras
            for label, corners in zip(self._labels(camera), self.comparator.outlines(camera), strict=True)
        )

    @cached_property
    def sensor(self) -> FloatArray:
        """(t, s) standard deviation of the instruments' noise; of cameras, from frames before the tool moves."""
        still = self.comparator.still_blocks()
        per_site = []
        for camera in self.comparator.cameras:
            count = len(self._labels(camera))
            level = np.sqrt(np.mean(still[camera] ** 2)) if camera in still else UNKNOWN_NOISE
            per_site.append(np.full(count, max(float(level), LEAST_NOISE)))
        frames = np.array([len(group) for group in self._bins], dtype=np.float64)
        pictured = np.concatenate([np.zeros(0), *per_site])[None] / np.sqrt(frames)[:, None]
        heights = None if self.heights is None else self.heights.noise
        return side_by_side(heights, pictured, None if self.forces is None else self.forces.noise)

    def predict(self, run: Run) -> FloatArray:
        """(t, s) features; see :class:`~splatsoil.experiment.base.Experiment`."""
        return self.features(self.prediction(run))

    def features(self, prediction: Prediction) -> FloatArray:
        """(t, s) predicted changes and forces."""
        return self.features_of(self.comparator.blocks(prediction.images), prediction)

    def features_of(self, blocks: FloatArray, prediction: Prediction) -> FloatArray:
        """(t, s) predicted features, given the residuals of a picture comparison (b,).

        Predicted changes are the measured ones minus the residual: both must omit the same pixels, those in which
        either picture shows the tool.
        """
        pictured = self._pictured - self._table(blocks)
        heights = None if self.heights is None else self.heights.predicted(prediction.surfaces)
        force = None if self.forces is None else self.forces.predicted(prediction.trajectory.force)
        return side_by_side(heights, pictured, None if force is None else compressed(force))

    def loss_of(self, comparison: Comparison, prediction: Prediction) -> float:
        """The loss that a search minimises: of pictures, or of heights where there are no pictures."""
        if self.comparator.cameras or self.heights is None:
            return comparison.loss
        return float(np.mean(list(self.heights.losses(prediction.surfaces).values())))

    def prediction(self, run: Run) -> Prediction:
        """The pictures behind the features; a variant or an effect of observation needs no new simulation."""
        draw = 1 + self.albedo_draws.index(run.variant) if run.variant in self.albedo_draws else None
        rounding = 2.0 if run.variant == ROUNDING else 1.0
        model, discretisation = self._model_of(run)
        trajectory = self._trajectory(model, run.values, run.seed, discretisation)
        return model.reported(trajectory, run.seed, run.values, albedo=draw, rounding=rounding)

    @cached_property
    def batch_size(self) -> int:
        """Number of simulations in a batch."""
        if self.base.device == "cpu":
            return 1
        count = len(self.base.particles())
        room = min(MAX_PARTICLES, MAX_CACHE // (_BYTES * len(self.base.recorded)))
        return min(max(1, room // count), MAX_BATCH)

    def prepare(self, runs: Iterable[Run]) -> None:
        """Simulate later calls of `predict` as batches; failures are left to `predict`."""
        groups: dict[object, dict[object, tuple[Model, dict[str, float], int]]] = {}
        for run in runs:
            model, discretisation = self._model_of(run)
            moving, physics = _physics_of(model, run.values)
            key = (moving, discretisation, run.seed, tuple(sorted(physics.items())))
            if key not in self._trajectories:
                groups.setdefault((moving, discretisation, model.recorded), {})[key] = (model, physics, run.seed)
        for group in groups.values():
            try:
                found = in_batches(self._batch, list(group.values()), "simulations")
            except (SplatsoilError, RuntimeError):  # `predict` raises it again
                continue
            for name, trajectory in zip(group, found, strict=True):
                if isinstance(trajectory, Trajectory):
                    self._cache(name, trajectory)

    def _batch(self, group: Sequence[tuple[Model, dict[str, float], int]]) -> Sequence[Trajectory | SimulationError]:
        """Simulations with one law and resolution, as one batch."""
        models, values, seeds = zip(*group, strict=True)
        particles = [models[0].particles(seed) for seed in seeds]
        return simulate_together(self.base.measurement, particles, values, models[0], self.progress)

    def _model_of(self, run: Run) -> tuple[Model, str]:
        """The model with candidates on, and the variant if it is a discretisation, else nothing."""
        discretisation = "" if run.variant in (*self.albedo_draws, *self.renderings) else run.variant
        names = tuple(dict.fromkeys((*self.model, *run.effects)))
        if names == self.model and not discretisation:
            return self.base, ""
        resolution = FINER_RESOLUTIONS[discretisation](self.base.resolution) if discretisation else None
        # The library does not know a candidate from a user's file.
        chosen = [self._wanted.get(name, name) for name in names]
        return self.base.variant(effects=chosen, resolution=resolution), discretisation

    def _trajectory(self, model: Model, values: Mapping[str, float], seed: int, variant: str) -> Trajectory:
        """A simulation, cached where only the observation differs."""
        moving, physics = _physics_of(model, values)
        key = (moving, variant, seed, tuple(sorted(physics.items())))
        trajectory = self._trajectories.get(key)
        if trajectory is None or not set(model.recorded) <= set(trajectory.frames):
            trajectory = model.simulate(physics, seed, self.progress)
            self._cache(key, trajectory)
        return trajectory

    def _cache(self, key: object, trajectory: Trajectory) -> None:
        self._trajectories.pop(key, None)
        while len(self._trajectories) >= self.batch_size:
            del self._trajectories[next(iter(self._trajectories))]
        self._trajectories[key] = trajectory

    def _labels(self, camera: str) -> list[Block]:
        """The blocks that one camera sees, in order."""
        first = self.comparator.frames[0]
        return [label for label in self.comparator.labels if label.camera == camera and label.frame == first]

    def _table(self, values: FloatArray) -> FloatArray:
        """(t, s) means over each row's frames of values (b,) of the comparator's blocks."""
        frames, columns, start = len(self.comparator.frames), [], 0
        for camera in self.comparator.cameras:
            count = len(self._labels(camera))
            mine = values[start : start + frames * count].reshape(frames, count)
            columns.append(np.stack([mine[group].mean(axis=0) for group in self._bins]))
            start += frames * count
        return np.concatenate([np.zeros((len(self._bins), 0)), *columns], axis=1)


def side_by_side(*columns: npt.NDArray[Any] | None) -> FloatArray:
    """(t, s) existing columns of heights, cameras and forces."""
    return np.concatenate([c for c in columns if c is not None], axis=1).astype(np.float64)


def _physics_of(model: Model, values: Mapping[str, float]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Names of the effects that act on the soil, and the values that do; those of observation are left out."""
    observed = {p.name for p in model.observation_parameters}
    moving = tuple(e.name for e in model.law.effects if not {p.name for p in e.parameters} <= observed)
    return moving, {name: value for name, value in values.items() if name not in observed}
