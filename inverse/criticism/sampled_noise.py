"""Noise as samples of it suggest: other seeds, other guesses, other numerics.

Such samples hold nothing but noise, and are few. So the law is plain and has few parameters: an empirical covariance
from as many raises false alarms by the dozen. What the law leaves out is noted where it matters, on slow waves and
along directions of interest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.optimize import minimize

from splatsoil.experiment.features import Layout

from .noise import Part, alive, in_space, in_time, orthonormal
from .scales import scales_of, spacing_of, varied
from .waves import smooth_waves

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MOST_MEMORY = 0.98
"""Largest correlation of neighbouring times."""
ROUNDS = 2
"""Of estimating scales and correlation in turn."""
NEARER = 0.3
"""First steps of looking for a correlation near that of the round before, in those of the first round."""
FEWEST_TO_JUDGE = 3
"""Samples from which each can be judged by the others."""
FEWEST_FREEDOM = 8.0
"""Least degrees of freedom of a part's variance: few samples scatter too little or too much by chance."""
OUTLYING = 9.0
"""Variance over that of the middle one beyond which a sample of a law that all follow counts as no farther out."""
SPARED = 0.1
"""Share of sites that a correlation may do without, where they weren't seen at neighbouring times."""
LEAST_BY_OTHERS = 1e-3
"""Share of a scale that is least believed of what the other samples give, where each may be of another kind."""


def estimate(
    layout: Layout,
    samples: FloatArray,
    seen: BoolArray,
    directions: FloatArray | None = None,
    free: FloatArray | None = None,
    *,
    alike: bool = True,
    known: Part | None = None,
) -> Part:
    """The part that samples (k, t, s) of it, with mean zero, suggest.

    See :mod:`.scales` for how large it is. The correlation's parameters maximise the Gaussian likelihood of the scaled
    samples, two neighbouring times at once (composite likelihood: Varin et al. 2011, Stat. Sinica 21:5).

    Such a part is too plain: soil that falls otherwise by chance does so where effects act, and other numerics change
    what is smooth. So how much more scores along slow waves and along directions (n, k) of interest scatter is noted,
    for `extra_noise`, once what ``free`` (n, q; times prior spreads) can take up is gone: a seed that acts like another
    friction angle is no noise where the angle is fitted. Where samples are ``alike``, draws of one law, one that is far
    out says something else than noise; where each is of its own kind, as other numerics are, it counts in full.

    ``known`` is what the same samples suggested along other directions.
    """
    samples = np.where(seen, samples, 0.0)
    if not np.any(samples):
        return Part(scale=np.zeros(layout.shape))
    if known is not None:
        return _calibrated(layout, known, samples, seen, directions, free, alike)
    # How far the variance's own scatter is chance depends on the correlation, which depends on the variance. Too much
    # memory at first: a scale that follows its few samples would hide what they have.
    part, best = Part(np.zeros(layout.shape), MOST_MEMORY, spacing_of(layout)), None
    for _ in range(ROUNDS):
        before = part.across(layout), in_time(layout.steps, part.memory)
        part, best = _correlated(layout, samples, seen, scales_of(layout, samples, seen, *before), best)
    return _calibrated(layout, part, samples, seen, directions, free, alike)


def correlated(layout: Layout, samples: FloatArray, seen: BoolArray, scale: FloatArray) -> Part:
    """The part of given scale (t, s) whose correlation samples (k, t, s) suggest where they were seen (t, s)."""
    return _correlated(layout, np.where(seen, samples, 0.0), seen, scale, None)[0]


