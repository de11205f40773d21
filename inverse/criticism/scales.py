"""How large noise is, feature by feature, from few samples of it.

Standard deviations range over three decades where soil moves in one place and lies still beside it, and four samples of
a place say little. So the logarithm of the variance is estimated in three levels, each drawn to the one before as far
as samples scatter by chance (empirical Bayes: Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3:3): of an instrument, of a
neighbourhood in time and space, of a place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import digamma, polygamma

from splatsoil.experiment.features import Layout

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

IN_TIME = 2.0
"""Width of a neighbourhood in steps of time."""
IN_SPACE = 0.6
"""Width of a neighbourhood in spacings of sites: disturbed soil has sharp edges."""
LEAST = 1e-4
"""Share of an instrument's mean variance below which nothing is told apart."""
ABOVE = 4.0
"""How much larger a variance has to be to count as told."""


def scales_of(
    layout: Layout, samples: FloatArray, seen: BoolArray, across: FloatArray, in_time: FloatArray
) -> FloatArray:
    """(t, s) standard deviations.

    Args:
        layout: of the features.
        samples: (k, t, s) with mean zero; zeros where nothing was seen.
        seen: (t, s).
        across: (s, s) correlation between sites.
        in_time: (t, t) correlation between times.
    """
    squares = np.mean(samples**2, axis=0)
    pooled = _of_instruments(layout, squares, seen)
    least, changed = LEAST * pooled, _changed(pooled, seen)
    near_in_time, near_in_space = _neighbours(layout)
    variance = pooled
    for near in (near_in_space, np.eye(layout.shape[1])):
        share = near_in_time @ seen.astype(float) @ near.T
        local = (near_in_time @ squares @ near.T) / np.maximum(share, 1e-9)
        local = np.maximum(np.where(share > 1e-6, local, variance), least)
        # Degrees of freedom of a mean of squares whose terms are correlated; of their logarithm, bias and variance.
        held = np.sum(near_in_time @ in_time**2 * near_in_time, axis=1).mean()
        held *= np.sum(near @ across**2 * near, axis=1).mean()
        half = 0.5 * len(samples) / float(held)
        chance = float(polygamma(1, half))
        relative = np.log(local / variance) - (digamma(half) - np.log(half))
        told = relative[changed]
        spread = float(np.var(told)) if told.size else 0.0
        kept = max(0.0, 1.0 - chance / spread) if spread > 0.0 else 0.0
        middle = float(np.mean(told)) if told.size else 0.0
        variance = variance * np.exp(middle + kept * (relative - middle))
    # The logarithm's mean lies below the mean's logarithm: keep each instrument's total.
    for mine in _instruments(layout):
        total = (variance * seen)[:, mine].sum()
        variance[:, mine] *= squares[:, mine].sum() / max(total, 1e-300) if total > 0.0 else 1.0
    return np.sqrt(np.maximum(variance, 1e-300))


def varied(layout: Layout, samples: FloatArray, seen: BoolArray, scale: FloatArray) -> BoolArray:
    """(t, s) features whose scale is larger than the least."""
    pooled = _of_instruments(layout, np.mean(samples**2, axis=0), seen)
    return _changed(pooled, seen) & (scale**2 > ABOVE * LEAST * pooled)


def _changed(pooled: FloatArray, seen: BoolArray) -> BoolArray:
    """Features of instruments that changed: one that stays the same in all samples (a force, drawn otherwise) says
    nothing of how others vary."""
    return seen & (pooled > 1e-9 * float(pooled.max()))


def _neighbours(layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Weights (t, t) and (s, s) of local means, Gaussian in time and space, each instrument's for itself."""
    steps = layout.steps
    in_time = np.exp(-0.5 * (np.subtract.outer(steps, steps) / IN_TIME) ** 2)
    in_time /= in_time.sum(axis=1, keepdims=True)
    channel = layout.channel_numbers
    same = channel[:, None] == channel[None]
    in_space = np.where(same, np.exp(-0.5 * (layout.distances / (IN_SPACE * spacing_of(layout))) ** 2), 0.0)
    in_space /= in_space.sum(axis=1, keepdims=True)
    return in_time, in_space


def spacing_of(layout: Layout) -> float:
    """Median distance of a site to its nearest neighbour of the same instrument, m."""
    channel = layout.channel_numbers
    distance = layout.distances + np.where(channel[:, None] == channel[None], 0.0, np.inf)
    distance[distance == 0.0] = np.inf
    nearest = distance.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if nearest.size else 1.0


def _instruments(layout: Layout) -> list[BoolArray]:
    return [layout.channel_numbers == c for c in range(len(layout.channels))]


def _of_instruments(layout: Layout, squares: FloatArray, seen: BoolArray) -> FloatArray:
    """(t, s) mean square of each instrument."""
    pooled = np.zeros(layout.shape)
    for mine in _instruments(layout):
        pooled[:, mine] = squares[:, mine].sum() / max(int(seen[:, mine].sum()), 1)
    return np.maximum(pooled, 1e-12 * max(float(pooled.max()), 1e-300))
