"""PlowSand-v0 at two resolutions."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from splatsoil.envs.levels import DRAWING, relative_cost
from splatsoil.envs.synthetic import SyntheticProblem
from splatsoil.envs.synthetic_world import experiment

from splatsoil.errors import ParameterError
from splatsoil.mpm import Resolution


def test_the_cost_is_particles_times_steps_and_what_is_drawn_all_the_same() -> None:
    fine, coarse = (Resolution.derive(experiment(), preset) for preset in ("small", "tiny"))
    # Half the cells along each axis; the steps' lengths are the presets' own.
    work = 0.5**3 * coarse.steps / fine.steps
    assert coarse.cell == pytest.approx(2.0 * fine.cell)
    assert relative_cost(fine, coarse) == pytest.approx(DRAWING + (1.0 - DRAWING) * work)
    with pytest.raises(ParameterError, match="no cheaper"):
        relative_cost(coarse, fine)


@pytest.mark.parametrize(("coarse", "says"), [("small", "no cheaper"), ("tiny", "no cheaper"), ("lumpy", "lumpy")])
def test_presets_that_are_no_likeness(coarse: str, says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        gym.make("splatsoil:PlowSand-v0", preset="tiny", coarse=coarse)


@pytest.mark.slow
def test_both_levels_are_held_against_the_same_world() -> None:
    env = gym.make("splatsoil:PlowSand-v0", preset="small", coarse="tiny", budget=3)
    _, info = env.reset(seed=1)
    assert info["parameter_names"] == ["friction_angle", "fidelity"] and env.action_space.shape == (2,)
    steps = [env.step(np.array([0.0, level], np.float32)) for level in (-1.0, 1.0, -1.0)]
    losses, costs = [-step[1] for step in steps], [step[4]["cost"] for step in steps]
    assert costs[1] == 1.0 and costs[0] == costs[2] < 0.5
    truth = steps[2][4]["truth"]
    assert set(truth) == {"friction_angle"}
    # The world was made at the full level: the other one is farther from it by more than chance.
    assert losses[1] < losses[0] and abs(losses[0] - losses[2]) < 0.5 * (losses[0] - losses[1])
    # A full evaluation is the one-level environment's.
    alone = SyntheticProblem(preset="small")
    alone.place(truth, env.unwrapped.problem.inner._truth_seed)  # type: ignore[attr-defined]
    assert alone.evaluate({"friction_angle": 35.0}, steps[1][4]["seed"]).loss == pytest.approx(losses[1], rel=1e-6)