def _calibrated(
    layout: Layout,
    part: Part,
    samples: FloatArray,
    seen: BoolArray,
    directions: FloatArray | None,
    free: FloatArray | None,
    alike: bool,
) -> Part:
    """The part, with what samples come to on slow waves and along directions.

    With three samples or more, each is judged by scales that the others give: a scale that is too small by chance
    weighs more than one that is too large, and a sample cannot show that of scales it has made itself.
    """
    across, times, count = part.across(layout), in_time(layout.steps, part.memory), len(samples)
    changed = alive(part, seen)
    directions, free = (None if columns is None else columns[changed[seen]] for columns in (directions, free))
    seen = changed
    waves = smooth_waves(layout, seen)
    waved, directed = list[float](), list[float]()
    for k in range(count):
        scale = part.scale
        if count >= FEWEST_TO_JUDGE:
            others = np.delete(samples, k, axis=0)
            # What but one sample changes has no scale by the others.
            least = part.scale * (1.0 / math.sqrt(count) if alike else LEAST_BY_OTHERS)
            scale = np.maximum(scales_of(layout, others, seen, across, times), least)
        solver = replace(part, scale=scale).solver(layout, seen)
        if free is not None:
            solver = solver.beside(free)
        left, sample = orthonormal(solver.whiten(waves * scale[seen][:, None])), solver.whiten(samples[k][seen])
        waved.append(float(np.mean((left.T @ sample) ** 2)))
        if directions is not None and directions.size:
            columns = solver.whiten(directions)
            shares = (columns.T @ sample) ** 2 / np.maximum(np.sum(columns**2, axis=0), 1e-300)
            directed.append(float(np.mean(shares)))
    on_waves, along = np.array(waved), np.array(directed)
    if alike:
        on_waves, along = (np.minimum(of, OUTLYING * np.median(of)) if of.size else of for of in (on_waves, along))
    factor = float(np.median(on_waves))
    # A mean of χ² over its ν degrees of freedom has the relative variance 2 / ν.
    doubt = float(np.var(on_waves, ddof=1)) / count / factor**2 if count > 1 and factor > 0.0 else 2.0
    return replace(
        part,
        on_waves=max(factor, 1.0),
        on_directions=max(float(np.mean(along)), 1.0) if along.size else 1.0,
        freedom=max(2.0 / max(doubt, 1e-12), FEWEST_FREEDOM),
    )


def _correlated(
    layout: Layout, samples: FloatArray, seen: BoolArray, scale: FloatArray, start: FloatArray | None
) -> tuple[Part, FloatArray]:
    """The part of given scale, with the correlation of samples that are 0 where nothing was seen, and where it was
    found; it is looked for from where another one was, if there is a ``start``."""
    # Where nothing is told apart scales are bounds, and samples over them far too small.
    telling = varied(layout, samples, seen, scale)
    scaled = np.divide(samples, scale, out=np.zeros_like(samples), where=telling)
    (memory, length, nugget, between), best = _correlation(layout, scaled, telling, start)
    return Part(scale, memory, length, nugget, between), best


def _correlation(
    layout: Layout, scaled: FloatArray, seen: BoolArray, start: FloatArray | None
) -> tuple[tuple[float, float, float, FloatArray], FloatArray]:
    """Memory, length, nugget and correlation between instruments that maximise the likelihood of scaled samples
    (k, t, s), whatever their size: scales are known too badly for that to tell a correlation. And where that is."""
    spacing, places = spacing_of(layout), bool(layout.placed.any())
    channels, number = len(layout.channels), layout.channel_numbers
    # Instruments with a place and those without are never correlated.
    placed = [bool(layout.placed[number == c].any()) for c in range(channels)]
    told = [bool(seen[:, number == c].any()) for c in range(channels)]
    pairs = [(a, b) for a in range(channels) for b in range(a) if placed[a] == placed[b] and told[a] and told[b]]
    blocks = _blocks(layout, scaled, seen)
    if not blocks:
        return (0.0, 0.0, 1.0, np.eye(channels)), np.zeros(3 + len(pairs))
    count = sum(block.pairs.size for block in blocks)

    def unpack(p: FloatArray) -> tuple[float, float, float, FloatArray]:
        memory = MOST_MEMORY / (1.0 + math.exp(-p[0]))
        length = spacing * math.exp(float(np.clip(p[1], -3.0, 4.0))) if places else 0.0
        nugget = 0.01 + 0.98 / (1.0 + math.exp(-p[2])) if places else 0.01
        between = np.eye(channels)
        for (a, b), value in zip(pairs, p[3:], strict=True):
            between[a, b] = between[b, a] = math.tanh(value)
        return memory, length, nugget, _valid(between)

    def loss(p: FloatArray) -> float:
        memory, length, nugget, between = unpack(p)
        whole = in_space(layout, length, nugget, between)
        squares, logs = np.sum([block.fit(whole, memory) for block in blocks], axis=0)
        return count * math.log(max(squares, 1e-300)) + float(logs)

    first, step = np.zeros(3 + len(pairs)), 1.0
    if start is not None and len(start) == len(first):
        first, step = start, NEARER
    options = {
        "maxfev": 120 + 40 * len(pairs),
        "xatol": 0.05,
        "fatol": 0.5,
        "initial_simplex": np.vstack([first, first + step * np.eye(len(first))]),
    }
    best = minimize(loss, first, method="Nelder-Mead", options=options).x
    return unpack(best), best


