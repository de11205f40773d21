"""The tool's motion, and the force on it, as a robot's controller records them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement.fields import read_table
from splatsoil.measurement.motion import ToolMotion, check_clock, rigid
from splatsoil.measurement.tool import FORCE_COLUMNS

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres in each unit of length."""


@dataclass(frozen=True)
class Grid:
    """Frames of the set on the robot's clock.

    Attributes:
        rate: frames a second.
        zero: time of frame 0 on the robot's clock, s.
    """

    rate: float
    zero: float

    def times(self, last: float) -> FloatArray:
        """On the robot's clock: of frames 0, 1, … to the first that isn't before ``last``."""
        count = int(np.ceil((last - self.zero) * self.rate - 1e-6))
        return self.zero + np.arange(max(count, 1) + 1) / self.rate


def metres(unit: str, file: Path) -> float:
    """In a unit of a file's lengths; MeasurementError for one that is unknown."""
    if unit not in UNITS:
        raise MeasurementError(f"its unit {unit!r} is none of {', '.join(UNITS)}", file=file)
    return UNITS[unit]


def read_rigid(file: Path | None) -> FloatArray:
    """A rigid motion (4, 4) from a text file of four rows of four numbers; none at all without a file.

    Raises:
        MeasurementError: it can't be read, or is none.
    """
    if file is None:
        return np.eye(4)
    try:
        matrix = np.loadtxt(file, delimiter="," if "," in file.read_text() else None, ndmin=2)
    except (OSError, ValueError) as error:
        raise MeasurementError(f"expected four rows of four numbers ({error})", file=file) from error
    try:
        if matrix.shape != (4, 4):
            raise ValueError("not a rigid motion: it is not 4 x 4")
        return rigid(matrix)
    except ValueError as error:
        raise MeasurementError(str(error), file=file) from error


def read_motion(file: Path, unit: str, robot_to_world: FloatArray, mesh_to_flange: FloatArray) -> ToolMotion:
    """The mesh's frame in the world, at the robot's own times; frames are row numbers.

    Args:
        file: CSV of ``time,x,y,z,qw,qx,qy,qz``: the flange in the robot's frame, seconds.
        unit: of the positions.
        robot_to_world: (4, 4), m, from hand-eye calibration.
        mesh_to_flange: (4, 4), m, how the tool is mounted.

    Raises:
        MeasurementError: naming the line and column.
    """
    read = ToolMotion.read(file, numbered=False)
    flange = np.tile(np.eye(4), (len(read.times), 1, 1))
    flange[:, :3, :3] = Rotation.from_quat(read.quaternions, scalar_first=True).as_matrix()
    flange[:, :3, 3] = metres(unit, file) * read.positions
    poses = robot_to_world @ flange @ mesh_to_flange
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    return replace(read, positions=poses[:, :3, 3], quaternions=quaternions)


def resampled(motion: ToolMotion, grid: Grid) -> ToolMotion:
    """The motion in the set's frames: row n is frame n, at n by the frame rate."""
    times = grid.times(float(motion.times[-1]))
    rotations, positions = zip(*(motion.pose(float(time)) for time in times), strict=True)
    quaternions = Rotation.from_matrix(np.stack(rotations)).as_quat(scalar_first=True)
    frames = np.arange(len(times))
    return ToolMotion(frames, frames / grid.rate, np.stack(positions), quaternions)


def read_force(file: Path, robot_to_world: FloatArray, grid: Grid) -> FloatArray:
    """The force on the tool in the set's frames, as `Tool.force` has it: (n, 5).

    Args:
        file: CSV of ``time,fx,fy,fz``: the soil's on the tool, N, along the robot's axes, on its clock.
        robot_to_world: (4, 4).
        grid: the set's frames; those that the record covers as a whole are kept.

    Raises:
        MeasurementError: naming the line and column, or that it covers no frame.
    """
    table = read_table(file, FORCE_COLUMNS[1:])
    times = table[:, 0]
    check_clock(np.arange(len(times), dtype=np.float64), times, file)
    ends = grid.times(float(times[-1]))
    ends = ends[(ends >= times[0]) & (ends <= times[-1])]
    if len(ends) < 2:
        raise MeasurementError("the force's times cover no frame of the tool's motion; is it on its clock?", file=file)
    # A frame's mean is the growth of the integral of what is linear between rows.
    integral = make_interp_spline(times, table[:, 1:], k=1).antiderivative()
    means = grid.rate * np.diff(integral(ends), axis=0)
    frames = np.rint((ends[1:] - grid.zero) * grid.rate)
    return np.column_stack([frames, frames / grid.rate, means @ robot_to_world[:3, :3].T])
