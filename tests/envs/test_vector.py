"""The batched environment against as many single ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
from splatsoil.envs.vector import PlowSandVectorEnv

from splatsoil.errors import ParameterError


def test_a_batch_of_simulations_is_what_single_ones_are() -> None:
    batch = gym.make_vec("PlowSand-v0", num_envs=2, budget=2)
    assert isinstance(batch, PlowSandVectorEnv)
    batch.reset(seed=4)
    actions = np.array([[-0.5], [0.6]], dtype=np.float32)
    observations, rewards, *_ = batch.step(actions)
    assert observations in batch.observation_space
    for k, action in enumerate(actions):
        single = gym.make("PlowSand-v0", budget=2)
        single.reset(seed=4 + k)
        observation, reward, *_ = single.step(action)
        assert rewards[k] == reward
        assert all(np.array_equal(observations[key][k], observation[key]) for key in observation)


def test_episodes_begin_anew_in_the_step_that_ends_them_and_fail_alone(analytic: ModuleType) -> None:
    problems = [analytic.AnalyticProblem(truth=t, fails_below=b) for t, b in ((30.0, 0.0), (40.0, 36.0))]
    batch = PlowSandVectorEnv(2, budget=2, problems=problems, autoreset_mode="SameStep")
    batch.reset(seed=[7, 8])
    *_, infos = batch.step(np.zeros((2, 1), np.float32))
    assert list(infos["status"]) == ["ok", "failed"]
    observations, rewards, terminated, truncated, infos = batch.step(np.full((2, 1), 0.5, np.float32))
    assert truncated.all() and not terminated.any() and np.all(rewards > -10.0)
    assert list(infos["final_info"]["truth"]["friction_angle"]) == [30.0, 40.0]
    # 42.5 degrees both times: ((42.5 - 30) / 10)^2 and, as 35 failed, ((42.5 - 40) / 10)^2 but for noise of 0.02.
    assert list(infos["final_info"]["error"]["friction_angle"]) == pytest.approx([5.0, 2.5], abs=1e-4)
    assert list(infos["final_info"]["regret"]) == pytest.approx([0.25, 0.0625], abs=0.12)
    assert all(last["evaluations_left"] == 0 for last in infos["final_obs"])
    assert np.all(observations["evaluations_left"] == 2)
    batch.step(np.zeros((2, 1), np.float32))
    with pytest.raises(ParameterError, match="shape"):
        batch.step(np.zeros(2, np.float32))


def test_emulated_episodes_side_by_side_are_the_single_ones() -> None:
    batch = gym.make_vec("PlowSandSeveralFast-v0", num_envs=2)
    batch.reset(seed=4)
    _, rewards, *_ = batch.step(np.zeros((2, 3), np.float32))
    for k, reward in enumerate(rewards):
        single = gym.make("PlowSandSeveralFast-v0")
        single.reset(seed=4 + k)
        assert single.step(np.zeros(3, np.float32))[1] == reward


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episodes_begin_anew_as_in_gymnasiums_own_vector(mode: str) -> None:
    """And by default in the same mode."""
    options: dict = {"num_envs": 2, "budget": 2}
    batch = gym.make_vec("PlowSandFast-v0", autoreset_mode=mode, **options)
    kwargs = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    theirs = gym.make_vec("PlowSandFast-v0", **options, **kwargs)
    default = gym.make_vec("PlowSandFast-v0", **options).metadata["autoreset_mode"]
    plain = {**options, "vectorization_mode": "sync"}
    assert default == gym.make_vec("PlowSandFast-v0", **plain).metadata["autoreset_mode"]
    for env in (batch, theirs):
        env.reset(seed=1)
    for k in range(5):
        actions = np.full((2, 1), 0.3 * k - 0.5, np.float32)
        (mine, *my_rest, my_info), (other, *rest, info) = batch.step(actions), theirs.step(actions)
        assert all(np.array_equal(mine[key], other[key]) for key in other)
        assert all(np.array_equal(a, b) for a, b in zip(my_rest, rest, strict=True))
        assert my_info.keys() == info.keys()


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn", "forkserver"])
def test_processes_work_after_their_parent_has_stepped(context: str, tmp_path: Path) -> None:
    script = tmp_path / "play.py"
    script.write_text(
        f"""import gymnasium as gym, numpy as np, splatsoil, torch
if __name__ == "__main__":
    torch.set_num_threads(2)
    torch.randn(400, 400, 400).sum()
    single = gym.make("PlowSand-v0", budget=2)
    single.reset(seed=0)
    one = single.step(np.zeros(1, np.float32))[1]
    options = {{"context": {context!r}}}
    batch = gym.make_vec("PlowSand-v0", num_envs=2, budget=2, vectorization_mode="async", vector_kwargs=options)
    batch.reset(seed=0)
    rewards = batch.step(np.zeros((2, 1), np.float32))[1]
    batch.close()
    print("same" if rewards[0] == one != rewards[1] else (rewards, one))
"""
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.splitlines()[-1] == "same"


@pytest.mark.parametrize("options", [{"num_envs": 0}, {"num_envs": 2, "problems": []}])
def test_numbers_that_do_not_fit(options: dict) -> None:
    with pytest.raises(ParameterError):
        PlowSandVectorEnv(**options)
