"""PlowSand-v0 as a newcomer meets it: no arguments, our own solver and renderer."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from splatsoil.envs import register
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.synthetic import BLOCKS, SyntheticProblem, compare
from splatsoil.envs.synthetic_experiment import HEIGHT, WIDTH, SyntheticExperiment, pattern

from splatsoil.errors import ParameterError, SimulationError


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def act(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float32)


def test_the_module_prefix_registers_it_in_a_fresh_interpreter_and_again_changes_nothing() -> None:
    script = "import gymnasium as gym; print(gym.make('splatsoil:PlowSand-v0').action_space)"
    out = subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", script], capture_output=True, text=True)
    assert out.stdout.strip().endswith("Box(-1.0, 1.0, (1,), float32)"), out.stderr
    before = gym.registry["PlowSand-v0"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register()
    assert gym.registry["PlowSand-v0"] is before


def test_effects_that_are_on_are_hidden_and_free() -> None:
    """Their defaults are off: on alone, they would do nothing."""
    problem = PlowSandEnv(effects=["cohesion", "dilatancy"]).problem
    assert problem.space.names == ("friction_angle", "cohesion", "dilatancy_angle")
    problem.begin(0)
    truth = problem.truth()
    assert truth is not None and truth["cohesion"] > 0.0 and truth["dilatancy_angle"] > 0.0


def test_a_step_prints_nothing() -> None:
    script = (
        "import gymnasium as gym\nenv = gym.make('splatsoil:PlowSand-v0')\n"
        "env.reset(seed=0)\nenv.step(env.action_space.sample())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_check_env_is_clean_and_the_spec_survives_json() -> None:
    env = gym.make("PlowSand-v0", budget=4, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    assert env.spec is not None
    again = EnvSpec.from_json(env.spec.to_json())
    assert json.loads(env.spec.to_json()) and again.kwargs == env.spec.kwargs
    twin = gym.make(again)
    assert isinstance(twin.unwrapped, PlowSandEnv) and twin.unwrapped.budget == 4


def test_pickled_after_a_step_of_two_parameters() -> None:
    env = gym.make("PlowSand-v0", budget=3, parameters=["friction_angle", "cohesion"], effects=["cohesion"])
    env.reset(seed=1)
    *_, info = env.step(act(0.2, -1.0))
    assert info["parameters"] == {"friction_angle": pytest.approx(38.0), "cohesion": pytest.approx(0.0)}
    twin = pickle.loads(pickle.dumps(env))
    one, other = env.step(act(-0.3, 0.1)), twin.step(act(-0.3, 0.1))
    assert one[1] == other[1] < 0.0
    np.testing.assert_array_equal(one[0]["block_residuals"], other[0]["block_residuals"])


def test_the_seed_draws_the_hidden_angle_and_gives_the_same_bits() -> None:
    problems = [SyntheticProblem() for _ in range(3)]
    for problem, seed in zip(problems, (3, 3, 2), strict=True):
        problem.begin(seed)
    truths = [p.truth()["friction_angle"] for p in problems]  # type: ignore[index]
    assert truths[0] == truths[1] != truths[2] and all(20.0 < t < 50.0 for t in truths)
    a, b = (p.evaluate({"friction_angle": 31.0}, 4) for p in problems[:2])
    assert a.loss == b.loss and a.blocks.tobytes() == b.blocks.tobytes()


def test_near_the_truth_the_loss_is_smaller_than_far_from_it() -> None:
    """Whatever the particles' seed, and though observation and prediction share no particle."""
    problem = SyntheticProblem()
    problem.place({"friction_angle": 30.0}, 5)
    # One seed at a time: its scatter moves both alike.
    near, far = ([problem.evaluate({"friction_angle": v}, seed).loss for seed in (11, 12, 13)] for v in (30.0, 39.0))
    assert all(n < 0.9 * f for n, f in zip(near, far, strict=True))  # type: ignore[operator]
    # Seed-to-seed scatter keeps the loss above zero; soil that doesn't move would have 1.
    assert min(near) > 0.0 and max(near) < 0.3 and len(set(near)) == 3  # type: ignore[type-var, operator]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"parameters": ["phi"]}, "unknown parameter phi.*friction_angle"),
        ({"effects": ["antigravity"]}, "antigravity"),
        ({"preset": "huge"}, "huge"),
    ],
)
def test_unknown_names_are_refused_when_the_environment_is_made(options: dict, says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        gym.make("PlowSand-v0", **options)


def test_a_hidden_truth_that_fails_is_simulated_with_other_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment, picture = SyntheticExperiment([], "tiny", "cpu"), np.zeros((1, 2, 2, 3), np.float32)
    seeds: list[int] = []

    def simulated(jobs: list) -> list:
        seeds.append(jobs[0][1])
        return [picture if len(seeds) == 3 else SimulationError("it flies")]

    monkeypatch.setattr(experiment, "simulated", simulated)
    assert experiment.surely({}, 5) is picture and len(set(seeds)) == 3 and seeds[0] == 5
    with pytest.raises(SimulationError, match="it flies"):
        experiment.surely({}, 5)


def test_the_comparison_by_hand() -> None:
    """Constant pictures: blurring changes nothing, so the loss and the patches are what arithmetic says."""
    shape = (2, HEIGHT, WIDTH, 3)
    observed, still = np.full(shape, 0.5, np.float32), np.full(shape, 0.3, np.float32)
    predicted = observed.copy()
    predicted[1] = 0.4
    loss, blocks = compare(observed, predicted, still)
    assert loss == pytest.approx(0.5 * 0.1**2 / 0.2**2, rel=1e-5)
    assert blocks.shape == (2 * BLOCKS[0] * BLOCKS[1],)
    np.testing.assert_allclose(blocks[:12], 0.0, atol=1e-5)
    np.testing.assert_allclose(blocks[12:], 25.5, rtol=1e-5)
    assert compare(observed, still, still)[0] == pytest.approx(1.0)


def test_the_pattern_is_sand_and_the_same_in_every_experiment() -> None:
    points = np.random.default_rng(0).uniform(0.0, 0.3, (500, 3))
    first = pattern(points)
    assert first.shape == (500, 3) and first.min() > 0.1 and first.max() <= 1.0
    assert np.array_equal(first, pattern(points)) and 0.01 < first.std(axis=0).min() < 0.1
