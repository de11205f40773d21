"""The benchmarks' own arithmetic, on worlds whose answers are known."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from splatsoil.benchmarks import bo_vs_mcmc, calibration
from splatsoil.benchmarks._simulations import Data
from splatsoil.inverse.bayesopt import sobol

from splatsoil.errors import ParameterError
from splatsoil.files import read_json
from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)])


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def made_up(count: int) -> Data:
    rng = np.random.default_rng(0)
    points = np.concatenate([sobol(count, 1, 0), np.zeros((4, 1))])
    directions = np.linalg.qr(rng.normal(size=(20, 2)))[0].T
    features = np.concatenate([5.0 * points, points**2], axis=1) + 0.5 * rng.normal(size=(len(points), 2))
    return Data(SPACE, points, -features @ directions)


def entry(truth: float, rank: int, inside: tuple[bool, bool]) -> dict:
    within = {"0.5": [inside[0]], "0.9": [inside[1]]}
    return {
        "truth": [truth],
        "rank": [rank],
        "within": within,
        "mean": [0.0],
        "std": [0.5],
    }


def test_coverage_and_ranks_are_counted() -> None:
    entries = [entry(0.5, 20 * k + 5, (k < 5, k < 9)) for k in range(10)]
    told = calibration.summarise(entries, SPACE)["parameters"]["friction_angle"]
    assert told["coverage"] == {"0.5": 0.5, "0.9": 0.9}
    assert told["ranks"] == [1] * 10 and told["p_uniform"] == pytest.approx(1.0)
    assert told["rms_z"] == pytest.approx(1.0)
    piled = calibration.summarise([entry(0.5, 199, (False, False))] * 10, SPACE)["parameters"]["friction_angle"]
    assert piled["p_uniform"] < 1e-6 and piled["coverage"]["0.9"] == 0.0


@pytest.mark.slow
def test_a_known_world_is_calibrated() -> None:
    entries = calibration.calibrate(made_up(16), 16, sensor=0.1)
    held = np.mean([e["within"]["0.9"][0] for e in entries])
    assert len(entries) == 16 and held >= 11 / 16  # less has a chance of 0.2 % when 90 % is right


def stops_early(env: gym.Env, seed: int) -> None:
    env.reset(seed=seed)
    env.step(env.action_space.sample())


def in_the_middle(env: gym.Env, seed: int) -> bo_vs_mcmc.Answer:
    """Guesses 35 degrees, and says 20, or 20 to 35."""
    env.reset(seed=seed)
    while not env.step(np.zeros(1, np.float32))[3]:
        pass
    return bo_vs_mcmc.Answer(-np.ones(1), -np.ones(1), np.zeros(1))


def compared(out: Path, *words: str) -> list[dict]:
    assert bo_vs_mcmc.main([*words, "--out", str(out)]) == 0
    (found,) = read_json(out / "result.json")["environments"]
    return list(found["entries"])


def test_agents_play_the_same_episodes_and_their_errors_are_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "my_agents", sys.modules[__name__])
    own, fast = f"my_agents:{in_the_middle.__name__}", ("--env", "PlowSandFast-v0", "--seeds", "8")
    chosen = ("--budgets", "40", "400", "--agents", "random", "direct", "lda", "--agent", own)
    by = {(e["agent"], e["steps"]): e for e in compared(tmp_path, *fast, *chosen)}
    assert set(by) == {(name, steps) for name in ("random", "direct", own) for steps in (40, 400)}
    env = gym.make("PlowSandFast-v0", budget=2)
    truths = []
    for seed in range(8):
        env.reset(seed=seed)
        truths.append(env.unwrapped.problem.truth()["friction_angle"])  # type: ignore[attr-defined]
    assert by[own, 40]["mae"][0] == pytest.approx(np.mean(np.array(truths) - 20.0))
    assert by[own, 40]["coverage_90"][0] == np.mean(np.array(truths) <= 35.0)
    # A chain of 100 steps by 4 walkers finds the posterior; errors of guesses that know nothing are 5 degrees.
    assert by["direct", 400]["mae"][0] < 3.0 and by["direct", 400]["coverage_90"][0] >= 0.5
    assert f"| {own} | 40 |" in (tmp_path / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--agent", f"my_agents:{stops_early.__name__}"], r"one whole episode; it made 1 steps"),
        (["--env", "Nonsense-v0"], "--env Nonsense-v0: cannot be made"),
        (["--env", "PlowSandNamingFast-v0"], "--env PlowSandNamingFast-v0: cannot be made"),
        *((["--agent", name], "give MODULE:FUNCTION") for name in ("nowhere:agent", "my_agents:nobody", "my_agents")),
    ],
)
def test_agents_and_environments_that_do_not_fit_are_named(
    words: list[str], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "my_agents", sys.modules[__name__])
    usual = ["--env", "PlowSandFast-v0", "--budgets", "3", "--seeds", "1", "--agents", "--out", str(tmp_path)]
    with pytest.raises(ParameterError, match=says):
        bo_vs_mcmc.main([*usual, *words])


def test_agents_of_strokes_beat_chance(tmp_path: Path) -> None:
    (naming,) = compared(tmp_path, "--env", "PlowSandNamingFast-v0", "--agents", "lda", "--seeds", "60")
    assert naming["return"] > -1.3 > -np.log(5.0)
    few = ("--env", "PlowSandDesignFast-v0", "--budgets", "2", "--seeds", "6")
    chance, greedy = compared(tmp_path, *few, "--agents", "random", "greedy")
    assert greedy["return"] > chance["return"]
