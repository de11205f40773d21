"""Bayesian optimisation against SciPy's optima, and its Gaussian process against scikit-learn's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.optimize import brute, fmin
from splatsoil.inverse.bayesopt import BayesianOptimiser, Minimum, Surrogate, optimise

Loss = Callable[[np.ndarray], float]


def two_valleys(a: np.ndarray) -> float:
    """A wide valley that is lowest near 0.2, a shallower one near -0.7, ripples."""
    x = float(a[0])
    return 0.35 - 0.3 * np.exp(-(((x - 0.2) / 0.4) ** 2)) - 0.15 * np.exp(-(((x + 0.7) / 0.15) ** 2)) + 0.05 * x**2


def tilted_bowl(a: np.ndarray) -> float:
    """Branin's shape without its repeats: a tilted quadratic valley with a quartic wall."""
    u, v = float(a[0]) - 0.4, float(a[1]) + 0.2
    return u**2 + 0.5 * v**2 + 0.6 * u * v + 0.2 * u**4


def dense_optimum(loss: Loss, dimension: int) -> np.ndarray:
    """Brute force on a dense grid, polished by simplex: SciPy's word, not ours."""
    steps = 2001 if dimension == 1 else 101
    grid = (slice(-1.0, 1.0, complex(steps)),) * dimension
    return np.atleast_1d(brute(lambda a: loss(np.atleast_1d(a)), grid, finish=fmin))


def play(loss: Loss, dimension: int, count: int, noise: float, seed: int, **options: Any) -> BayesianOptimiser:
    scatter = np.random.default_rng(1000 + seed)
    optimiser = BayesianOptimiser(dimension, seed=seed, **options)
    for _ in range(count):
        (action,) = optimiser.ask()
        optimiser.tell(action, loss(action.astype(np.float64)) + noise * scatter.normal())
    return optimiser


def std_of(minimum: Minimum) -> np.ndarray:
    return minimum.interval()[0]


def test_batches_spread_and_find_the_minimum() -> None:
    optimiser = BayesianOptimiser(2, seed=1)
    for _ in range(5):
        batch = optimiser.ask(4)
        assert batch.shape == (4, 2) and np.all(np.abs(batch) <= 1.0)
        gaps = np.abs(batch[:, None] - batch[None]).max(axis=-1) + np.eye(4)
        assert gaps.min() > 1e-3, "simulations of one place say little more than one"
        for action in batch:
            optimiser.tell(action, tilted_bowl(action))
    assert np.all(np.abs(optimiser.result().estimate - dense_optimum(tilted_bowl, 2)) < 0.1)


def test_one_random_start_and_expected_improvement_over_the_best() -> None:
    first = [BayesianOptimiser(1, seed=s, start=1).ask()[0, 0] for s in range(20)]
    assert len(set(first)) == 20 and min(first) < -0.5 and max(first) > 0.5
    found = play(two_valleys, 1, 10, 0.0, 3, start=1, acquisition="best").result()
    assert abs(found.estimate[0] - dense_optimum(two_valleys, 1)[0]) < 0.2


def test_ten_noisy_evaluations_find_a_minimum_in_one_dimension() -> None:
    """Over seeds: close to SciPy's optimum, and the quoted std is the size of the error."""
    truth = dense_optimum(two_valleys, 1)
    results = [play(two_valleys, 1, 10, 0.01, seed).result() for seed in range(4)]
    errors = np.array([r.estimate[0] - truth[0] for r in results])
    stds = np.array([std_of(r)[0] for r in results])
    # 0.1 of a range of 2: 1.5 degrees of 30.
    assert np.sqrt(np.mean(errors**2)) < 0.1
    assert np.sum(np.abs(errors) < 2.0 * stds) >= 3 and np.all(stds < 0.3)
    assert all(r.determined == (True,) and r.at_bound == (None,) for r in results)


def test_the_estimate_is_the_minimum_of_the_mean_not_the_luckiest_point() -> None:
    """Losses with much noise: the lowest lies far from the valley, the estimate in it."""
    points = np.linspace(-1.0, 1.0, 41)[:, None]
    losses = points[:, 0] ** 2 + 0.2 * np.random.default_rng(1).normal(size=41)
    losses[37] = -0.8
    surrogate = Surrogate(points, losses)
    assert points[np.argmin(losses), 0] == pytest.approx(0.85)
    assert abs(surrogate.minimum().estimate[0]) < 0.25
    assert 0.1 < surrogate.noise_std < 0.3


