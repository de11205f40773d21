"""PlowSand-v0 on a measurement set: the example, cut down, at the coarsest preset."""

from __future__ import annotations

import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from splatsoil.envs import measured
from splatsoil.envs.measured import MeasuredProblem

from splatsoil.errors import MeasurementError, ParameterError, RunError
from splatsoil.experiment.base import Run
from splatsoil.experiment.forces import SCALE
from splatsoil.measurement import Measurement
from splatsoil.reconstruction import reconstruct


@pytest.fixture(scope="module")
def reconstruction(plow_dry: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("reconstruction")
    return reconstruct(Measurement.load(plow_dry), preset="tiny").save(folder)


@pytest.mark.slow
def test_a_step_is_a_simulation_compared_with_the_video(small_set: Path, reconstruction: Path) -> None:
    options = {"measurement": str(small_set), "preset": "tiny", "budget": 2, "reconstruction": str(reconstruction)}
    made = gym.make("PlowSand-v0", **options, render_mode="rgb_array")
    made.reset(seed=0)
    observation, reward, _, truncated, info = made.step(np.zeros(1, dtype=np.float32))
    assert info["parameters"] == {"friction_angle": 35.0}
    assert -10.0 < reward < 0.0 and not truncated
    assert 0.0 < info["rgb"] < 0.1
    assert observation in made.observation_space
    assert observation["block_residuals"].std() > 0.0
    picture = made.render()
    assert isinstance(picture, np.ndarray) and picture.shape == (240, 3 * 320, 3)
    _, again, _, truncated, info = made.step(np.zeros(1, dtype=np.float32))
    assert truncated and "truth" not in info
    # Other particles, another chance.
    assert again != reward and again == pytest.approx(reward, rel=0.2)

    assert made.spec is not None
    spec = EnvSpec.from_json(made.spec.to_json())
    assert spec.kwargs == made.spec.kwargs


@pytest.mark.slow
def test_what_is_left_of_a_measured_force_is_told(plow_dry: Path, reconstruction: Path, tmp_path: Path) -> None:
    """Beside the example's own force, and one that is larger by half of it everywhere: the same force is predicted."""
    folder = Path(shutil.copytree(plow_dry, tmp_path / "set", copy_function=shutil.copyfile))
    folder.chmod(0o755)
    head, *rows = (plow_dry / "tool_force.csv").read_text().splitlines()
    table = np.array([[float(v) for v in row.split(",")] for row in rows])
    predicted, largest = [], []
    for factor in (1.0, 1.5):
        scaled = table * np.array([1.0, 1.0, factor, factor, factor])
        (folder / "tool_force.csv").write_text(
            "\n".join([head, *(f"{int(row[0])}," + ",".join(map(str, row[1:])) for row in scaled)])
        )
        problem = MeasuredProblem.load(folder, preset="tiny", reconstruction=reconstruction)
        experiment = problem.experiment
        assert experiment.forces is not None
        evaluation = problem.evaluate({"friction_angle": 36.0}, 0)
        assert evaluation.blocks.shape == (problem.block_count,) == (experiment.observed.size,)
        assert not evaluation.blocks.reshape(experiment.layout.shape)[~experiment.seen].any()
        force = ~experiment.layout.placed
        shares = SCALE * np.sinh(problem.features(list(evaluation.blocks))[:, force] / SCALE)
        predicted.append(0.01 * experiment.forces.largest * shares[experiment.seen[:, force]])
        largest.append(experiment.forces.largest)
    assert largest[1] == pytest.approx(1.5 * largest[0])
    assert predicted[1] == pytest.approx(predicted[0], rel=1e-6, abs=1e-9)
    assert 0.5 * largest[0] < np.abs(predicted[0]).max() < 2.0 * largest[0]
    # What a comparison of models would be told of the same simulation.
    direct = experiment.predict(Run({"friction_angle": 36.0}))
    assert problem.features(list(evaluation.blocks))[experiment.seen] == pytest.approx(direct[experiment.seen])


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"reconstruction": "nowhere"}, RunError, "nowhere"),
        ({"measurement": "nowhere"}, MeasurementError, "nowhere"),
        ({"device": "cuda:77"}, ParameterError, "cuda:77"),
    ],
)
def test_what_cannot_be_opened_is_named(small_set: Path, options: dict, error: type, says: str) -> None:
    with pytest.raises(error, match=says):
        gym.make("PlowSand-v0", **({"measurement": str(small_set)} | options))


def test_reconstructions_are_kept_for_a_set_and_a_preset(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    class Result:
        def save(self, folder: Path) -> None:
            made.append(folder.name)
            folder.mkdir(parents=True)
            (folder / "reconstruction.json").write_text("{}")

    monkeypatch.setenv("SPLATSOIL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("splatsoil.reconstruction.reconstruct", lambda *_, **__: Result())
    monkeypatch.setattr("splatsoil.reconstruction.Reconstruction.load", staticmethod(lambda folder: folder))
    measurement = Measurement.load(small_set)
    first = measured.cached_reconstruction(measurement, "tiny", "cpu")
    assert measured.cached_reconstruction(measurement, "tiny", "cpu") == first
    assert measured.cached_reconstruction(measurement, "small", "cpu") != first
    assert len(made) == 2 and made[0].startswith(measurement.hash[:16])
