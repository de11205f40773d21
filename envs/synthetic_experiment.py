"""A small synthetic experiment: a blade is lowered into a patterned bed and pushed, and two cameras see it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.quiet import hush

from .problem import Image, Job, simulation_seed

if TYPE_CHECKING:
    from splatsoil.measurement import Camera, Measurement
    from splatsoil.scene import Scene

FloatArray = npt.NDArray[np.float64]

#: The bed's box and the soil's depth, m.
BED = (0.36, 0.24, 0.16)
DEPTH = 0.06
#: The blade: thickness, width, height, m; how far it pushes.
BLADE = (0.012, 0.12, 0.08)
PUSH = 0.16
#: Frames a second; the blade dips for the first frames and pushes for the rest.
FRAME_RATE = 10
DIP_FRAMES, PUSH_FRAMES = 3, 7
COMPARED = (4, 7, 10)
#: Simulations of a hidden truth before it is given up.
TRIES = 4
#: Pictures.
WIDTH, HEIGHT = 96, 72


@dataclass(frozen=True)
class Stroke:
    """How the blade is led.

    Attributes:
        depth: of its edge, m.
        rake: its tilt, degrees; above 0 its top leans forwards.
    """

    depth: float = 0.035
    rake: float = 0.0


def blade_motion(stroke: Stroke) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and positions (n, 3) of the blade's centre."""
    frames = np.arange(DIP_FRAMES + PUSH_FRAMES + 1)
    dip = np.clip(frames / DIP_FRAMES, 0.0, 1.0)
    push = np.clip((frames - DIP_FRAMES) / PUSH_FRAMES, 0.0, 1.0)
    tilt = np.radians(stroke.rake)
    above = DEPTH + 0.5 * (BLADE[2] * np.cos(tilt) + BLADE[0] * abs(np.sin(tilt))) + 0.004
    x = 0.1 + PUSH * push
    z = above - (stroke.depth + 0.004) * dip
    return frames / FRAME_RATE, np.stack([x, np.full(len(frames), 0.5 * BED[1]), z], axis=1)


def measurement_of(stroke: Stroke) -> Measurement:
    """Bed, blade and motion; there are no photographs."""
    import trimesh

    from splatsoil.measurement import Bed, Measurement, Tool, ToolMotion

    times, positions = blade_motion(stroke)
    half = 0.5 * np.radians(stroke.rake)
    turned = np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (len(times), 1))
    motion = ToolMotion(np.arange(len(times)), times, positions, turned)
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
    from splatsoil.synthetic.setups import look_at

    target = (0.2, 0.12, 0.06)
    return {
        name: Camera(WIDTH, HEIGHT, 170.0, 170.0, WIDTH / 2, HEIGHT / 2, look_at(eye, target), name=name)
        for name, eye in {"left": (0.0, -0.2, 0.35), "right": (0.5, 0.4, 0.3)}.items()
    }


def pattern(points: FloatArray) -> FloatArray:
    """Albedo (n, 3) in sRGB of the soil at places (n, 3): sand with darker spots, the same in every experiment."""
    generator = np.random.default_rng(7)
    waves = generator.normal(0.0, 260.0, (24, 3))
    phases = generator.uniform(0.0, 2.0 * np.pi, 24)
    speckle = np.cos(points @ waves.T + phases).sum(axis=1) / np.sqrt(12.0)
    shade = np.clip(1.0 + 0.05 * speckle, 0.5, 1.3)
    return np.clip(shade[:, None] * np.array([0.72, 0.6, 0.43]), 0.0, 1.0)


class SyntheticExperiment:
    """The unchanging part: bed, blade, cameras, surface, light."""

    def __init__(self, effects: Sequence[str], preset: str, device: str, stroke: Stroke | None = None) -> None:
        from splatsoil.mpm import Resolution
        from splatsoil.reconstruction import HeightField
        from splatsoil.scene import Light
        from splatsoil.soil.law import Law
        from splatsoil.soil.library import find_effects

        hush()
        self.measurement = measurement_of(stroke or Stroke())
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

    def simulated(self, jobs: Sequence[Job]) -> list[Image | SimulationError]:
        """Pictures (k, h, w, 3) of each job, or why it could not go on; all are simulated as one batch."""
        from splatsoil.mpm import simulate_together

        particles = [self.particles(seed) for _, seed in jobs]
        found = simulate_together(self.measurement, particles, [values for values, _ in jobs], self)
        return [
            one if isinstance(one, SimulationError) else self.pictures(x, one.positions, one.deformations)
            for x, one in zip(particles, found, strict=True)
        ]

    def surely(self, parameters: Mapping[str, float], seed: int) -> Image:
        """Pictures (k, h, w, 3) of a simulation; one that fails is made again with other particles.

        Raises:
            SimulationError: the last of TRIES could not go on either.
        """
        (made,) = self.simulated([(parameters, seed)])
        for k in range(1, TRIES):
            if isinstance(made, SimulationError):
                (made,) = self.simulated([(parameters, simulation_seed(seed, k))])
        if isinstance(made, SimulationError):
            raise made
        return made

    def still(self) -> Image:
        """Pictures (k, h, w, 3) of soil that doesn't move while the blade does."""
        particles = self.particles(0)
        return self.pictures(particles, [particles] * len(COMPARED), [None] * len(COMPARED))

    def pictures(self, particles: FloatArray, positions: Iterable[Any], deformations: Iterable[Any]) -> Image:
        """Pictures (k, h, w, 3), camera by camera, of particles that have moved and deformed."""
        scene = self.scene(particles)
        motion = self.measurement.tool.motion
        posed = scene.poses(
            (x, f, motion.pose(frame / FRAME_RATE))
            for frame, x, f in zip(COMPARED, positions, deformations, strict=True)
        )
        return np.stack(scene.pictures((moment, camera) for camera in self.cameras.values() for moment in posed))

    def scene(self, particles: FloatArray) -> Scene:
        """Gaussians of the undisturbed surface, bound to these particles."""
        import torch

        from splatsoil.scene import Scene, ToolBody
        from splatsoil.splats import Gaussians

        def tensor(array: npt.ArrayLike) -> torch.Tensor:
            return torch.as_tensor(np.asarray(array), dtype=torch.float32).to(self.device).contiguous()

        cell = self.surface.cell[0]
        points = self.surface.points.reshape(-1, 3) - np.array([0.0, 0.0, 0.2 * cell])
        return Scene.of(
            Gaussians.discs(tensor(points), 0.6 * cell, 0.2 * cell, 0.95, tensor(pattern(points))),
            tensor(particles),
            self.resolution.spacing,
            grain_albedo=tensor(pattern(particles)),
            light=self.light,
            tool=ToolBody(self.measurement.tool.mesh, self.device),
            tool_albedo=np.array([0.08, 0.16, 0.5]),
            bed=self.measurement.bed,
            background=np.array([0.75, 0.77, 0.8]),
        )
