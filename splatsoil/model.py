"""The forward model: from parameters to the pictures and heights that the instruments measure."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import torch

from splatsoil.arrays import FloatArray, Image
from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement
from splatsoil.mpm import Resolution, Trajectory, frames_around, simulate
from splatsoil.observation import Observation
from splatsoil.parameters import Parameter, ParameterSpace
from splatsoil.reconstruction import Reconstruction, fill
from splatsoil.scene import Intrinsic, Posed, Relief, Scene, build_scene, relief_of_particles
from splatsoil.scene.relief import SMOOTHING
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

CACHED_SCENES = 4
"""Scenes in a model's cache, one for each particle seed."""


@dataclass(frozen=True)
class Prediction:
    """Predicted measurements of the instruments.

    Attributes:
        values: the parameters, by name.
        seed: of the particles.
        images: (h, w, 3) sRGB in [0, 1] by (camera, frame), free of lens distortion.
        trajectory: of the simulation.
        surfaces: of the soil by frame, where the set has heights.
    """

    values: Mapping[str, float]
    seed: int
    images: Mapping[tuple[str, int], Image]
    trajectory: Trajectory
    surfaces: Mapping[int, Relief] = field(default_factory=dict)


class _Poses:
    """Cache of posed scenes of the last trajectory: a change of the cameras alone reuses them."""

    def __init__(self) -> None:
        self._of: tuple[weakref.ref[Trajectory], object] | None = None
        self._made: dict[int, Posed] = {}

    def of(self, trajectory: Trajectory, setting: object) -> dict[int, Posed]:
        """By frame; empty for another trajectory or setting."""
        if self._of is None or self._of[0]() is not trajectory or self._of[1] != setting:
            self._of, self._made = (weakref.ref(trajectory), setting), {}
        return self._made