@dataclass(frozen=True)
class _Block:
    """Pairs of neighbouring times, at all of which the same sites were seen; or single times.

    Attributes:
        sites: (n,) their numbers.
        gaps: (p,) from one to the other of each pair, in steps; empty where there is but one time.
        pairs: (n, 2 p m) the sums of m samples at the first times and at the second ones, pair by pair, then the
            differences; (n, m) the samples where there is but one time.
    """

    sites: npt.NDArray[np.intp]
    gaps: FloatArray
    pairs: FloatArray

    def fit(self, whole: FloatArray, memory: float) -> tuple[float, float]:
        """χ² and logarithm of the determinant by a correlation (s, s) between sites."""
        lower, info = dpotrf(whole.take(self.sites, axis=0).take(self.sites, axis=1), lower=1, clean=0)
        if info:
            raise np.linalg.LinAlgError(f"a correlation between sites is not positive definite ({info})")
        logs = 2.0 * float(np.log(np.diag(lower)).sum())
        white, _ = dtrtrs(lower, self.pairs, lower=1)
        # columns are what lies in a row of memory
        squares, count = np.einsum("mn,mn->m", white.T, white.T), self.pairs.shape[1]
        if not len(self.gaps):
            return float(squares.sum()), logs * count
        # Sum and difference of two that are so correlated are independent.
        links = memory**self.gaps
        sums, differences = squares.reshape(2, len(links), -1).sum(axis=2)
        both = 0.5 * float((sums / (1.0 + links) + differences / (1.0 - links)).sum())
        share = self.pairs.size / (2.0 * len(links))
        return both, logs * count + share * float(np.log(1.0 - links**2).sum())


def _blocks(layout: Layout, scaled: FloatArray, seen: BoolArray) -> list[_Block]:
    """Pairs of neighbouring times, as far as the same sites were seen; or single times, where no two have any.

    Pairs that follow each other go together where they have all but `SPARED` of their sites in common: each block
    costs a decomposition, and the others of these sites say little more.
    """
    gaps, both = np.diff(layout.steps), seen[:-1] & seen[1:]
    alone = not both.any()
    groups: list[tuple[BoolArray, list[int], int]] = []
    for t, sites in enumerate(seen if alone else both):
        if not sites.any():
            continue
        shared, times, most = groups[-1] if groups else (sites, [], 0)
        most = max(most, int(sites.sum()))
        if times and np.count_nonzero(shared & sites) >= (1.0 - SPARED) * most:
            groups[-1] = (shared & sites, [*times, t], most)
        else:
            groups.append((sites, [t], int(sites.sum())))
    out = []
    for sites, times, _ in groups:
        first, second = (
            scaled[:, np.array(times) + on][:, :, sites].transpose(2, 1, 0).reshape(int(sites.sum()), -1)
            for on in (0, 0 if alone else 1)
        )
        pairs = first if alone else np.concatenate([first + second, first - second], axis=1)
        apart = gaps[:0] if alone else gaps[times]
        out.append(_Block(np.flatnonzero(sites), apart, np.asfortranarray(pairs)))
    return out


def _valid(correlation: FloatArray) -> FloatArray:
    """The nearest-looking correlation matrix whose eigenvalues are positive."""
    values, vectors = np.linalg.eigh(correlation)
    if values[0] > 1e-3:
        return correlation
    fixed = (vectors * np.maximum(values, 1e-3)) @ vectors.T
    root = np.sqrt(np.diag(fixed))
    return fixed / np.outer(root, root)
