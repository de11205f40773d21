"""Plow images: what fixed cameras see of a tool in soil, as changes of patches since the first frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.batches import in_batches
from splatsoil.comparison import PATCH, Block, Comparator, Comparison
from splatsoil.errors import SimulationError, SplatsoilError
from splatsoil.experiment.base import Candidate, candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.experiment.forces import REGION, UNIT, ToolForces, compressed
from splatsoil.experiment.heights import UNIT as MILLIMETRES
from splatsoil.experiment.heights import Heights
from splatsoil.experiment.scene_parts import QUIET, bins_of, regions_of, stages_of
from splatsoil.model import Model, Prediction
from splatsoil.mpm import Resolution, Trajectory, simulate_together
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.library import find_effects, library

FloatArray = npt.NDArray[np.float64]

MOST_ROWS = 10
MOST_FEATURES = 1800
"""More say no more: neighbouring patches and frames are alike, and the noise's covariance is solved with as a whole."""

UNKNOWN_NOISE = 0.5
"""Noise of a patch in grey levels where there are no frames to measure it on."""
LEAST_NOISE = 0.05

FINE = 2.0 / 3.0
"""Cells of the fine run of a pair, over the model's: those of the next preset."""
NUMERICS: Mapping[str, Callable[[Resolution], Resolution]] = {
    "fine": lambda r: replace(
        r,
        cell=FINE * r.cell,
        spacing=FINE * r.spacing,
        steps=math.ceil(r.steps / FINE - 1e-6),
        relaxation=r.relaxation / FINE,
    ),
}
"""Other ways to compute the same physics."""
ROUNDING = "rounding"
"""Another drawing of the same simulation, its surface rounded off twice as much. To first order that changes features
by as much as the drawing has done already, so that one such change is what it gets wrong."""

MOST_TOGETHER, MOST_PARTICLES, MOST_KEPT = 8, 500_000, 2**29
"""Simulations that a GPU makes as one batch, particles in it, and bytes of what is kept of it: one of the usual size
leaves most of a GPU idle."""
_BYTES = 48
"""Of a particle in a recorded frame."""

GUESSES = tuple(f"albedo {number}" for number in range(1, 7))
"""Other colours of the soil beneath the surface."""


