"""Two levels of a simulator, on landscapes whose minimum is known and whose cheap level is biased."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar
from splatsoil.envs.levels import TwoLevelProblem
from splatsoil.envs.problem import Evaluation
from splatsoil.inverse.bayesopt import BayesianOptimiser
from splatsoil.inverse.fitting import fit
from splatsoil.inverse.multifidelity import CHEAP, FULL, TwoLevelOptimiser, optimise_two_levels

from splatsoil.errors import ParameterError, RunError

COST = 0.2
Loss = Callable[[np.ndarray], float]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def valleys(a: np.ndarray) -> float:
    x = float(a[0])
    return 0.35 - 0.3 * np.exp(-(((x - 0.2) / 0.4) ** 2)) - 0.15 * np.exp(-(((x + 0.7) / 0.15) ** 2)) + 0.05 * x**2


def biased(a: np.ndarray) -> float:
    """The same, its minimum elsewhere by 0.15 (2.25° of 30), raised and tilted."""
    return valleys(a - 0.15) + 0.2 + 0.1 * float(a[0])


MINIMUM = minimize_scalar(lambda x: valleys(np.array([x])), bounds=(0.0, 0.5), method="bounded").x


def play(full: Loss, cheap: Loss, dimension: int, budget: float, seed: int) -> TwoLevelOptimiser:
    chance = np.random.default_rng(seed)
    optimiser = TwoLevelOptimiser(dimension, cost=COST, budget=budget, seed=seed)
    while not optimiser.over:
        ask = optimiser.ask_level()
        loss = (full if ask.level == FULL else cheap)(ask.action.astype(np.float64))
        optimiser.tell_level(ask.action, ask.level, loss + 0.01 * chance.normal())
    return optimiser


def play_one_level(loss: Loss, dimension: int, budget: int, seed: int) -> BayesianOptimiser:
    chance = np.random.default_rng(seed)
    optimiser = BayesianOptimiser(dimension, seed=seed)
    for _ in range(budget):
        action = optimiser.ask()
        optimiser.tell(action, loss(action.astype(np.float64)) + 0.01 * chance.normal())
    return optimiser


def test_a_biased_cheap_level_leads_to_the_full_ones_minimum() -> None:
    cheap_minimum = minimize_scalar(lambda x: biased(np.array([x])), bounds=(0.0, 0.6), method="bounded").x
    assert abs(cheap_minimum - MINIMUM) > 0.1, "a search that took the cheap level's word would be this wrong"
    for seed in range(2):
        optimiser = play(valleys, biased, 1, 6, seed)
        assert optimiser.spent <= 6.0 + 1e-9
        assert optimiser.levels.count(CHEAP) > 4 and optimiser.levels.count(FULL) >= 3
        result = optimiser.result()
        assert abs(result.estimate[0] - MINIMUM) < 0.06
        assert abs(result.estimate[0] - MINIMUM) < 3.0 * result.std[0]
        assert optimiser.offset() == pytest.approx(-0.2, abs=0.15)
        # What it says of the loss is about the full level.
        assert result.loss == pytest.approx(valleys(np.array([MINIMUM])), abs=0.03)


def test_a_cheap_level_that_misleads_gets_half_of_the_cost_at_most() -> None:
    for seed in range(2):
        optimiser = play(valleys, lambda a: 0.3 * np.sin(9.0 * float(a[0]) + 1.0), 1, 10, seed)
        assert optimiser.levels.count(CHEAP) * COST <= 0.5 * optimiser.spent
        result = optimiser.result()
        # Found all the same, or said not to be.
        assert abs(result.estimate[0] - MINIMUM) < max(0.1, result.std[0])


@pytest.mark.slow
def test_in_three_dimensions_it_pays() -> None:
    weights, shift = np.array([1.0, 2.0, 3.0]), np.array([0.2, -0.15, 0.1])

    def full(a: np.ndarray) -> float:
        return float(np.sum(weights * (a - 0.3) ** 2))

    two = [play(full, lambda a: full(a - shift) + 0.5, 3, 9, s).result().estimate - 0.3 for s in range(3)]
    one = [play_one_level(full, 3, 9, s).result().estimate - 0.3 for s in range(3)]
    assert np.sqrt(np.mean(np.square(two))) < 0.7 * np.sqrt(np.mean(np.square(one)))


def test_the_same_evaluations_the_same_proposals() -> None:
    first = play(valleys, biased, 1, 5, 3)
    again = TwoLevelOptimiser(1, cost=COST, budget=5, seed=3)
    for told, level in zip(first.told, first.levels, strict=True):
        ask = again.ask_level()
        assert ask.level == level and np.array_equal(ask.action, told.action.astype(np.float32))
        again.tell_level(told.action, level, told.loss)


def test_failures_of_either_level_are_left_out() -> None:
    optimiser = TwoLevelOptimiser(1, cost=COST, budget=7, seed=0)
    while not optimiser.over:
        ask = optimiser.ask_level()
        fails = ask.action[0] < -0.3
        optimiser.tell_level(ask.action, ask.level, None if fails else float(ask.action[0] - 0.2) ** 2)
    assert optimiser.result().estimate[0] == pytest.approx(0.2, abs=0.05)


def test_a_loss_without_a_level_is_the_full_one() -> None:
    optimiser = TwoLevelOptimiser(1, cost=COST, budget=5)
    optimiser.tell([0.0], 1.0)
    assert optimiser.levels == [FULL] and optimiser.spent == 1.0
    with pytest.raises(NotImplementedError, match="ask_level"):
        optimiser.ask()


@pytest.mark.parametrize(("cost", "error"), [(0.0, ValueError), (1.0, ValueError), (0.9, ParameterError)])
def test_costs_and_budgets_that_make_no_sense(cost: float, error: type) -> None:
    with pytest.raises(error):
        TwoLevelOptimiser(1, cost=cost, budget=5)


class StopError(Exception):
    """What ends a fit below."""


def two_level(analytic: ModuleType) -> Any:
    """A problem whose coarse preset moves the minimum by 2° and raises all losses."""

    class Analytic(analytic.AnalyticProblem):
        def cheaper(self, preset: str) -> tuple[Callable[[Mapping[str, float], int], Evaluation], float]:
            coarse = analytic.AnalyticProblem(truth=self.target + 2.0)

            def evaluate(parameters: Mapping[str, float], seed: int) -> Evaluation:
                found = coarse.evaluate(parameters, seed)
                assert found.loss is not None
                return replace(found, loss=found.loss + 0.3)

            return evaluate, COST

    return Analytic()


def test_a_fit_with_a_coarse_preset(analytic: ModuleType, tmp_path: Path) -> None:
    setup = replace(analytic.SETUP, coarse="tiny")
    whole = fit(two_level(analytic), analytic.prepare(tmp_path / "whole"), setup, budget=6)

    def stop(done: int, _: Any) -> None:
        if done == 8:
            raise StopError

    with pytest.raises(StopError):
        fit(two_level(analytic), analytic.prepare(tmp_path / "cut"), setup, budget=6, after_evaluation=stop)
    run = analytic.prepare(tmp_path / "cut")
    result = fit(two_level(analytic), run, setup, budget=6)
    assert result["parameters"] == whole["parameters"] and result["setup"]["coarse"] == "tiny"
    assert list(result["parameters"]) == ["friction_angle"]
    assert result["parameters"]["friction_angle"]["estimate"] == pytest.approx(36.0, abs=1.0)
    assert result["loss"] == pytest.approx(0.1, abs=0.06)
    levels = [step["level"] for step in result["history"]]
    assert set(levels) == {"full", "coarse"}
    assert sum(1.0 if level == "full" else COST for level in levels) <= 6.0 + 1e-9


def test_the_agent_plays_any_environment_with_a_level(analytic: ModuleType) -> None:
    env = gym.make("PlowSand-v0", problem=TwoLevelProblem(two_level(analytic), "tiny"), budget=30)
    assert env.action_space.shape == (2,)
    costs: list[float] = []
    episode = optimise_two_levels(env, cost=COST, budget=5, after_step=lambda _, info: costs.append(info["cost"]))
    assert set(costs) == {COST, 1.0} and sum(costs) <= 5.0 + 1e-9
    assert 35.0 + 15.0 * episode.minimum.estimate[0] == pytest.approx(36.0, abs=1.5)


def test_a_problem_without_a_coarse_likeness(analytic: ModuleType) -> None:
    with pytest.raises(ParameterError, match="no coarse likeness"):
        TwoLevelProblem(analytic.AnalyticProblem(), "tiny")


@pytest.mark.parametrize("full_fails", [False, True])
def test_a_search_whose_cheap_evaluations_all_failed(full_fails: bool) -> None:
    optimiser = TwoLevelOptimiser(1, cost=COST, budget=9.0)
    while not optimiser.over:
        ask = optimiser.ask_level()
        failed = ask.level == CHEAP or full_fails
        optimiser.tell_level(ask.action, ask.level, None if failed else valleys(ask.action.astype(np.float64)))
    if full_fails:
        with pytest.raises(RunError, match=r"no full evaluation succeeded .* there is no loss to model"):
            optimiser.result()
    else:
        assert abs(optimiser.result().estimate[0] - MINIMUM) < 0.1
