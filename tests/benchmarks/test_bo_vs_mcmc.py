"""``splatsoil benchmark bo-vs-mcmc``: how agents are scored, on answers that are known."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.stats import norm
from splatsoil.benchmarks import bo_vs_mcmc
from splatsoil.benchmarks._agents import Answer
from splatsoil.benchmarks.bo_vs_mcmc import accuracy, scored

from splatsoil.errors import ParameterError
from splatsoil.files import read_json
from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)])


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize(("wide", "uniform"), [(1.0, True), (0.3, False), (4.0, False)])
def test_intervals_are_calibrated_where_the_posterior_is_right(wide: float, uniform: bool) -> None:
    """A normal likelihood far from the bounds, whose posterior is known; and one too narrow or too wide."""
    rng = np.random.default_rng(0)
    truths = rng.uniform(-0.5, 0.5, 400)
    means = truths + 0.1 * rng.standard_normal(400)
    draws = means[:, None, None] + wide * 0.1 * rng.standard_normal((400, 500, 1))
    angles = SPACE.from_unit(truths[:, None])
    rows = [
        scored(Answer(d.mean(axis=0), d), SPACE, {"friction_angle": float(angle)})
        for d, (angle,) in zip(draws, angles, strict=True)
    ]
    found = {name: value[0] for name, value in accuracy(rows).items()}
    assert (found["p_uniform"] > 0.01) == uniform
    assert found["scatter"] == pytest.approx(1.5, rel=0.1) and found["width_90"] == pytest.approx(wide * 4.93, rel=0.05)
    for level, z in ((50, 0.674), (90, 1.645)):
        assert found[f"coverage_{level}"] == pytest.approx(2.0 * norm.cdf(wide * z) - 1.0, abs=0.06)


def stops_early(env: gym.Env, seed: int) -> None:
    env.reset(seed=seed)
    env.step(env.action_space.sample())


def in_the_middle(env: gym.Env, seed: int) -> bo_vs_mcmc.Answer:
    """Guesses 35 degrees, and answers 20, or 20 to 35."""
    env.reset(seed=seed)
    while not env.step(np.zeros(1, np.float32))[3]:
        pass
    return Answer(-np.ones(1), np.linspace(-1.0 - 1 / 18, 1 / 18, 1801)[:, None])


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
