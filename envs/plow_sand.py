"""PlowSand-v0: find the soil's parameters from pictures of a blade that plows it.

A black-box problem as an episode: each action is a guess, each step simulates it, compares the predicted pictures with
the observed ones and pays minus the loss; the episode ends when the budget of guesses is spent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from splatsoil.errors import ParameterError

from .problem import Evaluation, Image, Job, Problem, simulation_seed
from .together import attempt

Observation = dict[str, npt.NDArray[np.float32]]

#: Block residuals are clipped to this many units in observations, whose spaces have to be bounded.
BLOCK_LIMIT = 1e3


class PlowSandEnv(gym.Env[Observation, npt.NDArray[np.float32]]):
    """Simulate-and-compare as a Gymnasium environment.

    **Action**: Box(-1, 1, (n,)), one number for each free parameter, from its lower to its upper bound (logarithmic
    where the parameter is). Physical values are in ``info["parameters"]``.

    **Observation** (what a new agent needs to go on; float32):

    | key | shape | |
    |---|---|---|
    | `best_parameters` | (n,) | the action with the smallest loss so far; zeros before the first |
    | `best_loss` | (1,) | its loss; the worst loss before the first |
    | `last_action` | (n,) | zeros before the first |
    | `last_loss` | (1,) | the worst loss before the first step and after a failed simulation |
    | `block_residuals` | (b,) | residual for each block of camera, frame and region; zeros before the first |
    | `evaluations_left` | (1,) | steps until the episode is truncated |

    **Reward**: minus the loss. A simulation that fails pays minus the worst loss; ``info["status"]`` tells.

    **End**: truncated when the budget is spent. A guess is never terminal.

    Args:
        measurement: folder of a measurement set. None: a small synthetic experiment with a hidden friction angle,
            drawn at ``reset(seed=...)``, which ``info["truth"]`` reveals at the end of the episode.
        parameters: names of the free parameters.
        effects: names of the effects that are on.
        preset: resolution of the solver; by default ``small`` for a measurement, ``tiny`` for the synthetic one.
        budget: evaluations in an episode, at least 2.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        reconstruction: folder of a saved reconstruction of the measurement; made (minutes) when there is none.
        render_mode: ``rgb_array`` shows observed | predicted | difference.
        same_particles: simulate all of an episode with the same particles, so that two losses differ by their
            parameters and hardly by chance (common random numbers); by default each has its own.
        problem: a simulate-and-compare of one's own instead of all of the above but the budget.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self,
        measurement: str | None = None,
        parameters: Sequence[str] = ("friction_angle",),
        effects: Sequence[str] = (),
        preset: str | None = None,
        budget: int = 10,
        device: str = "cpu",
        reconstruction: str | None = None,
        render_mode: str | None = None,
        same_particles: bool = False,
        problem: Problem | None = None,
    ) -> None:
        if budget < 2:
            raise ParameterError(f"budget: an episode needs at least 2 evaluations, not {budget}")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(f"render_mode: must be rgb_array or None, not {render_mode}")
        self.render_mode = render_mode
        self.budget = int(budget)
        self.same_particles = bool(same_particles)
        self.problem = problem or make_problem(measurement, parameters, effects, preset, device, reconstruction)
        n, b = len(self.problem.space), self.problem.block_count
        box = gym.spaces.Box
        self.action_space = box(-1.0, 1.0, (n,), np.float32)
        self.observation_space = gym.spaces.Dict(  # type: ignore[assignment]
            {
                "best_parameters": box(-1.0, 1.0, (n,), np.float32),
                "best_loss": box(0.0, self.problem.worst_loss, (1,), np.float32),
                "last_action": box(-1.0, 1.0, (n,), np.float32),
                "last_loss": box(0.0, self.problem.worst_loss, (1,), np.float32),
                "block_residuals": box(-BLOCK_LIMIT, BLOCK_LIMIT, (b,), np.float32),
                "evaluations_left": box(0.0, float(self.budget), (1,), np.float32),
            }
        )
        self._left = 0
        self._clear()

    def _clear(self) -> None:
        n = len(self.problem.space)
        self._best_action = np.zeros(n, dtype=np.float32)
        self._best_loss: float | None = None
        self._last_action = np.zeros(n, dtype=np.float32)
        self.last_evaluation: Evaluation | None = None
        #: The next step's, where it was simulated in a batch with others.
        self.ahead: Evaluation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the seed decides the hidden truth (synthetic) and every simulation's particles."""
        super().reset(seed=seed)
        self._episode_seed = int(self.np_random.integers(2**31))
        self.problem.begin(self._episode_seed)
        self._left = self.budget
        self._clear()
        space = self.problem.space
        info: dict[str, Any] = {
            "parameter_names": list(space.names),
            "parameter_units": [p.unit for p in space],
            "lower": [p.lower for p in space],
            "upper": [p.upper for p in space],
        }
        return self._observation(), info

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Simulate a guess and compare it with the observation.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over or hasn't begun.
            ParameterError: the action isn't n finite numbers; one beyond [-1, 1] is clipped.
        """
        guess, (parameters, seed) = self.plan(action)
        evaluation = self.ahead or attempt(self.problem, parameters, seed)
        self.ahead = None
        self._left -= 1
        self._last_action, self.last_evaluation = guess, evaluation
        if evaluation.loss is not None and (self._best_loss is None or evaluation.loss < self._best_loss):
            self._best_action, self._best_loss = guess, evaluation.loss
        info: dict[str, Any] = {
            "parameters": dict(parameters),
            "status": "ok" if evaluation.loss is not None else "failed",
            "message": evaluation.message,
            "seed": seed,
            **{name: float(value) for name, value in evaluation.extras.items()},
        }
        truth = self.problem.truth()
        if self._left == 0 and truth is not None:
            info["truth"] = dict(truth)
        reward = -float(self.problem.worst_loss if evaluation.loss is None else evaluation.loss)
        return self._observation(), reward, False, self._left == 0, info

    def plan(self, action: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], Job]:
        """What a step will simulate: the guess (n,) as it counts, its physical values and the simulation's seed."""
        if self._left <= 0:
            raise gym.error.ResetNeeded("the budget of evaluations is spent; call reset() to start another episode")
        guess = np.array(action, dtype=np.float32).reshape(-1)
        if guess.shape != self.action_space.shape or not np.all(np.isfinite(guess)):
            raise ParameterError(f"action: expected {len(self.problem.space)} finite numbers, got {action}")
        guess = np.clip(guess, -1.0, 1.0)
        parameters = self.problem.space.to_dict(self.problem.space.from_unit(guess))
        step = 0 if self.same_particles else self.budget - self._left
        return guess, (parameters, simulation_seed(self._episode_seed, step))

    def _observation(self) -> Observation:
        worst = self.problem.worst_loss
        evaluation = self.last_evaluation
        last = worst if evaluation is None or evaluation.loss is None else evaluation.loss
        best = worst if self._best_loss is None else self._best_loss
        blocks = np.zeros(self.problem.block_count) if evaluation is None else evaluation.blocks
        return {
            "best_parameters": self._best_action.copy(),
            "best_loss": np.clip([best], 0.0, worst).astype(np.float32),
            "last_action": self._last_action.copy(),
            "last_loss": np.clip([last], 0.0, worst).astype(np.float32),
            "block_residuals": np.clip(blocks, -BLOCK_LIMIT, BLOCK_LIMIT).astype(np.float32),
            "evaluations_left": np.array([self._left], dtype=np.float32),
        }

    def render(self) -> npt.NDArray[np.uint8] | None:
        """(h, 3w, 3): observed | predicted | difference (grey: none); what isn't there yet is black."""
        if self.render_mode is None:
            return None
        evaluation = self.last_evaluation
        observed = None if evaluation is None else evaluation.observed
        if observed is None:
            observed = self.problem.observed_image()
        predicted = None if evaluation is None else evaluation.predicted
        black = np.zeros_like(observed)
        difference = black if predicted is None else signed_difference(observed, predicted)
        strip = np.concatenate([observed, black if predicted is None else predicted, difference], axis=1)
        return np.rint(np.clip(strip, 0.0, 1.0) * 255.0).astype(np.uint8)


def signed_difference(observed: Image, predicted: Image) -> Image:
    """(h, w, 3): grey where both agree, brighter where the observation is, darker where the prediction is."""
    return np.clip(0.5 + (observed - predicted), 0.0, 1.0).astype(np.float32)


def make_problem(
    measurement: str | None = None,
    parameters: Sequence[str] = ("friction_angle",),
    effects: Sequence[str] = (),
    preset: str | None = None,
    device: str = "cpu",
    reconstruction: str | None = None,
) -> Problem:
    """The simulate-and-compare that the environment's options describe."""
    if measurement is None:
        from .synthetic import SyntheticProblem

        return SyntheticProblem(parameters, effects, preset=preset or "tiny", device=device)
    from .measured import MeasuredProblem

    return MeasuredProblem.load(
        measurement, parameters, effects, preset=preset or "small", device=device, reconstruction=reconstruction
    )
