"""The posterior of a fit by Markov chain Monte Carlo, averaged over the base model and the discrepancy model.

These two models differ only in the prior of the factors of the discretisation error. Their average is one model with
the mean of both priors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from splatsoil.arrays import FloatArray
from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment, Run
from splatsoil.files import plain, write_json
from splatsoil.parameters import Parameter
from splatsoil.run_files import POSTERIOR_FORMAT
from splatsoil.threads import one_thread

from .criticism.design import Prior
from .criticism.evidence import BASE_PRIOR, Comparison, Marginal
from .criticism.noise import FACTORS, Noise
from .criticism.simulations import Simulations
from .mcmc import Chains, sample
from .run_folder import RunFolder

#: Posterior over prior standard deviation: a parameter is determined below the first, and not determined above the
#: second.
DETERMINED, UNDETERMINED = 0.5, 0.8
QUANTILES = {"median": 0.5, "low": 0.05, "high": 0.95, "low_50": 0.25, "high_50": 0.75}
#: Bins of the histograms in the report.
BINS = 60
#: First seed of simulations at draws from the posterior; a comparison uses lower ones.
FIRST_SEED = 1_000_000
#: χ² per score of these from which a note says that the emulator's variance is too small.
MAX_CHI2 = 3.0


@dataclass(frozen=True, eq=False)
class Density:
    """Log density of the posterior at points of [-1, 1]^n, up to a constant.

    Attributes:
        prior: of the parameters, uniform on that cube.
        comparison: of the base model, with the observation.
    """

    prior: Prior
    comparison: Comparison

    @classmethod
    def of(cls, noise: Noise, prior: Prior, seed: int = 0) -> Density:
        """From a comparison's noise and prior."""
        return cls(prior, Comparison.of(noise, prior, (), {}, seed))

    @property
    def noise(self) -> Noise:
        """Of the scores."""
        return self.comparison.noise

    @property
    def log_prior(self) -> FloatArray:
        """(f,) log prior probability of the factors of the discretisation error, averaged over both models."""
        base, discrepancy = self.noise.log_prior, self.noise.log_prior_discrepancy
        return np.asarray(np.logaddexp(np.log(BASE_PRIOR) + base, np.log(1.0 - BASE_PRIOR) + discrepancy))

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (q, p) of whitened scores at points (q, n), and the emulator's variance."""
        (base,) = self.comparison.models
        _, mean, variance = base.predict(0.5 * (points + 1.0))
        return mean, variance

    def by_factor(self, points: FloatArray) -> FloatArray:
        """(f, q) log prior plus log likelihood of each factor at points (q, n)."""
        mean, variance = self.predict(points)
        white = self.comparison.likelihood.white(self.noise.observed)
        log = self.comparison.likelihood.log(white - mean, variance, np.zeros((0, mean.shape[1])))
        return np.asarray(log + self.log_prior[:, None])

    def __call__(self, points: npt.ArrayLike) -> FloatArray:
        """(q,) at points (q, n); −∞ outside the cube."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        out = np.full(len(where), -np.inf)
        inside = np.all(np.abs(where) <= 1.0, axis=1)
        if inside.any():
            out[inside] = logsumexp(self.by_factor(where[inside]), axis=0)
        return out

    def replicates(self, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(q, p) draws of the posterior predictive scores at points (q, n)."""
        mean, variance = self.predict(points)
        root = self.comparison.likelihood.root
        log = self.by_factor(points)
        share = np.exp(log - logsumexp(log, axis=0))
        scores = (mean + np.sqrt(variance) * rng.standard_normal(mean.shape)) @ root.T
        for row, weights in zip(scores, share.T, strict=True):
            covariance = self.noise.covariance(rng.choice(FACTORS, p=weights))
            row += rng.multivariate_normal(np.zeros(len(row)), covariance, method="eigh")
        return np.asarray(scores)

    def chi2(self, tables: FloatArray, points: FloatArray) -> FloatArray:
        """(q,) χ² per score of new simulations (q, t, s) at points (q, n); about 1 for a correct emulator."""
        mean, variance = self.predict(points)
        white = self.comparison.likelihood.white
        scatter = white(white(self.noise.scatter).T)
        error = white(self.noise.scores(tables)) - mean
        covariance = scatter + (variance[:, :, None] + 1e-9) * np.eye(mean.shape[1])
        return np.asarray(np.mean(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of the parameters.

    Attributes:
        density: of the posterior.
        chains: in [-1, 1]^n.
    """

    density: Density
    chains: Chains

    @property
    def unit(self) -> FloatArray:
        """(k, n) samples in [-1, 1]."""
        return self.chains.flat

    @property
    def values(self) -> FloatArray:
        """(k, n) samples in physical units."""
        return self.density.prior.space.from_unit(self.unit)


@one_thread()
def run_posterior(
    run: RunFolder,
    experiment: Experiment,
    simulate: Simulations,
    density: Density,
    *,
    checks: int = 3,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> dict[str, Any]:
    """Sample, check, and write ``posterior.json`` and the folder ``posterior/``.

    Args:
        run: the latest fit's folder; only this process may write to it meanwhile.
        experiment: of the fit's model.
        simulate: its simulations.
        density: of a comparison of that model.
        checks: number of simulations at draws from the posterior, which test the emulator.
        seed: of chains and checks.
        progress: called with (what, share done).

    Returns:
        Contents of ``posterior.json``.

    Raises:
        RunError: the folder can't be written.
    """
    from .posterior_files import write_corner, write_inference_data

    began = time.perf_counter()
    fit, own = run.fit(), list(experiment.parameters)

    def sampling(done: int, most: int) -> None:
        progress(f"chains, step {done}", 0.5 * done / most)

    posterior = Posterior(density, sample(density, len(density.prior.space), seed=seed, progress=sampling))
    progress("checks", 0.5)
    checked = _check_emulator(posterior, simulate, checks, seed)
    result = summarise(posterior, own)
    mean_chi2 = float(np.mean([c["chi2"] for c in checked])) if checked else 0.0
    if len(checked) < checks:
        result["notes"].append(f"{checks - len(checked)} of {checks} checks could not be simulated.")
    if mean_chi2 > MAX_CHI2:
        result["notes"].append(
            "Simulations at draws from the posterior differ from the emulator by more than its variance "
            f"(χ² per score {mean_chi2:.1f} instead of 1): more evaluations would help."
        )
    files = run.path / "posterior"
    write_inference_data(posterior, files / "posterior.nc")
    result |= {
        "fit": fit["name"],
        "values": {name: entry["estimate"] for name, entry in fit["parameters"].items()},
        "checks": checked,
        "simulations": len(density.noise.base) + len(checked),
        "figures": [write_corner(posterior, own, files / "corner.png").name],
        "seconds": round(time.perf_counter() - began, 3),
        "seed": seed,
        **{key: fit[key] for key in ("device", "preset", "version")},
    }
    data: dict[str, Any] = plain(result)
    write_json(run.path / "posterior.json", data)
    return data


def _check_emulator(posterior: Posterior, simulate: Simulations, count: int, seed: int) -> list[dict[str, Any]]:
    """Parameters and χ² of simulations at draws from the posterior, those that succeeded."""
    prior = posterior.density.prior
    chosen = np.random.default_rng([seed, 7]).choice(len(posterior.unit), count, replace=False)
    runs = [Run(v, seed=FIRST_SEED + seed + i) for i, v in enumerate(prior.values(posterior.unit[chosen]))]
    simulate.prefetch(runs)
    out = []
    for run in runs:
        with suppress(SimulationError):
            table = simulate(run, "check")
            chi2 = posterior.density.chi2(table[None], prior.unit([run]))
            out.append({"parameters": dict(run.values), "chi2": float(chi2[0])})
    return out


def summarise(posterior: Posterior, own: Sequence[Parameter]) -> dict[str, Any]:
    """A posterior as plain data.

    Args:
        posterior: of parameters whose bounds are those of the prior's box.
        own: the same parameters with their full bounds.
    """
    unit, chains, noise = posterior.unit, posterior.chains, posterior.density.noise
    parameters = {p.name: _marginal(posterior, i, p) for i, p in enumerate(own)}
    correlation = np.atleast_2d(np.corrcoef(unit.T)) if len(own) > 1 else np.ones((1, 1))
    return {
        "format": POSTERIOR_FORMAT,
        "parameters": parameters,
        "correlation": correlation.tolist(),
        "emulator": {
            "simulations": len(noise.base),
            "features": int(noise.mask.sum()),
            "scores": noise.basis.shape[1],
        },
        "chains": {
            "ensembles": chains.samples.shape[0],
            "walkers": chains.samples.shape[2],
            "steps": chains.steps,
            "burn_in": chains.burn_in,
            "autocorrelation": float(chains.autocorrelation.max()),
            "acceptance": chains.acceptance,
            "r_hat": float(chains.r_hat.max()),
            "effective": chains.effective,
            "converged": chains.converged,
        },
        "notes": notes(posterior, parameters),
    }


def verdicts(unit: FloatArray) -> list[str]:
    """Whether each parameter is determined, from samples (k, n) in [-1, 1]."""
    return [
        "determined" if c < DETERMINED else "weakly determined" if c < UNDETERMINED else "not determined"
        for c in unit.std(axis=0) * np.sqrt(3.0)
    ]


def _marginal(posterior: Posterior, index: int, parameter: Parameter) -> dict[str, Any]:
    values, unit = posterior.values[:, index], posterior.unit[:, index]
    space = posterior.density.prior.space
    # On the axis on which the prior is uniform.
    contraction = float(unit.std() * np.sqrt(3.0))
    (verdict,) = verdicts(unit[:, None])
    bounds = Marginal(values, np.full(len(values), 1.0 / len(values))).bounds_reached(parameter)
    counts, edges = np.histogram(unit, bins=BINS, range=(-1.0, 1.0), density=True)
    ends = np.repeat(np.zeros((1, len(space))), BINS + 1, axis=0)
    ends[:, index] = edges
    return {
        "mean": float(values.mean()),
        "std": float(values.std(ddof=1)),
        **dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values())).tolist(), strict=True)),
        "unit": parameter.unit,
        "title": parameter.title,
        "bounds": [parameter.lower, parameter.upper],
        "contraction": contraction,
        "verdict": verdict,
        "at_bound": [] if verdict == "not determined" else bounds,
        # Over the density of the prior.
        "histogram": {"edges": space.from_unit(ends)[:, index].tolist(), "density": (2.0 * counts).tolist()},
    }


def notes(posterior: Posterior, parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Warnings for the reader."""
    out = []
    for name, entry in parameters.items():
        share = round(100.0 * entry["contraction"])
        if entry["verdict"] == "not determined":
            out.append(
                f"{name} is not determined by this experiment: its posterior is {min(share, 100)} % as wide as "
                "its prior."
            )
        elif entry["verdict"] == "weakly determined":
            out.append(f"{name} is only weakly determined: its posterior is {share} % as wide as its prior.")
        for bound in entry["at_bound"]:
            out.append(
                f"The posterior of {name} crowds at its {bound} bound: the value may lie beyond it, or the model may "
                "lack an effect."
            )
    chains = posterior.chains
    if not chains.converged:
        out.append(
            f"The chains have not converged (R-hat {chains.r_hat.max():.3f} after {chains.steps} steps): take the "
            "widths as rough."
        )
    return out
