"""A small experiment made up on the spot: a blade dips into a patterned bed and pushes, two cameras watch.

The same solver and the same renderer make the observation and the predictions, with other particles, so that the best
loss is chance and not zero. It is a toy for trying agents on; an answer about real soil needs a measurement set.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from splatsoil.errors import ParameterError
from splatsoil.parameters import ParameterSpace

from .devices import resolve_device
from .problem import Evaluation, Image

if TYPE_CHECKING:
    from splatsoil.measurement import Camera, Measurement
    from splatsoil.mpm import Trajectory
    from splatsoil.scene import Scene

FloatArray = npt.NDArray[np.float64]

#: The bed's box and the soil's depth, m.
BED = (0.36, 0.24, 0.16)
DEPTH = 0.06
#: The blade: thickness, width, height, m; how far its edge dips and how far it pushes.
BLADE = (0.012, 0.12, 0.08)
DIP, PUSH = 0.035, 0.16
#: Frames a second; the blade dips for the first frames and pushes for the rest.
FRAME_RATE = 10
DIP_FRAMES, PUSH_FRAMES = 3, 7
COMPARED = (4, 7, 10)
#: Pictures.
WIDTH, HEIGHT = 96, 72
#: Standard deviation of the observation's sensor noise, sRGB.
SENSOR_NOISE = 0.006
#: Hidden values are drawn from this middle part of a parameter's range.
HIDDEN_RANGE = (0.2, 0.8)
#: Pictures are compared after a blur of this standard deviation in pixels: which grain lies where is chance.
BLUR = 1.5
#: Patches of residuals along each picture's height and width.
BLOCKS = (3, 4)


def blade_motion() -> tuple[FloatArray, FloatArray]:
    """Times (n,) and positions (n, 3) of the blade's centre."""
    frames = np.arange(DIP_FRAMES + PUSH_FRAMES + 1)
    dip = np.clip(frames / DIP_FRAMES, 0.0, 1.0)
    push = np.clip((frames - DIP_FRAMES) / PUSH_FRAMES, 0.0, 1.0)
    above = DEPTH + 0.5 * BLADE[2] + 0.004
    x = 0.1 + PUSH * push
    z = above - (DIP + 0.004) * dip
    return frames / FRAME_RATE, np.stack([x, np.full(len(frames), 0.5 * BED[1]), z], axis=1)


def look_at(eye: Sequence[float], target: Sequence[float]) -> FloatArray:
    """Camera-to-world (4, 4) with OpenGL axes and the world's z up in the picture."""
    back = np.subtract(eye, target)
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, np.asarray(eye, dtype=np.float64)], axis=1)
    return matrix


def experiment() -> Measurement:
    """Bed, blade and motion; there are no photographs."""
    import trimesh

    from splatsoil.measurement import Bed, Measurement, Tool, ToolMotion

    times, positions = blade_motion()
    motion = ToolMotion(np.arange(len(times)), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1)))
    return Measurement(
        folder=Path(),
        name="synthetic",
        gravity=np.array([0.0, 0.0, -9.81]),
        frame_rate=float(FRAME_RATE),
        bed=Bed(np.zeros(3), np.array(BED), density=1600.0),
        tool=Tool(trimesh.creation.box(BLADE), motion, friction=0.3),
        views=(),
        video=(),
    )


def cameras() -> dict[str, Camera]:
    """Two cameras, from the left and from the right of the furrow; the bed's ragged edges are out of sight."""
    from splatsoil.measurement import Camera

    target = (0.2, 0.12, 0.06)
    return {
        name: Camera(WIDTH, HEIGHT, 170.0, 170.0, WIDTH / 2, HEIGHT / 2, look_at(eye, target), name=name)
        for name, eye in {"left": (0.0, -0.2, 0.35), "right": (0.5, 0.4, 0.3)}.items()
    }


