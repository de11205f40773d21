"""The environment's contract, on a problem whose answer is known in closed form."""

from __future__ import annotations

import pickle
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
from splatsoil.envs.plow_sand import BLOCK_LIMIT, PlowSandEnv

from splatsoil.errors import ParameterError


@pytest.fixture
def env(analytic: ModuleType) -> PlowSandEnv:
    return PlowSandEnv(problem=analytic.AnalyticProblem(), budget=4, render_mode="rgb_array")


def act(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float32)


def test_the_reward_is_minus_the_loss_of_the_physical_value(analytic: ModuleType) -> None:
    env = PlowSandEnv(problem=analytic.AnalyticProblem(noise=0.0), budget=5)
    env.reset(seed=0)
    # beyond the bounds an action is clipped
    for action, angle in [(-1.0, 20.0), (0.0, 35.0), (1.0, 50.0), (0.2, 38.0), (1.7, 50.0)]:
        _, reward, terminated, _, info = env.step(act(action))
        assert info["parameters"] == {"friction_angle": pytest.approx(angle, abs=1e-5)}
        assert reward == pytest.approx(-(0.1 + ((angle - 36.0) / 10.0) ** 2), rel=1e-5)
        assert not terminated


def test_the_budget_is_the_episode_and_only_its_end_reveals_the_truth(env: PlowSandEnv, analytic: ModuleType) -> None:
    with pytest.raises(gym.error.ResetNeeded):
        env.step(act(0.0))
    observation, begun = env.reset(seed=0)
    assert observation["evaluations_left"] == 4
    for left in (3, 2, 1, 0):
        observation, _, terminated, truncated, info = env.step(act(0.0))
        assert observation["evaluations_left"] == left
        assert (terminated, truncated) == (False, left == 0) and type(truncated) is bool
        assert ("truth" in info) == (left == 0)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(act(0.0))
    _, other = PlowSandEnv(problem=analytic.AnalyticProblem(truth=30.0), budget=4).reset(seed=0)
    assert other == begun and "truth" not in begun


def test_the_end_tells_error_and_regret_and_a_time_limit_does_not_hide_them(analytic: ModuleType) -> None:
    env = PlowSandEnv(problem=analytic.AnalyticProblem(noise=0.0), budget=3)
    env.reset(seed=0)
    for angle in (0.2, 0.9, -1.0):
        *_, info = env.step(act(angle))
    # The best guess is 38 degrees: its loss is 0.2^2 more than that of the truth.
    assert info["error"] == {"friction_angle": pytest.approx(2.0, abs=1e-5)}
    assert info["regret"] == pytest.approx(0.04, rel=1e-4) and info["truth"] == {"friction_angle": 36.0}
    limited = gym.wrappers.TimeLimit(env, 1)
    limited.reset(seed=0)
    assert env.outcome() == {"truth": {"friction_angle": 36.0}}
    *_, truncated, info = limited.step(act(0.0))
    assert truncated and "truth" not in info
    assert limited.get_wrapper_attr("outcome")()["regret"] == pytest.approx(0.01, rel=1e-4)


def test_the_observation_remembers_the_best_and_the_last(env: PlowSandEnv, analytic: ModuleType) -> None:
    first, _ = env.reset(seed=0)
    assert first["best_loss"] == first["last_loss"] == env.problem.worst_loss
    env.step(act(0.1))
    observation, reward, *_ = env.step(act(-0.9))
    assert observation["best_parameters"] == np.float32(0.1) and observation["last_action"] == np.float32(-0.9)
    assert observation["last_loss"] == pytest.approx(-reward) and observation["best_loss"] < observation["last_loss"]
    expected = np.array([21.5 - 36.0, 1.0]) @ analytic.DIRECTIONS
    np.testing.assert_allclose(observation["block_residuals"], expected, atol=1e-5)


def test_block_residuals_stay_in_their_space(analytic: ModuleType) -> None:
    env = PlowSandEnv(problem=analytic.AnalyticProblem(truth=1e6), budget=2)
    env.reset(seed=0)
    observation, *_ = env.step(act(0.0))
    assert np.abs(observation["block_residuals"]).max() == BLOCK_LIMIT
    assert observation in env.observation_space


def test_a_failed_simulation_is_an_outcome_and_not_a_crash(analytic: ModuleType) -> None:
    env = PlowSandEnv(problem=analytic.AnalyticProblem(fails_below=30.0), budget=3)
    env.reset(seed=0)
    observation, reward, _, _, info = env.step(act(-1.0))
    assert reward == -env.problem.worst_loss
    assert info["status"] == "failed" and "nothing holds" in info["message"]
    assert observation in env.observation_space and observation["best_parameters"] == 0.0
    assert env.step(act(0.0))[-1]["status"] == "ok"


@pytest.mark.parametrize("action", [[np.nan], [0.0, 0.0], []])
def test_an_action_that_is_none_is_refused(env: PlowSandEnv, action: list[float]) -> None:
    env.reset(seed=0)
    with pytest.raises(ParameterError, match="action"):
        env.step(act(*action))


def test_the_seed_decides_an_episode_and_each_step_has_particles_of_its_own(analytic: ModuleType) -> None:
    def episode(seed: int, same: bool) -> list[float]:
        env = PlowSandEnv(problem=analytic.AnalyticProblem(), budget=4, same_particles=same)
        env.reset(seed=seed)
        return [env.step(act(0.0))[1] for _ in range(4)]

    assert episode(3, False) == episode(3, False) != episode(4, False)
    assert len(set(episode(3, False))) == 4 and len(set(episode(3, True))) == 1


def test_pictures_are_observed_predicted_difference(env: PlowSandEnv, analytic: ModuleType) -> None:
    env.reset(seed=0)
    before = env.render()
    height, width = env.problem.image_size
    assert before is not None and before.dtype == np.uint8 and before.shape == (height, 3 * width, 3)
    assert np.all(before[:, :width] == 128) and np.all(before[:, width:] == 0)
    env.step(act(0.0))
    after = env.render()
    assert after is not None
    # Observed 0.5, predicted 0.6: the difference is 0.1 darker than grey.
    for panel, value in enumerate([0.5, 0.6, 0.4]):
        assert np.all(np.abs(after[:, panel * width : (panel + 1) * width] / 255.0 - value) < 0.003)
    assert PlowSandEnv(problem=analytic.AnalyticProblem()).render() is None


def test_pickled_in_the_middle_of_an_episode(env: PlowSandEnv) -> None:
    env.reset(seed=5)
    env.step(act(0.3))
    twin = pickle.loads(pickle.dumps(env))
    for action in (0.1, -0.4):
        one, other = env.step(act(action)), twin.step(act(action))
        assert one[1:] == other[1:]
        assert all(np.array_equal(one[0][key], other[0][key]) for key in one[0])


@pytest.mark.parametrize(("options", "says"), [({"budget": 1}, "at least 2"), ({"render_mode": "human"}, "rgb_array")])
def test_options_that_make_no_sense(analytic: ModuleType, options: dict, says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        PlowSandEnv(problem=analytic.AnalyticProblem(), **options)
