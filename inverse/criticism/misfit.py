"""Is there a misfit at all, and where? Tests that know nothing of effects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, f

from splatsoil.experiment.features import Layout

from .noise import Noise, Solver
from .waves import smooth_waves

FloatArray = npt.NDArray[np.float64]

DRAWS = 1000
FEWEST = 4
"""Features that a block needs."""


@dataclass(frozen=True)
class Omnibus:
    """Whether something smooth is left.

    Attributes:
        statistic: χ² of the remainder on a smooth basis.
        freedom: its degrees of freedom.
        p: chance of more, with nothing wrong.
    """

    statistic: float
    freedom: int
    p: float

    @property
    def dispersion(self) -> float:
        """χ² over its degrees of freedom: 1 where nothing is wrong."""
        return self.statistic / max(self.freedom, 1)

    @property
    def excess(self) -> float:
        """χ² beyond what chance leaves."""
        return max(self.statistic - self.freedom, 0.0)


def smooth_basis(layout: Layout, noise: Noise) -> FloatArray:
    """(n, k) slow waves in units of each feature's noise."""
    return smooth_waves(layout, noise.seen) * noise.scale[:, None]


def omnibus(noise: Noise, nuisance: FloatArray, residual: FloatArray, basis: FloatArray) -> Omnibus:
    """χ² of a residual (n,) on a basis (n, k), with nuisances (n, q; times their prior std) projected out.

    The noise's size is itself known from a few samples only, so the statistic over its degrees of freedom is F.
    """
    solver = noise.solver.beside(nuisance)
    white = solver.whiten(basis)
    left, singular, _ = np.linalg.svd(white, full_matrices=False)
    left = left[:, singular > 1e-6 * singular[0]]
    statistic = float(np.sum((left.T @ solver.whiten(residual)) ** 2))
    freedom = left.shape[1]
    if not math.isfinite(noise.freedom):
        return Omnibus(statistic, freedom, float(chi2.sf(statistic, freedom)))
    return Omnibus(statistic, freedom, float(f.sf(statistic / max(freedom, 1), freedom, noise.freedom)))


@dataclass(frozen=True)
class Block:
    """A part of the data and how far it is from the prediction.

    Attributes:
        stage, region, channel: which part; an empty word means all of them.
        ratio: root mean square of the residual over that of noise alone: 1 where nothing is wrong.
        p: chance that it is as far off, of a part that any of them is, with nothing wrong.
        features: how many it holds.
    """

    stage: str
    region: str
    channel: str
    ratio: float
    p: float
    features: int


def blocks(
    layout: Layout, noise: Noise, nuisance: FloatArray, residual: FloatArray, *, seed: int = 0
) -> tuple[Block, tuple[Block, ...]]:
    """The whole of the data, and parts of it, the worst first, these calibrated together on draws of the noise (max-T).

    Of the residual (n,) counts what parameters and nuisances (n, q) cannot take up.
    """
    bare = noise.solver
    gain = _gain(bare, nuisance)
    generator = np.random.default_rng(seed)
    draws = _project(nuisance, gain, bare.sample(generator, DRAWS) + _drawn(nuisance, generator))
    rest = _project(nuisance, gain, residual[:, None])[:, 0]
    squares, of_noise = (rest / noise.scale) ** 2, (draws / noise.scale[:, None]) ** 2
    labels = _labels(layout, noise)
    keys = sorted(set(labels))
    found, worst = [], np.full(DRAWS, -np.inf)
    for key in keys:
        mine = np.array([label == key for label in labels])
        if mine.sum() < FEWEST:
            continue
        null = of_noise[mine].mean(axis=0)
        # Logarithms of mean squares are near normal, whatever the block's size.
        middle, spread = float(np.log(null).mean()), float(np.log(null).std())
        value = squares[mine].mean()
        worst = np.maximum(worst, (np.log(null) - middle) / spread)
        found.append((key, float(np.log(max(value, 1e-300)) - middle) / spread, value / null.mean(), int(mine.sum())))
    parts = [
        Block(*key, ratio=float(np.sqrt(ratio)), p=_chance(worst, t), features=count) for key, t, ratio, count in found
    ]
    value, null = float(squares.mean()), of_noise.mean(axis=0)
    whole = Block("", "", "", float(np.sqrt(value / null.mean())), _chance(null, value), len(squares))
    return whole, tuple(sorted(parts, key=lambda b: (b.p, -b.ratio)))


def _chance(null: FloatArray, value: float) -> float:
    """Of being as large as a value, by draws with nothing wrong."""
    return float((1 + np.sum(null >= value)) / (1 + len(null)))


def shares(layout: Layout, noise: Noise, contributions: FloatArray) -> dict[tuple[str, str, str], float]:
    """Sum of contributions (n,) in each (stage, region, channel)."""
    out: dict[tuple[str, str, str], float] = {}
    for label, value in zip(_labels(layout, noise), contributions, strict=True):
        out[label] = out.get(label, 0.0) + float(value)
    return out


def left_over(noise: Noise, nuisance: FloatArray, residual: FloatArray) -> FloatArray:
    """(n,) what parameters and nuisances cannot take up of a residual."""
    bare = noise.solver
    return _project(nuisance, _gain(bare, nuisance), residual[:, None])[:, 0]


def _labels(layout: Layout, noise: Noise) -> list[tuple[str, str, str]]:
    rows, columns = np.nonzero(noise.seen)
    return [
        (layout.stages[t], str(layout.regions[t, s]), layout.sites[s].channel)
        for t, s in zip(rows, columns, strict=True)
    ]


def _gain(bare: Solver, nuisance: FloatArray) -> FloatArray:
    """(q, n) the nuisances' best amplitudes by residual."""
    if not nuisance.size:
        return np.zeros((0, len(nuisance)))
    solved = bare.solve(nuisance)
    return np.asarray(np.linalg.solve(nuisance.T @ solved + np.eye(nuisance.shape[1]), solved.T), dtype=np.float64)


def _project(nuisance: FloatArray, gain: FloatArray, columns: FloatArray) -> FloatArray:
    return columns - nuisance @ (gain @ columns) if nuisance.size else columns


def _drawn(nuisance: FloatArray, generator: np.random.Generator) -> FloatArray:
    if not nuisance.size:
        return np.zeros((len(nuisance), DRAWS))
    return nuisance @ generator.standard_normal((nuisance.shape[1], DRAWS))
