"""What benchmarks of numerics read: truths, and angles and volumes off height maps."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks.numerics import Scan, Truth, volume_range


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
    found = Scan(angles, angles[:, None, None, None] * ridge, 0.0, (0.0, 0.0), np.zeros(5))
    assert found.best(34.3 * ridge) == pytest.approx(34.3, abs=0.01)
    assert found.best(34.3 * ridge, slopes=True) == pytest.approx(34.3, abs=0.01)
    assert found.residual(34.3 * ridge) == pytest.approx(0.0, abs=1e-6)
    raised = 34.3 * ridge + 2e-3
    assert found.best(raised, slopes=True) == pytest.approx(34.3, abs=0.01), "slopes know nothing of a level"
    assert found.best(raised) > 36.0


def test_volume_is_told_as_the_most_of_a_loss_and_of_a_gain() -> None:
    start = np.full((3, 4), 0.1)
    frames = start * np.array([0.996, 0.987, 1.002])[:, None, None]
    assert volume_range(start, frames) == pytest.approx((-0.013, 0.002))
