"""Simulation of a measurement set: particles and parameters to recorded frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.mpm.presets import Preset, Resolution
from splatsoil.mpm.solver import Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.settings import FRICTION_ANGLE, Settings

State = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


@dataclass(frozen=True)
class Trajectory:
    """Recorded frames of a simulation, and the tool's force.

    Attributes:
        frames: recorded frame numbers.
        positions: particles (frames, n, 3) in m, float32.
        deformations: visual deformation since frame 0, (frames, n, 3, 3), float32.
        force: mean force of the soil on the tool in each frame from 1 on, (frames run, 3) in N.
        spacing: edge of the cube of soil that a particle stands for, in m.
        resolution: lengths, steps and stiffness.
    """

    frames: tuple[int, ...]
    positions: npt.NDArray[np.float32]
    deformations: npt.NDArray[np.float32]
    force: npt.NDArray[np.float64]
    spacing: float
    resolution: Resolution

    def at(self, moment: float) -> State:
        """Positions (n, 3) in m and deformations (n, 3, 3) at a moment in frames, linear between neighbouring frames.

        Before frame 0 everything rests.

        Raises:
            ParameterError: the trajectory holds neither that frame nor the two around it.
        """
        wanted = round(max(moment, 0.0), 6)
        index = {frame: k for k, frame in enumerate(self.frames)}
        before = math.floor(wanted)
        share = wanted - before
        missing = [f for f in (before, before + (share > 0.0)) if f not in index]
        if missing:
            raise ParameterError(
                f"the trajectory has no frame {missing[0]}, which pictures at frame {wanted:g} need; "
                "simulate with the effect that shifts time on"
            )
        k = index[before]
        if share == 0.0:
            return self.positions[k], self.deformations[k]
        weight = np.float32(share)
        return (
            (1 - weight) * self.positions[k] + weight * self.positions[k + 1],
            (1 - weight) * self.deformations[k] + weight * self.deformations[k + 1],
        )


def frames_around(frames: Iterable[int], late: float) -> tuple[int, ...]:
    """Frames to record so that moments up to ``late`` frames before and after the given ones can be interpolated."""
    around = math.ceil(round(abs(late), 6))
    return tuple(sorted({max(f + k, 0) for f in frames for k in range(-around, around + 1)}))


def base_settings(measurement: Measurement) -> Settings:
    """Settings as the experiment's notes give them; the friction angle is the parameter's default."""
    bed = measurement.bed
    gx, gy, gz = (float(g) for g in measurement.gravity)
    return Settings(
        friction_angle=FRICTION_ANGLE.default,
        gravity=(gx, gy, gz),
        tool_friction=measurement.tool.friction,
        wall_friction=bed.wall_friction,
        floor_friction=bed.floor_friction,
    )


@lru_cache(maxsize=2048)
def step_poses(motion: ToolMotion, start: float, frame_time: float, steps: int) -> tuple[Pose, ...]:
    """The tool at the start of each of a frame's ``steps`` steps, with the velocity that carries it to the next.

    Kept, as many simulations share a motion: with a GPU the host is a fifth of a simulation's time at these.
    """
    times = start + frame_time * np.arange(steps + 1) / steps
    rotations, positions = zip(*(motion.pose(float(t)) for t in times), strict=True)
    turn = Rotation.from_matrix(np.stack(rotations))
    step = frame_time / steps
    spin = (turn[1:] * turn[:-1].inv()).as_rotvec() / step
    quaternions = turn.as_quat()
    return tuple(
        Pose(positions[k], quaternions[k], (positions[k + 1] - positions[k]) / step, spin[k]) for k in range(steps)
    )


def simulate(
    measurement: Measurement,
    positions: npt.NDArray[np.floating],
    values: Mapping[str, float] | Sequence[Mapping[str, float]],
    *,
    law: Law | None = None,
    preset: Preset | str = "small",
    resolution: Resolution | None = None,
    frames: Iterable[int],
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> list[Trajectory]:
    """Simulate one or several parameter sets as one batch.

    Args:
        measurement: bed, tool and motion.
        positions: particles (n, 3), or (simulations, n, 3) where each has its own.
        values: parameters by name, one mapping or one for each simulation.
        law: soil law; the base law by default.
        preset: how finely; ignored when ``resolution`` is given.
        resolution: as derived from ``preset`` unless given. Particles must stand ``resolution.spacing`` apart.
        frames: frame numbers to record; the run ends with the largest.
        device: Warp device name.
        progress: called with (frame, last frame) after each frame.

    Returns:
        One trajectory for each parameter set.

    Raises:
        SimulationError, ParameterError: see :class:`~splatsoil.mpm.solver.Solver`.
    """
    batch = [values] if isinstance(values, Mapping) else list(values)
    x = np.asarray(positions, dtype=np.float32)
    if x.ndim == 2:
        x = np.broadcast_to(x, (len(batch), *x.shape))
    resolution = resolution or Resolution.derive(measurement, preset)
    law = law or Law()
    bed = measurement.bed.domain
    solver = Solver(
        x, bed.lower, bed.upper, measurement.tool.mesh, resolution, law, base_settings(measurement), batch, device
    )
    wanted = sorted({int(f) for f in frames})
    recorded: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]] = []
    if wanted and wanted[0] == 0:
        recorded.append((solver.positions(), solver.deformations()))
    forces = []
    last = wanted[-1] if wanted else 0
    for frame in range(1, last + 1):
        start = (frame - 1) * resolution.frame_time
        poses = step_poses(measurement.tool.motion, start, resolution.frame_time, resolution.steps)
        forces.append(solver.advance(poses))
        if frame in wanted:
            recorded.append((solver.positions(), solver.deformations()))
        if progress is not None:
            progress(frame, last)
    force = np.array(forces).reshape(last, len(batch), 3)
    return [
        Trajectory(
            frames=tuple(wanted),
            positions=np.stack([r[0][row] for r in recorded]),
            deformations=np.stack([r[1][row] for r in recorded]),
            force=force[:, row],
            spacing=resolution.spacing,
            resolution=resolution,
        )
        for row in range(len(batch))
    ]
