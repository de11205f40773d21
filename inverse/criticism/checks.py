"""Posterior predictive checks by instrument, stage and region.

The statistic of a block of features is the mean square of the residual over its expectation. Its distribution for a
correct model comes from replicates of the noise (Gelman, Meng & Stern 1996, Stat. Sinica 6:733). The p-values are
adjusted for the number of blocks (Holm 1979, Scand. J. Stat. 6:65).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.base import Experiment

REPLICATES = 999
MIN_FEATURES = 4
"""Features that a block needs."""
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Check:
    """The check of one block.

    Attributes:
        stage, region, channel: of the block.
        ratio: root mean square of the residual over its expectation.
        p: adjusted p-value.
        n: number of features.
        amplitude: root mean square of the prediction over that of the measurement.
    """

    stage: str
    region: str
    channel: str
    ratio: float
    p: float
    n: int
    amplitude: float


@dataclass(frozen=True, eq=False)
class Expected:
    """The noise model, feature by feature: independent parts, each times a standard normal number.

    Attributes:
        sensor: (t, s) standard deviation of the instruments.
        fixed: (m, t, s) seed-to-seed scatter, unknown albedo, effects of observation.
        discretisation: (k, t, s) discretisation error.
        factor_std: standard deviation of the logarithm of a common factor of the discretisation error.
    """

    sensor: FloatArray
    fixed: FloatArray
    discretisation: FloatArray
    factor_std: float = 0.0

    @property
    def variance(self) -> FloatArray:
        """(t, s)."""
        return np.asarray(self.sensor**2 + np.sum(self.fixed**2, axis=0) + np.sum(self.discretisation**2, axis=0))

    def replicate(self, rng: np.random.Generator) -> FloatArray:
        """(t, s) a random residual of a correct model."""
        factor = np.exp(self.factor_std * np.abs(rng.standard_normal()))
        out = self.sensor * rng.standard_normal(self.sensor.shape)
        for parts, size in ((self.fixed, 1.0), (self.discretisation, factor)):
            out = out + size * np.tensordot(rng.standard_normal(len(parts)), parts, axes=1)
        return np.asarray(out)


def checks(
    experiment: Experiment, residual: FloatArray, expected: Expected, mask: BoolArray, seed: int = 0
) -> list[Check]:
    """Checks of a residual (t, s) where ``mask`` (t, s) is set, the smallest p-value first."""
    layout, rng = experiment.layout, np.random.default_rng([seed, 13])
    stages = np.broadcast_to(np.array(layout.stages)[:, None], mask.shape)[mask]
    channels = np.broadcast_to(np.array([s.channel for s in layout.sites]), mask.shape)[mask]
    labels = np.stack([stages, layout.regions[mask], channels], axis=1)
    inside = {tuple(map(str, key)): np.flatnonzero(np.all(labels == key, axis=1)) for key in np.unique(labels, axis=0)}
    blocks = {key: index for key, index in inside.items() if len(index) >= MIN_FEATURES}
    variance = expected.variance[mask]

    def statistics(table: FloatArray) -> FloatArray:
        squares = table[mask] ** 2
        return np.array([squares[index].sum() / variance[index].sum() for index in blocks.values()])

    own = statistics(residual)
    replicates = np.array([statistics(expected.replicate(rng)) for _ in range(REPLICATES)])
    p = (1.0 + np.sum(replicates >= own, axis=0)) / (1.0 + REPLICATES)
    order, adjusted = np.argsort(p), np.ones(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    measured = experiment.observed[mask]
    predicted = measured - residual[mask]
    found = []
    for ((stage, region, channel), index), ratio, value in zip(blocks.items(), np.sqrt(own), adjusted, strict=True):
        amplitude = np.linalg.norm(predicted[index]) / np.maximum(np.linalg.norm(measured[index]), 1e-12)
        found.append(Check(stage, region, channel, float(ratio), float(value), len(index), float(amplitude)))
    return sorted(found, key=lambda c: (c.p, -c.ratio))


def passes(found: list[Check]) -> bool:
    """Whether no check fails."""
    return all(check.p >= SIGNIFICANT for check in found)
