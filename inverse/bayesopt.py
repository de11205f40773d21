"""Bayesian optimisation as an agent: it knows a Gymnasium environment and nothing of soil.

Ask, tell, and a result. What is asked next depends only on the seed and on what was told, so that a run told the
evaluations of an interrupted one goes on as that one would have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch

from .surrogate import FloatArray, Minimum, Surrogate, quiet, seeded, sobol

#: Space-filling evaluations before the first acquisition: at least, and for each parameter. With fewer, a search in
#: many dimensions runs into corners and stays there.
START, START_EACH = 4, 3
#: Quasi-Monte-Carlo draws, restarts and raw candidates of the acquisition function.
DRAWS = 128
RESTARTS = 4
RAW = 128
#: A proposal closer than this to an evaluated point (in [-1, 1]^n) adds too little: it is moved away.
NEAREST = 1e-3


@dataclass(frozen=True)
class Search:
    """How an optimiser searches.

    Attributes:
        start: space-filling points before the first acquisition.
        acquisition: ``noisy`` (log noisy expected improvement: what is best so far is itself uncertain) or ``ei`` (log
            expected improvement over the best mean at an evaluated point).
        random: the start is drawn uniformly, not from a Sobol sequence.
    """

    start: int = START
    acquisition: Literal["noisy", "ei"] = "noisy"
    random: bool = False


#: The settings of Hsiao and Kumar: one random start, expected improvement; with 10 evaluations in [25°, 55°].
PAPER = Search(start=1, acquisition="ei", random=True)


@dataclass(frozen=True)
class Told:
    """One evaluation the optimiser knows.

    Attributes:
        action: (n,) in [-1, 1].
        loss: None where the evaluation failed.
    """

    action: FloatArray
    loss: float | None


class BayesianOptimiser:
    """Expected improvement over a GP, after a space-filling start.

    Args:
        dimension: number of free parameters; points live in [-1, 1]^dimension.
        start: least number of space-filling points before the first acquisition, where ``search`` doesn't say.
        noise_std: standard deviation of one evaluation's noise, where it was measured; inferred otherwise.
        seed: the same seed and evaluations give the same proposals.
        search: how to search.
    """

    def __init__(
        self,
        dimension: int,
        *,
        start: int = START,
        noise_std: float | None = None,
        seed: int = 0,
        search: Search | None = None,
    ) -> None:
        self.search = search or Search(start=max(start, START_EACH * dimension))
        if dimension < 1 or start < 1 or self.search.start < 1:
            raise ValueError("an optimiser needs at least one dimension and one starting point")
        self.dimension = dimension
        self.noise_std = noise_std
        self.seed = seed
        self.told: list[Told] = []

    def tell(self, action: npt.ArrayLike, loss: float | None) -> None:
        """Learn the loss (None: the evaluation failed) at a point (n,) of [-1, 1]^n."""
        point = np.array(action, dtype=np.float64).reshape(self.dimension)
        usable = loss is not None and np.isfinite(loss)
        self.told.append(Told(point, float(loss) if usable and loss is not None else None))

    def ask(self) -> npt.NDArray[np.float32]:
        """The next point (n,) to evaluate, in float32 as environments take it."""
        return self.ask_batch(1)[0]

    def ask_batch(self, count: int) -> npt.NDArray[np.float32]:
        """The next ``count`` points (count, n), chosen to be evaluated side by side: together they are to improve."""
        done = len(self.told)
        if done < self.search.start or not self._succeeded():
            # Beyond the start only while nothing has succeeded: keep filling the space.
            return self._fill(done + count)[done:].astype(np.float32)
        seed = self._stream(done)
        return self._apart(self._most_improving(seed, count), seed).astype(np.float32)

    def _fill(self, count: int) -> FloatArray:
        if self.search.random:
            return np.random.default_rng(self._stream(2**20)).uniform(-1.0, 1.0, (count, self.dimension))
        return sobol(count, self.dimension, self.seed)

    def surrogate(self) -> Surrogate:
        """The GP over every evaluation that succeeded.

        Raises:
            ValueError: none has.
        """
        good = self._succeeded()
        return Surrogate(
            [t.action for t in good],
            [t.loss for t in good if t.loss is not None],
            noise_std=self.noise_std,
            seed=self._stream(0),
        )

    def result(self) -> Minimum:
        """Minimiser of the GP's mean with its posterior spread."""
        return self.surrogate().minimum(seed=self._stream(1))

    def _succeeded(self) -> list[Told]:
        return [t for t in self.told if t.loss is not None]

    def _stream(self, index: int) -> int:
        """An independent seed for each use."""
        return int(np.random.SeedSequence([self.seed, index]).generate_state(1)[0])

    def _most_improving(self, seed: int, count: int) -> FloatArray:
        with quiet():
            from botorch.acquisition.logei import qLogExpectedImprovement, qLogNoisyExpectedImprovement
            from botorch.optim import optimize_acqf
            from botorch.sampling.normal import SobolQMCNormalSampler

        # A failed simulation tells where not to go: for the search (not for the estimate) it counts as the worst seen.
        worst = max(t.loss for t in self._succeeded() if t.loss is not None)
        points = np.array([t.action for t in self.told])
        losses = [worst if t.loss is None else t.loss for t in self.told]
        surrogate = Surrogate(points, losses, noise_std=self.noise_std, seed=seed)
        if surrogate.constant:
            return self._farthest(points, seed, count)
        bounds = torch.tensor([[0.0] * self.dimension, [1.0] * self.dimension], dtype=torch.float64)
        cube = torch.from_numpy(0.5 * (points + 1.0))
        sampler = SobolQMCNormalSampler(torch.Size([DRAWS]), seed=seed % 2**31)
        model = surrogate.likeliest
        with seeded(seed), quiet():
            if self.search.acquisition == "noisy":
                acquisition: Any = qLogNoisyExpectedImprovement(model, cube, sampler=sampler, prune_baseline=True)
            else:
                best_mean = model.posterior(cube).mean.max().detach()
                acquisition = qLogExpectedImprovement(model, best_f=best_mean, sampler=sampler)
            best, _ = optimize_acqf(
                acquisition, bounds, q=count, num_restarts=RESTARTS, raw_samples=RAW, sequential=count > 1
            )
        return 2.0 * np.asarray(best.detach().reshape(count, -1).numpy()) - 1.0

    def _apart(self, proposals: FloatArray, seed: int) -> FloatArray:
        """Proposals (count, n), those moved that come too close to evaluated points or to each other."""
        points = np.array([t.action for t in self.told])
        chosen: list[FloatArray] = []
        for k, proposal in enumerate(proposals):
            known = np.concatenate([points, *(c[None] for c in chosen)])
            near = np.min(np.max(np.abs(known - proposal), axis=1)) < NEAREST
            chosen.append(self._beside(proposal, seed + k) if near else np.clip(proposal, -1.0, 1.0))
        return np.array(chosen)

    def _farthest(self, points: FloatArray, seed: int, count: int) -> FloatArray:
        """Sobol points farthest from all evaluated ones: what is left to do when all losses are equal."""
        candidates = sobol(256, self.dimension, seed % 2**31)
        known = points
        for _ in range(count):
            gaps = np.linalg.norm(candidates[:, None] - known[None], axis=-1).min(axis=1)
            known = np.concatenate([known, candidates[[np.argmax(gaps)]]])
        return known[len(points) :]

    def _beside(self, proposal: FloatArray, seed: int) -> FloatArray:
        """Close to a repeated proposal, but not on it: repetition says less about the slope than a neighbour does."""
        step = np.random.default_rng(seed).uniform(0.02, 0.05, self.dimension)
        sign = np.where(proposal > 0.0, -1.0, 1.0)
        return np.clip(proposal + sign * step, -1.0, 1.0)


