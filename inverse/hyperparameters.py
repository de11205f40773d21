"""Length scales, noise and mean of a GP: their posterior, not only their best values.

Ten evaluations leave these open, and one best guess is overconfident: on pure noise it may call every point a valley.
So the surrogate averages over draws from the posterior, made by emcee from starting points that importance resampling
provides. Inputs live in [0, 1]^n, outcomes have mean 0 and standard deviation 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import emcee
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.stats import multivariate_t, norm, qmc

FloatArray = npt.NDArray[np.float64]

#: ln of a length scale: the dimension-scaled prior of Hvarfner, Hellsten & Nardi (2024), BoTorch's default.
LENGTH_MEAN, LENGTH_STD = np.sqrt(2.0), np.sqrt(3.0)
#: ln of the noise variance: BoTorch's median, twice its width, so that "all of it is noise" (0) stays thinkable.
NOISE_MEAN, NOISE_STD = -4.0, 2.0
#: Below these the kernel matrix is singular to machine precision, above nothing changes any more.
LENGTH_BOUNDS = (np.log(0.025), np.log(1e3))
NOISE_BOUNDS = (np.log(1e-6), np.log(4.0))
#: Added to the diagonal for the Cholesky factor's sake.
JITTER = 1e-8
#: Larger than any sum of squares of whitened outcomes, which makes a matrix bordered by them positive definite.
CORNER = 1e100
#: Of differences that make a slope: the square root of a double's precision.
SLOPE_STEP = 1.5e-8
#: Length scales, alike for all axes, from which the most probable setting is looked for besides the prior's best point.
SMOOTH = (0.5, 1.5)
#: Prior points for importance resampling (powers of two, for Sobol): for up to MANY outcomes; fewer beyond, down to a
#: least number, since each costs the cube of them and more outcomes say more. Then emcee's steps.
PRIOR_POINTS, MANY, LEAST_POINTS, STEPS = 4096, 32, 512, 60


@dataclass(frozen=True)
class Hyperparameters:
    """k settings of a GP.

    Attributes:
        lengths: (k, n) length scales.
        noise: (k, m) noise variance of each outcome.
        mean: (k,) constant mean.
    """

    lengths: FloatArray
    noise: FloatArray
    mean: FloatArray

    def __len__(self) -> int:
        return len(self.mean)


class Density:
    """Log posterior density of (ln lengths, mean[, ln noise]), for many settings at once.

    Args:
        x: (m, n) inputs in [0, 1].
        y: (m,) standardised outcomes.
        noise: (m,) known noise variances, None to infer one for all.
    """

    def __init__(self, x: FloatArray, y: FloatArray, noise: FloatArray | None) -> None:
        self.y = y
        self.noise = noise
        self.n = x.shape[1]
        self.squares = (x[:, None] - x[None]) ** 2
        length_mean = LENGTH_MEAN + 0.5 * np.log(self.n)
        known = noise is not None
        self.means = np.array([length_mean] * self.n + [0.0] + ([] if known else [NOISE_MEAN]))
        self.stds = np.array([LENGTH_STD] * self.n + [1.0] + ([] if known else [NOISE_STD]))
        self.bounds: FloatArray = np.array([LENGTH_BOUNDS] * self.n + [(-8.0, 8.0)] + ([] if known else [NOISE_BOUNDS]))

    def prior(self, points: FloatArray) -> FloatArray:
        """(w, d) to (w,): log prior density, −∞ out of bounds."""
        inside = np.all((points >= self.bounds[:, 0]) & (points <= self.bounds[:, 1]), axis=1)
        return np.where(inside, -0.5 * np.sum(((points - self.means) / self.stds) ** 2, axis=1), -np.inf)

    def likelihood(self, points: FloatArray) -> FloatArray:
        """(w, d) to (w,): log marginal likelihood."""
        settings = self.unpack(points)
        m = len(self.y)
        diagonal = np.arange(m)
        # Outcomes as one more row: its part of the Cholesky factor is L⁻¹(y − mean), without a system to solve.
        bordered = np.empty((len(points), m + 1, m + 1))
        exponent = settings.lengths**-2.0 @ self.squares.reshape(m * m, -1).T
        bordered[:, :m, :m] = np.exp(-0.5 * exponent).reshape(-1, m, m)
        bordered[:, diagonal, diagonal] += settings.noise + JITTER
        bordered[:, m, :m] = self.y - settings.mean[:, None]
        bordered[:, m, m] = CORNER
        factor = np.linalg.cholesky(bordered)
        return -0.5 * np.sum(factor[:, m, :m] ** 2, axis=1) - np.sum(np.log(factor[:, diagonal, diagonal]), axis=1)

    def __call__(self, points: FloatArray) -> FloatArray:
        """(w, d) to (w,): log posterior density up to a constant."""
        out = self.prior(points)
        good = np.isfinite(out)
        if good.any():
            out[good] += self.likelihood(points[good])
        return out

    def unpack(self, points: FloatArray) -> Hyperparameters:
        """Settings (w, d) by name."""
        count = len(points)
        noise = np.exp(points[:, -1:]) if self.noise is None else self.noise[None]
        return Hyperparameters(
            lengths=np.exp(points[:, : self.n]),
            noise=np.broadcast_to(noise, (count, len(self.y))).copy(),
            mean=points[:, self.n].copy(),
        )


def posterior(
    x: FloatArray, y: FloatArray, noise: FloatArray | None, *, count: int, seed: int
) -> tuple[Hyperparameters, Hyperparameters]:
    """The most probable setting (k = 1), and ``count`` draws from the posterior.

    Args:
        x: (m, n) inputs in [0, 1].
        y: (m,) outcomes with mean 0 and standard deviation 1.
        noise: (m,) known noise variances, None to infer one for all.
        count: draws; even, and at least twice the number of hyperparameters.
        seed: the same seed gives the same bits.
    """
    density = Density(x, y, noise)
    d = len(density.means)
    halvings = max(0, int(np.ceil(2.0 * np.log2(len(y) / MANY))))
    prior_points = max(LEAST_POINTS, PRIOR_POINTS >> halvings)
    cube = qmc.Sobol(d, rng=np.random.default_rng(seed)).random(prior_points)
    points = density.means + density.stds * norm.ppf(np.clip(cube, 1e-6, 1.0 - 1e-6))
    points = np.clip(points, density.bounds[:, 0], density.bounds[:, 1])

    best = points[np.argmax(density(points))]
    for start in [best, *_smooth(density)]:
        found = minimize(_downhill, start, (density,), jac=True, bounds=density.bounds, method="L-BFGS-B")
        if np.isfinite(found.fun) and found.fun < -density(best[None])[0]:
            best = found.x

    # In several dimensions hardly a point of the prior is near the peak, so a heavy-tailed bell around it helps out;
    # the two together are the proposal whose importance weights choose the walkers' starts.
    random = np.random.RandomState(seed)  # the kind that emcee takes
    bell = multivariate_t(best, _curvature(density, best), df=4)
    near = np.atleast_2d(bell.rvs(max(prior_points // 4, 1), random_state=random)).reshape(-1, d)
    points = np.concatenate([points, np.clip(near, density.bounds[:, 0], density.bounds[:, 1])])
    prior = norm.pdf(points, density.means, density.stds).prod(axis=1)
    proposal = (prior_points * prior + len(near) * bell.pdf(points)) / len(points)
    logs = density(points)
    weights = np.where(np.isfinite(logs), np.exp(logs - logs.max()), 0.0) / proposal
    start = points[random.choice(len(points), count, p=weights / weights.sum())]
    # Twins would never part: emcee's moves are along differences between walkers.
    start = start + 0.05 * density.stds * random.standard_normal(start.shape)
    start = np.clip(start, density.bounds[:, 0] + 1e-9, density.bounds[:, 1] - 1e-9)
    sampler = emcee.EnsembleSampler(count, d, density, vectorize=True)
    state = sampler.run_mcmc(emcee.State(start, random_state=random.get_state()), STEPS, skip_initial_state_check=True)
    return density.unpack(best[None]), density.unpack(np.asarray(state.coords))


def _smooth(density: Density) -> list[FloatArray]:
    """Settings of smooth outcomes with little noise, to climb from, too: in several dimensions the best point of the
    prior is on the slope of a lesser peak, where some axes seem not to matter."""
    if density.n == 1:
        return []
    ends = [density.means.copy() for _ in SMOOTH]
    for point, length in zip(ends, SMOOTH, strict=True):
        point[: density.n] = np.log(length)
        if density.noise is None:
            point[-1] = NOISE_MEAN - NOISE_STD
    return ends


def _downhill(point: FloatArray, density: Density) -> tuple[float, FloatArray]:
    """Minus the density at a point (d,) and its slope, by differences within the bounds, all in one call."""
    step = SLOPE_STEP * np.maximum(1.0, np.abs(point))
    step = np.where(point + step > density.bounds[:, 1], -step, step)
    values = density(point + np.concatenate([np.zeros((1, len(point))), np.diag(step)]))
    return -float(values[0]), -(values[1:] - values[0]) / step


def _curvature(density: Density, peak: FloatArray) -> FloatArray:
    """Covariance (d, d) of the bell with the density's curvature at its peak, no wider than the prior."""
    d = len(peak)
    step = 0.05 * density.stds
    corners = np.array([[i, j, a, b] for i in range(d) for j in range(i, d) for a in (-1, 1) for b in (-1, 1)])
    moved = np.repeat(peak[None], len(corners), axis=0)
    rows = np.arange(len(corners))
    moved[rows, corners[:, 0]] += corners[:, 2] * step[corners[:, 0]]
    moved[rows, corners[:, 1]] += corners[:, 3] * step[corners[:, 1]]
    # At a bound the density beyond is as at the bound: a one-sided slope then counts as curvature, which is cautious.
    values = density(np.clip(moved, density.bounds[:, 0], density.bounds[:, 1]))
    hessian = np.zeros((d, d))
    for (i, j, a, b), value in zip(corners, values, strict=True):
        hessian[i, j] -= a * b * value / (4.0 * step[i] * step[j])
    hessian = np.triu(hessian) + np.triu(hessian, 1).T + np.diag(density.stds**-2.0)
    eigenvalues, vectors = np.linalg.eigh(hessian)
    floor = density.stds.max() ** -2.0
    covariance = (vectors / np.maximum(eigenvalues, floor)) @ vectors.T
    return 0.5 * (covariance + covariance.T)
