"""The tool's force as features: which frames, which direction, and what may be wrong with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatsoil.experiment.forces import ALONG, SCALE, SENSOR, UP, ToolForces, compressed, force_record
from splatsoil.measurement import Measurement, ToolMotion

ROWS = [[frame, frame + 10] for frame in range(10, 200, 20)]
"""Compared frames of the example set, two to a row."""
PUSHED = slice(1, 5)
"""Rows in which the tool is pushed: from frame 25 to 100."""
LAST = 200


@pytest.fixture(scope="module")
def dry(plow_dry: Path) -> Measurement:
    return Measurement.load(plow_dry)


def with_force(measurement: Measurement, force: np.ndarray, first: int = 1) -> Measurement:
    """A set whose force (f, 3) in frames ``first``, … is made up."""
    frames = np.arange(first, first + len(force))
    table = np.column_stack([frames, frames / measurement.frame_rate, force])
    return replace(measurement, tool=replace(measurement.tool, force=table))


def forces_of(measurement: Measurement, rows: list[list[int]] | None = None) -> ToolForces:
    found = ToolForces.of(measurement, ROWS if rows is None else rows)
    assert found is not None
    return found


def test_a_prediction_that_is_right_is_what_was_measured(dry: Measurement) -> None:
    assert dry.tool.force is not None
    found = forces_of(dry)
    assert np.allclose(found.predicted(dry.tool.force[:, 2:]), found.observed)


def test_rows_are_means_over_their_frames_in_newtons_of_the_largest(dry: Measurement) -> None:
    assert dry.tool.force is not None
    found = forces_of(dry)
    assert found.channels == (ALONG, UP)
    # The plate is pushed along x from frame 26 to 100; compared frames stand for those from 5 before to 5 after.
    fx, fz = dry.tool.force[:, 2], dry.tool.force[:, 4]
    row = slice(45 - 1, 64)
    push, lift = (0.01 * found.largest * found.observed[2, k] for k in (0, 1))
    assert push == pytest.approx(-fx[row].mean(), rel=0.02)
    assert lift == pytest.approx(fz[row].mean(), rel=0.02)
    assert np.linalg.norm(found.observed[PUSHED], axis=1).max() == pytest.approx(100.0)


def test_features_are_read_in_newtons(dry: Measurement) -> None:
    found = forces_of(dry)
    assert np.allclose(found.newtons(found.features), 0.01 * found.largest * found.observed)


def test_what_is_shown_of_a_set_is_its_own_table_in_newtons(dry: Measurement) -> None:
    assert dry.tool.force is not None
    force = dry.tool.force[:, 2:]
    shown = force_record(dry, [40, 50, 60, 150], 2.0 * force)
    assert shown is not None
    along, up = shown["channels"]
    assert (shown["unit"], shown["frames"], along["channel"], up["channel"]) == ("N", [40, 50, 60, 150], ALONG, UP)
    # Frame 50 stands for those from 46 to 55; the tool is pushed along x, the soil pushes back.
    assert along["measured"][1] == pytest.approx(-force[45:54, 0].mean(), rel=0.02)
    assert up["measured"][1] == pytest.approx(force[45:54, 2].mean(), rel=0.02)
    for channel in (along, up):
        assert np.allclose(channel["predicted"], 2.0 * np.array(channel["measured"]), atol=2e-4)
    still = replace(dry, tool=replace(dry.tool, force=None))
    assert force_record(still, [40, 50], force) is None


def test_a_way_through_the_air_is_no_push(dry: Measurement) -> None:
    """Carried to its place first, sideways and high above the bed, faster than it is pushed."""
    motion = dry.tool.motion
    away = np.arange(40)
    start = motion.positions[0] + np.array([0.0, -0.005, 0.0]) * (40 - away)[:, None]
    positions = np.concatenate([start, motion.positions])
    frames = np.arange(len(positions))
    carried = ToolMotion(
        frames, frames / dry.frame_rate, positions, np.concatenate([motion.quaternions[:40], motion.quaternions])
    )
    assert dry.tool.force is not None
    force = np.concatenate([np.zeros((40, 3)), dry.tool.force[:, 2:]])
    later = replace(dry, tool=replace(dry.tool, motion=carried))
    found = forces_of(with_force(later, force), [[a + 40, b + 40] for a, b in ROWS])
    whole = forces_of(dry)
    assert found.largest == pytest.approx(whole.largest)
    assert np.allclose(found.observed[PUSHED], whole.observed[PUSHED])


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.5])
def test_the_way_is_the_tools_wherever_it_heads(dry: Measurement, turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    motion = dry.tool.motion
    turned = ToolMotion(motion.frames, motion.times, motion.positions @ rotation.T, motion.quaternions)
    assert dry.tool.force is not None
    force = dry.tool.force.copy()
    force[:, 2:] = force[:, 2:] @ rotation.T
    found = forces_of(replace(dry, tool=replace(dry.tool, motion=turned, force=force)))
    assert np.allclose(found.observed, forces_of(dry).observed)


def test_a_tool_that_is_only_lowered_tells_nothing(dry: Measurement) -> None:
    motion = dry.tool.motion
    positions = motion.positions.copy()
    positions[:, :2] = positions[0, :2]
    positions[:, 2] = positions[0, 2] - 0.0005 * np.arange(len(positions))
    straight = ToolMotion(motion.frames, motion.times, positions, motion.quaternions)
    force = np.column_stack([np.zeros(LAST), np.zeros(LAST), np.linspace(0.0, 100.0, LAST)])
    assert ToolForces.of(with_force(replace(dry, tool=replace(dry.tool, motion=straight)), force), ROWS) is None


def test_a_comparison_of_models_takes_large_forces_by_their_ratio_and_small_ones_as_they_are(dry: Measurement) -> None:
    large, small = np.array([40.0, 90.0, -90.0]), np.array([0.5, -0.5])
    assert np.allclose(compressed(1.1 * large) - compressed(large), np.sign(large) * SCALE * np.log(1.1), rtol=0.05)
    assert np.allclose(compressed(small), small, rtol=1e-3)
    found = forces_of(dry)
    assert np.array_equal(found.features, compressed(found.observed))
    # What the instrument adds, in the same features.
    shift = 1e-3 * SENSOR
    moved = (compressed(found.observed + shift) - compressed(found.observed - shift)) / (2e-3)
    stands = np.isclose(found.noise, moved, rtol=1e-4).all(axis=1).argmin()
    moving = np.delete(np.arange(len(moved)), stands)
    assert np.allclose(found.noise[moving], moved[moving], rtol=1e-4)
    # Of a tool that stands, anything from nothing to what it bore before: a uniform distribution's standard deviation.
    bore = np.linspace(0.0, 1.0, 100_001)[:, None] * found.features[stands - 1]
    assert np.allclose(found.noise[stands], np.hypot(bore.std(axis=0), moved[stands]), rtol=1e-4)
    assert (found.noise[stands] > 3.0 * moved[stands]).all()


@pytest.mark.parametrize("frames", [(0, 0), (150, 200), (1, 12)])
def test_forces_of_hardly_any_use_are_left_alone(dry: Measurement, frames: tuple[int, int]) -> None:
    first, last = frames
    force = np.tile([-50.0, 0.0, 20.0], (last - first, 1))
    made = with_force(dry, force, first) if last else replace(dry, tool=replace(dry.tool, force=None))
    assert ToolForces.of(made, ROWS) is None


def test_forces_that_end_early_count_as_far_as_they_go(dry: Measurement) -> None:
    assert dry.tool.force is not None
    whole = forces_of(dry)
    part = forces_of(with_force(dry, dry.tool.force[:64, 2:]))
    assert part.measured[:, 0].tolist() == [True] * 3 + [False] * 7
    assert np.allclose(part.largest * part.observed[1:2], whole.largest * whole.observed[1:2])
