"""Which sizes of an effect would have been seen: synthetic observations from its emulator, judged like the real one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from splatsoil.experiment.base import Candidate

from .evidence import AS_IT_IS, PRIOR, Comparison, Evidence

FloatArray = npt.NDArray[np.float64]

POWER = 0.8
NAMED = 0.9
"""Probability from which an effect is named."""
SIZES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Over the smallest meaningful one."""
WORLDS = 40
THINNED = 4
"""Of the sequence's points and of the numerics' factors, every so many serve here."""
NEAR = 1.5
"""Factor within which a point's size is taken for a size asked for."""


def detectable(comparison: Comparison, evidence: Evidence, candidate: Candidate, seed: int = 0) -> float | None:
    """Smallest size over the meaningful one, of `SIZES`, from which 80 % of synthetic worlds name the effect, the base
    model being the only other one; None where none is.

    Args:
        comparison: emulators.
        evidence: of the observation: synthetic worlds have base parameters of its posterior.
        candidate: the effect.
        seed: of the worlds.
    """
    models = {m.name: (*m.prior[1], m.pattern) for m in comparison.models}
    if candidate.name not in models:
        return None
    rng = np.random.default_rng([seed, 17])
    values, mean, variance, pattern = models[candidate.name]
    base, measure = models[AS_IT_IS], candidate.measure
    odds = np.log(PRIOR / ((1.0 - PRIOR) / len(evidence.probability)) * NAMED / (1.0 - NAMED))
    for size in SIZES:
        if len(pattern):
            direction = rng.standard_normal((WORLDS, len(pattern)))
            direction *= size / np.linalg.norm(direction, axis=1, keepdims=True)
            likely = _density(base[0], evidence)
            chosen = rng.choice(len(likely), WORLDS, p=likely / likely.sum())
            truth = base[1][chosen] + direction @ pattern
        else:
            reached = np.abs(values[measure.name] - float(measure.off or 0.0)) / measure.meaningful
            near = np.flatnonzero((reached > size / NEAR) & (reached < size * NEAR))
            weight = _density(values, evidence)[near]
            if not weight.sum() > 0.0:
                continue
            chosen = rng.choice(near, WORLDS, p=weight / weight.sum())
            truth = mean[chosen] + np.sqrt(variance[chosen]) * rng.standard_normal((WORLDS, mean.shape[1]))
        worlds = truth + rng.standard_normal(truth.shape)
        gains = [
            _evidence(comparison, world, mean, variance, pattern) - _evidence(comparison, world, *base[1:])
            for world in worlds
        ]
        if np.sum(np.array(gains) > odds) >= POWER * WORLDS:
            return size
    return None


def _density(values: Mapping[str, FloatArray], evidence: Evidence) -> FloatArray:
    """(q,) how well base parameters at an effect's points agree with the averaged posterior."""
    z2 = np.array(0.0)
    for name in evidence.models[AS_IT_IS].values:
        averaged = evidence.marginal(name)
        z2 = z2 + ((values[name] - averaged.mean) / max(averaged.std, 1e-12)) ** 2
    return np.asarray(np.exp(-0.5 * np.minimum(z2, 60.0)))


def _evidence(
    comparison: Comparison, world: FloatArray, mean: FloatArray, variance: FloatArray, pattern: FloatArray
) -> float:
    thin = slice(None, None, THINNED)
    log = comparison.likelihood.log(world - mean[thin], variance[thin], pattern, every=THINNED)
    return float(logsumexp(log + comparison.noise.expected[::THINNED, None])) - float(np.log(log.shape[1]))
