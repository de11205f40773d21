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

from .episode import Array, EpisodeEnv
from .problem import Evaluation, Job, Problem, simulation_seed
from .together import attempt

Observation = dict[str, npt.NDArray[np.float32]]

#: Block residuals are clipped to this many units in observations, whose spaces have to be bounded.
BLOCK_LIMIT = 1e3


class PlowSandEnv(EpisodeEnv[Observation]):
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

    **End**: truncated when the budget is spent. A guess is never terminal. The truth is simulated once more then, with
    the last step's particles, for the regret.

    Args:
        measurement: folder of a measurement set. None: a small synthetic experiment with a hidden friction angle,
            drawn at ``reset(seed=...)``, which ``info["truth"]`` reveals at the end of the episode.
        parameters: names of the free parameters. None: friction angle and strengths of the effects that are on.
        effects: names of the effects that are on.
        preset: resolution of the solver; by default ``small`` for a measurement, ``tiny`` for the synthetic one.
        budget: evaluations in an episode, at least 2.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        reconstruction: folder of a saved reconstruction of the measurement; made (minutes) when there is none.
        render_mode: ``rgb_array`` shows observed | predicted | difference.
        same_particles: simulate all of an episode with the same particles, so that two losses differ by their
            parameters and hardly by scatter (common random numbers); by default each has its own.
        fast: the synthetic experiment emulated, for the parameters and effects that there is an emulator of.
        problem: a simulate-and-compare of one's own instead of all of the above but the budget.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self,
        measurement: str | None = None,
        parameters: Sequence[str] | None = None,
        effects: Sequence[str] = (),
        preset: str | None = None,
        budget: int = 10,
        device: str = "cpu",
        reconstruction: str | None = None,
        render_mode: str | None = None,
        same_particles: bool = False,
        fast: bool = False,
        problem: Problem | None = None,
    ) -> None:
        super().__init__(budget, least=2)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(f"render_mode: must be rgb_array or None, not {render_mode}")
        self.render_mode = render_mode
        self.same_particles = bool(same_particles)
        self.problem = problem or _problem(measurement, parameters, effects, preset, device, reconstruction, fast)
        n, b = len(self.problem.space), self.problem.block_count
        box = gym.spaces.Box
        self.action_space = box(-1.0, 1.0, (n,), np.float32)
        loss = box(0.0, self.problem.worst_loss, (1,), np.float32)
        self.observation_space = gym.spaces.Dict(  # type: ignore[assignment]
            {
                "best_parameters": self.action_space,
                "best_loss": loss,
                "last_action": self.action_space,
                "last_loss": loss,
                "block_residuals": box(-BLOCK_LIMIT, BLOCK_LIMIT, (b,), np.float32),
                "evaluations_left": box(0.0, float(self.budget), (1,), np.float32),
            }
        )
        self._clear()

    def _clear(self) -> None:
        n = len(self.problem.space)
        self._best_action = np.zeros(n, dtype=np.float32)
        self._best_loss: float | None = None
        self._of_truth: Evaluation | None = None
        self._last_action = np.zeros(n, dtype=np.float32)
        self.last_evaluation: Evaluation | None = None
        #: The next step's, where they were simulated in a batch with others.
        self.ahead: Sequence[Evaluation] = ()

    def _begin(self, seed: int) -> dict[str, Any]:
        self.problem.begin(seed)
        self._clear()
        space = self.problem.space
        return {
            "parameter_names": list(space.names),
            "parameter_units": [p.unit for p in space],
            "lower": [p.lower for p in space],
            "upper": [p.upper for p in space],
        }

    def _act(self, action: Array) -> tuple[float, dict[str, Any]]:
        """Simulate a guess and compare it with the observation."""
        jobs = self.plan(action)
        parameters, self._last_seed = jobs[0]
        evaluation, *of_truth = self.ahead or [attempt(self.problem, *job) for job in jobs]
        self.ahead = ()
        self._of_truth = of_truth[0] if of_truth else None
        self._last_action, self.last_evaluation = action, evaluation
        if evaluation.loss is not None and (self._best_loss is None or evaluation.loss < self._best_loss):
            self._best_action, self._best_loss = action, evaluation.loss
        info: dict[str, Any] = {
            "parameters": dict(parameters),
            "status": "ok" if evaluation.loss is not None else "failed",
            "message": evaluation.message,
            "seed": self._last_seed,
            **{name: float(value) for name, value in evaluation.extras.items()},
        }
        return -float(self.problem.worst_loss if evaluation.loss is None else evaluation.loss), info

    def plan(self, action: Array) -> list[Job]:
        """What a step will simulate, for a guess (n,) as it counts; in an episode's last step the truth, too."""
        seed = simulation_seed(self._episode_seed, 0) if self.same_particles else self.step_seed()
        truth = self.problem.truth() if self._left == 1 else None
        return [(self.values(action), seed), *([] if truth is None else [(truth, seed)])]

    def values(self, action: Array) -> dict[str, float]:
        """Physical values by name of an action (n,)."""
        return self.problem.space.to_dict(self.problem.space.from_unit(action))

    def outcome(self) -> dict[str, Any]:
        """Truth, error and regret of the best guess so far; nothing where nobody knows the truth.

        ``error`` is guess minus truth for each parameter, ``regret`` the best loss minus that of the truth, simulated
        with other particles than the observation.
        """
        truth = self.problem.truth()
        if truth is None:
            return {}
        found: dict[str, Any] = {"truth": dict(truth)}
        if self._best_loss is not None:
            best = self.values(self._best_action)
            found["error"] = {name: best[name] - value for name, value in truth.items() if name in best}
            if self._of_truth is None:
                self._of_truth = attempt(self.problem, truth, self._last_seed)
            if self._of_truth.loss is not None:
                found["regret"] = self._best_loss - self._of_truth.loss
        return found

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
        # grey where both agree, brighter where the observation is, darker where the prediction is
        difference = black if predicted is None else 0.5 + (observed - predicted)
        strip = np.concatenate([observed, black if predicted is None else predicted, difference], axis=1)
        return np.rint(np.clip(strip, 0.0, 1.0) * 255.0).astype(np.uint8)


def _problem(
    measurement: str | None,
    parameters: Sequence[str] | None,
    effects: Sequence[str],
    preset: str | None,
    device: str,
    reconstruction: str | None,
    fast: bool,
) -> Problem:
    """The simulate-and-compare that the environment's options describe."""
    if fast:
        from .emulated import EmulatedProblem

        if any(option is not None for option in (measurement, preset, reconstruction)):
            raise ParameterError("fast: the emulated experiment takes no measurement, preset or reconstruction")
        return EmulatedProblem(parameters, effects)
    if measurement is None:
        from .synthetic import SyntheticProblem

        return SyntheticProblem(parameters, effects, preset=preset or "tiny", device=device)
    from .measured import MeasuredProblem

    return MeasuredProblem.load(
        measurement, parameters, effects, preset=preset or "small", device=device, reconstruction=reconstruction
    )
