"""What a preset makes of a measurement set, and simulations of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._truth import Truth

from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution, Trajectory, simulate
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects


@pytest.mark.parametrize("name", PRESETS)
def test_a_faster_tool_loses_as_much_soil_on_its_way(name: str, plow_dry: Path) -> None:
    """Dry sand that is pushed slowly doesn't know how fast: rates follow the tool, and steps go no farther."""
    slow = Measurement.load(plow_dry)
    motion = slow.tool.motion
    start = motion.positions[0]
    quick = replace(motion, positions=start + 3.0 * (motion.positions - start))
    sets = (slow, replace(slow, tool=replace(slow.tool, motion=quick)))
    before, after = (Resolution.derive(measurement, name) for measurement in sets)
    assert after.relaxation == pytest.approx(3.0 * before.relaxation)
    for measurement, resolution in zip(sets, (before, after), strict=True):
        speed = np.linalg.norm(np.diff(measurement.tool.motion.positions, axis=0), axis=1) * slow.frame_rate
        assert speed.max() * resolution.frame_time / resolution.steps <= 1.001 * PRESETS[name].transport * before.cell


def test_dry_soil_is_the_same_under_any_gravity(plow_dry: Path) -> None:
    """Froude's scaling: under a quarter of the gravity, told or found, with a skeleton a quarter as stiff, a tool half
    as fast moves every grain as before, and feels a quarter of the force: bit for bit, as these are powers of two."""
    truth = Truth.load(plow_dry)
    earth, motion = truth.measurement, truth.measurement.tool.motion
    slow = replace(
        earth,
        frame_rate=0.5 * earth.frame_rate,
        tool=replace(earth.tool, motion=replace(motion, times=2.0 * motion.times)),
    )
    resolution = Resolution.derive(earth, "tiny")
    soft = replace(Resolution.derive(slow, "tiny"), bulk=0.25 * resolution.bulk, shear=0.25 * resolution.shear)
    start, values = truth.start(resolution.spacing, 0), {"friction_angle": 36.0}

    def ploughed(measurement: Measurement, resolution: Resolution, **more: float) -> Trajectory:
        law = Law(find_effects(["gravity"] if more else []))
        at = law.require_on({**values, **more})
        return simulate(measurement, start, at, law=law, resolution=resolution, frames=[0, 30, 60], device="cpu")[0]

    expected = ploughed(earth, resolution)
    moon = replace(slow, gravity=tuple(0.25 * g for g in earth.gravity))
    for found in (ploughed(moon, soft), ploughed(slow, soft, gravity_factor=0.25)):
        np.testing.assert_array_equal(found.positions, expected.positions)
        np.testing.assert_array_equal(found.force, 0.25 * expected.force)
    assert np.abs(expected.force[40:]).max() > 20.0


def test_the_tool_is_in_each_frame_where_the_set_has_it(plow_dry: Path) -> None:
    """Above the soil up to frame 10 and in it from frame 11 on: the soil bears and moves in frame 11 for the first
    time, and so does what is recorded."""
    truth = Truth.load(plow_dry)
    tool, resolution = truth.measurement.tool, Resolution.derive(truth.measurement, "tiny")
    x, (low, high) = truth.start(resolution.spacing, 0), tool.bounds(0.0)
    under = np.all((x[:, :2] > low[:2]) & (x[:, :2] < high[:2]), axis=1)
    positions = np.repeat(tool.motion.positions[:1], len(tool.motion.positions), axis=0)
    positions[:, 2] += x[under, 2].max() - low[2] + np.where(tool.motion.frames > 10, -0.02, 0.04)
    measurement = replace(truth.measurement, tool=replace(tool, motion=replace(tool.motion, positions=positions)))
    resolution = Resolution.derive(measurement, "tiny")
    (run,) = simulate(measurement, x, {"friction_angle": 36.0}, resolution=resolution, frames=[0, 10, 11, 12])
    size = np.linalg.norm(run.force, axis=1)
    assert size[:10].max() == 0.0 and size[10] > 1.0
    moved = np.linalg.norm(np.diff(run.positions[:, under], axis=0), axis=2).max(axis=1)
    assert moved[0] < 2e-3 and moved[1] > 5e-3
