"""What a preset makes of a measurement set."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks.numerics import Truth

from splatsoil.errors import SimulationError
from splatsoil.measurement import Measurement, write_measurement
from splatsoil.mpm import PRESETS, Resolution, Trajectory, simulate
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings


@pytest.mark.parametrize("name", PRESETS)
def test_a_faster_tool_loses_as_much_soil_on_its_way(name: str, plow_dry: Path) -> None:
    """Dry sand that is pushed slowly doesn't know how fast: rates follow the tool, soil gives way to it by its way, and
    steps go no farther."""
    slow = Measurement.load(plow_dry)
    motion = slow.tool.motion
    start = motion.positions[0]
    quick = replace(motion, positions=start + 3.0 * (motion.positions - start))
    sets = (slow, replace(slow, tool=replace(slow.tool, motion=quick)))
    before, after = (Resolution.derive(measurement, name) for measurement in sets)
    assert before.give > 0.0
    assert after.give == before.give
    assert after.relaxation == pytest.approx(3.0 * before.relaxation)
    for measurement, resolution in zip(sets, (before, after), strict=True):
        speed = np.linalg.norm(np.diff(measurement.tool.motion.positions, axis=0), axis=1) * slow.frame_rate
        assert speed.max() * resolution.frame_time / resolution.steps <= 1.001 * PRESETS[name].transport * before.cell


def test_a_larger_tool_moves_as_much_larger_soil(plow_dry: Path) -> None:
    """Similar soil before a similar tool gives way by the same share of its way: before one of twice the size by a
    quarter for each pascal and metre, if its cohesion follows its weight."""
    small = Measurement.load(plow_dry)
    mesh = small.tool.mesh.copy()
    mesh.apply_scale(2.0)
    large = replace(small, tool=replace(small.tool, mesh=mesh))
    one, two = (Resolution.derive(m, "small") for m in (small, large))
    for cohesion in (0.0, 300.0):
        soil = Settings(friction_angle=36.0, cohesion=cohesion)
        assert two.ease(replace(soil, cohesion=2.0 * cohesion)) == pytest.approx(0.25 * one.ease(soil))


def test_a_set_can_say_how_much_its_soil_gives_way(small_set: Path) -> None:
    """Photographs of real soil do: it doesn't. A copy of the set says the same."""
    unsaid = Measurement.load(small_set)
    assert Resolution.derive(unsaid, "small").give == PRESETS["small"].give
    file = small_set / "experiment.json"
    for told in (0, 0.1):
        said = json.loads(file.read_text())
        said["tool"]["give"] = told
        file.write_text(json.dumps(said))
        real = Measurement.load(small_set)
        copy = write_measurement(
            small_set.parent / f"copy-{told}",
            name="copy",
            bed=real.bed,
            tool=real.tool,
            frame_rate=real.frame_rate,
            gravity=real.gravity,
            views=real.views,
            video=real.video,
        )
        for measurement in (real, copy):
            assert all(Resolution.derive(measurement, name).give == told for name in PRESETS)


def test_soil_with_cohesion_gives_way_as_heavier_soil_does(plow_dry: Path) -> None:
    """By corresponding states: 600 Pa at 45 degrees are pressures larger by 600 Pa everywhere, whatever carries them.
    Nothing to compare with is no giving way."""
    resolution = Resolution.derive(Measurement.load(plow_dry), "small")
    soil = Settings(friction_angle=45.0)
    heavier = (1600.0 * 9.81 * 0.06 + 600.0) / (1600.0 * 0.06)
    cohesive, heavy = replace(soil, cohesion=600.0), replace(soil, gravity=(0.0, 0.0, -heavier))
    assert resolution.ease(cohesive) == pytest.approx(resolution.ease(heavy))
    assert resolution.ease(cohesive) < resolution.ease(soil)
    # the examples' blade goes its depth of 60 mm in 0.3 s: what shears as fast carries 600 Pa by 180 Pa s
    assert resolution.ease(replace(soil, viscosity=180.0)) == pytest.approx(resolution.ease(heavy))
    assert resolution.ease(replace(soil, gravity=(0.0, 0.0, 0.0))) == 0.0
    # the effects say so, too
    for size in ({"cohesion": 600.0}, {"viscosity": 180.0}):
        told = Law(find_effects(size)).settings(soil, {"friction_angle": 45.0, **size})
        assert resolution.ease(told) == pytest.approx(resolution.ease(heavy))
    # Rankine's passive pressure, by another formula: 3 at 30 degrees, 3 + 2 sqrt(2) at 45
    weak = resolution.ease(replace(soil, friction_angle=30.0))
    assert weak / resolution.ease(soil) == pytest.approx((3.0 + 2.0 * math.sqrt(2.0)) / 3.0)
    with pytest.raises(SimulationError, match="depth"):
        replace(resolution, depth=0.0)


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