def pattern(points: FloatArray) -> FloatArray:
    """Albedo (n, 3) in sRGB of the soil at places (n, 3): sand with darker spots, the same in every world."""
    generator = np.random.default_rng(7)
    waves = generator.normal(0.0, 260.0, (24, 3))
    phases = generator.uniform(0.0, 2.0 * np.pi, 24)
    speckle = np.cos(points @ waves.T + phases).sum(axis=1) / np.sqrt(12.0)
    shade = np.clip(1.0 + 0.05 * speckle, 0.5, 1.3)
    return np.clip(shade[:, None] * np.array([0.72, 0.6, 0.43]), 0.0, 1.0)


def compare(observed: Image, predicted: Image, still: Image) -> tuple[float, FloatArray]:
    """Loss and block residuals of stacks of pictures (k, h, w, 3), all blurred first.

    Args:
        observed: what the cameras saw.
        predicted: what the model says.
        still: what they would have seen had the soil not moved.

    Returns:
        The mean square of the residual over that of ``still``'s: 1 is as good as no model at all. And the mean
        residual of each patch (k · 3 · 4,) in grey levels of 255.
    """
    blurred = [
        gaussian_filter(stack.astype(np.float64), (0.0, BLUR, BLUR, 0.0)) for stack in (observed, predicted, still)
    ]
    residual = blurred[0] - blurred[1]
    loss = float(np.mean(residual**2) / np.mean((blurred[0] - blurred[2]) ** 2))
    count, height, width = residual.shape[:3]
    rows, columns = BLOCKS
    patches = residual.reshape(count, rows, height // rows, columns, width // columns, 3)
    return loss, 255.0 * patches.mean(axis=(2, 4, 5)).reshape(-1)


@dataclass(frozen=True)
class Patch:
    """Where a block residual is taken: camera, frame, and place in the picture, in patches."""

    camera: str
    frame: int
    x: float
    y: float


class SyntheticProblem:
    """Simulate-and-compare against a hidden truth.

    Args:
        parameters: names of the free parameters, whose hidden values are drawn at ``begin``; the rest have defaults.
        effects: names of effects that are on, in the world and in the model.
        preset: resolution of the solver.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises:
        ParameterError: unknown names.
    """

    #: Ten times as bad as soil that doesn't move; losses beyond are cut.
    worst_loss = 10.0
    image_size = (HEIGHT, WIDTH)
    block_count = 2 * len(COMPARED) * BLOCKS[0] * BLOCKS[1]
    #: Of a block residual, grey levels of 255.
    sensor_std = 255.0 * SENSOR_NOISE / (WIDTH * HEIGHT / (BLOCKS[0] * BLOCKS[1]) * 3) ** 0.5

    def __init__(
        self,
        parameters: Sequence[str] = ("friction_angle",),
        effects: Sequence[str] = (),
        *,
        preset: str = "tiny",
        device: str = "cpu",
    ) -> None:
        from splatsoil.mpm import PRESETS
        from splatsoil.soil.law import Law
        from splatsoil.soil.library import find_effects

        if preset not in PRESETS:
            raise ParameterError(f"preset {preset!r} is unknown; known are {', '.join(PRESETS)}")
        law = Law(find_effects(effects))
        seen = [effect.name for effect in law.effects if effect.observes]
        if seen:
            raise ParameterError(f"the made-up world has no {seen[0]}: it is seen as it is; give a measurement set")
        known = {p.name: p for p in law.parameters}
        unknown = [name for name in parameters if name not in known]
        if unknown:
            raise ParameterError(f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}")
        self.space = ParameterSpace(known[name] for name in parameters)
        self.effects = tuple(effects)
        self.preset = preset
        self.device = resolve_device(device)
        self._truth: dict[str, float] | None = None
        self._truth_seed = 0
        self._observed: Image | None = None
        self._still: Image | None = None

    def begin(self, seed: int) -> None:
        """Draw another hidden truth; it is simulated when it is first needed."""
        if self._truth is not None and seed == self._truth_seed:
            return
        generator = np.random.default_rng(seed)
        unit = 2.0 * generator.uniform(*HIDDEN_RANGE, len(self.space)) - 1.0
        self._truth = self.space.to_dict(self.space.from_unit(unit))
        self._truth_seed = seed
        self._observed = None

    def place(self, truth: Mapping[str, float], seed: int) -> None:
        """Hide this truth instead of a drawn one; the seed decides its particles and noise."""
        self._truth = self.space.to_dict(self.space.to_vector(truth))
        self._truth_seed = seed
        self._observed = None

    def truth(self) -> Mapping[str, float] | None:
        """The hidden values."""
        return self._truth

    def observed(self) -> Image:
        """(k, h, w, 3): the world as the cameras recorded it, sensor noise and all."""
        if self._truth is None:
            raise RuntimeError("begin() has to be called before anything is observed")
        if self._observed is None:
            self.record(self.predict(self._truth, self._truth_seed))
        assert self._observed is not None
        return self._observed

    def unobserved(self) -> tuple[Mapping[str, float], int] | None:
        """Values and seed of the world's own simulation, as long as it hasn't been made."""
        return (self._truth, self._truth_seed) if self._observed is None and self._truth is not None else None

    def record(self, clean: Image) -> None:
        """Take pictures (k, h, w, 3) of the world's own simulation as what the cameras saw, but for their noise."""
        noise = np.random.default_rng([self._truth_seed, 1]).standard_normal(clean.shape)
        self._observed = np.clip(clean + SENSOR_NOISE * noise, 0.0, 1.0).astype(np.float32)

    @property
    def places(self) -> tuple[Patch, ...]:
        """Where each block residual is taken."""
        rows, columns = BLOCKS
        return tuple(
            Patch(camera, frame, float(column), float(row))
            for camera in cameras()
            for frame in COMPARED
            for row in range(rows)
            for column in range(columns)
        )

    def observed_image(self) -> Image:
        """The left camera's last picture."""
        return self.observed()[len(COMPARED) - 1]

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate, draw, compare.

        Raises:
            SimulationError: the simulation could not go on.
        """
        began = time.perf_counter()
        self.observed()
        evaluation = self.judge(self.predict(parameters, seed))
        return replace(evaluation, seconds=time.perf_counter() - began)

    def cheaper(self, preset: str) -> tuple[Callable[[Mapping[str, float], int], Evaluation], float]:
        """Evaluation by a coarser simulation, against the same observation, and its cost in units of a full one.

        Raises:
            ParameterError: a preset that is unknown or no cheaper.
        """
        from .levels import relative_cost

        world = World(self.effects, preset, self.device)

        def evaluate(parameters: Mapping[str, float], seed: int) -> Evaluation:
            particles = world.particles(seed)
            found = world.simulate(particles, parameters)
            return self.judge(world.pictures(particles, found.positions, found.deformations))

        return evaluate, relative_cost(self.world.resolution, world.resolution)

    def judge(self, predicted: Image) -> Evaluation:
        """Predicted pictures (k, h, w, 3) compared with the observed ones."""
        observed = self.observed()
        if self._still is None:
            self._still = self.world.still()
        loss, blocks = compare(observed, predicted, self._still)
        shown = len(COMPARED) - 1
        return Evaluation(
            loss=min(loss, self.worst_loss),
            blocks=blocks,
            extras={"rgb": float(np.mean((observed - predicted) ** 2))},
            observed=observed[shown],
            predicted=predicted[shown],
        )

    def predict(self, parameters: Mapping[str, float], seed: int) -> Image:
        """Pictures (k, h, w, 3), camera by camera, of a bed of other particles (by ``seed``) with these parameters."""
        world = self.world
        particles = world.particles(seed)
        trajectory = world.simulate(particles, parameters)
        return world.pictures(particles, trajectory.positions, trajectory.deformations)

    def share(self, other: SyntheticProblem) -> None:
        """Use another problem's solver and scene, if they are for the same law, preset and device."""
        if (self.effects, self.preset, self.device) == (other.effects, other.preset, other.device):
            self.world = other.world

    @cached_property
    def world(self) -> World:
        """What all simulations share."""
        return World(self.effects, self.preset, self.device)

    def __getstate__(self) -> dict[str, Any]:
        # Solver and scene are made again from their names: kernels and meshes don't travel between processes.
        return {key: value for key, value in self.__dict__.items() if key != "world"}


class World:
    """The unchanging part: bed, blade, cameras, surface, light."""

    def __init__(self, effects: Sequence[str], preset: str, device: str) -> None:
        from splatsoil.mpm import Resolution
        from splatsoil.reconstruction import HeightField
        from splatsoil.scene import Light
        from splatsoil.soil.law import Law
        from splatsoil.soil.library import find_effects

        self.measurement = experiment()
        self.cameras = cameras()
        self.law = Law(find_effects(effects))
        self.resolution = Resolution.derive(self.measurement, preset)
        self.device = device
        self.recorded = COMPARED
        self.light = Light.from_angles(200.0, 50.0, np.full(3, 0.35))
        bed = self.measurement.bed
        self.surface = HeightField.over(bed.lower, bed.upper, 0.005, DEPTH)

    def particles(self, seed: int) -> FloatArray:
        """Particles (n, 3) that fill the bed."""
        from splatsoil.reconstruction import fill

        return fill(self.surface, self.measurement.bed, self.resolution.spacing, seed=seed)

    def simulate(self, particles: FloatArray, parameters: Mapping[str, float]) -> Trajectory:
        """The compared frames."""
        from splatsoil.mpm import simulate

        return simulate(
            self.measurement,
            particles,
            parameters,
            law=self.law,
            resolution=self.resolution,
            frames=COMPARED,
            device=self.device,
        )[0]

    def still(self) -> Image:
        """Pictures (k, h, w, 3) of soil that doesn't move while the blade does."""
        particles = self.particles(0)
        return self.pictures(particles, [particles] * len(COMPARED), [None] * len(COMPARED))

    def pictures(self, particles: FloatArray, positions: Iterable[Any], deformations: Iterable[Any]) -> Image:
        """Pictures (k, h, w, 3), camera by camera, of particles that have moved and deformed."""
        scene = self.scene(particles)
        motion = self.measurement.tool.motion
        posed = [
            scene.pose(x, f, motion.pose(frame / FRAME_RATE))
            for frame, x, f in zip(COMPARED, positions, deformations, strict=True)
        ]
        return np.stack([scene.picture(moment, camera) for camera in self.cameras.values() for moment in posed])

    def scene(self, particles: FloatArray) -> Scene:
        """Gaussians of the undisturbed surface, bound to these particles."""
        import torch

        from splatsoil.scene import Scene, ToolBody, bind
        from splatsoil.splats import Gaussians

        def tensor(array: npt.ArrayLike) -> torch.Tensor:
            return torch.as_tensor(np.asarray(array), dtype=torch.float32).to(self.device).contiguous()

        cell = self.surface.cell[0]
        points = self.surface.points.reshape(-1, 3) - np.array([0.0, 0.0, 0.2 * cell])
        rest = tensor(particles)
        covariance = (
            torch.diag(tensor([0.6 * cell, 0.6 * cell, 0.2 * cell]) ** 2).expand(len(points), 3, 3).contiguous()
        )
        empty = tensor(np.zeros((0, 3)))
        return Scene(
            soil=bind(tensor(points), covariance, rest, self.resolution.spacing),
            soil_opacity=torch.full((len(points),), 0.95, device=self.device),
            soil_albedo=tensor(pattern(points)),
            grain_albedo=tensor(pattern(particles)),
            surroundings=Gaussians(empty, empty, tensor(np.zeros((0, 4))), tensor(np.zeros(0)), empty),
            surrounding_shapes=tensor(np.zeros((0, 3, 3))),
            light=self.light,
            tool=ToolBody(self.measurement.tool.mesh, self.device),
            tool_albedo=np.array([0.08, 0.16, 0.5]),
            bed=self.measurement.bed,
            spacing=self.resolution.spacing,
            background=np.array([0.75, 0.77, 0.8]),
        )
