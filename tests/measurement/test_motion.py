"""The tool's pose and velocity in time, against SciPy's rotations and by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from splatsoil.measurement import ToolMotion

TIMES = np.array([0.0, 0.1, 0.25, 0.3, 1.0])


@pytest.fixture
def tumbling() -> tuple[ToolMotion, Slerp]:
    """Random poses at uneven times, with quaternion signs that hop; and SciPy's interpolation of them."""
    rng = np.random.default_rng(3)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.7, size=(5, 3)), axis=0))
    quaternions = rotations.as_quat()[:, [3, 0, 1, 2]] * np.array([1, -1, 1, -1, -1])[:, None]
    motion = ToolMotion(np.arange(5), TIMES, rng.normal(size=(5, 3)), quaternions)
    return motion, Slerp(TIMES, rotations)


def test_pose_is_interpolated_as_scipy_does(tumbling: tuple[ToolMotion, Slerp]) -> None:
    motion, slerp = tumbling
    for time in np.linspace(0.0, 1.0, 101):
        rotation, position = motion.pose(time)
        np.testing.assert_allclose(rotation, slerp(time).as_matrix(), atol=1e-12)
        expected = [np.interp(time, TIMES, motion.positions[:, axis]) for axis in range(3)]
        np.testing.assert_allclose(position, expected, atol=1e-12)
        matrix = motion.matrix(time)
        np.testing.assert_array_equal(matrix[:3, :3], rotation)
        np.testing.assert_array_equal(matrix[:, 3], [*position, 1.0])


def test_the_tool_rests_before_and_after(tumbling: tuple[ToolMotion, Slerp]) -> None:
    motion, _ = tumbling
    for outside, row in ((-5.0, 0), (7.0, -1)):
        np.testing.assert_array_equal(motion.pose(outside)[1], motion.positions[row])
        expected = Rotation.from_quat(motion.quaternions[row], scalar_first=True).as_matrix()
        np.testing.assert_allclose(motion.pose(outside)[0], expected)
        assert not np.any(motion.twist(outside))


def test_twist_is_the_poses_derivative(tumbling: tuple[ToolMotion, Slerp]) -> None:
    motion, _ = tumbling
    h = 1e-6
    for time in (0.05, 0.2, 0.27, 0.9):
        (before, x0), (after, x1) = motion.pose(time - h), motion.pose(time + h)
        linear, angular = motion.twist(time)
        np.testing.assert_allclose(linear, (x1 - x0) / (2 * h), rtol=1e-6)
        spin = Rotation.from_matrix(after @ before.T).as_rotvec() / (2 * h)
        np.testing.assert_allclose(angular, spin, rtol=1e-6, atol=1e-6)


def test_turning_about_an_axis_by_hand() -> None:
    """A quarter turn about z and 0.1 m along x in half a second."""
    s = np.sqrt(0.5)
    motion = ToolMotion([0, 1], [0.0, 0.5], [[0, 0, 0], [0.1, 0, 0]], [[1, 0, 0, 0], [s, 0, 0, s]])
    rotation, position = motion.pose(0.25)
    np.testing.assert_allclose(rotation, [[s, -s, 0], [s, s, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(position, [0.05, 0, 0])
    linear, angular = motion.twist(0.25)
    np.testing.assert_allclose(linear, [0.2, 0, 0])
    np.testing.assert_allclose(angular, [0, 0, np.pi], atol=1e-12)
    np.testing.assert_allclose(motion.twist(0.0)[0], [0.2, 0, 0], err_msg="at a row, what begins there")
    np.testing.assert_array_equal(motion.twist(0.5)[0], 0.0)


HEADER = ["frame", "time", "x", "y", "z", "qw", "qx", "qy", "qz"]
ROWS = [[0, 0.0, 0.25, 1.5, -0.5, 1.0, 0.0, 0.0, 0.0], [1, 0.02, 0.26, 1.5, -0.5, 0.8, 0.6, 0.0, 0.0]]
ORDER = [1, 0, 4, 3, 2, 6, 7, 8, 5]


def csv(mark: str = ",", header: list[str] = HEADER, rows: list[list] = ROWS, first: str = "", end: str = "") -> str:
    return first + "\n".join(mark.join(str(v) for v in row) + end for row in (header, *rows)) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        csv(),
        csv(first="# made by a robot\n\n"),
        csv(first="# "),
        csv().replace("\n1,", "\n# paused\n1,"),
        csv("\t"),
        csv("\t").replace(".", ","),
        csv(";"),
        csv(";").replace(".", ","),
        csv("; ").replace(".", ","),
        csv(header=[name.upper() for name in HEADER]),
        csv(end=","),
        csv(end=",").replace("0,\n", "0\n"),
        csv(header=[*HEADER, "Torque"], rows=[[*row, 7.0] for row in ROWS]),
        csv(header=["note", *HEADER], rows=[["", *row] for row in ROWS]),
        csv(header=[HEADER[k] for k in ORDER], rows=[[row[k] for k in ORDER] for row in ROWS]),
        "\ufeff" + csv().replace("\n", "\r\n"),
    ],
    ids=["plain", "comment", "header-in-comment", "comment-between", "tabs", "tabs-comma", "semicolons",
         "semicolons-comma", "semicolons-space", "capitals", "trailing", "trailing-header", "further", "further-first",
         "order", "windows"],
)  # fmt: skip
def test_tables_that_are_unambiguous_are_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "motion.csv").write_text(text, encoding="utf-8", newline="")
    motion = ToolMotion.read(tmp_path / "motion.csv")
    np.testing.assert_array_equal(motion.frames, [0, 1])
    np.testing.assert_array_equal(motion.times, [0.0, 0.02])
    np.testing.assert_array_equal(motion.positions, [row[2:5] for row in ROWS])
    np.testing.assert_allclose(motion.quaternions, [row[5:] for row in ROWS], atol=1e-15)


def test_one_row_is_a_resting_tool() -> None:
    motion = ToolMotion([0], [0.0], [[1, 2, 3]], [[1, 0, 0, 0]])
    np.testing.assert_array_equal(motion.pose(4.0)[1], [1, 2, 3])
    assert not np.any(motion.twist(0.0))


def test_tables_of_uneven_length_are_refused() -> None:
    with pytest.raises(ValueError, match="positions"):
        ToolMotion([0, 1], [0.0, 1.0], [[0, 0, 0]], [[1, 0, 0, 0]] * 2)
