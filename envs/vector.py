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
    give the same rewards.

    Args:
        num_envs: N.
        autoreset_mode: when an episode that has ended begins anew: Gymnasium's default, the next step. In the same
            step, its last observation and info are in ``infos["final_obs"]`` and ``infos["final_info"]``.
        problems: one simulate-and-compare for each sub-environment, instead of the options that describe one.
        options: those of PlowSandEnv.

    Raises:
        ParameterError: numbers that do not fit, or what PlowSandEnv refuses.
    """

    def __init__(
        self,
        num_envs: int = 1,
        problems: Sequence[Problem] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        if num_envs < 1:
            raise ParameterError(f"num_envs: at least one is needed, not {num_envs}")
        chosen: Sequence[Problem | None] = [None] * num_envs if problems is None else problems
        if len(chosen) != num_envs:
            raise ParameterError(f"problems: {len(chosen)} do not make {num_envs} environments")
        if problems is None and options.get("measurement") is not None:
            # A measured problem is the same for all; a synthetic one has a hidden truth for each.
            chosen = [PlowSandEnv(**options).problem] * num_envs
        makers = [partial(PlowSandEnv, **options, problem=one) for one in chosen]
        super().__init__(makers, autoreset_mode=autoreset_mode)

    def step(self, actions: npt.NDArray[np.float32]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Simulate N guesses (N, n) as one batch, and compare each with its observation."""
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ParameterError(f"actions: expected an array of shape {self.action_space.shape}, got {actions.shape}")
        # Others begin anew in this step, or refuse it.
        every: Sequence[Any] = self.envs
        going = [(env, action) for env, action in zip(every, actions, strict=True) if not env.over]
        envs = [env for env, _ in going]
        plans = [env.plan(env.accepted(action)) for env, action in going]
        problems = [env.problem for env, plan in zip(envs, plans, strict=True) for _ in plan]
        found = iter(evaluate_together(problems, [job for plan in plans for job in plan]) if problems else ())
        for env, plan in zip(envs, plans, strict=True):
            env.ahead = [next(found) for _ in plan]
        return super().step(actions)
