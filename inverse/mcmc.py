"""Markov chains: several ensembles of emcee's walkers, from different starts, until they agree."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import emcee
import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from splatsoil.errors import RunError

FloatArray = npt.NDArray[np.float64]
LogDensity = Callable[[FloatArray], FloatArray]

#: Independent ensembles, and walkers in each (more in many dimensions).
ENSEMBLES, WALKERS = 4, 24
#: Steps between looks at the autocorrelation, and the most of them.
STRIDE, MOST_STEPS = 200, 6000
#: An ensemble is long enough at this many autocorrelation times (emcee's own advice).
LENGTHS = 50.0
#: Ensembles agree below this R-hat (Vehtari et al. 2021, Bayesian Anal. 16:667).
AGREE = 1.01


@dataclass(frozen=True)
class Chains:
    """What was sampled.

    Attributes:
        samples: (ensembles, steps, walkers, d), burn-in removed and thinned.
        log_density: (ensembles, steps, walkers).
        steps: steps taken by each ensemble.
        burn_in: steps thrown away.
        autocorrelation: (d,) longest autocorrelation time over ensembles, steps.
        acceptance: mean accepted share.
        r_hat: (d,) between ensembles.
        converged: long enough, and in agreement.
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
        """Number of independent samples that these are worth, at least."""
        drawn = self.samples.shape[0] * self.samples.shape[2] * (self.steps - self.burn_in)
        return float(drawn / max(float(np.max(self.autocorrelation)), 1.0))


def sample(
    log_density: LogDensity,
    dimension: int,
    *,
    seed: int = 0,
    ensembles: int = ENSEMBLES,
    walkers: int | None = None,
    most_steps: int = MOST_STEPS,
    progress: Callable[[int, int], None] = lambda done, most: None,
) -> Chains:
    """Sample a density inside [-1, 1]^d.

    Args:
        log_density: (k, d) to (k,), up to a constant; −∞ where there is none, never NaN or +∞.
        dimension: d.
        seed: the same seed gives the same chains.
        ensembles: independent groups of walkers.
        walkers: in each; even, more than 2 d.
        most_steps: after which the chains stop, converged or not.
        progress: called with (steps done, most).

    Raises:
        RunError: the density is −∞ everywhere, or NaN or +∞ somewhere.
    """

    def checked(points: FloatArray) -> FloatArray:
        # NaN and +∞ would end a chain without a word on the point.
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
    for done in range(STRIDE, most_steps + STRIDE, STRIDE):
        for e, sampler in enumerate(samplers):
            states[e] = sampler.run_mcmc(states[e], STRIDE, skip_initial_state_check=True)
        progress(done, most_steps)
        times = np.max([emcee.autocorr.integrated_time(s.get_chain(), tol=0) for s in samplers], axis=0)
        longest = float(times.max())
        burn, thin = int(min(5.0 * longest, 0.5 * done)), max(1, int(0.5 * longest))
        samples = np.stack([s.get_chain(discard=burn, thin=thin) for s in samplers])
        r_hat = _r_hat(samples)
        converged = bool(done > LENGTHS * longest and np.all(r_hat < AGREE))
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
    """Walkers drawn from Sobol points of the cube by their density."""
    rng = np.random.default_rng([seed, e])
    points = 2.0 * qmc.Sobol(dimension, rng=rng).random(1024) - 1.0
    logs = log_density(points)
    if not np.any(np.isfinite(logs)):
        raise RunError("the posterior is zero everywhere: the observation is out of reach of the model")
    # Tempered, so that the starts are wider than the posterior: agreement of ensembles then means something.
    weights = np.exp(0.25 * (logs - logs.max()))
    chosen = points[rng.choice(len(points), count, p=weights / weights.sum())]
    spread = chosen + 0.04 * rng.standard_normal(chosen.shape)
    # What sticks out is folded back: walkers that met at a bound would never part again.
    folded = np.where(np.abs(spread) > 1.0, 2.0 * np.sign(spread) - spread, spread)
    random = np.random.RandomState(np.random.SeedSequence([seed, e]).generate_state(4))  # the kind that emcee takes
    return emcee.State(folded, random_state=random.get_state())


def _r_hat(samples: FloatArray) -> FloatArray:
    """(d,) rank-normalised split R-hat. The walkers of an ensemble are not independent, but ensembles are: each is one
    chain, in the order of its steps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # a remark on its next major version
        from arviz import rhat

    chains = samples.reshape(len(samples), -1, samples.shape[-1])
    return np.array([rhat(chains[..., i]) for i in range(samples.shape[-1])])
