"""Bayesian optimisation with BoTorch: a Gaussian process of the loss, and log expected improvement.

The interface is ask and tell. Proposals depend only on the seed and the evaluations, so that a run which repeats the
evaluations of an interrupted one continues it exactly.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import emcee
import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from scipy.stats import norm

from splatsoil.arrays import FloatArray

if TYPE_CHECKING:
    from botorch.models import SingleTaskGP

Acquisition = Literal["noisy", "best"]

#: Space-filling evaluations before the first acquisition: minimum, and number for each parameter. With fewer, a search
#: in many dimensions stays in corners.
START, START_EACH = 4, 3
#: Restarts and raw samples of each acquisition optimisation.
RESTARTS, RAW_SAMPLES = 4, 128
#: Prior of the log noise variance of standardised losses: BoTorch's median and twice its width, because a simulator
#: may have little noise.
NOISE_MEAN, NOISE_STD = -4.0, 2.0
#: Draws of the hyperparameters (emcee walkers), steps of the chain, and sample paths for each draw.
HYPERPARAMETER_DRAWS, CHAIN_STEPS, PATHS = 64, 200, 2
#: Initial points from the prior and from around the mode, and the width of the latter in prior standard deviations.
INITIAL_POINTS, MODE_WIDTH = 1024, 0.2
#: A minimum within this share of the axis from a bound lies on the bound.
AT_BOUND = 0.01
#: A parameter is determined if the root mean square distance of the minimisers from the estimate is less than this
#: share of a uniform distribution's standard deviation.
DETERMINED = 0.6


class Trial(NamedTuple):
    """One evaluation: the action (n,) in [-1, 1], and its loss; None where it failed."""

    action: FloatArray
    loss: float | None


@dataclass(frozen=True, eq=False)
class Minimum:
    """Minimum of the loss by the Gaussian process.

    Attributes:
        estimate: (n,) minimiser of the posterior mean, in [-1, 1]^n.
        minimisers: (k, n) those of sample paths.
        constant: all losses were equal.
    """

    estimate: FloatArray
    minimisers: FloatArray
    constant: bool = False

    @property
    def at_bound(self) -> tuple[Literal["lower", "upper"] | None, ...]:
        """For each axis the bound on which the estimate lies, if any."""
        near = np.abs(self.estimate) > 1.0 - 2.0 * AT_BOUND
        return tuple(
            ("upper" if value > 0.0 else "lower") if on else None for on, value in zip(near, self.estimate, strict=True)
        )

    @property
    def determined(self) -> tuple[bool, ...]:
        """For each axis, whether the evaluations determine the minimum."""
        spread = np.sqrt(np.mean((self.minimisers - self.estimate) ** 2, axis=0))
        return tuple(bool(s < DETERMINED * 2.0 / np.sqrt(12.0)) and not self.constant for s in spread)

    def interval(
        self, to: Callable[[FloatArray], FloatArray] = lambda unit: unit
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Standard deviation, 5 and 95 % quantiles (n,) of the minimisers, on the scale of ``to``.

        The first is the 68.3 % quantile of the distance from the estimate: a root mean square is dominated by few paths
        with a minimum in a gap between evaluations. For an axis that is not determined, it is the root mean square.
        """
        minimisers = to(self.minimisers)
        distances = np.abs(minimisers - to(self.estimate))
        rms = np.sqrt(np.mean(distances**2, axis=0))
        low, high = np.quantile(minimisers, [0.05, 0.95], axis=0)
        return np.where(self.determined, np.quantile(distances, 0.683, axis=0), rms), low, high


