"""Posterior predictive checks: by instrument, stage and region, is the observation like what the model would give?

The statistic of a block is its mean square over what is expected of that; replicates drawn from the noise say
how large it would be with nothing wrong (Gelman, Meng & Stern 1996, Stat. Sinica 6:733). Over blocks p is adjusted
(Holm 1979, Scand. J. Stat. 6:65).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Experiment

FloatArray = npt.NDArray[np.float64]

DRAWS = 999
FEWEST = 4
"""Features that make a block."""
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Check:
    """One block.

    Attributes:
        stage, region, channel: what it is.
        ratio: root mean square of the residual over what is expected.
        p: chance of as much with nothing wrong, in any block.
        n: features in it.
    """

    stage: str
    region: str
    channel: str
    ratio: float
    p: float
    n: int


@dataclass(frozen=True, eq=False)
class Expected:
    """What a residual is made of with nothing wrong, feature by feature.

    Attributes:
        sensor: (t, s) standard deviation of instruments.
        fixed: (m, t, s) chance, guesses and effects of observation: independent parts, each of a standard normal size.
        numerics: (k, t, s) the model's own error, likewise.
        doubt: standard deviation of the logarithm of a factor of that, drawn anew for each replicate.
    """

    sensor: FloatArray
    fixed: FloatArray
    numerics: FloatArray
    doubt: float = 0.0

    @property
    def variance(self) -> FloatArray:
        """(t, s)."""
        return np.asarray(self.sensor**2 + np.sum(self.fixed**2, axis=0) + np.sum(self.numerics**2, axis=0))

    def replicate(self, rng: np.random.Generator) -> FloatArray:
        """(t, s) a residual."""
        factor = np.exp(self.doubt * np.abs(rng.standard_normal()))
        out = self.sensor * rng.standard_normal(self.sensor.shape)
        for parts, size in ((self.fixed, 1.0), (self.numerics, factor)):
            out = out + size * np.tensordot(rng.standard_normal(len(parts)), parts, axes=1)
        return np.asarray(out)


def checks(
    experiment: Experiment, residual: FloatArray, expected: Expected, mask: npt.NDArray[np.bool_], seed: int = 0
) -> list[Check]:
    """Every block of a residual (t, s), the most surprising first."""
    layout, rng = experiment.layout, np.random.default_rng([seed, 13])
    stages = np.broadcast_to(np.array(layout.stages)[:, None], mask.shape)[mask]
    channels = np.broadcast_to(np.array([s.channel for s in layout.sites]), mask.shape)[mask]
    labels = np.stack([stages, layout.regions[mask], channels], axis=1)
    inside = {tuple(map(str, key)): np.flatnonzero(np.all(labels == key, axis=1)) for key in np.unique(labels, axis=0)}
    blocks = {key: index for key, index in inside.items() if len(index) >= FEWEST}
    variance = expected.variance[mask]

    def statistics(table: FloatArray) -> FloatArray:
        squares = table[mask] ** 2
        return np.array([squares[index].sum() / variance[index].sum() for index in blocks.values()])

    own = statistics(residual)
    replicates = np.array([statistics(expected.replicate(rng)) for _ in range(DRAWS)])
    p = (1.0 + np.sum(replicates >= own, axis=0)) / (1.0 + DRAWS)
    order, adjusted = np.argsort(p), np.ones(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    found = [
        Check(stage, region, channel, float(ratio), float(chance), len(index))
        for ((stage, region, channel), index), ratio, chance in zip(blocks.items(), np.sqrt(own), adjusted, strict=True)
    ]
    return sorted(found, key=lambda c: (c.p, -c.ratio))


def passes(found: list[Check]) -> bool:
    """Whether no block stands out."""
    return all(check.p >= SIGNIFICANT for check in found)
