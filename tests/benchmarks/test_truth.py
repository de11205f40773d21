"""True particles: what is read and kept, and how heights, volumes and forces are compared."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._scenes import Scene
from splatsoil.benchmarks._truth import Truth, cut_and_heaped, in_patches, stage_forces, volume_range

from splatsoil.errors import MeasurementError
from splatsoil.measurement import ToolMotion

STAGES = {"lowering": (2.0, 60.0), "pushing": (-150.0, 70.0), "pause": (-40.0, 25.0), "withdrawal": (30.0, 5.0)}
"""Force along the way and upwards, N."""


def staged(heading: np.ndarray) -> np.ndarray:
    """A force (199, 3) that is constant in each stage, but for a part across the way and one that comes and goes."""
    force, across = np.zeros((199, 3)), np.array([-heading[1], heading[0]])
    ends = (0, 25, 100, 125, 199)
    for begin, end, (along, up) in zip(ends[:-1], ends[1:], STAGES.values(), strict=True):
        force[begin:end] = [*(along * heading + 9.0 * across), up]
    force[25:55] += 20.0
    force[55:85] -= 20.0
    return force


def test_a_set_of_ours_is_read_like_the_examples(plow_dry: Path, tmp_path: Path) -> None:
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
    (shifted / "truth.json").write_text("{}")
    with pytest.raises(MeasurementError, match="true parameters"):
        Truth.load(shifted)


def test_other_particles_fill_the_same_bed(plow_dry: Path) -> None:
    truth = Truth.load(plow_dry)
    x = truth.start(0.015, 3)
    true = truth.heights(truth.particles[0], truth.volume)
    assert len(x) * 0.015**3 == pytest.approx(len(truth.particles[0]) * truth.volume, rel=0.01)
    assert in_patches(truth.heights(x, 0.015**3) - true) < 2e-3


@pytest.mark.parametrize("heading", [(1.0, 0.0), (0.0, 1.0)])
def test_forces_are_means_by_stage_along_the_way_and_upwards(heading: tuple[float, float]) -> None:
    measurement = Scene(seed=7, angle=34.0).setup().experiment()
    if heading[1]:
        motion = measurement.tool.motion
        turned = ToolMotion(motion.frames, motion.times, motion.positions[:, [1, 0, 2]], motion.quaternions)
        measurement = replace(measurement, tool=replace(measurement.tool, motion=turned))
    found = stage_forces(measurement, staged(np.array(heading)))
    assert list(found) == list(STAGES)
    for name, parts in STAGES.items():
        assert found[name] == pytest.approx(parts, abs=1e-9)


def test_patches_keep_what_is_wide_and_drop_what_is_narrow() -> None:
    """A blur of s cells leaves exp(-(2 pi s / length)^2 / 2) of a wave."""
    assert in_patches(np.full((4, 50, 80), 2e-3)) == pytest.approx(2e-3)
    x = np.arange(80.0)
    for length in (40.0, 16.0):
        wave = 1e-3 * np.cos(2.0 * np.pi * (x + 0.5) / length) * np.ones((2, 50, 1))
        left = np.exp(-0.5 * (2.0 * np.pi * 1.5 / length) ** 2)
        assert in_patches(wave) == pytest.approx(1e-3 * left / np.sqrt(2.0), rel=0.01)
    assert in_patches(2e-3 * (-1.0) ** x * np.ones((2, 50, 1))) < 0.1e-3


def test_soil_cut_and_heaped_is_told_apart_and_without_what_settles() -> None:
    """A trench of 20 x 12 cm and 5 cm deep, a heap of half its soil beside it; a millimetre everywhere is settling."""
    before = np.full((50, 80), 0.12)
    after = before.copy()
    after[10:22, 20:40] -= 0.05
    after[30:42, 20:40] += 0.025
    cut, heaped = cut_and_heaped(before, after)
    assert cut == pytest.approx(20 * 12 * 5, rel=0.02)
    assert heaped == pytest.approx(20 * 12 * 2.5, rel=0.03)
    assert cut_and_heaped(before, before - 1e-3) == pytest.approx((0.0, 0.0))
    assert max(cut_and_heaped(before, before + 1e-3 * np.random.default_rng(0).standard_normal(before.shape))) < 5.0


def test_volume_is_the_most_of_a_loss_and_of_a_gain() -> None:
    start = np.full((3, 4), 0.1)
    frames = start * np.array([0.996, 0.987, 1.002])[:, None, None]
    assert volume_range(start, frames) == pytest.approx((-0.013, 0.002))