class Surrogate:
    """A Gaussian process of a loss: BoTorch's single-task model.

    Proposals and means use the most probable hyperparameters. The distribution of the minimum is averaged over draws
    of the hyperparameters: ten losses do not determine them.

    Args:
        points: (m, n) in [-1, 1].
        losses: (m,) finite.
        seed: of draws.

    Raises:
        ValueError: no evaluations, or shapes that do not agree.
    """

    def __init__(self, points: npt.ArrayLike, losses: npt.ArrayLike, *, seed: int = 0) -> None:
        x, y = np.atleast_2d(np.asarray(points, dtype=np.float64)), np.asarray(losses, dtype=np.float64).reshape(-1)
        if len(y) == 0 or len(x) != len(y):
            raise ValueError(f"{len(x)} points and {len(y)} losses make no surrogate")
        spread = float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
        self.constant = spread <= 1e-12 * max(1.0, float(np.abs(y).max()))
        self.shift, self.scale = float(np.mean(y)), 1.0 if self.constant else spread
        self.dimension, self.seed = x.shape[1], seed
        # BoTorch maximises, and its priors are meant for the unit cube and standardised outcomes.
        self.inputs = torch.from_numpy(0.5 * (x + 1.0))
        self.outcomes = torch.from_numpy((self.shift - y) / self.scale)[:, None]
        with _torch(seed):
            from botorch.fit import fit_gpytorch_mll
            from gpytorch.mlls import ExactMarginalLogLikelihood

            self.model = self._process()
            fit_gpytorch_mll(ExactMarginalLogLikelihood(self.model.likelihood, self.model))

    @property
    def noise_std(self) -> float:
        """Standard deviation of one evaluation's noise, in the loss's unit."""
        return 0.0 if self.constant else self.scale * self.model.likelihood.noise.item() ** 0.5

    def mean_and_std(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Posterior mean and standard deviation (m,), (m,) of the noise-free loss at points (m, n) of [-1, 1]^n."""
        x = torch.from_numpy(0.5 * (np.atleast_2d(np.asarray(points, dtype=np.float64)) + 1.0))
        with torch.no_grad(), _torch(self.seed):
            given = self.model.posterior(x)
        mean, variance = given.mean.numpy()[:, 0], given.variance.clamp_min(0.0).numpy()[:, 0]
        return self.shift - self.scale * mean, self.scale * np.sqrt(variance)

    def proposals(self, count: int, acquisition: Acquisition = "noisy") -> FloatArray:
        """(count, n) points of [-1, 1]^n with the largest joint expected improvement.

        Args:
            count: of them.
            acquisition: ``noisy`` (log noisy expected improvement: the best value so far is uncertain) or
                ``best`` (log expected improvement over the best mean at an evaluated point).
        """
        with _torch(self.seed):
            from botorch.acquisition.logei import qLogExpectedImprovement, qLogNoisyExpectedImprovement

            if acquisition == "noisy":
                improvement: Any = qLogNoisyExpectedImprovement(self.model, self.inputs, prune_baseline=True)
            else:
                best = self.model.posterior(self.inputs).mean.max().detach()
                improvement = qLogExpectedImprovement(self.model, best_f=best)
            return self._maximised(improvement, count)

    def minimum(self) -> Minimum:
        """Minimiser of the posterior mean, and minimisers of posterior sample paths."""
        with _torch(self.seed):
            from botorch.acquisition import PosteriorMean
            from botorch.sampling.pathwise import draw_matheron_paths
            from botorch.utils.sampling import optimize_posterior_samples

            estimate = self._maximised(PosteriorMean(self.model), 1)[0]
            paths = draw_matheron_paths(self._ensemble(), torch.Size([PATHS]))
            best, _ = optimize_posterior_samples(paths, self._bounds, raw_samples=RAW_SAMPLES, num_restarts=2)  # type: ignore[arg-type]
        minimisers = 2.0 * best.detach().reshape(-1, self.dimension).numpy() - 1.0
        return Minimum(estimate, minimisers, self.constant)

    def _process(self, *batch: int) -> SingleTaskGP:
        """A Gaussian process, or a batch of them."""
        from botorch.models import SingleTaskGP
        from gpytorch.constraints import GreaterThan
        from gpytorch.likelihoods import GaussianLikelihood
        from gpytorch.priors import LogNormalPrior

        likelihood = GaussianLikelihood(
            noise_prior=LogNormalPrior(NOISE_MEAN, NOISE_STD),
            noise_constraint=GreaterThan(1e-6, transform=None, initial_value=np.exp(NOISE_MEAN)),
            batch_shape=torch.Size(batch),
        )
        x, y = (t.expand(*batch, *t.shape) for t in (self.inputs, self.outcomes))
        return SingleTaskGP(x, y, likelihood=likelihood, outcome_transform=None)

    def _ensemble(self) -> SingleTaskGP:
        """A batch of processes with hyperparameters from their posterior."""
        n, x, y = self.dimension, self.inputs.numpy(), self.outcomes.numpy()
        lengths = self.model.covar_module.lengthscale_prior
        means = np.array([*[float(lengths.loc)] * n, NOISE_MEAN, 0.0])
        stds = np.array([*[float(lengths.scale)] * n, NOISE_STD, 1.0])
        squares = ((x[:, None] - x[None]) ** 2).reshape(-1, n).T

        def log_density(points: FloatArray) -> FloatArray:
            """(w,) of logarithms of lengths and noise variance, and means (w, n + 2)."""
            correlation = np.exp(-0.5 * np.exp(-2.0 * points[:, :n]) @ squares).reshape(-1, len(x), len(x))
            noise = np.exp(points[:, n, None, None]) + 1e-6
            factor = np.linalg.cholesky(correlation + noise * np.eye(len(x)))
            z = np.linalg.solve(factor, y - points[:, n + 1, None, None])[..., 0]
            determinant = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            return norm.logpdf(points, means, stds).sum(axis=1) - 0.5 * np.sum(z**2, axis=1) - determinant

        random = np.random.RandomState(self.seed)  # the kind that emcee takes
        # Initial points come from the prior and from around the mode, weighted by density: in several dimensions hardly
        # a point of the prior is near the mode.
        mode = torch.cat([self.model.covar_module.lengthscale[0].log(), self.model.likelihood.noise.log()])
        peak = np.append(mode.detach().numpy(), self.model.mean_module.constant.item())
        spread = random.standard_normal((2, INITIAL_POINTS, n + 2)) * stds
        pool = np.concatenate([means + spread[0], peak + MODE_WIDTH * spread[1]])
        weights = np.exp((logs := log_density(pool)) - logs.max())
        start = pool[random.choice(len(pool), HYPERPARAMETER_DRAWS, p=weights / weights.sum())]
        start = start + 0.05 * stds * random.standard_normal(start.shape)  # equal walkers would stay equal
        moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.StretchMove(), 0.2)]
        sampler = emcee.EnsembleSampler(HYPERPARAMETER_DRAWS, n + 2, log_density, vectorize=True, moves=moves)
        state = emcee.State(start, random_state=random.get_state())
        draws = torch.from_numpy(sampler.run_mcmc(state, CHAIN_STEPS).coords)
        model = self._process(HYPERPARAMETER_DRAWS)
        model.covar_module.lengthscale = draws[:, None, :n].exp()
        model.likelihood.noise = draws[:, n, None].exp() + 1e-6
        model.mean_module.constant.data = draws[:, n + 1]
        return model.requires_grad_(False).eval()

    @property
    def _bounds(self) -> torch.Tensor:
        return torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, self.dimension)

    def _maximised(self, acquisition: Any, count: int) -> FloatArray:
        """(count, n) points of [-1, 1]^n."""
        from botorch.optim import optimize_acqf

        found, _ = optimize_acqf(
            acquisition, self._bounds, q=count, num_restarts=RESTARTS, raw_samples=RAW_SAMPLES, sequential=count > 1
        )
        return np.clip(2.0 * found.detach().numpy() - 1.0, -1.0, 1.0)


class BayesianOptimiser:
    """A Sobol sequence first, then expected improvement of a Gaussian process.

    Args:
        dimension: number of free parameters; points live in [-1, 1]^dimension.
        seed: the same seed and evaluations give the same proposals.
        start: number of space-filling points; 4, or 3 for each parameter if that is more, if not given.
        acquisition: see :meth:`Surrogate.proposals`.
    """

    def __init__(
        self, dimension: int, *, seed: int = 0, start: int | None = None, acquisition: Acquisition = "noisy"
    ) -> None:
        self.start = max(START, START_EACH * dimension) if start is None else start
        if dimension < 1 or self.start < 1:
            raise ValueError("an optimiser needs at least one dimension and one starting point")
        self.dimension, self.seed, self.acquisition = dimension, seed, acquisition
        self.trials: list[Trial] = []

    def tell(self, action: npt.ArrayLike, loss: float | None) -> None:
        """Learn the loss (None: the evaluation failed) at a point (n,) of [-1, 1]^n."""
        usable = loss is not None and np.isfinite(loss)
        self.trials.append(Trial(np.array(action, dtype=np.float64).reshape(self.dimension), loss if usable else None))

    def ask(self, count: int = 1) -> npt.NDArray[np.float32]:
        """The next points (count, n), float32, with the largest joint expected improvement."""
        done, succeeded = len(self.trials), [t.loss for t in self.trials if t.loss is not None]
        if done < self.start or not succeeded:
            # Also later, while no evaluation has succeeded.
            return sobol(done + count, self.dimension, self.seed)[done:].astype(np.float32)
        # In the search (not in the result) a failed simulation has the worst loss so far.
        losses = [max(succeeded) if t.loss is None else t.loss for t in self.trials]
        surrogate = Surrogate([t.action for t in self.trials], losses, seed=self._stream(done))
        return surrogate.proposals(count, self.acquisition).astype(np.float32)

    def surrogate(self) -> Surrogate:
        """The Gaussian process of all evaluations that succeeded.

        Raises:
            ValueError: none has.
        """
        good = [(t.action, t.loss) for t in self.trials if t.loss is not None]
        return Surrogate([action for action, _ in good], [loss for _, loss in good], seed=self._stream(0))

    def result(self) -> Minimum:
        """The minimum of the loss."""
        return self.surrogate().minimum()

    def _stream(self, index: int) -> int:
        """An independent seed for each use."""
        return int(np.random.SeedSequence([self.seed, index]).generate_state(1)[0])


def optimise(env: gym.Env[Any, Any], *, seed: int = 0) -> BayesianOptimiser:
    """Run one episode of an environment whose reward is minus a loss, until it truncates or terminates.

    Args:
        env: action space Box(-1, 1, (n,)); ``info["status"] == "failed"`` marks an evaluation without a loss.
        seed: of environment and optimiser.

    Raises:
        ValueError: the action space is not [-1, 1]^n.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or np.any(space.low != -1.0) or np.any(space.high != 1.0):
        raise ValueError(f"Bayesian optimisation needs actions in [-1, 1]^n, not {space}")
    optimiser = BayesianOptimiser(int(np.prod(space.shape)), seed=seed)
    env.reset(seed=seed)
    over = False
    while not over:
        (action,) = optimiser.ask()
        _, reward, terminated, truncated, info = env.step(action.reshape(space.shape))
        optimiser.tell(action, None if info.get("status") == "failed" else -float(reward))
        over = terminated or truncated
    return optimiser


def sobol(count: int, dimension: int, seed: int) -> FloatArray:
    """Scrambled Sobol points (count, dimension) in [-1, 1]."""
    engine = torch.quasirandom.SobolEngine(dimension, scramble=True, seed=seed)
    return 2.0 * engine.draw(count, dtype=torch.float64).numpy() - 1.0


@contextmanager
def _torch(seed: int) -> Iterator[None]:
    """Seed torch's CPU generator inside the block, and silence warnings that concern no user."""
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore", FutureWarning)  # torch.jit, on BoTorch's import
        from botorch.exceptions.warnings import BotorchWarning
        from linear_operator.utils.warnings import NumericalWarning

        warnings.simplefilter("ignore", BotorchWarning)
        warnings.simplefilter("ignore", NumericalWarning)
        warnings.filterwarnings("ignore", "Optimization failed", RuntimeWarning)
        torch.manual_seed(seed)
        yield
