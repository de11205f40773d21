"""Bayesian optimisation with two simulators: the one whose loss counts, and a coarser one that costs less.

Both are one Gaussian process with one more input, the level; how alike they are is learned with its length scale. What
a coarser grid adds everywhere is learned from points evaluated at both. The next point is where the *full* loss is
expected to improve; it is evaluated at the level that takes away more of the doubt about the full loss there for its
cost (variance reduction per cost, as in the cost-aware information gains of Takeno et al. 2020 and Wu et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch

from splatsoil.errors import ParameterError, RunError

from .bayesopt import DRAWS, NEAREST, RAW, RESTARTS, START, START_EACH, BayesianOptimiser, Episode, Told
from .surrogate import FloatArray, Surrogate, quiet, seeded, sobol

CHEAP, FULL = 0, 1


@dataclass(frozen=True)
class Ask:
    """What to evaluate next: a point (n,) of [-1, 1]^n, at a level."""

    action: npt.NDArray[np.float32]
    level: int


class TwoLevelOptimiser(BayesianOptimiser):
    """Expected improvement of the full loss, evaluated where that is worth its cost.

    Args:
        dimension: number of free parameters, the level not among them.
        cost: of a cheap evaluation, in units of a full one.
        budget: of everything, in full evaluations.
        noise_std: standard deviation of one evaluation's noise, where it was measured.
        seed: the same seed and evaluations give the same proposals.

    Raises:
        ValueError: a cost outside (0, 1).
        ParameterError: a budget that doesn't reach beyond the start.
    """

    def __init__(
        self, dimension: int, *, cost: float, budget: float, noise_std: float | None = None, seed: int = 0
    ) -> None:
        super().__init__(dimension, noise_std=noise_std, seed=seed)
        if not 0.0 < cost < 1.0:
            raise ValueError(f"a cheap evaluation costs a part of a full one, not {cost:g}")
        self.cost, self.budget = cost, budget
        self.start = max(START, START_EACH * dimension)
        #: Full evaluations at cheap points, the best and others down the ranks: from these it is first seen how alike
        #: the levels are.
        self.pairs = dimension + 1
        if budget < self.start * cost + self.pairs + 1:
            raise ParameterError(
                f"a budget of {budget:g} full evaluations is too small for {self.start} cheap ones of {cost:g} and "
                f"{self.pairs + 1} full ones"
            )
        self.levels: list[int] = []

    @property
    def spent(self) -> float:
        """Cost of everything told, in full evaluations."""
        return sum(1.0 if level == FULL else self.cost for level in self.levels)

    @property
    def over(self) -> bool:
        """Whether no full evaluation fits into the budget any more."""
        return self.spent + 1.0 > self.budget + 1e-9

    def tell_level(self, action: npt.ArrayLike, level: int, loss: float | None) -> None:
        """Learn the loss (None: the evaluation failed) at a point (n,) and a level."""
        super().tell(action, loss)
        self.levels.append(int(level))

    def tell(self, action: npt.ArrayLike, loss: float | None) -> None:
        """Learn the full loss at a point."""
        self.tell_level(action, FULL, loss)

    def ask_batch(self, count: int) -> npt.NDArray[np.float32]:
        """Not here: a proposal has a level.

        Raises:
            NotImplementedError: always; `ask_level` proposes.
        """
        raise NotImplementedError("a two-level optimiser proposes points with their level: call ask_level()")

    def ask_level(self) -> Ask:
        """The next point and level."""
        cheap = [t for t, level in zip(self.told, self.levels, strict=True) if level == CHEAP]
        full = [t for t, level in zip(self.told, self.levels, strict=True) if level == FULL]
        if len(cheap) < self.start:
            return Ask(sobol(len(cheap) + 1, self.dimension, self.seed)[-1].astype(np.float32), CHEAP)
        if len(full) < self.pairs:
            ranked = sorted((t for t in cheap if t.loss is not None), key=_loss)
            ranked = ranked[:: max(1, len(ranked) // self.pairs)]
            fresh = [t for t in ranked if not any(_same(t.action, other) for other in full)]
            if fresh:
                return Ask(fresh[0].action.astype(np.float32), FULL)
        if not any(t.loss is not None for t in full):
            # Nothing has succeeded at the level that counts: keep filling the space there.
            return Ask(sobol(self.start + len(full) + 1, self.dimension, self.seed)[-1].astype(np.float32), FULL)
        return self._propose(self._stream(len(self.told)))

    def surrogate(self) -> Surrogate:
        """The GP over every evaluation that succeeded; it speaks of the full loss.

        Raises:
            RunError: none of the full loss has succeeded.
        """
        if FULL not in [level for _, level in self._succeeded_levels()]:
            raise RunError(
                f"no full evaluation succeeded ({self.levels.count(FULL)} full and {self.levels.count(CHEAP)} cheap "
                "ones were told): there is no loss to model"
            )
        return self._surrogate(self._succeeded_levels(), self._stream(0))

    def _succeeded_levels(self) -> list[tuple[Told, int]]:
        return [(t, level) for t, level in zip(self.told, self.levels, strict=True) if t.loss is not None]

    def _surrogate(self, known: Sequence[tuple[Told, int]], seed: int) -> Surrogate:
        shift = self.offset()
        losses = [_loss(t) + (shift if level == CHEAP else 0.0) for t, level in known]
        return Surrogate(
            [t.action for t, _ in known],
            losses,
            noise_std=self.noise_std,
            seed=seed,
            levels=[level for _, level in known],
        )

    def offset(self) -> float:
        """Mean full minus cheap loss over points evaluated at both; 0 before there are any."""
        good = self._succeeded_levels()
        cheap = [t for t, level in good if level == CHEAP]
        gaps = [_loss(t) - _loss(twin) for t, level in good if level == FULL for twin in cheap if _same(t.action, twin)]
        return float(np.mean(gaps)) if gaps else 0.0

    def _propose(self, seed: int) -> Ask:
        with quiet():
            from botorch.acquisition.logei import qLogNoisyExpectedImprovement
            from botorch.optim import optimize_acqf
            from botorch.sampling.normal import SobolQMCNormalSampler

        # As with one level: where a simulation failed, the search (not the estimate) takes the worst loss seen.
        worst = max(_loss(t) for t, _ in self._succeeded_levels())
        known = [
            (t if t.loss is not None else Told(t.action, worst), level)
            for t, level in zip(self.told, self.levels, strict=True)
        ]
        surrogate = self._surrogate(known, seed)
        points = np.array([t.action for t, _ in known])
        if surrogate.constant:
            return Ask(self._farthest(points, seed, 1)[0].astype(np.float32), FULL)
        n = self.dimension
        baseline = _inputs(points, FULL)
        sampler = SobolQMCNormalSampler(torch.Size([DRAWS]), seed=seed % 2**31)
        bounds = torch.tensor([[0.0] * (n + 1), [1.0] * (n + 1)], dtype=torch.float64)
        with seeded(seed), quiet():
            acquisition: Any = qLogNoisyExpectedImprovement(
                surrogate.likeliest, baseline, sampler=sampler, prune_baseline=True
            )
            best, _ = optimize_acqf(
                acquisition,
                bounds,
                q=1,
                num_restarts=RESTARTS,
                raw_samples=RAW,
                fixed_features={n: 1.0},
            )
        point = np.clip(2.0 * best.detach().reshape(-1).numpy()[:n] - 1.0, -1.0, 1.0)
        level = self._level(surrogate, point)
        mine = points[[level == other for _, other in known]]
        if len(mine) and np.min(np.max(np.abs(mine - point), axis=1)) < NEAREST:
            point = self._beside(point, seed)
        return Ask(point.astype(np.float32), level)

    def _level(self, surrogate: Surrogate, point: FloatArray) -> int:
        """The level that takes away more variance of the full loss at a point, for its cost."""
        if self.spent + self.cost + 1.0 > self.budget + 1e-9:
            return FULL  # what is left is for one more evaluation of what counts
        full_count = self.levels.count(FULL)
        if self.cost * (len(self.levels) - full_count + 1) > full_count:
            return FULL  # a likeness that misleads is found out: it never gets more than half of the cost
        both = torch.cat([_inputs(point[None], CHEAP), _inputs(point[None], FULL)])
        with torch.no_grad(), quiet():
            covariance = surrogate.ensemble.posterior(both).distribution.covariance_matrix  # type: ignore[union-attr]
        noise = torch.from_numpy(np.median(surrogate.settings.noise, axis=1))
        cheap, full, shared = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
        gain_cheap = float((shared**2 / (cheap + noise)).mean())
        gain_full = float((full**2 / (full + noise)).mean())
        return CHEAP if gain_cheap / self.cost > gain_full else FULL


def _inputs(points: FloatArray, level: int) -> torch.Tensor:
    """Points (m, n) of [-1, 1]^n in the unit cube, with a level."""
    x = torch.from_numpy(0.5 * (points + 1.0))
    return torch.cat([x, torch.full((len(x), 1), float(level), dtype=x.dtype)], dim=1)


def _loss(told: Told) -> float:
    assert told.loss is not None
    return told.loss


def _same(action: FloatArray, other: Told) -> bool:
    return bool(np.max(np.abs(action - other.action)) < 1e-6)


def optimise_two_levels(
    env: gym.Env[Any, Any],
    *,
    cost: float,
    budget: float,
    seed: int = 0,
    noise_std: float | None = None,
    replay: Sequence[npt.ArrayLike] = (),
    after_step: Callable[[int, dict[str, Any]], None] | None = None,
) -> Episode:
    """Play an environment whose last action chooses the level (negative: cheap), until a budget of cost is spent.

    Args:
        env: action space Box(-1, 1, (n + 1,)); reward minus the loss at that level; its own budget of steps must
            reach as far as ``budget / cost``.
        cost: of a cheap evaluation, in units of a full one.
        budget: in full evaluations.
        seed: of environment and agent.
        noise_std: standard deviation of one evaluation's noise, if measured.
        replay: actions (n + 1,) of an interrupted episode, taken again before anything new is asked.
        after_step: called with the number of steps done and the step's info.

    Raises:
        ParameterError: a budget too small for a search.
        ValueError: another action space.
        RuntimeError: every full evaluation failed.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or np.prod(space.shape) < 2:
        raise ValueError(f"two levels need actions in [-1, 1]^(n + 1), not {space}")
    optimiser = TwoLevelOptimiser(
        int(np.prod(space.shape)) - 1, cost=cost, budget=budget, noise_std=noise_std, seed=seed
    )
    env.reset(seed=seed)
    over = False
    while not (over or optimiser.over):
        done = len(optimiser.told)
        if done < len(replay):
            action = np.asarray(replay[done], dtype=np.float32)
        else:
            ask = optimiser.ask_level()
            action = np.append(ask.action, 1.0 if ask.level == FULL else -1.0).astype(np.float32)
        _, reward, terminated, truncated, info = env.step(action.reshape(space.shape))
        failed = info.get("status") == "failed"
        level = FULL if action[-1] >= 0.0 else CHEAP
        optimiser.tell_level(action[:-1], level, None if failed else -float(reward))
        over = terminated or truncated
        if after_step is not None:
            after_step(done + 1, info)
    if not any(level == FULL for _, level in optimiser._succeeded_levels()):
        raise RuntimeError("every full evaluation of the episode failed")
    return Episode(optimiser.result(), tuple(optimiser.told), optimiser)


def most_steps(budget: float, cost: float) -> int:
    """Steps that an environment must allow for a budget of cost."""
    return math.ceil(budget / cost) + 1
