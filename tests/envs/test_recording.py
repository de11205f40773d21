"""Recorded episodes, read back by Minari itself."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
from splatsoil.benchmarks import bo_vs_mcmc
from splatsoil.benchmarks._agents import at_random
from splatsoil.envs.recording import recorded, write

from splatsoil.errors import ParameterError, RunError

minari = pytest.importorskip("minari")
pytest.importorskip("jax")


@pytest.fixture(autouse=True)
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def play(env: gym.Env, seed: int, guesses: list[float]) -> list[tuple[dict, float]]:
    env.reset(seed=seed)
    return [env.step(np.array([g], np.float32))[:2] for g in guesses]  # type: ignore[misc]


@pytest.mark.filterwarnings("ignore:env_spec is not serializable")  # this test's problem isn't made from names
def test_minari_reads_back_what_was_played(analytic: ModuleType) -> None:
    problem = analytic.AnalyticProblem(noise=0.0, fails_below=25.0)
    env = recorded(gym.make("PlowSand-v0", problem=problem, budget=3))
    played = [play(env, 0, [0.0, -0.9, 0.2]), play(env, 5, [1.5, 0.1])]  # the second ends early, and clips
    env.reset()
    made = write(env, "plow-sand/by-hand-v0", algorithm_name="by hand")
    assert made.total_episodes == 2

    dataset = minari.load_dataset("plow-sand/by-hand-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 5)
    assert dataset.observation_space == env.observation_space and dataset.action_space == env.action_space
    first, second = dataset.iterate_episodes()
    for episode, steps in zip((first, second), played, strict=True):
        np.testing.assert_allclose(episode.rewards, [reward for _, reward in steps])
        for key, column in episode.observations.items():
            assert len(column) == len(steps) + 1
            np.testing.assert_array_equal(column[1:], [observation[key] for observation, _ in steps])
    np.testing.assert_array_equal(second.actions[:, 0], np.float32([1.0, 0.1]))
    assert first.truncations.tolist() == [False, False, True] and second.truncations.tolist() == [False, True]
    angles = first.infos["parameters"]["friction_angle"]
    # 20° to 50°, as the problem has it; nothing was simulated before the first step.
    np.testing.assert_allclose(angles, [np.nan, 35.0, 21.5, 38.0], rtol=1e-6)
    assert first.infos["failed"].tolist() == [False, False, True, False]
    # The loss is 0.1 + ((angle - 36) / 10)^2, and the truth is told at the end of an episode only.
    assert first.rewards[2] == pytest.approx(-(0.1 + 0.2**2), rel=1e-5)
    np.testing.assert_array_equal(first.infos["truth"]["friction_angle"], [np.nan, np.nan, np.nan, 36.0])

    with pytest.raises(RunError, match=r"by-hand-v0.*already exists"):
        write(env, "plow-sand/by-hand-v0")


def test_the_environment_is_made_again_from_the_data_set() -> None:
    env = recorded(gym.make("PlowSand-v0", budget=2))
    ((_, reward),) = play(env, 3, [0.3])
    write(env, "plow-sand/one-step-v0")
    again = minari.load_dataset("plow-sand/one-step-v0").recover_environment()
    assert again.spec.kwargs == {"budget": 2}
    again.reset(seed=3)
    assert again.step(np.array([0.3], np.float32))[1] == reward


def test_the_benchmark_keeps_the_episodes_of_its_agents() -> None:
    bo_vs_mcmc.run(gym.make("PlowSandFast-v0", budget=3), {"random": at_random}, 2, "plow-sand/agents-v0")
    dataset = minari.load_dataset("plow-sand/agents-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 6)


def test_other_environments_are_refused() -> None:
    with pytest.raises(ParameterError, match="PlowSand"):
        recorded(gym.make("CartPole-v1"))
