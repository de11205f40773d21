"""Detectable size of an effect: a power analysis on synthetic observations from its emulator."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import logsumexp

from splatsoil.arrays import FloatArray
from splatsoil.experiment.base import Candidate

from .evidence import BASE_MODEL, BASE_PRIOR, Comparison, Evidence

POWER = 0.8
NAMED = 0.9
"""Posterior probability from which a model is named."""
SIZES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Over the smallest meaningful size."""
OBSERVATIONS = 40
"""Synthetic observations of each size."""
THINNING = 4
"""Step through the prior's points and the factors of the discretisation error."""
SIZE_TOLERANCE = 1.5
"""Factor within which a point has a size."""


def detectable(comparison: Comparison, evidence: Evidence, candidate: Candidate, seed: int = 0) -> float | None:
    """Smallest of `SIZES` at which the effect is named in 80 % of synthetic observations, with the base model as the
    only alternative; None where there is none.

    Args:
        comparison: emulators.
        evidence: of the real observation; base parameters are drawn from its posterior.
        candidate: the effect.
        seed: of the synthetic observations.
    """
    models = {m.name: (*m.prior[1], m.pattern) for m in comparison.models}
    if candidate.name not in models:
        return None
    rng = np.random.default_rng([seed, 17])
    values, mean, variance, pattern = models[candidate.name]
    base, measure = models[BASE_MODEL], candidate.measure
    odds = np.log(BASE_PRIOR / ((1.0 - BASE_PRIOR) / len(evidence.probability)) * NAMED / (1.0 - NAMED))
    for size in SIZES:
        if len(pattern):
            direction = rng.standard_normal((OBSERVATIONS, len(pattern)))
            direction *= size / np.linalg.norm(direction, axis=1, keepdims=True)
            likely = _density(base[0], evidence)
            chosen = rng.choice(len(likely), OBSERVATIONS, p=likely / likely.sum())
            truth = base[1][chosen] + direction @ pattern
        else:
            reached = np.abs(values[measure.name] - float(measure.off or 0.0)) / measure.meaningful
            near = np.flatnonzero((reached > size / SIZE_TOLERANCE) & (reached < size * SIZE_TOLERANCE))
            weight = _density(values, evidence)[near]
            if not weight.sum() > 0.0:
                continue
            chosen = rng.choice(near, OBSERVATIONS, p=weight / weight.sum())
            truth = mean[chosen] + np.sqrt(variance[chosen]) * rng.standard_normal((OBSERVATIONS, mean.shape[1]))
        observations = truth + rng.standard_normal(truth.shape)
        gains = [
            _log_evidence(comparison, observed, mean, variance, pattern)
            - _log_evidence(comparison, observed, *base[1:])
            for observed in observations
        ]
        if np.sum(np.array(gains) > odds) >= POWER * OBSERVATIONS:
            return size
    return None


def _density(values: Mapping[str, FloatArray], evidence: Evidence) -> FloatArray:
    """(q,) density of the averaged posterior at base parameters (q,) by name, taken as normal, up to a constant."""
    z2 = np.array(0.0)
    for name in evidence.models[BASE_MODEL].values:
        averaged = evidence.marginal(name)
        z2 = z2 + ((values[name] - averaged.mean) / max(averaged.std, 1e-12)) ** 2
    return np.asarray(np.exp(-0.5 * np.minimum(z2, 60.0)))


def _log_evidence(
    comparison: Comparison, observed: FloatArray, mean: FloatArray, variance: FloatArray, pattern: FloatArray
) -> float:
    thin = slice(None, None, THINNING)
    log = comparison.likelihood.log(observed - mean[thin], variance[thin], pattern, every=THINNING)
    return float(logsumexp(log + comparison.noise.log_prior[::THINNING, None])) - float(np.log(log.shape[1]))