def test_what_is_asked_hangs_on_the_seed_and_what_was_told_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    whole = play(two_valleys, 1, 7, 0.01, 4)
    assert torch.equal(torch.rand(3), expected), "the caller's generator is as it was"
    resumed = BayesianOptimiser(1, seed=4)
    for trial in whole.trials[:6]:
        resumed.tell(*trial)
    assert resumed.ask()[0].astype(np.float64).tobytes() == whole.trials[6].action.tobytes()
    resumed.tell(*whole.trials[6])
    assert resumed.result().minimisers.tobytes() == whole.result().minimisers.tobytes()
    assert play(two_valleys, 1, 1, 0.0, 5).trials[0].action != whole.trials[0].action


def test_noise_without_a_minimum_is_not_taken_for_one() -> None:
    """The most probable hyperparameters call the lowest of ten random numbers a valley, with a std of 0.03."""
    points = np.linspace(-1.0, 1.0, 10)[:, None]
    minima = [Surrogate(points, 1.0 + 0.1 * np.random.default_rng(s).normal(size=10)).minimum() for s in range(6)]
    assert sum(m.determined[0] for m in minima) <= 1
    assert all(std_of(m)[0] > 0.35 for m in minima if not m.determined[0])


def test_one_axis_may_be_determined_and_another_not() -> None:
    """A valley along the second axis: every place in it is as good as another."""
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (16, 2))
    losses = (points[:, 0] - 0.3) ** 2 + 0.003 * np.random.default_rng(3).normal(size=16)
    minimum = Surrogate(points, losses).minimum()
    assert minimum.determined == (True, False) and std_of(minimum)[1] > 0.35
    assert minimum.estimate[0] == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize(("slope", "bound"), [(1.0, "lower"), (-1.0, "upper")])
def test_a_minimum_at_a_bound_is_named(slope: float, bound: str) -> None:
    result = play(lambda a: float((slope * a[0] + 1.5) ** 2), 1, 7, 0.01, 0).result()
    assert result.at_bound == (bound,)
    assert result.estimate[0] == pytest.approx(-slope, abs=0.02)


def test_failed_evaluations_are_avoided_and_left_out() -> None:
    optimiser = BayesianOptimiser(1, seed=1)
    for _ in range(10):
        (action,) = optimiser.ask()
        optimiser.tell(action, None if action[0] < -0.2 else float((action[0] - 0.3) ** 2))
    assert any(t.loss is None for t in optimiser.trials), "the start covers the range where evaluations fail"
    assert sum(t.loss is None for t in optimiser.trials[4:]) <= 2
    assert optimiser.result().estimate[0] == pytest.approx(0.3, abs=0.05)


def test_the_gaussian_process_agrees_with_scikit_learn() -> None:
    """Posterior mean and std against an independent implementation with the same kernel and noise."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    points = np.linspace(-0.9, 0.8, 8)[:, None]
    losses = np.array([two_valleys(p) for p in points])
    surrogate = Surrogate(points, losses)
    scale, shift = losses.std(ddof=1), losses.mean()
    length = 2.0 * surrogate.model.covar_module.lengthscale.item()
    constant = surrogate.model.mean_module.constant.item()
    other = GaussianProcessRegressor(RBF(length, "fixed"), alpha=(surrogate.noise_std / scale) ** 2, optimizer=None)
    query = np.linspace(-1.0, 1.0, 31)[:, None]
    # BoTorch maximises: its outcomes are minus the loss.
    mean, std = other.fit(points, -(losses - shift) / scale - constant).predict(query, return_std=True)
    ours = surrogate.mean_and_std(query)
    np.testing.assert_allclose(ours[0], shift - scale * (mean + constant), atol=1e-5)
    np.testing.assert_allclose(ours[1], scale * std, atol=1e-5)


class Valley(gym.Env):
    """Any environment will do whose reward is minus a loss."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left = 8
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.left -= 1
        return np.zeros(1, np.float32), -float((action[0] + 0.4) ** 2), False, self.left == 0, {}


def test_an_agent_that_knows_the_environments_interface_and_no_more() -> None:
    env = Valley()
    optimiser = optimise(env)
    assert len(optimiser.trials) == 8
    assert optimiser.result().estimate[0] == pytest.approx(-0.4, abs=0.02)
    env.action_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    with pytest.raises(ValueError, match="actions in"):
        optimise(env)
