"""Simple scenes for the solver: lattices of particles, resolutions, and runs that take measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import trimesh
from splatsoil.benchmarks._common import FloatArray

from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings

STILL = np.array([0.0, 0.0, 0.0, 1.0])
GRAVITY = 9.81


def lattice(
    lower: npt.ArrayLike, upper: npt.ArrayLike, spacing: float, seed: int = 0, jitter: float = 0.3
) -> FloatArray:
    """Particles (n, 3) in m at the centres of cubes that fill a box, moved by up to ``jitter`` of half a cube."""
    corners = zip(np.asarray(lower, dtype=float), np.asarray(upper, dtype=float), strict=True)
    axes = [a + spacing * (np.arange(round((b - a) / spacing)) + 0.5) for a, b in corners]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return x + np.random.default_rng(seed).uniform(-0.5, 0.5, x.shape) * jitter * spacing


def resolution(
    cell: float, fastest: float, *, density: float, young: float, transport: float = 0.1, way: float | None = None
) -> Resolution:
    """Two particles along a cell's edge, one step a frame; soil at ``fastest`` m/s goes ``transport`` cells in it.

    ``way`` is how many cells it goes while hourglass modes are damped once; as many as in a step by default.
    Poisson's ratio is 0.3.
    """
    return Resolution(
        cell=cell,
        spacing=0.5 * cell,
        frame_time=transport * cell / fastest,
        steps=1,
        courant=0.5,
        bulk=young / 1.2,
        shear=young / 2.6,
        density=density,
        relaxation=fastest / ((way or transport) * cell),
    )


@dataclass(frozen=True)
class Scene:
    """Soil in a box, a tool or none, and the law.

    Attributes:
        x: particles (n, 3) in m.
        upper: corner of the box opposite to the origin, m.
        resolution: lengths, steps and stiffness.
        settings: of the experiment.
        effects: names of effects that are on.
        values: their parameters; the friction angle is that of ``settings``.
        mesh: the tool.
    """

    x: FloatArray
    upper: Sequence[float]
    resolution: Resolution
    settings: Settings
    effects: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    mesh: trimesh.Trimesh | None = None

    def solver(self, device: str) -> Solver:
        """The solver at time 0."""
        values = {"friction_angle": self.settings.friction_angle, **self.values}
        law = Law(find_effects(self.effects))
        return Solver(
            self.x[None], np.zeros(3), self.upper, self.mesh, self.resolution, law, self.settings, [values], device
        )

    def rest(self, seconds: float, device: str) -> Solver:
        """Run without a tool for a time."""
        run = self.solver(device)
        for _ in range(math.ceil(seconds / self.resolution.frame_time)):
            run.advance(1)
        return run

    def push(self, start: FloatArray, speed: float, travel: float, device: str) -> tuple[FloatArray, FloatArray]:
        """Move the tool along x at a constant speed, m/s.

        Returns:
            Ways gone (n,) in m, and forces of the soil on the tool (n, 3) in N, each the mean over a step.
        """
        run, step = self.solver(device), speed * self.resolution.frame_time
        count, along = math.ceil(travel / step), np.array([1.0, 0.0, 0.0])
        poses = [Pose(start + k * step * along, STILL, speed * along, np.zeros(3)) for k in range(count)]
        force = [run.advance([pose])[0] for pose in poses]
        return np.asarray(step * (np.arange(count) + 0.5)), np.array(force, dtype=np.float64)