class PlowExperiment:
    """A measurement set and a model of it.

    Features are grey levels (of 255): the change of a square of the bed, as one camera sees it, since the first frame,
    averaged over neighbouring frames of one stage. Where heights or the force on the tool were measured, they make
    further columns; see :class:`~splatsoil.experiment.heights.Heights` and
    :class:`~splatsoil.experiment.forces.ToolForces`.

    Args:
        model: the model at hand; candidates are the library's effects that it doesn't have.
        parameters: names of its free parameters.
        candidates: effects to consider, by name or from a file; by default all of the library but those that only
            tests of a laboratory tell.
        numerics: names of other numerics to consider.
        progress: called with (frame, last frame) while a simulation runs.
    """

    chance = True
    sensor_memory = 0.0
    guesses = GUESSES

    def __init__(
        self,
        model: Model,
        parameters: Iterable[str] | None = None,
        *,
        candidates: Iterable[str | Effect] | None = None,
        numerics: Iterable[str] = (ROUNDING, *NUMERICS),
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.base = model
        self.name = model.measurement.name
        self.model = tuple(effect.name for effect in model.law.effects)
        self.parameters: tuple[Parameter, ...] = tuple(model.space(parameters))
        self.numerics = tuple(numerics)
        self.redrawn = tuple(name for name in self.numerics if name == ROUNDING)
        self.progress = progress
        told = (effect for effect in library().values() if not effect.laboratory)
        wanted = tuple(told) if candidates is None else find_effects(candidates)
        self._wanted: dict[str, Effect] = {effect.name: effect for effect in wanted if not effect.numerical}
        self.candidates: tuple[Candidate, ...] = candidates_of(
            (e.for_measurement(model.measurement) for e in self._wanted.values()), model.law.effects
        )
        bed = model.measurement.bed
        rows = min(MOST_ROWS, len(model.frames) - 1)
        instruments = len(model.measurement.cameras) + bool(model.measurement.height_frames)
        area = float(np.prod((bed.upper - bed.lower)[:2])) * instruments * rows
        self.comparator = Comparator(
            model.measurement,
            surface=model.reconstruction.surface,
            frames=model.frames,
            patch=max(PATCH, math.sqrt(area / MOST_FEATURES)),
            surroundings=model.reconstruction.standing,
        )
        self._kept: dict[object, Trajectory] = {}
        self._bins = bins_of(model.measurement, self.comparator.frames, MOST_ROWS)
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
        """(t, s) measured changes, and forces."""
        heights = None if self.heights is None else self.heights.observed
        return side_by_side(heights, self._pictured, None if self.forces is None else self.forces.features)

    @cached_property
    def _pictured(self) -> FloatArray:
        """Columns of ``observed`` that cameras have seen."""
        still = {c: self.comparator.observed[c, self.comparator.reference] for c in self.comparator.cameras}
        frames = (self.comparator.reference, *self.comparator.frames)
        return self._table(self.comparator.blocks({(c, f): still[c] for c in still for f in frames}))

    @cached_property
    def quiet(self) -> npt.NDArray[np.bool_]:
        """(t, s) patches far from wherever the tool has been in the soil: nothing but light changes there."""
        return (self.layout.regions == QUIET) & self.seen

    @cached_property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(t, s) False where the tool hides most of a patch, or neither height nor force was measured."""
        heights = None if self.heights is None else self.heights.seen
        shares = self._table(self.comparator.open_shares())
        return side_by_side(heights, shares, None if self.forces is None else self.forces.measured) > 0.5

    @cached_property
    def _sites(self) -> tuple[Site, ...]:
        """Columns that have a place: heights, then those of cameras."""
        return (() if self.heights is None else self.heights.sites) + tuple(
            Site(camera, label.x, label.y, outline=tuple(map(tuple, corners)))
            for camera in self.comparator.cameras
            for label, corners in zip(self._labels(camera), self.comparator.outlines(camera), strict=True)
        )

    @cached_property
    def sensor(self) -> FloatArray:
        """(t, s) standard deviation of a patch's change by the cameras' noise, from frames before anything moves; and
        of heights and the measured force.
        """
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

    def predict(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, s) features; see :class:`~splatsoil.experiment.base.Experiment`."""
        return self.features(self.prediction(values, effects=effects, seed=seed, numerics=numerics))

    def features(self, prediction: Prediction) -> FloatArray:
        """(t, s) predicted changes, and forces."""
        return self.features_of(self.comparator.blocks(prediction.images), prediction)

    def features_of(self, blocks: FloatArray, prediction: Prediction) -> FloatArray:
        """(t, s) predicted features, given what a comparison of pictures leaves of each block and frame (b,).

        Changes are the measured ones minus the difference, because both sides must leave out the same pixels: those in
        which either shows the tool.
        """
        pictured = self._pictured - self._table(blocks)
        heights = None if self.heights is None else self.heights.predicted(prediction.surfaces)
        force = None if self.forces is None else self.forces.predicted(prediction.trajectory.force)
        return side_by_side(heights, pictured, None if force is None else compressed(force))

    def loss_of(self, comparison: Comparison, prediction: Prediction) -> float:
        """What a search for parameters minimises: the loss of pictures, or of heights where there are no pictures."""
        if self.comparator.cameras or self.heights is None:
            return comparison.loss
        return float(np.mean(list(self.heights.losses(prediction.surfaces).values())))

    def prediction(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> Prediction:
        """The pictures behind the features. What only changes the observation is drawn without a new simulation."""
        guess = 1 + self.guesses.index(numerics) if numerics in self.guesses else None
        rounding = 2.0 if numerics == ROUNDING else 1.0
        model, way = self._computed(effects, numerics)
        trajectory = self._trajectory(model, values, seed, way)
        return model.reported(trajectory, seed, values, albedo=guess, rounding=rounding)

    @cached_property
    def together(self) -> int:
        """How many simulations are best prepared at a time."""
        if self.base.device == "cpu":
            return 1
        count = len(self.base.particles())
        room = min(MOST_PARTICLES, MOST_KEPT // (_BYTES * len(self.base.recorded)))
        return min(max(1, room // count), MOST_TOGETHER)

    def prepare(self, jobs: Iterable[Mapping[str, Any]]) -> None:
        """Simulate together what `predict` will be asked for next, given its keyword arguments.

        What can't be made like this, or made at all, is left to `predict`.
        """
        groups: dict[object, dict[object, tuple[Model, dict[str, float], int]]] = {}
        for job in jobs:
            model, way = self._computed(job["effects"], job["numerics"])
            moving, physics = _without_reports(model, job["values"])
            key = (moving, way, job["seed"], tuple(sorted(physics.items())))
            if key not in self._kept:
                groups.setdefault((moving, way, model.recorded), {})[key] = (model, physics, job["seed"])
        for group in groups.values():
            try:
                found = in_batches(self._together, list(group.values()), "simulations")
            except (SplatsoilError, RuntimeError):  # `predict` meets it, too, and says which one it is of
                continue
            for asked, trajectory in zip(group, found, strict=True):
                if isinstance(trajectory, Trajectory):
                    self._keep(asked, trajectory)

    def _together(self, group: Sequence[tuple[Model, dict[str, float], int]]) -> Sequence[Trajectory | SimulationError]:
        """Simulations of models that are alike, as one batch."""
        models, values, seeds = zip(*group, strict=True)
        particles = [models[0].particles(seed) for seed in seeds]
        return simulate_together(self.base.measurement, particles, values, models[0], self.progress)

    def _computed(self, effects: Iterable[str], numerics: str) -> tuple[Model, str]:
        """The model with candidates on, computed in one of the numerics; what only draws otherwise is none of them."""
        way = "" if numerics in self.guesses or numerics == ROUNDING else numerics
        return self._variant(tuple(dict.fromkeys((*self.model, *effects))), way), way

    def _trajectory(self, model: Model, values: Mapping[str, float], seed: int, numerics: str) -> Trajectory:
        """A simulation, or one of the last where it differs in nothing but what is reported."""
        moving, physics = _without_reports(model, values)
        key = (moving, numerics, seed, tuple(sorted(physics.items())))
        kept = self._kept.get(key)
        if kept is None or not set(model.recorded) <= set(kept.frames):
            kept = model.simulate(physics, seed, self.progress)
            self._keep(key, kept)
        return kept

    def _keep(self, key: object, trajectory: Trajectory) -> None:
        self._kept.pop(key, None)
        while len(self._kept) >= self.together:
            del self._kept[next(iter(self._kept))]
        self._kept[key] = trajectory

    def _variant(self, effects: tuple[str, ...], numerics: str) -> Model:
        if effects == self.model and not numerics:
            return self.base
        resolution = NUMERICS[numerics](self.base.resolution) if numerics else None
        # a candidate from a user's file is known here alone
        chosen = [self._wanted.get(name, name) for name in effects]
        return self.base.variant(effects=chosen, resolution=resolution)

    def _labels(self, camera: str) -> list[Block]:
        """The blocks that one camera sees, in order."""
        first = self.comparator.frames[0]
        return [label for label in self.comparator.labels if label.camera == camera and label.frame == first]

    def _table(self, values: FloatArray) -> FloatArray:
        """(b,) values of blocks, as the comparator orders them, to (t, s)."""
        frames, columns, start = len(self.comparator.frames), [], 0
        for camera in self.comparator.cameras:
            count = len(self._labels(camera))
            mine = values[start : start + frames * count].reshape(frames, count)
            columns.append(np.stack([mine[group].mean(axis=0) for group in self._bins]))
            start += frames * count
        return np.concatenate([np.zeros((len(self._bins), 0)), *columns], axis=1)


def side_by_side(*columns: npt.NDArray[Any] | None) -> FloatArray:
    """Columns (t, …) of heights, cameras and forces, those that there are."""
    return np.concatenate([c for c in columns if c is not None], axis=1).astype(np.float64)


def _without_reports(model: Model, values: Mapping[str, float]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Names of the effects that move soil, and the values that do: not those of what cameras report alone."""
    reported = {p.name for p in model.observation_parameters}
    moving = tuple(e.name for e in model.law.effects if not {p.name for p in e.parameters} <= reported)
    return moving, {name: value for name, value in values.items() if name not in reported}
