"""A Gaussian process over the loss, and what it says about where the minimum lies.

BoTorch's single-task GP in float64 on the unit cube, outcomes standardised, averaged over draws of its hyperparameters.
Observation noise is the simulator's own chance (another particle seed, another loss): known, when it was measured,
else inferred with the rest.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import minimize

from .hyperparameters import Hyperparameters, posterior

if TYPE_CHECKING:
    from botorch.models import SingleTaskGP

FloatArray = npt.NDArray[np.float64]

#: Points on which a one-dimensional posterior is drawn: half a per cent of the axis apart.
GRID = 201
#: No std is quoted below that of the grid's own rounding.
RESOLUTION = 2.0 / (GRID - 1) / np.sqrt(12.0)
#: Draws of the hyperparameters, and sample paths for each: in one dimension (cheap), in more (optimised one by one).
SETTINGS = 64
PATHS_1D = 16
PATHS_ND = 2
#: A minimum this close to a bound, as a part of the axis' length, counts as lying on it.
AT_BOUND = 0.01
#: Spread of a uniform distribution over [-1, 1]: what "nothing is known" looks like.
UNIFORM_STD = 2.0 / np.sqrt(12.0)
#: Minimisers whose root mean square distance from the estimate is more than this part of it say next to nothing.
UNINFORMED = 0.6


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Torch's CPU generator seeded inside the block, as it was outside."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


@dataclass(frozen=True)
class Minimum:
    """Where the loss is least, by the GP's posterior.

    Attributes:
        estimate: (n,) minimiser of the posterior mean, in [-1, 1]^n.
        std: (n,) distance from the estimate that holds 68.3 % of the minimisers of posterior sample paths; their
            root mean square distance along an axis that isn't determined.
        low: (n,) 5 % quantile of those minimisers.
        high: (n,) 95 % quantile.
        loss: posterior mean at the estimate.
        loss_std: posterior standard deviation of the (noise-free) loss there.
        noise_std: standard deviation of one evaluation's noise.
        at_bound: for each axis ``lower`` or ``upper`` when the estimate lies on that bound, else None.
        determined: for each axis, False when the evaluations hardly say where along it the minimum is.
    """

    estimate: FloatArray
    std: FloatArray
    low: FloatArray
    high: FloatArray
    loss: float
    loss_std: float
    noise_std: float
    at_bound: tuple[Literal["lower", "upper"] | None, ...]
    determined: tuple[bool, ...]


class Surrogate:
    """A GP conditioned on evaluations of a loss.

    Args:
        points: (m, n) in [-1, 1].
        losses: (m,) finite.
        noise_std: standard deviation of one evaluation's noise, where measured; None to infer it.
        seed: of the hyperparameters' draws.
        levels: (m,) 1 for an evaluation of the loss itself, 0 for one of a cheap likeness of it. The two are taken as
            values of one process with one more input (its length scale, learned with the others, says how alike they
            are). Whatever is asked of the surrogate is about the loss itself. None: all are.

    Raises:
        ValueError: no evaluations, or shapes that don't agree.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        losses: npt.ArrayLike,
        *,
        noise_std: float | None = None,
        seed: int = 0,
        levels: npt.ArrayLike | None = None,
    ) -> None:
        self.points = np.atleast_2d(np.asarray(points, dtype=np.float64))
        self.losses = np.asarray(losses, dtype=np.float64).reshape(-1)
        if len(self.losses) == 0 or self.points.shape[0] != len(self.losses):
            raise ValueError(f"{self.points.shape[0]} points and {len(self.losses)} losses make no surrogate")
        spread = float(np.std(self.losses, ddof=1)) if len(self.losses) > 1 else 0.0
        self.constant = spread <= 1e-12 * max(1.0, float(np.abs(self.losses).max()))
        self._shift = float(np.mean(self.losses))
        self._scale = 1.0 if self.constant else spread
        # Maximisation is BoTorch's direction; the unit cube is what the length scales' prior is meant for.
        self._x = 0.5 * (self.points + 1.0)
        self._levels = None if levels is None else np.asarray(levels, dtype=np.float64).reshape(-1, 1)
        if self._levels is not None:
            self._x = np.concatenate([self._x, self._levels], axis=1)
        self._y = -(self.losses - self._shift) / self._scale
        noise = None if noise_std is None else np.full(len(self._y), (noise_std / self._scale) ** 2)
        self.best, self.settings = posterior(self._x, self._y, noise, count=SETTINGS, seed=seed)

    @property
    def dimension(self) -> int:
        """Number of free parameters."""
        return self.points.shape[1]

    @property
    def noise_std(self) -> float:
        """Standard deviation of one evaluation's noise, in the loss's unit (its median, where it is inferred)."""
        return 0.0 if self.constant else self._scale * float(np.median(self.settings.noise)) ** 0.5

    @cached_property
    def likeliest(self) -> SingleTaskGP:
        """BoTorch model of minus the standardised loss, with the most probable hyperparameters: for acquisition.

        Its inputs are points of the unit cube, followed by the level where there are levels.
        """
        return self._model(self.best)

    @cached_property
    def ensemble(self) -> SingleTaskGP:
        """The same with a batch of hyperparameter draws: for what is believed."""
        return self._model(self.settings)

    def _model(self, settings: Hyperparameters) -> SingleTaskGP:
        with quiet():
            from botorch.models import SingleTaskGP
            from gpytorch.kernels import RBFKernel

        batch = torch.Size([]) if len(settings) == 1 else torch.Size([len(settings)])
        count = len(self._y)
        inputs = self._x.shape[1]
        kernel = RBFKernel(ard_num_dims=inputs, batch_shape=batch)
        with quiet():
            model = SingleTaskGP(
                torch.from_numpy(self._x).expand(*batch, count, inputs),
                torch.from_numpy(self._y)[:, None].expand(*batch, count, 1),
                train_Yvar=torch.from_numpy(settings.noise).reshape(*batch, count, 1),
                covar_module=kernel.double(),
                outcome_transform=None,
            )
        model.covar_module.lengthscale = torch.from_numpy(settings.lengths).reshape(*batch, 1, inputs)
        model.mean_module.constant.data = torch.from_numpy(settings.mean).reshape(batch)
        for parameter in model.parameters():
            parameter.requires_grad_(False)
        return model.eval()

    def _inputs(self, points: npt.ArrayLike) -> torch.Tensor:
        """Points (m, n) of [-1, 1]^n as the model takes them: in the unit cube, at the level of the loss itself."""
        x = torch.from_numpy(0.5 * (np.atleast_2d(np.asarray(points, dtype=np.float64)) + 1.0))
        return x if self._levels is None else torch.cat([x, torch.ones(len(x), 1, dtype=x.dtype)], dim=1)

    def mean_and_std(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Posterior mean and standard deviation (m,), (m,) of the noise-free loss at points (m, n) of [-1, 1]^n."""
        x = self._inputs(points)
        means, variances = [], []
        with torch.no_grad(), quiet():
            # In pieces: BoTorch makes the joint covariance of all points, for every draw of the hyperparameters.
            for piece in torch.split(x, 64):
                given = self.ensemble.posterior(piece)
                means.append(given.mean.squeeze(-1))
                variances.append(given.variance.squeeze(-1).clamp_min(0.0))
        mean, variance = torch.cat(means, dim=-1), torch.cat(variances, dim=-1)
        # Total variance: the mean of the variances and the variance of the means.
        total = variance.mean(0) + mean.var(0, unbiased=False)
        return self._shift - self._scale * mean.mean(0).numpy(), self._scale * total.sqrt().numpy()

    def minimum(self, *, seed: int = 0) -> Minimum:
        """Minimiser of the posterior mean, with the spread that the posterior gives it."""
        estimate = self._minimise_mean(seed)
        minimisers = self._sample_minimisers_1d(seed) if self.dimension == 1 else self._sample_minimisers(seed)
        loss, loss_std = self.mean_and_std(estimate[None])
        # About the estimate, not about their own mean: what is quoted as ± belongs to the number in front of it. The
        # distance that holds 68.3 % of them is one standard deviation of a normal distribution; a root mean square
        # would be ruled by the few paths that dip in a gap between evaluations.
        distances = np.abs(minimisers - estimate)
        spread = np.sqrt(np.mean(distances**2, axis=0))
        determined = (spread < UNINFORMED * UNIFORM_STD) & (not self.constant)
        std = np.where(determined, np.quantile(distances, 0.683, axis=0), spread)
        low, high = np.quantile(minimisers, [0.05, 0.95], axis=0)
        return Minimum(
            estimate=estimate,
            std=np.maximum(std, RESOLUTION),
            low=low,
            high=high,
            loss=float(loss[0]),
            loss_std=float(loss_std[0]),
            noise_std=self.noise_std,
            at_bound=tuple(bound_of(value) for value in estimate),
            determined=tuple(bool(d) for d in determined),
        )

    def _minimise_mean(self, seed: int) -> FloatArray:
        """Best of a grid (one dimension) or of Sobol points and the data (more), polished by L-BFGS-B."""
        if self.dimension == 1:
            candidates = np.linspace(-1.0, 1.0, GRID)[:, None]
        else:
            candidates = np.concatenate([sobol(1024, self.dimension, seed), self.points])
        mean, _ = self.mean_and_std(candidates)
        starts = candidates[np.argsort(mean, kind="stable")[: 1 if self.dimension == 1 else 4]]

        def value_and_gradient(point: FloatArray) -> tuple[float, FloatArray]:
            x = self._inputs(point).requires_grad_()
            with quiet():
                value = -self.ensemble.posterior(x).mean.mean()
            (gradient,) = torch.autograd.grad(value, x)
            return value.item(), 0.5 * gradient.numpy().reshape(-1)[: self.dimension]

        results = [
            minimize(value_and_gradient, s, jac=True, bounds=[(-1, 1)] * self.dimension, method="L-BFGS-B")
            for s in starts
        ]
        best = min(results, key=lambda r: r.fun)
        return np.clip(best.x, -1.0, 1.0)

    def _sample_minimisers_1d(self, seed: int) -> FloatArray:
        """Minimisers (k, 1) of exact joint draws on a grid."""
        grid = np.linspace(-1.0, 1.0, GRID)
        x = self._inputs(grid[:, None])
        with torch.no_grad(), quiet():
            given = self.ensemble.posterior(x)
            mean, covariance = given.mean, given.distribution.covariance_matrix  # type: ignore[union-attr]
        # A draw is mean + V √λ z; an RBF's covariance is singular to machine precision, which Cholesky minds.
        eigenvalues, vectors = torch.linalg.eigh(covariance)
        with seeded(seed):
            normal = torch.randn(SETTINGS, GRID, PATHS_1D, dtype=torch.float64)
        draws = mean + vectors @ (eigenvalues.clamp_min(0.0).sqrt()[..., None] * normal)
        return grid[torch.argmax(draws, dim=1).numpy()].reshape(-1, 1)

    def _sample_minimisers(self, seed: int) -> FloatArray:
        """Minimisers (k, n) of Matheron sample paths, each optimised from Sobol starts."""
        with quiet():
            from botorch.sampling.pathwise import draw_matheron_paths
            from botorch.utils.sampling import optimize_posterior_samples

        bounds = self._inputs(np.stack([np.full(self.dimension, -1.0), np.full(self.dimension, 1.0)]))
        if self._levels is not None:
            bounds[0, -1] -= 1e-6  # BoTorch minds rounding where two bounds are equal
        with seeded(seed), quiet():
            paths = draw_matheron_paths(self.ensemble, torch.Size([PATHS_ND]))
            best, _ = optimize_posterior_samples(paths, bounds, raw_samples=128, num_restarts=2)  # type: ignore[arg-type]
        return 2.0 * best.detach().reshape(-1, bounds.shape[1])[:, : self.dimension].numpy() - 1.0


def sobol(count: int, dimension: int, seed: int) -> FloatArray:
    """Scrambled Sobol points (count, dimension) in [-1, 1]."""
    engine = torch.quasirandom.SobolEngine(dimension, scramble=True, seed=seed)
    return 2.0 * engine.draw(count, dtype=torch.float64).numpy() - 1.0


def bound_of(value: float) -> Literal["lower", "upper"] | None:
    if value <= -1.0 + 2.0 * AT_BOUND:
        return "lower"
    return "upper" if value >= 1.0 - 2.0 * AT_BOUND else None


@contextmanager
def quiet() -> Iterator[None]:
    """Silence remarks that say nothing to a user: scaling hints, jitter, an optimiser that starts again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch.jit, on BoTorch's import
        from botorch.exceptions.warnings import BotorchWarning
        from linear_operator.utils.warnings import NumericalWarning

        warnings.simplefilter("ignore", BotorchWarning)
        warnings.simplefilter("ignore", NumericalWarning)
        warnings.filterwarnings("ignore", "Optimization failed", RuntimeWarning)
        yield
