"""The independent solver's scene: what its solver is handed, held against what the tool and the bed must do."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from splatsoil.benchmarks._newton import Numerics, Run, World, _model, _walls, plough
from splatsoil.benchmarks.independent import apart, judge, twice_cohesive
from splatsoil.benchmarks.numerics import Scan, Truth, volume_range

SPACING, COARSE = 0.02, Numerics(voxel=0.04, substeps=2, iterations=60)


def test_the_set_tells_the_numerics_it_was_made_with(plow_dry: Path) -> None:
    assert Numerics.of(plow_dry) == Numerics(voxel=0.02, substeps=2, iterations=120)


def test_the_truth_of_a_set_of_ours_is_read_like_that_of_the_examples(plow_dry: Path, tmp_path: Path) -> None:
    """Ours store positions from below the bed on, so that none is negative, and parameters by name."""
    shifted = tmp_path / "shifted"
    shutil.copytree(plow_dry, shifted)
    with np.load(plow_dry / "truth_particles.npz") as file:
        stored = dict(file)
    above = np.array([0.0, 0.0, 800], dtype=np.uint16)
    arrays = {k: v + above if k[0] == "f" else v for k, v in stored.items()}
    origin = -above.astype(np.float64) * float(stored["scale"])
    np.savez(shifted / "truth_particles.npz", **arrays, origin=origin)
    parameters = {"friction_angle": 36.0, "cohesion": 250.0}
    (shifted / "truth.json").write_text(json.dumps({"parameters": parameters, "effects": ["cohesion"]}))
    there, here = Truth.load(shifted), Truth.load(plow_dry)
    assert (there.values, there.effects) == (parameters, ("cohesion",))
    assert (here.values, here.effects) == ({"friction_angle": 36.0}, ())
    assert np.allclose(there.particles[100], here.particles[100], atol=1e-9)


def test_a_world_between_two_angles_is_estimated_between_them() -> None:
    # a ridge that grows with the angle by 1 mm a degree, and its copies a fixed 2 mm higher
    ridge = 1e-3 * np.exp(-((np.arange(40) - 20.0) ** 2) / 50.0) * np.ones((1, 30, 1))
    angles = np.array([27.0, 30.0, 33.0, 36.0, 39.0])
    found = Scan(angles, angles[:, None, None, None] * ridge, 0.0, (0.0, 0.0))
    told = judge(34.3 * ridge, {"small": found}, found)
    for estimate in (told["presets"]["small"], told["own"]):
        assert estimate["heights"] == pytest.approx(34.3, abs=0.01)
        assert estimate["slopes"] == pytest.approx(34.3, abs=0.01)
        assert estimate["residual_mm"] == pytest.approx(0.0, abs=1e-3)
    raised = judge(34.3 * ridge + 2e-3, {"small": found}, None)
    assert raised["own"] is None
    assert raised["presets"]["small"]["slopes"] == pytest.approx(34.3, abs=0.01), "slopes know nothing of a level"
    assert raised["presets"]["small"]["heights"] > 36.0


def test_volume_is_told_as_the_most_of_a_loss_and_of_a_gain() -> None:
    start = np.full((3, 4), 0.1)
    frames = start * np.array([0.996, 0.987, 1.002])[:, None, None]
    assert volume_range(start, frames) == pytest.approx((-0.013, 0.002))


def test_cohesion_is_the_whole_strength_without_pressure_and_counted_once() -> None:
    newton = pytest.importorskip("newton")
    truth = Truth.load(Path(__file__).parents[2] / "examples" / "plow-damp")
    x = truth.start(SPACING, 0)
    worlds = [World("damp", 33.0, x, SPACING, cohesion=300.0), World("dry", 30.0, x, SPACING)]
    soil = _model(newton, truth.measurement, worlds, np.zeros((2, 3)), "cpu").mpm
    # Newton's shear strength is yield_stress + friction (p + tension)
    tension = soil.yield_pressure.numpy() * soil.tensile_yield_ratio.numpy()
    strength = soil.yield_stress.numpy() + soil.friction.numpy() * tension
    sine = np.sin(np.radians(33.0))
    # Drucker-Prager matched to triaxial compression, in sqrt(J2): 6 c cos / (sqrt(3) (3 - sin))
    exact = 6.0 * 300.0 * np.cos(np.radians(33.0)) / (np.sqrt(3.0) * (3.0 - sine))
    assert strength[: len(x)] == pytest.approx(exact, rel=1e-3)
    assert not strength[len(x) :].any()


def test_a_yield_stress_beside_the_tension_makes_the_cohesion_twice() -> None:
    newton = pytest.importorskip("newton")
    truth = Truth.load(Path(__file__).parents[2] / "examples" / "plow-damp")
    worlds = twice_cohesive(truth)
    soil = _model(newton, truth.measurement, worlds, np.zeros((1, 3)), "cpu").mpm
    tension = soil.yield_pressure.numpy() * soil.tensile_yield_ratio.numpy()
    strength = soil.yield_stress.numpy() + soil.friction.numpy() * tension
    sine = np.sin(np.radians(33.0))
    assert strength == pytest.approx(6.0 * 600.0 * np.cos(np.radians(33.0)) / (np.sqrt(3.0) * (3.0 - sine)), rel=1e-3)
    dry = Truth.load(Path(__file__).parents[2] / "examples" / "plow-dry")
    assert not twice_cohesive(dry)


def test_how_far_particles_are_off_is_told_of_those_that_moved() -> None:
    start = np.zeros((5, 3))
    there = start + np.array([0.05, 0.04, 0.06, 0.0, 0.0])[:, None] * np.array([1.0, 0.0, 0.0])
    truth = SimpleNamespace(particles={0: start, 50: there})
    ours = there + np.array([0.001, 0.002, 0.004, 9.0, 9.0])[:, None] * np.array([0.0, 1.0, 0.0])
    assert apart(cast("Truth", truth), {50: ours}) == {50: pytest.approx(2.0)}


def test_no_gap_is_left_between_two_walls() -> None:
    lower, upper = np.array([0.0, -0.2, 0.1]), np.array([0.8, 0.3, 0.4])
    margin = np.array([0.1, 0.1, 0.0])
    around = np.random.default_rng(0).uniform(lower - margin, upper + margin, (2000, 3))
    outside = np.any((around < lower) | (around > upper), axis=1)
    held = [np.all(np.abs(around - centre) <= half, axis=1) for centre, half in _walls(lower, upper)]
    assert np.array_equal(np.any(held, axis=0), outside)


@pytest.mark.slow
def test_soil_too_weak_to_stand_stays_in_the_box(plow_dry: Path) -> None:
    pytest.importorskip("newton")
    truth = Truth.load(plow_dry)
    bed, weak = truth.measurement.bed, World("weak", 12.0, truth.start(SPACING, 0), SPACING)
    x = plough(truth.measurement, [weak], COARSE, (20,))[0].particles[20]
    # through corners that were open it came out by 57 mm
    assert np.maximum(bed.lower - x, x - bed.upper).max() < 1e-3


@pytest.mark.slow
def test_a_set_is_repeated_by_what_made_it(plow_dry: Path) -> None:
    """With cells laid anew particles are 2.6 mm from the set's."""
    pytest.importorskip("newton")
    truth = Truth.load(plow_dry)
    world = World("the set's", 36.0, truth.particles[0], truth.volume ** (1.0 / 3.0))
    run = plough(truth.measurement, [world], Numerics.of(plow_dry), (50,))[0]
    assert apart(truth, run.particles)[50] < 0.5


