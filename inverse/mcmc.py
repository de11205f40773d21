"""Markov chains: several ensembles of emcee's walkers, from different starts, until they agree.

Kept in an HDF5 file as they go, so that an interrupted run goes on and comes to the same end.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
#: An ensemble is long enough at this many autocorrelation times (emcee's own advice), if the time itself is steady.
LENGTHS, STEADY = 50.0, 0.1
#: Ensembles agree below this R-hat (Vehtari et al. 2021).
AGREE = 1.01
#: Bytes that HDF5 may need beside the samples: indices, and chunks that are not full.
HDF5_NEEDS = 1_000_000


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
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    seed: int = 0,
    ensembles: int = ENSEMBLES,
    walkers: int | None = None,
    most_steps: int = MOST_STEPS,
    file: Path | None = None,
    identity: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Chains:
    """Sample a density inside a box.

    Args:
        log_density: (k, d) to (k,), up to a constant; −∞ where there is none, never NaN or +∞.
        lower, upper: (d,) the box in which walkers start.
        seed: the same seed gives the same chains.
        ensembles: independent groups of walkers.
        walkers: in each; even, more than 2 d.
        most_steps: after which the chains stop, converged or not.
        file: HDF5 file that keeps them; None keeps nothing.
        identity: of the density: chains in the file that belong to another are thrown away.
        progress: called with (steps done, most).

    Raises:
        RunError: the density is −∞ everywhere, NaN or +∞ somewhere, or the file can't be written.
    """
    log_density = _checked(log_density)
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    d = len(low)
    count = walkers or max(WALKERS, 4 * d)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.StretchMove(), 0.2)]
    backends = [_backend(file, identity, e) for e in range(ensembles)]
    samplers = [
        emcee.EnsembleSampler(count, d, log_density, vectorize=True, moves=moves, backend=backend)
        for backend in backends
    ]
    times = np.full(d, np.inf)
    while True:
        done = min(sampler.backend.iteration if sampler.backend.initialized else 0 for sampler in samplers)
        if done:
            times = _autocorrelation(samplers, done)
            earlier = _autocorrelation(samplers, done - STRIDE) if done > STRIDE else np.full(d, np.inf)
            steady = bool(np.all(np.abs(times - earlier) < STEADY * times))
            agreed = bool(np.all(_r_hat(_kept(samplers, done, times)[0]) < AGREE))
            if (done > LENGTHS * times.max() and steady and agreed) or done >= most_steps:
                break
        for e, sampler in enumerate(samplers):
            _advance(sampler, done + STRIDE, log_density, low, high, seed, e)
        if progress is not None:
            progress(min(done + STRIDE, most_steps), most_steps)
    samples, logs, burn = _kept(samplers, done, times)
    r_hat = _r_hat(samples)
    return Chains(
        samples=samples,
        log_density=logs,
        steps=done,
        burn_in=burn,
        autocorrelation=times,
        acceptance=float(np.mean([s.acceptance_fraction.mean() for s in samplers])),
        r_hat=r_hat,
        converged=bool(done > LENGTHS * times.max() and np.all(r_hat < AGREE)),
    )


def _checked(log_density: LogDensity) -> LogDensity:
    """The density, which says where it is none: NaN and +∞ would end a chain without a word on the point."""

    def checked(points: FloatArray) -> FloatArray:
        logs = np.asarray(log_density(points))
        wrong = np.isnan(logs) | np.isposinf(logs)
        if wrong.any():
            first = int(np.argmax(wrong))
            where = ", ".join(f"{x:g}" for x in points[first])
            raise RunError(
                f"the logarithm of the posterior is {logs[first]:g} at ({where}), where it has to be finite or −∞"
            )
        return logs

    return checked


class _Blocks(emcee.backends.HDFBackend):
    """emcee's HDF5 file, written a stride at a time: opening it for each step costs more than the step."""

    def __init__(self, file: str, name: str) -> None:
        super().__init__(file, name=name)
        self._waiting: list[tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]] = []
        self._random: tuple[Any, ...] = ()

    def save_step(self, state: emcee.State, accepted: npt.NDArray[np.bool_]) -> None:
        """Remember a step until :meth:`flush`."""
        self._waiting.append((state.coords.copy(), state.log_prob.copy(), np.array(accepted)))
        self._random = state.random_state

    def flush(self) -> None:
        """Write what waits."""
        chain, logs, accepted = (np.array(part) for part in zip(*self._waiting, strict=True))
        with self.open("a") as file:
            group = file[self.name]
            done = int(group.attrs["iteration"])
            group["chain"][done : done + len(chain)] = chain
            group["log_prob"][done : done + len(chain)] = logs
            group["accepted"][:] += accepted.sum(axis=0)
            for k, value in enumerate(self._random):
                group.attrs[f"random_state_{k}"] = value
            group.attrs["iteration"] = done + len(chain)
        self._waiting.clear()


