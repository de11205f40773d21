"""A posterior by Markov chains: the one that a comparison integrates over, of the base model and "something else".

These two differ in what is believed of the numerics' factor alone, so the density that is averaged over both is that of
one model with the mean of both beliefs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from splatsoil.parameters import Parameter
from splatsoil.run_files import POSTERIOR_FORMAT

from .criticism.design import Prior
from .criticism.evidence import PRIOR, Comparison
from .criticism.noise import FACTORS, Noise
from .marginal import Marginal
from .mcmc import Chains

FloatArray = npt.NDArray[np.float64]

#: Posterior over prior standard deviation: below the first a parameter is determined, above the second it is not.
DETERMINED, UNDETERMINED = 0.5, 0.8
#: Bins of the histograms kept for the report.
BINS = 60


@dataclass(frozen=True, eq=False)
class Density:
    """Logarithm of a posterior's density at points of [-1, 1]^n, up to a constant.

    Attributes:
        prior: of the parameters, uniform on that cube.
        comparison: of the base model; knows the observation.
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
    def beliefs(self) -> FloatArray:
        """(f,) logarithms of the probability of each of the numerics' factors beforehand, over both models."""
        return np.asarray(np.logaddexp(np.log(PRIOR) + self.noise.expected, np.log(1.0 - PRIOR) + self.noise.beyond))

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (q, p) of whitened scores at points (q, n), and the emulator's variance."""
        (base,) = self.comparison.models
        _, mean, variance = base.predict(0.5 * (points + 1.0))
        return mean, variance

    def by_factor(self, points: FloatArray) -> FloatArray:
        """(f, q) logarithms of factors' beliefs times their likelihoods at points (q, n)."""
        mean, variance = self.predict(points)
        white = self.comparison.likelihood.white(self.noise.observed)
        log = self.comparison.likelihood.log(white - mean, variance, np.zeros((0, mean.shape[1])))
        return np.asarray(log + self.beliefs[:, None])

    def __call__(self, points: npt.ArrayLike) -> FloatArray:
        """(q,) at points (q, n); −∞ outside of the cube."""
        where = np.atleast_2d(np.asarray(points, dtype=np.float64))
        out = np.full(len(where), -np.inf)
        inside = np.all(np.abs(where) <= 1.0, axis=1)
        if inside.any():
            out[inside] = logsumexp(self.by_factor(where[inside]), axis=0)
        return out

    def replicates(self, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(q, p) scores that would be observed again at points (q, n), every source of doubt included."""
        mean, variance = self.predict(points)
        root = self.comparison.likelihood.root
        log = self.by_factor(points)
        share = np.exp(log - logsumexp(log, axis=0))
        scores = (mean + np.sqrt(variance) * rng.standard_normal(mean.shape)) @ root.T
        for row, weights in zip(scores, share.T, strict=True):
            covariance = self.noise.covariance(rng.choice(FACTORS, p=weights))
            row += rng.multivariate_normal(np.zeros(len(row)), covariance, method="eigh")
        return np.asarray(scores)

    def surprise(self, tables: FloatArray, points: FloatArray) -> FloatArray:
        """(q,) χ² per score of new simulations (q, t, s) at points (q, n): about 1 by what the emulator promised."""
        mean, variance = self.predict(points)
        white = self.comparison.likelihood.white
        chance = white(white(self.noise.chance).T)
        error = white(self.noise.scores(tables)) - mean
        covariance = chance + (variance[:, :, None] + 1e-9) * np.eye(mean.shape[1])
        return np.asarray(np.mean(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of the parameters.

    Attributes:
        density: that they are drawn from.
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


def summarise(posterior: Posterior, own: Sequence[Parameter]) -> dict[str, Any]:
    """A posterior in plain numbers, physical units and words.

    Args:
        posterior: of parameters whose bounds are those of the prior's box.
        own: the same parameters with their own bounds.
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
    """Of samples (k, n) in [-1, 1]: whether each parameter is determined, by its spread over the prior's."""
    return [
        "determined" if c < DETERMINED else "weakly determined" if c < UNDETERMINED else "not determined"
        for c in unit.std(axis=0) * np.sqrt(3.0)
    ]


def _marginal(posterior: Posterior, index: int, parameter: Parameter) -> dict[str, Any]:
    values, unit = posterior.values[:, index], posterior.unit[:, index]
    low, low50, median, high50, high = (float(q) for q in np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95]))
    space = posterior.density.prior.space
    # Compared on the axis that the prior is uniform on: the logarithmic one where the parameter is.
    contraction = float(unit.std() * np.sqrt(3.0))
    (verdict,) = verdicts(unit[:, None])
    bounds = Marginal(parameter, values, np.full(len(values), 1.0 / len(values))).at_bounds
    counts, edges = np.histogram(unit, bins=BINS, range=(-1.0, 1.0), density=True)
    ends = np.repeat(np.zeros((1, len(space))), BINS + 1, axis=0)
    ends[:, index] = edges
    return {
        "mean": float(values.mean()),
        "std": float(values.std(ddof=1)),
        "median": median,
        "low": low,
        "high": high,
        "low_50": low50,
        "high_50": high50,
        "unit": parameter.unit,
        "title": parameter.title,
        "bounds": [parameter.lower, parameter.upper],
        "contraction": contraction,
        "verdict": verdict,
        "at_bound": [] if verdict == "not determined" else bounds,
        # Density on the axis of the prior, whose own is 1 everywhere on it.
        "histogram": {"edges": space.from_unit(ends)[:, index].tolist(), "density": (2.0 * counts).tolist()},
    }


def notes(posterior: Posterior, parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What a reader must know before believing the numbers."""
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