class Model:
    """A soil model of one experiment: base law and effects, started from one reconstruction.

    Args:
        measurement: bed, tool, motion, cameras.
        reconstruction: of the scene before the tool moves.
        effects: names of effects (or files that define some) that are on.
        preset: resolution of the solver.
        device: ``cpu`` or ``cuda:N``.
        frames: video frames to predict; all measured ones from frame 0 on by default.
        intrinsic: file that caches light and albedo from the photographs, by particle spacing.

    Raises:
        ParameterError: unknown preset, effect or frame.
    """

    def __init__(
        self,
        measurement: Measurement,
        reconstruction: Reconstruction,
        *,
        effects: Iterable[str | Effect] = (),
        preset: str = "small",
        device: str = "cpu",
        frames: Iterable[int] | None = None,
        intrinsic: Callable[[float], Path] | None = None,
    ) -> None:
        self.measurement, self.reconstruction = measurement, reconstruction
        self.preset, self.device = preset, device
        self.effects = find_effects(effects)
        self.law = Law(effect.for_measurement(measurement) for effect in self.effects)
        self.resolution = Resolution.derive(measurement, preset)
        measured = tuple(int(f) for f in measurement.frames)
        self.frames = measured if frames is None else tuple(sorted({int(f) for f in frames}))
        unknown = sorted(set(self.frames) - set(measured))
        if unknown or not self.frames:
            raise ParameterError(f"frames {unknown or 'none'} are not in the video; it has {measured}")
        self._intrinsic = intrinsic
        self._scene = lru_cache(maxsize=CACHED_SCENES)(self._build_scene)
        self._poses = _Poses()
        self.recorded = self._recorded_frames()

    def variant(
        self,
        *,
        effects: Iterable[str | Effect] | None = None,
        resolution: Resolution | None = None,
        frames: Iterable[int] | None = None,
        scene: Scene | None = None,
    ) -> Model:
        """The same experiment with other effects, resolution, frames or scene; equal particles share scenes."""
        on: dict[str | Effect, Effect] = {effect.name: effect for effect in self.effects}
        chosen = self.effects if effects is None else tuple(on.get(name, name) for name in effects)
        other = Model(
            self.measurement,
            self.reconstruction,
            effects=chosen,
            preset=self.preset,
            device=self.device,
            frames=self.frames if frames is None else frames,
            intrinsic=self._intrinsic,
        )
        other.resolution = resolution or self.resolution
        if other.resolution.spacing == self.resolution.spacing:
            other._scene, other._poses = self._scene, self._poses
        if scene is not None:
            other._scene, other._poses = lru_cache(maxsize=CACHED_SCENES)(lambda seed: scene), _Poses()
        return other

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the law with its effects."""
        return self.law.parameters

    @property
    def observation_parameters(self) -> tuple[Parameter, ...]:
        """Parameters of effects of observation: `draw` needs no new simulation for them."""
        return tuple(p for e in self.law.effects if e.observes for p in e.parameters)

    def observation(self, values: Mapping[str, float] | None = None) -> Observation:
        """The observation model for ``values`` (by name; defaults for the rest).

        Raises:
            ParameterError: values out of bounds.
        """
        return self.law.observation(values or {})

    def space(self, names: Iterable[str] | None = None) -> ParameterSpace:
        """The named parameters as free ones.

        By default the friction angle and the parameters with an off value of the effects that are on. Shape parameters
        keep their defaults unless they are named.

        Raises:
            ParameterError: the model has no such parameter.
        """
        known = {p.name: p for p in self.parameters}
        chosen = tuple(self.law.free) if names is None else tuple(names)
        unknown = [n for n in chosen if n not in known]
        if unknown:
            raise ParameterError(f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}")
        return ParameterSpace(known[n] for n in chosen)

    def particles(self, seed: int = 0) -> FloatArray:
        """Particles (n, 3) in m that fill the reconstructed bed."""
        return fill(self.reconstruction.surface, self.measurement.bed, self.resolution.spacing, seed=seed)

    @property
    def photographed(self) -> bool:
        """Whether photographs show soil, so that there is a scene."""
        return bool(self.reconstruction.soil.any())

    def scene(self, seed: int = 0) -> Scene:
        """Scene whose Gaussians move with the particles of ``seed``; light and albedo are estimated once."""
        return self._scene(seed)

    def _build_scene(self, seed: int) -> Scene:
        if seed != 0:
            return self.scene(0).with_particles(self.particles(seed))
        file = None if self._intrinsic is None else self._intrinsic(self.resolution.spacing)
        known = None if file is None or not file.is_file() else Intrinsic.load(file)
        scene = build_scene(
            self.reconstruction,
            self.measurement,
            self.particles(0),
            self.resolution.spacing,
            device=self.device,
            intrinsic=known,
        )
        if file is not None and known is None:
            Intrinsic.of(scene).save(file)
        return scene

    def simulate(
        self, values: Mapping[str, float], seed: int = 0, progress: Callable[[int, int], None] | None = None
    ) -> Trajectory:
        """Simulate the soil for ``values`` (by name, in physical units; defaults for the rest).

        Raises:
            SimulationError: the simulation failed.
            ParameterError: unknown names or values out of bounds.
        """
        return simulate(
            self.measurement,
            self.particles(seed),
            values,
            law=self.law,
            resolution=self.resolution,
            frames=self.recorded,
            device=self.device,
            progress=progress,
        )[0]

    def draw(
        self,
        trajectory: Trajectory,
        seed: int = 0,
        values: Mapping[str, float] | None = None,
        *,
        albedo: int | None = None,
        rounding: float = 1.0,
    ) -> dict[tuple[str, int], Image]:
        """Pictures of a trajectory by (camera, frame), without lens distortion.

        Args:
            trajectory: from `simulate` of this model, for any values of `observation_parameters`.
            seed: of the trajectory's particles.
            values: by name; only those of effects of observation matter.
            albedo: seed of a random draw of the albedo of buried soil; the standard albedo by default.
            rounding: variance of the surface's smoothing kernel over the standard one.

        Raises:
            ParameterError: values out of bounds, or a trajectory without the frames that a time offset needs.
        """
        if not self.measurement.cameras:
            return {}
        observation = self.observation(values)
        scene = self.scene(seed)
        if rounding != 1.0:
            scene = scene.replace(smoothing=math.sqrt(rounding) * scene.smoothing)
        if observation.changes_light:
            light = scene.light.changed(observation.sun_azimuth, observation.sun_elevation, observation.sky_share)
            scene = scene.replace(light=light)
        rate, motion = self.measurement.frame_rate, self.measurement.tool.motion
        cameras = {
            name: observation.camera(camera.undistorted(), k)
            for k, (name, camera) in enumerate(self.measurement.cameras.items())
        }
        posed = self._poses.of(trajectory, (seed, rounding, observation.of_scene))
        moments = {f: f + observation.time_offset * rate for f in self.frames if f not in posed}
        tools = [observation.tool(motion.pose(moment / rate)) for moment in moments.values()]
        states = [(*trajectory.at(moment), tool) for moment, tool in zip(moments.values(), tools, strict=True)]
        posed |= zip(moments, scene.poses(states), strict=True)
        seen = dict(posed)
        if albedo is not None:
            other = scene.with_sampled_albedo(albedo)
            seen = {frame: other.recoloured(moment) for frame, moment in posed.items()}
        keys = [(name, frame) for frame in self.frames for name in cameras]
        pictures = scene.pictures([(seen[frame], cameras[name]) for name, frame in keys])
        return {
            (name, frame): observation.image(picture, frame / rate)
            for (name, frame), picture in zip(keys, pictures, strict=True)
        }

    def surfaces(
        self, trajectory: Trajectory, values: Mapping[str, float] | None = None, *, rounding: float = 1.0
    ) -> dict[int, Relief]:
        """The soil's surface by frame; empty if the set has no heights. Arguments and errors as for :meth:`draw`."""
        if not self.measurement.height_frames:
            return {}
        delay = self.observation(values).time_offset * self.measurement.frame_rate
        bed, width = self.measurement.bed.domain, SMOOTHING * math.sqrt(rounding)
        return {
            frame: relief_of_particles(
                torch.from_numpy(trajectory.at(frame + delay)[0]).to(self.device),
                trajectory.spacing,
                bed.lower,
                bed.upper,
                smoothing=width,
            )
            for frame in self.frames
        }

    def predict(
        self,
        values: Mapping[str, float],
        seed: int = 0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Prediction:
        """Simulate and draw.

        Raises:
            SimulationError, ParameterError: see :meth:`simulate`.
        """
        return self.reported(self.simulate(values, seed, progress), seed, values)

    def reported(
        self,
        trajectory: Trajectory,
        seed: int,
        values: Mapping[str, float],
        *,
        albedo: int | None = None,
        rounding: float = 1.0,
    ) -> Prediction:
        """Predicted measurements of a trajectory; arguments and errors are those of :meth:`draw`."""
        images = self.draw(trajectory, seed, values, albedo=albedo, rounding=rounding)
        surfaces = self.surfaces(trajectory, values, rounding=rounding)
        return Prediction(dict(values), seed, images, trajectory, surfaces)

    def _recorded_frames(self) -> tuple[int, ...]:
        """The model's frames and their neighbours, between which a time offset interpolates."""
        delay = sum(
            max(abs(self.observation({p.name: bound}).time_offset) for bound in (p.lower, p.upper))
            for p in self.observation_parameters
        )
        return frames_around(self.frames, delay * self.measurement.frame_rate)
