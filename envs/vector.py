"""PlowSand-v0 several times over: one step is one batch of simulations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from splatsoil.errors import ParameterError

from .plow_sand import Observation, PlowSandEnv, make_problem
from .problem import Problem
from .together import evaluate_together

Bools = npt.NDArray[np.bool_]


class PlowSandVectorEnv(VectorEnv[Observation, npt.NDArray[np.float32], Any]):
    """``gymnasium.make_vec("PlowSand-v0", num_envs=N)``: N episodes side by side, with the same options.

    Each sub-environment is a :class:`~splatsoil.envs.plow_sand.PlowSandEnv` in every respect: the same seed and actions
    give the same rewards. An episode that ends begins anew in the same step; its last observation and info are in
    ``infos["final_obs"]`` and ``infos["final_info"]``.

    Args:
        num_envs: N.
        problems: one simulate-and-compare for each sub-environment, instead of the options that describe one.
        options: those of PlowSandEnv.
    """

    metadata = {  # noqa: RUF012 (Gymnasium's own form)
        "render_modes": ["rgb_array"],
        "render_fps": 1,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        measurement: str | None = None,
        parameters: Sequence[str] = ("friction_angle",),
        effects: Sequence[str] = (),
        preset: str | None = None,
        budget: int = 10,
        device: str = "cpu",
        reconstruction: str | None = None,
        render_mode: str | None = None,
        same_particles: bool = False,
        coarse: str | None = None,
        problems: Sequence[Problem] | None = None,
    ) -> None:
        if num_envs < 1:
            raise ParameterError(f"num_envs: at least one is needed, not {num_envs}")
        if problems is None:
            chosen = (measurement, parameters, effects, preset, device, reconstruction, coarse)
            first = make_problem(*chosen)
            # A measured world is the same for all; a made-up one has a hidden truth for each.
            problems = (
                [first] * num_envs
                if measurement is not None
                else [first, *(make_problem(*chosen) for _ in range(num_envs - 1))]
            )
        if len(problems) != num_envs:
            raise ParameterError(f"problems: {len(problems)} do not make {num_envs} environments")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.envs = [
            PlowSandEnv(problem=p, budget=budget, render_mode=render_mode, same_particles=same_particles)
            for p in problems
        ]
        self.single_action_space = self.envs[0].action_space
        self.single_observation_space = self.envs[0].observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start N episodes; a single seed gives the others the numbers after it."""
        if seed is None or isinstance(seed, int):
            seeds: Sequence[int | None] = [None if seed is None else seed + k for k in range(self.num_envs)]
        else:
            seeds = seed
        if len(seeds) != self.num_envs:
            raise ParameterError(f"seed: {len(seeds)} seeds for {self.num_envs} environments")
        infos: dict[str, Any] = {}
        observations = []
        for k, (env, one) in enumerate(zip(self.envs, seeds, strict=True)):
            observation, info = env.reset(seed=one, options=options)
            observations.append(observation)
            infos = self._add_info(infos, info, k)
        return self._batched(observations), infos

    def step(
        self, actions: npt.NDArray[np.float32]
    ) -> tuple[Observation, npt.NDArray[np.float64], Bools, Bools, dict[str, Any]]:
        """Simulate N guesses (N, n) as one batch, and compare each with its world."""
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ParameterError(f"actions: expected an array of shape {self.action_space.shape}, got {actions.shape}")
        plans = [env.plan(action) for env, action in zip(self.envs, actions, strict=True)]
        found = evaluate_together([env.problem for env in self.envs], [(values, seed) for _, values, seed in plans])
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, dtype=np.bool_), np.zeros(self.num_envs, dtype=np.bool_)
        infos: dict[str, Any] = {}
        observations = []
        for k, (env, plan, evaluation) in enumerate(zip(self.envs, plans, found, strict=True)):
            observation, rewards[k], terminated[k], truncated[k], info = env.settle(*plan, evaluation)
            if truncated[k]:
                infos = self._add_info(infos, {"final_obs": observation, "final_info": info}, k)
                observation, info = env.reset()
            observations.append(observation)
            infos = self._add_info(infos, info, k)
        return self._batched(observations), rewards, terminated, truncated, infos

    def render(self) -> tuple[Any, ...] | None:
        """Each sub-environment's picture."""
        return tuple(env.render() for env in self.envs)

    def _batched(self, observations: Sequence[Observation]) -> Observation:
        out: Any = create_empty_array(self.single_observation_space, n=self.num_envs, fn=np.zeros)
        batch: Any = concatenate(self.single_observation_space, observations, out)
        return batch
