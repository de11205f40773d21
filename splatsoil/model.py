"""The forward model: a parameter vector in, what the cameras would have seen out."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

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

Image = npt.NDArray[np.float32]

SCENES_KEPT = 4
"""Scenes, one for each particle seed, that a model keeps at hand."""


@dataclass(frozen=True)
class Prediction:
    """What the model says the instruments see.

    Attributes:
        values: the parameters, by name.
        seed: of the particles.
        images: (h, w, 3) sRGB in [0, 1] by (camera, frame), free of lens distortion.
        trajectory: the simulation behind them.
        surfaces: the soil's, by frame, where the set has heights.
    """

    values: Mapping[str, float]
    seed: int
    images: Mapping[tuple[str, int], Image]
    trajectory: Trajectory
    surfaces: Mapping[int, Relief] = field(default_factory=dict)


class _Poses:
    """Posed scenes of the trajectory drawn last: what cameras alone report otherwise looks at the same ones."""

    def __init__(self) -> None:
        self._of: tuple[weakref.ref[Trajectory], object] | None = None
        self._made: dict[int, Posed] = {}

    def of(self, trajectory: Trajectory, way: object) -> dict[int, Posed]:
        """By frame; none yet of another trajectory, or of one posed in another way."""
        if self._of is None or self._of[0]() is not trajectory or self._of[1] != way:
            self._of, self._made = (weakref.ref(trajectory), way), {}
        return self._made


class Model:
    """A soil model of one experiment: base law and effects, started from one reconstruction.

    Args:
        measurement: bed, tool, motion, cameras.
        reconstruction: of the scene before anything moves.
        effects: names of effects (or files that define some) that are on.
        preset: resolution of the solver.
        device: ``cpu`` or ``cuda:N``.
        frames: video frames to predict; all measured ones from frame 0 on by default.
        intrinsic: file for the light and the albedo that photographs show, by the spacing of particles; what is there
            isn't estimated again, and what isn't is kept there.

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
        self._scene = lru_cache(maxsize=SCENES_KEPT)(self._build_scene)
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
        """The same experiment with other effects on, computed otherwise, at other frames, or drawn with another scene;
        it shares scenes where particles agree.

        An effect that is on already keeps its name here, wherever it came from.
        """
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
            other._scene, other._poses = lru_cache(maxsize=SCENES_KEPT)(lambda seed: scene), _Poses()
        return other

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the law with its effects."""
        return self.law.parameters

    @property
    def observation_parameters(self) -> tuple[Parameter, ...]:
        """Those of effects that change what the cameras report: `draw` needs no new simulation for them."""
        return tuple(p for e in self.law.effects if e.observes for p in e.parameters)

    def observation(self, values: Mapping[str, float] | None = None) -> Observation:
        """What the cameras report under ``values`` (by name; defaults for those left out).

        Raises:
            ParameterError: values out of bounds.
        """
        return self.law.observation(values or {})

    def space(self, names: Iterable[str] | None = None) -> ParameterSpace:
        """The named parameters as free ones.

        By default the friction angle and, of the effects that are on, the parameters that can be off: those that only
        shape an effect (a strain over which it decays, say) keep their defaults unless they are named.

        Raises:
            ParameterError: a name that this model does not have.
        """
        known = {p.name: p for p in self.parameters}
        wanted = tuple(self.law.free) if names is None else tuple(names)
        unknown = [n for n in wanted if n not in known]
        if unknown:
            raise ParameterError(f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}")
        return ParameterSpace(known[n] for n in wanted)

    def particles(self, seed: int = 0) -> npt.NDArray[np.float64]:
        """Particles (n, 3) in m that fill the reconstructed bed."""
        return fill(self.reconstruction.surface, self.measurement.bed, self.resolution.spacing, seed=seed)

    @property
    def photographed(self) -> bool:
        """Whether photographs show soil, so that there is a scene; heights alone make none."""
        return bool(self.reconstruction.soil.any())

    def scene(self, seed: int = 0) -> Scene:
        """Scene whose Gaussians ride on the particles of ``seed``; light and albedo are estimated once."""
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
        """Run the soil for ``values`` (by name, in physical units; defaults for those left out).

        Raises:
            SimulationError: the simulation could not go on.
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
        """Pictures of a trajectory by (camera, frame), as cameras without distortion report it.

        Args:
            trajectory: from `simulate` of this model; one serves all values of `observation_parameters`.
            seed: of the trajectory's particles.
            values: by name; of these only observation effects' count. Everything is reported as it is by default.
            albedo: seed of another guess of the colour of soil beneath the surface, which photographs leave open.
            rounding: variance of the kernel that rounds off the surface, over the usual one.

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
        """The soil's surface by frame, as instruments that measure heights report it; none if the set has no heights.

        Takes and raises what :meth:`draw` does.
        """
        if not self.measurement.height_frames:
            return {}
        late = self.observation(values).time_offset * self.measurement.frame_rate
        bed, width = self.measurement.bed.domain, SMOOTHING * math.sqrt(rounding)
        return {
            frame: relief_of_particles(
                torch.from_numpy(trajectory.at(frame + late)[0]).to(self.device),
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
        """What all instruments report of a trajectory; takes and raises what :meth:`draw` does."""
        images = self.draw(trajectory, seed, values, albedo=albedo, rounding=rounding)
        surfaces = self.surfaces(trajectory, values, rounding=rounding)
        return Prediction(dict(values), seed, images, trajectory, surfaces)

    def _recorded_frames(self) -> tuple[int, ...]:
        """The model's frames, and those around them between which a time offset within its bounds interpolates."""
        late = sum(
            max(abs(self.observation({p.name: bound}).time_offset) for bound in (p.lower, p.upper))
            for p in self.observation_parameters
        )
        return frames_around(self.frames, late * self.measurement.frame_rate)
