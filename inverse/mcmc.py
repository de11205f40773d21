"""Markov chain Monte Carlo: several emcee ensembles with different initial points, until they converge."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import emcee
import numpy as np
from scipy.stats import qmc

from splatsoil.arrays import FloatArray
from splatsoil.errors import RunError

LogDensity = Callable[[FloatArray], FloatArray]

#: Independent ensembles, and walkers in each (more in many dimensions).
ENSEMBLES, WALKERS = 4, 24
#: Steps between tests of convergence, and their maximum.
STRIDE, MAX_STEPS = 200, 6000
#: Minimum length of an ensemble in autocorrelation times (emcee's documentation).
MIN_LENGTH = 50.0
#: Ensembles agree below this R-hat (Vehtari et al. 2021, Bayesian Anal. 16:667).
MAX_R_HAT = 1.01


@dataclass(frozen=True)
class Chains:
    """Samples of a density.

    Attributes:
        samples: (ensembles, steps, walkers, d), burn-in removed and thinned.
        log_density: (ensembles, steps, walkers).
        steps: of each ensemble.
        burn_in: discarded steps.
        autocorrelation: (d,) longest autocorrelation time over ensembles, in steps.
        acceptance: mean acceptance fraction.
        r_hat: (d,) between ensembles.
        converged: ensembles are long enough and agree.
    """

    samples: FloatArray
    log_density: FloatArray
    steps: int
    burn_in: int
    autocorrelation: FloatArray
    acceptance: float
    r_hat: FloatArray
    converged: bool

    @property
    def flat(self) -> FloatArray:
        """(k, d) all samples."""
        return self.samples.reshape(-1, self.samples.shape[-1])

    @property
    def effective(self) -> float:
        """Effective sample size of the slowest parameter."""
        total = self.samples.shape[0] * self.samples.shape[2] * (self.steps - self.burn_in)
        return float(total / max(float(np.max(self.autocorrelation)), 1.0))


def sample(
    log_density: LogDensity,
    dimension: int,
    *,
    seed: int = 0,
    ensembles: int = ENSEMBLES,
    walkers: int | None = None,
    max_steps: int = MAX_STEPS,
    progress: Callable[[int, int], None] = lambda done, most: None,
) -> Chains:
    """Sample a density inside [-1, 1]^d.

    Args:
        log_density: (k, d) to (k,), up to a constant; −∞ where the density is zero, never NaN or +∞.
        dimension: d.
        seed: the same seed gives the same chains.
        ensembles: independent groups of walkers.
        walkers: in each ensemble; even, more than 2 d.
        max_steps: maximum number of steps.
        progress: called with (steps done, maximum).

    Raises:
        RunError: the density is −∞ everywhere, or NaN or +∞ somewhere.
    """

    def checked(points: FloatArray) -> FloatArray:
        # emcee does not report the point of a NaN or +∞.
        logs = np.asarray(log_density(points))
        wrong = np.isnan(logs) | np.isposinf(logs)
        if wrong.any():
            first = int(np.argmax(wrong))
            where = ", ".join(f"{x:g}" for x in points[first])
            raise RunError(
                f"the logarithm of the posterior is {logs[first]:g} at ({where}), where it has to be finite or −∞"
            )
        return logs

    count = walkers or max(WALKERS, 4 * dimension)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.StretchMove(), 0.2)]
    samplers = [emcee.EnsembleSampler(count, dimension, checked, vectorize=True, moves=moves) for _ in range(ensembles)]
    states = [_start(checked, dimension, count, seed, e) for e in range(ensembles)]
    for done in range(STRIDE, max_steps + STRIDE, STRIDE):
        for e, sampler in enumerate(samplers):
            states[e] = sampler.run_mcmc(states[e], STRIDE, skip_initial_state_check=True)
        progress(done, max_steps)
        times = np.max([emcee.autocorr.integrated_time(s.get_chain(), tol=0) for s in samplers], axis=0)
        longest = float(times.max())
        burn, thin = int(min(5.0 * longest, 0.5 * done)), max(1, int(0.5 * longest))
        samples = np.stack([s.get_chain(discard=burn, thin=thin) for s in samplers])
        r_hat = _r_hat(samples)
        converged = bool(done > MIN_LENGTH * longest and np.all(r_hat < MAX_R_HAT))
        if converged:
            break
    return Chains(
        samples=samples,
        log_density=np.stack([s.get_log_prob(discard=burn, thin=thin) for s in samplers]),
        steps=done,
        burn_in=burn,
        autocorrelation=times,
        acceptance=float(np.mean([s.acceptance_fraction.mean() for s in samplers])),
        r_hat=r_hat,
        converged=converged,
    )


def _start(log_density: LogDensity, dimension: int, count: int, seed: int, e: int) -> emcee.State:
    """Walkers from Sobol points of the cube, weighted by density."""
    rng = np.random.default_rng([seed, e])
    points = 2.0 * qmc.Sobol(dimension, rng=rng).random(1024) - 1.0
    logs = log_density(points)
    if not np.any(np.isfinite(logs)):
        raise RunError("the posterior is zero everywhere: the observation is out of reach of the model")
    # Tempered: initial points must be wider than the posterior for R-hat to be a test.
    weights = np.exp(0.25 * (logs - logs.max()))
    chosen = points[rng.choice(len(points), count, p=weights / weights.sum())]
    spread = chosen + 0.04 * rng.standard_normal(chosen.shape)
    # Reflected at the bounds: equal walkers would stay equal.
    folded = np.where(np.abs(spread) > 1.0, 2.0 * np.sign(spread) - spread, spread)
    random = np.random.RandomState(np.random.SeedSequence([seed, e]).generate_state(4))  # the kind that emcee takes
    return emcee.State(folded, random_state=random.get_state())


def _r_hat(samples: FloatArray) -> FloatArray:
    """(d,) rank-normalised split R-hat between ensembles; an ensemble is one chain, as its walkers interact."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # a remark on its next major version
        from arviz import rhat

    chains = samples.reshape(len(samples), -1, samples.shape[-1])
    return np.array([rhat(chains[..., i]) for i in range(samples.shape[-1])])
