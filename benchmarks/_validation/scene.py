"""Simple scenes for the solver: lattices of particles, resolutions, and runs that take measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings

FloatArray = npt.NDArray[np.float64]

STILL = np.array([0.0, 0.0, 0.0, 1.0])
GRAVITY = 9.81


def lattice(
    lower: npt.ArrayLike, upper: npt.ArrayLike, spacing: float, seed: int = 0, jitter: float = 0.3
) -> FloatArray:
    """Particles (n, 3) in m at the centres of cubes that fill a box, moved by up to ``jitter`` of half a cube."""
    axes = [
        a + spacing * (np.arange(round((b - a) / spacing)) + 0.5)
        for a, b in zip(np.asarray(lower, dtype=float), np.asarray(upper, dtype=float), strict=True)
    ]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return x + np.random.default_rng(seed).uniform(-0.5, 0.5, x.shape) * jitter * spacing


def resolution(
    cell: float,
    fastest: float,
    *,
    density: float,
    young: float,
    poisson: float = 0.3,
    transport: float = 0.1,
    courant: float = 0.5,
    way: float | None = None,
) -> Resolution:
    """Two particles along a cell's edge, one step a frame; soil at ``fastest`` m/s goes ``transport`` cells in it.

    ``way`` is how many cells it goes while hourglass modes are damped once; as many as in a step by default.
    """
    return Resolution(
        cell=cell,
        spacing=0.5 * cell,
        frame_time=transport * cell / fastest,
        steps=1,
        courant=courant,
        bulk=young / (3.0 * (1.0 - 2.0 * poisson)),
        shear=young / (2.0 * (1.0 + poisson)),
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


def rest(scene: Scene, seconds: float, device: str) -> Solver:
    """Run without a tool for a time."""
    run = scene.solver(device)
    for _ in range(math.ceil(seconds / scene.resolution.frame_time)):
        run.advance(1)
    return run


def push(
    scene: Scene, start: npt.ArrayLike, velocity: npt.ArrayLike, travel: float, device: str
) -> tuple[FloatArray, FloatArray, Solver]:
    """Move the tool at a constant velocity.

    Returns:
        Ways gone (n,) in m, forces of the soil on the tool (n, 3) in N, each the mean over a step, and the solver.
    """
    run, place, speed = (
        scene.solver(device),
        np.asarray(start, dtype=np.float64),
        np.asarray(velocity, dtype=np.float64),
    )
    step = scene.resolution.frame_time
    count = math.ceil(travel / (float(np.linalg.norm(speed)) * step))
    force = [run.advance([Pose(place + k * step * speed, STILL, speed, np.zeros(3))])[0] for k in range(count)]
    way = np.asarray(float(np.linalg.norm(speed)) * step * (np.arange(count) + 0.5), dtype=np.float64)
    return way, np.array(force, dtype=np.float64), run
