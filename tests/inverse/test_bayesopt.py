from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.optimize import brute, fmin
from splatsoil.inverse.bayesopt import PAPER, START_EACH, BayesianOptimiser, optimise
from splatsoil.inverse.surrogate import Surrogate

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
    chance = np.random.default_rng(1000 + seed)
    optimiser = BayesianOptimiser(dimension, seed=seed, **options)
    for _ in range(count):
        action = optimiser.ask()
        optimiser.tell(action, loss(action.astype(np.float64)) + noise * chance.normal())
    return optimiser


def test_batches_spread_and_find_the_minimum() -> None:
    truth = dense_optimum(tilted_bowl, 2)
    optimiser = BayesianOptimiser(2, seed=1)
    for _ in range(5):
        batch = optimiser.ask_batch(4)
        assert batch.shape == (4, 2) and np.all(np.abs(batch) <= 1.0)
        gaps = np.abs(batch[:, None] - batch[None]).max(axis=-1) + np.eye(4)
        assert gaps.min() > 1e-3, "evaluations side by side at one place tell little more than one"
        for action in batch:
            optimiser.tell(action, tilted_bowl(action))
    assert np.all(np.abs(optimiser.result().estimate - truth) < 0.1)


def test_the_papers_settings() -> None:
    """One random start, then expected improvement; the start is the seed's."""
    first = [BayesianOptimiser(1, seed=s, search=PAPER).ask()[0] for s in range(20)]
    assert len(set(first)) == 20 and min(first) < -0.5 and max(first) > 0.5
    optimiser = play(two_valleys, 1, 10, 0.0, 3, search=PAPER)
    assert optimiser.told[0].action[0] == BayesianOptimiser(1, seed=3, search=PAPER).ask()[0]
    assert abs(optimiser.result().estimate[0] - dense_optimum(two_valleys, 1)[0]) < 0.2


@pytest.mark.slow
def test_six_parameters() -> None:
    weights = np.arange(1.0, 7.0)
    result = play(lambda a: float(np.sum(weights * (a - 0.3) ** 2)), 6, 48, 0.01, 1).result()
    assert np.all(np.abs(result.estimate - 0.3) < 0.25)
    assert all(result.determined)


def test_more_parameters_begin_with_more_points() -> None:
    optimiser = BayesianOptimiser(4, seed=0)
    batch = optimiser.ask_batch(START_EACH * 4)
    for action in batch:
        optimiser.tell(action, 1.0)
    again = BayesianOptimiser(4, seed=0)
    for k in range(START_EACH * 4):
        assert np.array_equal(again.ask(), batch[k])
        again.tell(batch[k], 1.0)


@pytest.mark.parametrize("noise_std", [None, 0.01])
def test_ten_noisy_evaluations_find_a_minimum_in_one_dimension(noise_std: float | None) -> None:
    """Over seeds: close to SciPy's optimum, and the quoted std is the size of the error."""
    truth = dense_optimum(two_valleys, 1)
    results = [play(two_valleys, 1, 10, 0.01, seed, noise_std=noise_std).result() for seed in range(4)]
    errors = np.array([r.estimate[0] - truth[0] for r in results])
    stds = np.array([r.std[0] for r in results])
    # 0.1 of a range of 2: 1.5 degrees of 30.
    assert np.sqrt(np.mean(errors**2)) < 0.1
    assert np.sum(np.abs(errors) < 2.0 * stds) >= 3
    assert np.all(stds < 0.3)
    assert all(r.determined == (True,) and r.at_bound == (None,) for r in results)


def test_two_dimensions() -> None:
    truth = dense_optimum(tilted_bowl, 2)
    results = [play(tilted_bowl, 2, 18, 0.005, seed).result() for seed in range(3)]
    errors = np.array([r.estimate - truth for r in results])
    assert np.all(np.abs(errors) < 0.1)
    # Six standardised errors: a root mean square above 1.8 has a chance of 0.4 % when stds are right.
    assert np.sqrt(np.mean((errors / [r.std for r in results]) ** 2)) < 1.8


def test_the_estimate_is_the_minimum_of_the_mean_not_the_luckiest_point() -> None:
    """One outlier below all others, far from the valley, known to be noise: the estimate stays in the valley."""
    points = np.linspace(-1.0, 1.0, 21)[:, None]
    losses = points[:, 0] ** 2
    losses[17] = -0.02  # at 0.7
    minimum = Surrogate(points, losses, noise_std=0.3).minimum()
    assert points[np.argmin(losses), 0] == pytest.approx(0.7)
    assert abs(minimum.estimate[0]) < 0.25


def test_same_seed_same_bits_and_the_callers_chance_untouched() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second = (play(two_valleys, 1, 6, 0.01, 4) for _ in range(2))
    assert torch.equal(torch.rand(3), expected)
    assert [t.action.tobytes() for t in first.told] == [t.action.tobytes() for t in second.told]
    assert first.result().estimate.tobytes() == second.result().estimate.tobytes()
    assert play(two_valleys, 1, 6, 0.01, 5).told[0].action != first.told[0].action