def _advance(
    sampler: emcee.EnsembleSampler,
    until: int,
    log_density: LogDensity,
    low: FloatArray,
    high: FloatArray,
    seed: int,
    e: int,
) -> None:
    """Go on to step ``until``, from the start or from where the file stops."""
    done = sampler.backend.iteration if sampler.backend.initialized else 0
    if done >= until:
        return
    if done:
        start = sampler.backend.get_last_sample()
    else:
        random = np.random.RandomState(np.random.SeedSequence([seed, e]).generate_state(4))
        start = emcee.State(_start(log_density, low, high, sampler.nwalkers, seed, e), random_state=random.get_state())
    if isinstance(sampler.backend, _Blocks):
        check_room(Path(sampler.backend.filename), 8 * (until - done) * sampler.nwalkers * (sampler.ndim + 2))
    sampler.run_mcmc(start, until - done, skip_initial_state_check=True)
    if isinstance(sampler.backend, _Blocks):
        try:
            sampler.backend.flush()
        except OSError as error:
            raise RunError(f"{sampler.backend.filename}: cannot be written ({error}); free some space") from error


def check_room(file: Path, size: int) -> None:
    """Be sure that ``size`` bytes and HDF5's own needs fit on the disk: where they don't, HDF5 takes the whole process
    down instead of raising an error.

    Raises:
        RunError: they don't.
    """
    free = shutil.disk_usage(file.parent).free
    if free < size + HDF5_NEEDS:
        raise RunError(
            f"{file}: {free / 1e6:.1f} MB are left on its disk and {(size + HDF5_NEEDS) / 1e6:.1f} MB are needed; free "
            "some space and run again, what is stored is kept"
        )


def _start(log_density: LogDensity, low: FloatArray, high: FloatArray, count: int, seed: int, e: int) -> FloatArray:
    """(count, d) starts, drawn from Sobol points of the box by their density."""
    rng = np.random.default_rng([seed, e])
    points = low + (high - low) * qmc.Sobol(len(low), rng=rng).random(1024)
    logs = log_density(points)
    if not np.any(np.isfinite(logs)):
        raise RunError("the posterior is zero everywhere: the observation is out of reach of the model")
    # Tempered, so that the starts are wider than the posterior: agreement of ensembles then means something.
    weights = np.exp(0.25 * (logs - logs.max()))
    chosen = points[rng.choice(len(points), count, p=weights / weights.sum())]
    spread = chosen + 0.02 * (high - low) * rng.standard_normal(chosen.shape)
    # What sticks out is folded back: walkers that met at a bound would never part again.
    share = np.abs((spread - low) / (high - low))
    return low + (high - low) * np.where(share > 1.0, 2.0 - share, share)


def _backend(file: Path | None, identity: str, e: int) -> emcee.backends.Backend | None:
    if file is None:
        return None
    import h5py

    if file.exists() and e == 0:
        try:
            with h5py.File(file, "r") as store:
                mine = store.attrs.get("identity", "") == identity
        except OSError:  # a process killed while it wrote leaves what HDF5 can't open
            mine = False
        if not mine:
            file.unlink()
    try:
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            check_room(file, 0)
            with h5py.File(file, "w") as store:
                store.attrs["identity"] = identity
        return _Blocks(str(file), f"ensemble{e}")
    except OSError as error:
        raise RunError(f"{file}: cannot be written ({error}); choose a run folder you may write to") from error


def _autocorrelation(samplers: list[emcee.EnsembleSampler], steps: int) -> FloatArray:
    """(d,) the longest over ensembles."""
    chains = [s.get_chain()[:steps] for s in samplers]
    return np.max([emcee.autocorr.integrated_time(chain, tol=0) for chain in chains], axis=0)


def _kept(samplers: list[emcee.EnsembleSampler], steps: int, times: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Samples and log densities without burn-in, thinned to about twice an autocorrelation time."""
    longest = float(times.max())
    burn = int(min(5.0 * longest, 0.5 * steps))
    thin = max(1, int(0.5 * longest))
    samples = np.stack([s.get_chain()[burn:steps:thin] for s in samplers])
    return samples, np.stack([s.get_log_prob()[burn:steps:thin] for s in samplers]), burn


def _r_hat(samples: FloatArray) -> FloatArray:
    """(d,) Gelman and Rubin's ratio for ensembles, each cut in halves (Gelman et al. 2013, eq. 11.4).

    The walkers of an ensemble are not independent, but ensembles are.
    """
    half = samples.shape[1] // 2
    if half < 2:
        return np.full(samples.shape[-1], np.inf)
    pieces = np.concatenate([samples[:, :half], samples[:, half : 2 * half]])
    pieces = pieces.reshape(len(pieces), -1, samples.shape[-1])
    within = pieces.var(axis=1, ddof=1).mean(axis=0)
    between = pieces.mean(axis=1).var(axis=0, ddof=1)
    return np.sqrt(1.0 + between / np.maximum(within, 1e-300))