@dataclass(frozen=True)
class Episode:
    """What an agent brought back from one episode.

    Attributes:
        minimum: the estimate, in [-1, 1]^n.
        told: every evaluation, in order.
        optimiser: for the GP behind the estimate.
    """

    minimum: Minimum
    told: tuple[Told, ...]
    optimiser: BayesianOptimiser


def optimise(
    env: gym.Env[Any, Any],
    *,
    seed: int = 0,
    start: int = START,
    noise_std: float | None = None,
    search: Search | None = None,
    replay: Sequence[npt.ArrayLike] = (),
    at_once: int = 1,
    before_batch: Callable[[Sequence[npt.ArrayLike]], None] | None = None,
    after_step: Callable[[int, dict[str, Any]], None] | None = None,
) -> Episode:
    """Play one episode of an environment whose reward is minus a loss, until it truncates or terminates.

    Args:
        env: action space Box(-1, 1, (n,)); ``info["status"] == "failed"`` marks an evaluation without a loss.
        seed: of environment and agent.
        start: Sobol points before the first acquisition.
        noise_std: standard deviation of one evaluation's noise, if measured.
        search: how to search, start included; :data:`PAPER` for the paper's way.
        replay: actions of an interrupted episode, taken again before anything new is asked.
        at_once: points that are chosen together.
        before_batch: called with actions chosen together before the first of them is taken, unless all are replayed.
        after_step: called with the number of steps done and the step's info.

    Raises:
        ValueError: the action space isn't [-1, 1]^n.
        RuntimeError: every evaluation failed.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or np.any(space.low != -1.0) or np.any(space.high != 1.0):
        raise ValueError(f"Bayesian optimisation needs actions in [-1, 1]^n, not {space}")
    optimiser = BayesianOptimiser(int(np.prod(space.shape)), start=start, noise_std=noise_std, seed=seed, search=search)
    env.reset(seed=seed)
    over, batch = False, list[npt.ArrayLike]()
    while not over:
        done = len(optimiser.told)
        if not batch:
            known = list(replay[done : done + at_once])
            batch = [*known, *(optimiser.ask_batch(at_once)[len(known) :] if len(known) < at_once else ())]
            if before_batch is not None and len(known) < at_once:
                before_batch(batch)
        action = np.asarray(batch.pop(0), dtype=np.float32)
        _, reward, terminated, truncated, info = env.step(action.reshape(space.shape))
        failed = info.get("status") == "failed"
        optimiser.tell(action, None if failed else -float(reward))
        over = terminated or truncated
        if after_step is not None:
            after_step(done + 1, info)
    if not any(t.loss is not None for t in optimiser.told):
        raise RuntimeError("every evaluation of the episode failed")
    return Episode(optimiser.result(), tuple(optimiser.told), optimiser)