def test_proposals_depend_on_what_was_told_alone() -> None:
    """A fresh optimiser told the first evaluations of another goes on as it did."""
    whole = play(two_valleys, 1, 7, 0.01, 2)
    resumed = BayesianOptimiser(1, seed=2)
    for told in whole.told[:6]:
        resumed.tell(told.action, told.loss)
    assert resumed.ask().astype(np.float64).tobytes() == whole.told[6].action.tobytes()


def test_constant_losses_end_in_a_plain_statement() -> None:
    optimiser = play(lambda _: 0.25, 1, 8, 0.0, 0)
    actions = np.sort([t.action[0] for t in optimiser.told])
    result = optimiser.result()
    assert result.determined == (False,)
    assert np.isfinite(result.estimate).all() and np.isfinite(result.std).all()
    # Nothing to go by: the points fill the axis.
    assert np.max(np.diff(actions)) < 0.6


def test_noise_without_a_minimum_is_not_taken_for_one() -> None:
    """Best-guess hyperparameters call the lowest of ten random numbers a valley, with a std of 0.03."""
    points = np.linspace(-1.0, 1.0, 10)[:, None]
    minima = [Surrogate(points, 1.0 + 0.1 * np.random.default_rng(s).normal(size=10)).minimum() for s in range(8)]
    assert sum(m.determined[0] for m in minima) <= 1
    assert all(m.std[0] > 0.35 for m in minima if not m.determined[0])


def test_one_axis_may_be_determined_and_another_not() -> None:
    """A valley along the second axis: every place in it is as good as another."""
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (16, 2))
    losses = (points[:, 0] - 0.3) ** 2 + 0.003 * np.random.default_rng(3).normal(size=16)
    minimum = Surrogate(points, losses).minimum()
    assert minimum.determined == (True, False)
    assert minimum.estimate[0] == pytest.approx(0.3, abs=0.1)
    assert minimum.std[1] > 0.35


@pytest.mark.parametrize(("slope", "bound"), [(1.0, "lower"), (-1.0, "upper")])
def test_a_minimum_at_a_bound_is_named(slope: float, bound: str) -> None:
    result = play(lambda a: float((slope * a[0] + 1.5) ** 2), 1, 7, 0.01, 0).result()
    assert result.at_bound == (bound,)
    assert result.estimate[0] == pytest.approx(-slope, abs=0.02)


def test_failed_evaluations_are_avoided_and_left_out() -> None:
    optimiser = BayesianOptimiser(1, seed=1)
    for _ in range(10):
        action = optimiser.ask()
        failed = action[0] < -0.2
        optimiser.tell(action, None if failed else float((action[0] - 0.3) ** 2))
    failures = [t for t in optimiser.told if t.loss is None]
    assert failures, "the start covers the range where evaluations fail"
    assert sum(t.loss is None for t in optimiser.told[4:]) <= 2
    assert optimiser.result().estimate[0] == pytest.approx(0.3, abs=0.05)


def test_nothing_succeeded() -> None:
    optimiser = BayesianOptimiser(1)
    for _ in range(6):
        optimiser.tell(optimiser.ask(), None)
    assert len({t.action[0] for t in optimiser.told}) == 6
    with pytest.raises(ValueError):
        optimiser.result()


def test_the_gp_agrees_with_scikit_learn() -> None:
    """Posterior mean and std against an independent implementation with the same kernel and noise."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    points = np.linspace(-0.9, 0.8, 8)[:, None]
    losses = np.array([two_valleys(p) for p in points])
    surrogate = Surrogate(points, losses, noise_std=0.02)
    scale, shift = losses.std(ddof=1), losses.mean()
    query = np.linspace(-1.0, 1.0, 31)[:, None]
    means, variances = [], []
    for length, constant in zip(surrogate.settings.lengths[:, 0], surrogate.settings.mean, strict=True):
        # Ours lives on [0, 1] and has minus the loss.
        other = GaussianProcessRegressor(RBF(2.0 * length, "fixed"), alpha=(0.02 / scale) ** 2, optimizer=None)
        other.fit(points, -(losses - shift) / scale - constant)
        mean, std = other.predict(query, return_std=True)
        means.append(shift - scale * (mean + constant))
        variances.append((scale * std) ** 2)
    ours = surrogate.mean_and_std(query)
    np.testing.assert_allclose(ours[0], np.mean(means, axis=0), atol=1e-6)
    np.testing.assert_allclose(ours[1], np.sqrt(np.mean(variances, axis=0) + np.var(means, axis=0)), atol=1e-5)


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


def test_the_agent_knows_the_environments_api_and_no_more() -> None:
    steps: list[int] = []
    episode = optimise(Valley(), seed=0, after_step=lambda done, _: steps.append(done))
    assert steps == list(range(1, 9))
    assert episode.minimum.estimate[0] == pytest.approx(-0.4, abs=0.02)


def test_actions_beyond_the_unit_cube_are_refused() -> None:
    env = Valley()
    env.action_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    with pytest.raises(ValueError, match="actions in"):
        optimise(env)
