"""Naming an effect and choosing strokes."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from splatsoil.envs.emulator import STRENGTHS, surfaces
from splatsoil.envs.strokes import PARTICLES, DesignEnv, NamingEnv

from splatsoil.errors import ParameterError


def test_the_reward_is_the_logarithmic_score_and_the_answer_ends_the_episode() -> None:
    env = gym.make("PlowSandNamingFast-v0")
    seen = set()
    for seed in range(20):
        evidence, info = env.reset(seed=seed)
        assert "truth" not in info and info["effects"] == list(STRENGTHS)
        _, reward, terminated, truncated, info = env.step(np.array([0.0, 0.4, 0.0, 1.8, 0.0], np.float32))
        # Logits are 5 times the action, which 1 bounds.
        score = {"cohesion": np.exp(2.0), "compaction": np.exp(5.0)}.get(info["truth"]["effect"], 1.0)
        assert reward == pytest.approx(np.log(score / (3.0 + np.exp(2.0) + np.exp(5.0))))
        assert terminated and not truncated and sum(info["probabilities"].values()) == pytest.approx(1.0)
        seen.add(info["truth"]["effect"])
    assert seen == set(STRENGTHS)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(evidence[:5] / 255.0)


def test_the_posterior_is_that_of_bayes_and_the_reward_its_information() -> None:
    env = DesignEnv(fast=True)
    env.reset(seed=3)
    surface, logs, total = surfaces()["stroke/cohesion"], np.zeros(PARTICLES), 0.0
    for stroke in ([0.3, -0.5], [-0.8, 0.2], [0.9, 0.9]):
        observation, reward, _, over, info = env.step(np.array(stroke, np.float32))
        for k, particle in enumerate(env._particles):
            point = np.float32([*particle, *stroke])[None].astype(np.float64)
            covariance = surface.scale(point)[0] ** 2 * surface.factor @ surface.factor.T
            seen = surface.patches.T @ observation["evidence"]
            logs[k] += multivariate_normal.logpdf(seen, surface.mean(point)[0], covariance)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        np.testing.assert_allclose(observation["mean"], weights @ env._particles, atol=1e-3)
        information = np.sum(weights * np.log(np.maximum(PARTICLES * weights, 1e-300)))
        total += reward
        assert info["information"] == pytest.approx(information, abs=0.02) and total == pytest.approx(
            information, abs=0.02
        )
    assert over and set(info["error"]) == {"friction_angle", "cohesion"}


def test_the_posterior_is_calibrated_and_expected_information_is_what_comes() -> None:
    env, stroke = DesignEnv(budget=1, fast=True), np.array([0.6, 0.0])
    env.reset(seed=0)
    expected = env.expected_information(stroke, 200, np.random.default_rng(0))
    z, came = [], []
    for seed in range(200):
        env.reset(seed=seed)
        observation, reward, *_ = env.step(stroke.astype(np.float32))
        z.append((observation["mean"] - env.soil.point) / observation["std"])
        came.append(reward)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(z), axis=0)), 1.0, atol=0.15)
    assert np.mean(came) == pytest.approx(expected, abs=4.0 * np.std(came) / np.sqrt(100.0))


@pytest.mark.parametrize("effects", [[], ["antigravity"], ["cohesion", "cohesion"]])
def test_effects_that_make_no_choice(effects: list[str]) -> None:
    with pytest.raises(ParameterError, match="effects: give some of none, cohesion"):
        NamingEnv(effects)


@pytest.mark.slow
def test_a_simulated_stroke_shows_what_the_emulated_one_does() -> None:
    torch.set_num_threads(1)
    seen = {}
    for fast in (False, True):
        env = DesignEnv(budget=1, fast=fast)
        env.reset(seed=4)
        seen[fast] = env.step(np.array([0.5, 0.0], np.float32))[0]["evidence"]
    assert np.corrcoef(seen[False], seen[True])[0, 1] > 0.9
    simulated = gym.make("PlowSandNaming-v0")
    one, other = (simulated.reset(seed=2)[0] for _ in range(2))
    assert np.array_equal(one, other) and simulated.observation_space.contains(one)