@pytest.fixture(scope="module")
def ploughed() -> tuple[Truth, list[Run]]:
    """Two coarse worlds, ten frames into the push."""
    pytest.importorskip("newton")
    truth = Truth.load(Path(__file__).parents[2] / "examples" / "plow-damp")
    x = truth.start(SPACING, 0)
    short = replace(truth, particles={0: x, 5: x, 35: x}, volume=SPACING**3)
    worlds = [World("true", 33.0, x, SPACING, cohesion=300.0), World("weak", 20.0, x, SPACING, cohesion=300.0)]
    return short, plough(short.measurement, worlds, COARSE, (5, 35))


@pytest.mark.slow
def test_before_the_tool_arrives_the_bed_rests(
    ploughed: tuple[Truth, list[Run]],
) -> None:
    truth, runs = ploughed
    for run in runs:
        moved = np.linalg.norm(run.particles[5] - truth.particles[0], axis=1)
        assert np.percentile(moved, 90) < 0.3e-3  # loose grains on top settle by more; free fall would be 49 mm


@pytest.mark.slow
def test_soil_reaches_where_the_plate_was_a_substep_ago_and_no_further(
    ploughed: tuple[Truth, list[Run]],
) -> None:
    truth, runs = ploughed
    tool = truth.measurement.tool
    lower, upper = tool.mesh.bounds
    now = 35 / truth.measurement.frame_rate
    rotation, position = tool.motion.pose(now - 1 / truth.measurement.frame_rate / COARSE.substeps)
    for run in runs:
        local = (run.particles[35] - position) @ rotation
        before = local[(np.abs(local[:, 1]) < upper[1] - 0.01) & (local[:, 2] > lower[2] + 0.01) & (local[:, 0] > 0.0)]
        gap = before[:, 0].min() - upper[0]
        # the solver lets particles a hundredth of a voxel in; the tool's way in a substep is 2 mm
        assert abs(gap) < 0.6e-3


@pytest.mark.slow
def test_worlds_beside_each_other_differ_by_their_soil_alone(
    ploughed: tuple[Truth, list[Run]],
) -> None:
    truth, runs = ploughed
    weak = World("weak", 20.0, truth.particles[0], SPACING, cohesion=300.0)
    alone = plough(truth.measurement, [weak], COARSE, (5,))[0]
    # 0.1 mm was measured, against 0.7 mm between the two soils, at that frame
    assert np.percentile(np.linalg.norm(alone.particles[5] - runs[1].particles[5], axis=1), 99) < 0.2e-3
    assert np.percentile(np.linalg.norm(runs[0].particles[5] - runs[1].particles[5], axis=1), 99) > 0.4e-3


@pytest.mark.slow
def test_the_force_is_the_soils_on_the_tool(ploughed: tuple[Truth, list[Run]]) -> None:
    """Next to nothing before it arrives; then against its way and up, more of it in stronger soil. The set's is twice
    as large, as its soil has twice the cohesion; coarse voxels and few iterations bear still less.
    """
    truth, (strong, weak) = ploughed
    force = truth.measurement.tool.force
    assert force is not None
    pushing = slice(29, 35)
    ours, less = (run.force[pushing].mean(axis=0) for run in (strong, weak))
    measured = force[pushing, 2:].mean(axis=0)
    assert np.abs(strong.force[:5, 0]).max() < 0.05 * abs(ours[0])
    assert np.all(np.sign(ours[[0, 2]]) == np.sign(measured[[0, 2]]))
    assert abs(ours[1]) < 0.1 * abs(ours[0])
    assert np.linalg.norm(less) < 0.8 * np.linalg.norm(ours)
    assert 0.3 * np.linalg.norm(measured) < np.linalg.norm(ours) < np.linalg.norm(measured)
