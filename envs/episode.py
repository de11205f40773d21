"""What all PlowSand environments share: an episode of a budget of steps, about a truth that its seed hides."""

from __future__ import annotations

import os
import sys
from abc import abstractmethod
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from splatsoil.errors import ParameterError

from .problem import simulation_seed

Array = npt.NDArray[np.float32]
Observed = TypeVar("Observed")


def _one_thread() -> None:
    # Threads of OpenMP's do not survive a fork: the child would wait for them for ever.
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_one_thread)


class EpisodeEnv(gym.Env[Observed, Array]):
    """An episode of ``budget`` steps; the last one's info has the :meth:`outcome`.

    Args:
        budget: steps in an episode.
        least: fewest that make sense.

    Raises:
        ParameterError: the budget is smaller.
    """

    action_space: gym.spaces.Box  # type: ignore[assignment]

    def __init__(self, budget: int, least: int) -> None:
        if budget < least:
            raise ParameterError(f"budget: an episode needs at least {least}, not {budget}")
        self.budget = int(budget)
        self._left = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode; the seed decides what is hidden and every simulation's particles."""
        super().reset(seed=seed)
        self._episode_seed = int(self.np_random.integers(2**31))
        self._left = self.budget
        info = self._begin(self._episode_seed)
        return self._observation(), info

    def step(self, action: Array) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Act.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over or hasn't begun.
            ParameterError: the action isn't n finite numbers; one beyond its bounds is clipped.
        """
        reward, info = self._act(self.accepted(action))
        self._left -= 1
        if self._left == 0:
            info |= self.outcome()
        return self._observation(), reward, False, self._left == 0, info

    @property
    def over(self) -> bool:
        """Whether the episode has ended, or none has begun."""
        return self._left <= 0

    def accepted(self, action: Array) -> Array:
        """An action (n,) as it counts."""
        if self.over:
            raise gym.error.ResetNeeded("the budget of steps is spent; call reset() to start another episode")
        given, space = np.array(action, dtype=np.float32).reshape(-1), self.action_space
        if given.shape != space.shape or not np.all(np.isfinite(given)):
            raise ParameterError(f"action: expected {space.shape[0]} finite numbers, got {action}")
        return np.clip(given, space.low, space.high)

    def step_seed(self) -> int:
        """Seed of the present step's particles."""
        return simulation_seed(self._episode_seed, self.budget - self._left)

    @abstractmethod
    def outcome(self) -> dict[str, Any]:
        """The truth, and how near the episode has come to it so far; a wrapper that ends it early can ask, too."""

    @abstractmethod
    def _begin(self, seed: int) -> dict[str, Any]:
        """Hide another truth; reset's info."""

    @abstractmethod
    def _act(self, action: Array) -> tuple[float, dict[str, Any]]:
        """Reward and info of a step."""

    @abstractmethod
    def _observation(self) -> Observed: ...
