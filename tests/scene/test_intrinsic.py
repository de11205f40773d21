"""Light and albedo on file: what is read back is what was estimated, to the bit."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from splatsoil.commands._model import model_on
from splatsoil.errors import ParameterError, RunError
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField
from splatsoil.scene import Intrinsic
from splatsoil.splats import Gaussians

LEVEL = 0.12


@pytest.fixture
def experiment(small_set: Path):
    """A set, and level soil of one colour for its reconstruction."""
    measurement = Measurement.load(small_set)
    bed = measurement.bed
    x, y = (torch.arange(float(bed.lower[k]) + 0.01, float(bed.upper[k]), 0.02) for k in (0, 1))
    flat = torch.cartesian_prod(x, y)
    count = len(flat)
    gaussians = Gaussians(
        torch.cat([flat, torch.full((count, 1), LEVEL)], dim=1),
        torch.tensor([0.012, 0.012, 0.001]).repeat(count, 1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count,), 0.9),
        torch.tensor([0.6, 0.5, 0.4]).repeat(count, 1),
    )
    whole = torch.ones(count, dtype=torch.bool)
    surface = HeightField.over(bed.lower, bed.upper, 0.02, LEVEL)
    made = SimpleNamespace(
        gaussians=gaussians, soil=whole, tool=~whole, background=(0.0, 0.0, 0.0), surface=surface, container="bin"
    )
    return measurement, made


def pictures(model: Model) -> list[bytes]:
    """Of soil at rest, with particles of two seeds and buried soil of another colour."""
    scene, drawn = model.scene(0), []
    for each in (scene, model.scene(1), scene.with_sampled_albedo(2)):
        posed = each.pose(each.soil.particles, None, model.measurement.tool.motion.pose(0.0))
        drawn += [each.picture(posed, camera.undistorted()).tobytes() for camera in model.measurement.cameras.values()]
    return drawn


def test_a_model_estimates_light_and_albedo_once(experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def file(spacing: float) -> Path:
        asked.append(spacing)
        return tmp_path / f"{spacing:.6f}.npz"

    alone = Model(*experiment, preset="tiny", frames=[0])
    first = Model(*experiment, preset="tiny", frames=[0], intrinsic=file)
    expected = pictures(alone)
    assert pictures(first) == expected and len(set(expected)) == len(expected)
    assert [path.name for path in tmp_path.glob("*.npz")] == [f"{first.resolution.spacing:.6f}.npz"]

    def never(*_: object) -> None:
        raise AssertionError("estimated again")

    monkeypatch.setattr("splatsoil.scene.build.estimate_light", never)
    monkeypatch.setattr("splatsoil.scene.build._refined", never)
    second = Model(*experiment, preset="tiny", frames=[0], intrinsic=file).variant(effects=["cohesion"])
    assert pictures(second) == expected
    assert asked == [first.resolution.spacing] * 2


def test_a_runs_file_is_of_one_reconstruction(experiment, tmp_path: Path) -> None:
    """Soil of other colours, as many Gaussians as before, isn't drawn with the albedo of what was there."""
    measurement, made = experiment
    darker = SimpleNamespace(
        **{**vars(made), "gaussians": replace(made.gaussians, colours=0.5 * made.gaussians.colours)}
    )
    run: Any = SimpleNamespace(path=tmp_path)
    first, other, again = (
        Intrinsic.of(model_on(measurement, run, each, (), "tiny", "cpu").scene()) for each in (made, darker, made)
    )
    assert len(list((tmp_path / "features").glob("intrinsic-*.npz"))) == 2
    assert np.array_equal(first.soil, again.soil) and not np.array_equal(first.soil, other.soil)


def test_a_file_of_another_scene_or_no_file_of_ours_is_refused(experiment, tmp_path: Path) -> None:
    file = tmp_path / "kept.npz"
    model = Model(*experiment, preset="tiny", frames=[0], intrinsic=lambda spacing: file)
    model.scene()
    other = model.variant(resolution=model.resolution).scene().replace(soil_albedo=torch.zeros(3, 3))
    Intrinsic.of(other).save(file)
    again = Model(*experiment, preset="tiny", frames=[0], intrinsic=lambda spacing: file)
    with pytest.raises(ParameterError, match=r"soil has shape \(3, 3\)"):
        again.scene()
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(RunError, match="delete it"):
        again.scene()
