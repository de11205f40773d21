"""The tool's motion: a pose for each frame, interpolated in time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement.fields import read_table

IntArray = npt.NDArray[np.int64]

MOTION_COLUMNS = ("frame", "time", "x", "y", "z", "qw", "qx", "qy", "qz")
_LARGEST_FRAME = 1e9
_QUATERNION_SLACK = 0.05  # further from length 1 than rounding explains: the columns are likely mixed up


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Poses of the tool's frame in the world.

    Attributes:
        frames: (n,) frame numbers, increasing.
        times: (n,) seconds, increasing.
        positions: (n, 3) metres.
        quaternions: (n, 4) unit, wxyz.

    Between rows positions are interpolated linearly and orientations along the shortest arc; before the first and after
    the last row the tool rests.
    """

    frames: IntArray
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray

    def __post_init__(self) -> None:
        n = len(self.times)
        for name, shape in (("frames", (n,)), ("times", (n,)), ("positions", (n, 3)), ("quaternions", (n, 4))):
            kind = np.int64 if name == "frames" else np.float64
            array = np.array(getattr(self, name), dtype=kind)
            if n == 0 or array.shape != shape:
                raise ValueError(f"{name} must be {shape} with at least one row, not {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def read(cls, file: Path, *, numbered: bool = True) -> ToolMotion:
        """Read ``frame,time,x,y,z,qw,qx,qy,qz``; if not ``numbered``, there are no frames but rows.

        Raises:
            MeasurementError: naming the line and column.
        """
        table = read_table(file, MOTION_COLUMNS[0 if numbered else 1 :])
        if not numbered:
            table = np.column_stack([np.arange(len(table)), table])
        frames, times = table[:, 0], table[:, 1]
        check_clock(frames, times, file)
        if len(table) < 2:
            raise MeasurementError("a motion has two rows at least: where the tool is at two moments", file=file)
        norms = np.linalg.norm(table[:, 5:], axis=1)
        off = np.flatnonzero(np.abs(norms - 1.0) > _QUATERNION_SLACK)
        if off.size:
            i = int(off[0])
            message = (
                "the quaternion has length 0; no turn is 1,0,0,0"
                if norms[i] < 1e-12
                else f"the quaternion has length {norms[i]:g} instead of 1; the order is w, x, y, z"
            )
            row = f"frame {int(frames[i])}" if numbered else f"row {i + 1}"
            raise MeasurementError(message, file=file, field=f"qw,qx,qy,qz, {row}")
        return cls(frames.astype(np.int64), times, table[:, 2:5], table[:, 5:] / norms[:, None])

    @property
    def table(self) -> FloatArray:
        """(n, 9) its rows, in the order of ``MOTION_COLUMNS``."""
        return np.column_stack([self.frames, self.times, self.positions, self.quaternions])

    def pose(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3), tool frame to world, and position (3,) of the tool frame's origin at ``time`` in seconds."""
        i, t = self._segment(time)
        start = Rotation.from_quat(self.quaternions[i], scalar_first=True)
        if t == 0.0:
            return start.as_matrix(), self.positions[i].copy()
        position = (1.0 - t) * self.positions[i] + t * self.positions[i + 1]
        return (Rotation.from_rotvec(t * self._turn(i)) * start).as_matrix(), position

    def matrix(self, time: float) -> FloatArray:
        """The pose as a (4, 4) matrix, tool frame to world."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.pose(time)
        return out

    def twist(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Velocity (3,) in m/s of the tool frame's origin and angular velocity (3,) in rad/s, both in the world.

        Constant between rows (at a row's time, that of the motion which begins there); zero outside the rows.
        """
        if len(self.times) < 2 or not self.times[0] <= time < self.times[-1]:
            return np.zeros(3), np.zeros(3)
        i = int(np.searchsorted(self.times, time, side="right")) - 1
        step = self.times[i + 1] - self.times[i]
        linear = (self.positions[i + 1] - self.positions[i]) / step
        return linear, self._turn(i) / step

    def _turn(self, i: int) -> FloatArray:
        """The shortest rotation vector (3,), in the world, from a row's orientation to the next one's."""
        start, end = (Rotation.from_quat(self.quaternions[k], scalar_first=True) for k in (i, i + 1))
        return (end * start.inv()).as_rotvec()

    def _segment(self, time: float) -> tuple[int, float]:
        """Row before ``time`` and the fraction of the way to the next."""
        i = int(np.searchsorted(self.times, time, side="right")) - 1
        if i < 0:
            return 0, 0.0
        if i >= len(self.times) - 1:
            return len(self.times) - 1, 0.0
        return i, float((time - self.times[i]) / (self.times[i + 1] - self.times[i]))


def rigid(matrix: FloatArray, tolerance: float = 1e-3) -> FloatArray:
    """The rigid motion nearest to a (4, 4) matrix that is one up to rounding.

    Raises:
        ValueError: what keeps it from being one.
    """
    rotation = matrix[:3, :3]
    fault = ""
    if not np.isfinite(matrix).all():
        fault = "its numbers are not finite"
    elif np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
        fault = "its last row is not 0 0 0 1"
    elif np.abs(rotation.T @ rotation - np.eye(3)).max() > tolerance:
        fault = "its upper left 3 x 3 part is not a rotation (columns of length 1 at right angles)"
        scale = float(np.linalg.norm(rotation, axis=0).mean())
        if scale > 0.0 and np.abs(rotation.T @ rotation / scale**2 - np.eye(3)).max() < tolerance:
            fault = f"it scales by {scale:g}"
    elif np.linalg.det(rotation) < 0.0:
        fault = "it mirrors (its determinant is -1)"
    if fault:
        raise ValueError(f"not a rigid motion: {fault}")
    u, _, vt = np.linalg.svd(rotation)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = u @ vt, matrix[:3, 3]
    return out


def check_clock(frames: FloatArray, times: FloatArray, file: Path) -> None:
    """Raise MeasurementError unless frame numbers are whole and both frames and times increase from row to row."""
    broken = np.flatnonzero((frames != np.round(frames)) | (np.abs(frames) > _LARGEST_FRAME))
    if broken.size:
        i = int(broken[0])
        raise MeasurementError(f"{frames[i]:g} is no frame number", file=file, field=f"frame, row {i + 1}")
    for name, values, verb in (("frame", frames, "does not increase"), ("time", times, "runs backwards")):
        steps = np.flatnonzero(np.diff(values) <= 0.0)
        if steps.size:
            i = int(steps[0])
            said = "stands still" if values[i + 1] == values[i] else verb
            raise MeasurementError(
                f"{said}: {values[i]:g} is followed by {values[i + 1]:g}", file=file, field=f"{name}, row {i + 2}"
            )
