"""Agents of other makers, unmodified: the scripts of examples/agents, on a problem whose answer is known."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import pytest

SEARCHES = {"random_search": 12, "cma_es": 20, "optuna_tpe": 12, "turbo": 12}
LIBRARIES = {"cma_es": "cmaes", "optuna_tpe": "optuna", "stable_baselines": "stable_baselines3"}


def script(repository: Path, name: str) -> ModuleType:
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name])
    path = repository / "examples" / "agents" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", SEARCHES)
def test_searches_spend_their_budget_and_come_near(repository: Path, analytic: ModuleType, name: str) -> None:
    problem = analytic.AnalyticProblem(noise=0.0)
    env = gym.make("PlowSand-v0", problem=problem, budget=SEARCHES[name])
    parameters, loss = script(repository, name).search(env)
    assert problem.calls == SEARCHES[name] + 1  # the truth, for the regret
    # The loss is 0.1 + ((angle - 36) / 10)^2: what is reported belongs together.
    assert loss == pytest.approx(0.1 + ((parameters["friction_angle"] - 36.0) / 10.0) ** 2, rel=1e-5)
    assert abs(parameters["friction_angle"] - 36.0) < 5.0


def test_stable_baselines_checks_and_learns(repository: Path) -> None:
    module = script(repository, "stable_baselines")
    with warnings.catch_warnings():
        # Any complaint of its checker about the environment fails the test.
        warnings.simplefilter("error", UserWarning)
        agent = module.train("PlowSandFast-v0", 4, steps=128)
    assert agent.num_timesteps == 128
    env = gym.make("PlowSandFast-v0", budget=4)
    action, _ = agent.predict(env.reset(seed=1)[0])
    assert env.action_space.contains(action)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SEARCHES, "stable_baselines"])
def test_the_scripts_run_as_they_are(repository: Path, name: str) -> None:
    script(repository, name)
    path = repository / "examples" / "agents" / f"{name}.py"
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=600, check=True)
    assert "friction_angle" in done.stdout
