"""PlowSand-v0 several times over: one step is one batch of simulations."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from splatsoil.errors import ParameterError

from .plow_sand import PlowSandEnv
from .problem import Problem
from .together import evaluate_together


class PlowSandVectorEnv(SyncVectorEnv):
    """``gymnasium.make_vec("PlowSand-v0", num_envs=N)``: N episodes side by side, with the same options.

    Each sub-environment is a :class:`~splatsoil.envs.plow_sand.PlowSandEnv` in every respect: the same seed and actions
    give the same rewards. An episode that ends begins anew in the same step; its last observation and info are in
    ``infos["final_obs"]`` and ``infos["final_info"]``.

    Args:
        num_envs: N.
        problems: one simulate-and-compare for each sub-environment, instead of the options that describe one.
        options: those of PlowSandEnv.

    Raises:
        ParameterError: numbers that do not fit, or what PlowSandEnv refuses.
    """

    def __init__(self, num_envs: int = 1, problems: Sequence[Problem] | None = None, **options: Any) -> None:
        if num_envs < 1:
            raise ParameterError(f"num_envs: at least one is needed, not {num_envs}")
        chosen: Sequence[Problem | None] = [None] * num_envs if problems is None else problems
        if len(chosen) != num_envs:
            raise ParameterError(f"problems: {len(chosen)} do not make {num_envs} environments")
        if problems is None and options.get("measurement") is not None:
            # A measured problem is the same for all; a synthetic one has a hidden truth for each.
            chosen = [PlowSandEnv(**options).problem] * num_envs
        makers = [partial(PlowSandEnv, **options, problem=one) for one in chosen]
        super().__init__(makers, autoreset_mode=AutoresetMode.SAME_STEP)

    def step(self, actions: npt.NDArray[np.float32]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Simulate N guesses (N, n) as one batch, and compare each with its observation."""
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ParameterError(f"actions: expected an array of shape {self.action_space.shape}, got {actions.shape}")
        envs: Sequence[Any] = self.envs
        plans = [env.plan(env.accepted(action)) for env, action in zip(envs, actions, strict=True)]
        problems = [env.problem for env, plan in zip(envs, plans, strict=True) for _ in plan]
        found = iter(evaluate_together(problems, [job for plan in plans for job in plan]))
        for env, plan in zip(envs, plans, strict=True):
            env.ahead = [next(found) for _ in plan]
        return super().step(actions)
