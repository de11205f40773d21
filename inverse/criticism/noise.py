"""Noise of features: what differs between observation and prediction although nothing is wrong with the model.

The covariance is a sum of parts, each separable: a scale for each feature, AR(1) in time, a correlation between
instruments and a Matérn-3/2 correlation in space with a nugget. Parts are estimated from samples that hold nothing but
noise (other seeds, other numerics), with few parameters, because the samples are few: an empirical covariance from as
many raises false alarms by the dozen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from splatsoil.experiment.features import Layout

from .waves import smooth_waves

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MOST_MEMORY = 0.98
"""Largest correlation of neighbouring times."""
FEWEST_TO_JUDGE = 3
"""Samples from which each can be judged by the others."""
MEMORY_OF_SCALE = 2.0
"""Width of the local mean of variances in steps of time."""
REACH = 0.6
"""Width of the local mean of variances, in spacings of sites: disturbed soil has sharp edges."""
FEWEST_FREEDOM = 8.0
"""Least degrees of freedom of a part's variance: few samples scatter too little or too much by chance."""
STILL = 1e-4
"""Share of the largest standard deviation below which a feature isn't changed at all."""
FARTHEST = 500.0
"""Distance over a correlation's length at which nothing is left of it."""
RIDGE = 1e-6
"""Added to the diagonal of a correlation, for its Cholesky factor's sake."""


@dataclass(frozen=True)
class Part:
    """One separable part of a covariance.

    Attributes:
        scale: (t, s) standard deviations.
        memory: correlation of neighbouring times.
        length: of the Matérn correlation, m; 0 for none.
        nugget: share of the variance that is not correlated in space.
        between: (c, c) correlation between instruments.
        on_waves: factor on the variance of slow waves, beyond what all of this gives there.
        on_directions: the same along directions of interest.
        freedom: degrees of freedom that the variance on slow waves is known with.
    """

    scale: FloatArray
    memory: float = 0.0
    length: float = 0.0
    nugget: float = 0.0
    between: FloatArray | None = None
    on_waves: float = 1.0
    on_directions: float = 1.0
    freedom: float = math.inf

    def correlation(self, layout: Layout) -> FloatArray:
        """(t s, t s) correlation of the features."""
        return np.asarray(np.kron(_time(layout.steps, self.memory), self.across(layout)), dtype=np.float64)

    def across(self, layout: Layout) -> FloatArray:
        """(s, s) correlation between sites at one time."""
        return _space(layout, self.length, self.nugget, self.between)

    def covariance(self, layout: Layout) -> FloatArray:
        """(t s, t s) covariance."""
        scale = self.scale.reshape(-1)
        return scale[:, None] * self.correlation(layout) * scale[None]


def independent(scale: FloatArray, memory: float = 0.0) -> Part:
    """Noise of instruments: independent between sites."""
    return Part(scale=scale, memory=memory, nugget=1.0)


def estimate(
    layout: Layout,
    samples: FloatArray,
    seen: BoolArray,
    directions: FloatArray | None = None,
    free: FloatArray | None = None,
) -> Part:
    """The part that samples (k, t, s) of it, with mean zero, suggest.

    Scales are pooled over each instrument, and vary over time and place as far as the samples show that they do more
    than chance would (empirical Bayes on the logarithm of the variance). The correlation's parameters maximise the
    Gaussian likelihood of the scaled samples.

    Such a part is too plain: soil that falls otherwise by chance does so where effects act, and other numerics change
    what is smooth. So how much more scores along slow waves and along directions (n, k) of interest scatter is noted,
    for `extra_noise`, once what ``free`` (n, q; times prior spreads) can take up is gone: a seed that acts like another
    friction angle is no noise where the angle is fitted.
    """
    samples = np.where(seen, samples, 0.0)
    if not np.any(samples):
        return Part(scale=np.zeros(layout.shape))
    scale = _scales(layout, samples, seen, across=None, memory=0.0)
    part = _correlation(layout, np.where(seen, samples / scale, 0.0), scale)
    # How far the variance's own scatter is chance depends on the correlation, which depends on the variance: twice.
    scale = _scales(layout, samples, seen, across=part.across(layout), memory=part.memory)
    part = _correlation(layout, np.where(seen, samples / scale, 0.0), scale, part)
    return _calibrated(layout, part, samples, seen, directions, free)


def correlated(layout: Layout, samples: FloatArray, scale: FloatArray) -> Part:
    """The part of given scale (t, s) whose correlation samples (k, t, s) suggest; zeros stand for what wasn't seen."""
    return _correlation(layout, samples / np.maximum(scale, 1e-300), scale)


def _calibrated(
    layout: Layout,
    part: Part,
    samples: FloatArray,
    seen: BoolArray,
    directions: FloatArray | None,
    free: FloatArray | None,
) -> Part:
    """The part, with what samples come to on slow waves and along directions.

    With three samples or more, each is judged by scales that the others give: a scale that is too small by chance
    weighs more than one that is too large, and a sample cannot show that of scales it has made itself.
    """
    across, count = part.across(layout), len(samples)
    alive = _alive(part, seen)
    directions, free = (None if columns is None else columns[alive[seen]] for columns in (directions, free))
    seen = alive
    waves = smooth_waves(layout, seen)
    on_waves, along = [], []
    for k in range(count):
        scale = part.scale
        if count >= FEWEST_TO_JUDGE:
            others = np.delete(samples, k, axis=0)
            scale = _scales(layout, others, seen, across=across, memory=part.memory)
        noise = Noise.of(layout, [(1.0, replace(part, scale=scale))], seen)
        solver = (noise if free is None else noise.plus(free)).solver()
        left, _ = np.linalg.qr(solver.whiten(waves * noise.scale[:, None]))
        sample = solver.whiten(samples[k][seen])
        on_waves.append(np.mean((left.T @ sample) ** 2))
        if directions is not None and directions.size:
            columns = solver.whiten(directions)
            along.append(np.mean((columns.T @ sample) ** 2 / np.maximum(np.sum(columns**2, axis=0), 1e-300)))
    # One sample that is far larger than the others there says that it is another kind of thing.
    factor = float(np.median(on_waves))
    # A mean of χ² over its ν degrees of freedom has the relative variance 2 / ν.
    doubt = float(np.var(on_waves, ddof=1)) / count / factor**2 if count > 1 and factor > 0.0 else 2.0
    return replace(
        part,
        on_waves=max(factor, 1.0),
        on_directions=max(float(np.mean(along)), 1.0) if along else 1.0,
        freedom=max(2.0 / max(doubt, 1e-12), FEWEST_FREEDOM),
    )


def extra_noise(layout: Layout, part: Part, seen: BoolArray, directions: FloatArray | None = None) -> FloatArray:
    """(n, r) low-rank noise by which a part has the variance that was found on slow waves and along directions (n, k).

    Everywhere else the part's own stays as it is.
    """
    if not np.any(part.scale[seen]):
        return np.zeros((int(seen.sum()), 0))
    alive = _alive(part, seen)
    noise = Noise.of(layout, [(1.0, part)], alive)
    solver = noise.solver()
    nothing = np.zeros((int(alive.sum()), 0))
    chosen = orthonormal(solver.whiten(nothing if directions is None else directions[alive[seen]]))
    waves = solver.whiten(smooth_waves(layout, alive) * noise.scale[:, None])
    waves = orthonormal(waves - chosen @ (chosen.T @ waves))
    parts = [math.sqrt(part.on_directions - 1.0) * chosen, math.sqrt(part.on_waves - 1.0) * waves]
    columns = np.tril(solver.factor[0]) @ np.concatenate(parts, axis=1)
    out = np.zeros((int(seen.sum()), columns.shape[1]))
    out[alive[seen]] = columns
    return out


def _alive(part: Part, seen: BoolArray) -> BoolArray:
    """(t, s) features that a part changes: other guesses of colours leave forces as they are, and what acts on these
    would hide all that acts on pictures."""
    return seen & (part.scale > STILL * float(part.scale[seen].max()))


def orthonormal(columns: FloatArray) -> FloatArray:
    """(n, r) of the span of columns (n, k), whatever their lengths."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)]
    if not columns.size:
        return np.zeros((len(columns), 0))
    left, singular, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    return np.asarray(left[:, singular > 1e-6 * singular[0]])


def _scales(
    layout: Layout, samples: FloatArray, seen: BoolArray, across: FloatArray | None, memory: float
) -> FloatArray:
    """(t, s) standard deviations."""
    squares = np.mean(samples**2, axis=0)
    channel = layout.channel_numbers
    pooled = np.zeros(layout.shape)
    for c in range(len(layout.channels)):
        mine = channel == c
        weight = seen[:, mine].sum()
        pooled[:, mine] = squares[:, mine].sum() / max(weight, 1)
    pooled = np.maximum(pooled, 1e-12 * max(float(pooled.max()), 1e-300))
    in_time, in_space = _neighbours(layout)
    share = in_time @ seen.astype(float) @ in_space.T
    local = (in_time @ squares @ in_space.T) / np.maximum(share, 1e-9)
    local = np.maximum(np.where(share > 1e-6, local, pooled), 1e-4 * pooled)
    # Degrees of freedom of a local mean of squares whose terms are correlated.
    time = _time(layout.steps, memory)
    space = np.eye(layout.shape[1]) if across is None else across
    held = np.einsum("ij,ik,jk->i", in_time, in_time, time**2).mean()
    held *= np.einsum("ij,ik,jk->i", in_space, in_space, space**2).mean()
    freedom = samples.shape[0] / held
    # An instrument that stays the same in all samples (a force, drawn otherwise) says nothing of how others' vary.
    varied = seen & (pooled > 1e-9 * float(pooled.max()))
    relative = np.log(local / pooled)[varied]
    spread = float(np.var(relative)) if relative.size else 0.0
    kept = max(0.0, 1.0 - (2.0 / freedom) / spread) if spread > 0.0 else 0.0
    variance = pooled * np.exp(kept * np.log(local / pooled))
    # The logarithm's mean lies below the mean's logarithm: keep each instrument's total.
    for c in range(len(layout.channels)):
        mine = channel == c
        total = (variance * seen)[:, mine].sum()
        variance[:, mine] *= squares[:, mine].sum() / max(total, 1e-300) if total > 0.0 else 1.0
    return np.sqrt(np.maximum(variance, 1e-300))


def _neighbours(layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Weights (t, t) and (s, s) of local means, Gaussian in time and space."""
    steps = layout.steps
    in_time = np.exp(-0.5 * (np.subtract.outer(steps, steps) / MEMORY_OF_SCALE) ** 2)
    in_time /= in_time.sum(axis=1, keepdims=True)
    distance, spacing = layout.distances, _spacing(layout)
    channel = layout.channel_numbers
    same = channel[:, None] == channel[None]
    in_space = np.where(same, np.exp(-0.5 * (distance / (REACH * spacing)) ** 2), 0.0)
    in_space /= in_space.sum(axis=1, keepdims=True)
    return in_time, in_space


def _spacing(layout: Layout) -> float:
    """Median distance of a site to its nearest neighbour of the same instrument, m."""
    channel = layout.channel_numbers
    distance = layout.distances + np.where(channel[:, None] == channel[None], 0.0, np.inf)
    distance[distance == 0.0] = np.inf
    nearest = distance.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if nearest.size else 1.0


def _correlation(layout: Layout, scaled: FloatArray, scale: FloatArray, start: Part | None = None) -> Part:
    """Parameters of the correlation that maximise the likelihood of scaled samples (k, t, s)."""
    spacing, places = _spacing(layout), layout.placed.any()
    channels, number = len(layout.channels), layout.channel_numbers
    # Instruments with a place and those without are never correlated.
    placed = [bool(layout.placed[number == c].any()) for c in range(channels)]
    pairs = [(a, b) for a in range(channels) for b in range(a) if placed[a] == placed[b]]
    times, sites = layout.shape

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
        lower_t = np.linalg.cholesky(_time(layout.steps, memory))
        lower_s = np.linalg.cholesky(_space(layout, length, nugget, between))
        white = solve_triangular(lower_t, scaled.transpose(1, 0, 2).reshape(times, -1), lower=True)
        white = white.reshape(times, -1, sites).transpose(2, 0, 1).reshape(sites, -1)
        white = solve_triangular(lower_s, white, lower=True)
        logs = 2.0 * (sites * np.log(np.diag(lower_t)).sum() + times * np.log(np.diag(lower_s)).sum())
        return float(np.sum(white**2) + len(scaled) * logs)

    first = np.zeros(3 + len(pairs)) if start is None else _packed(start, spacing, pairs)
    simplex = np.vstack([first, first + (1.0 if start is None else 0.3) * np.eye(len(first))])
    options = {"maxfev": 120 + 40 * len(pairs), "xatol": 0.05, "fatol": 0.5, "initial_simplex": simplex}
    found = minimize(loss, first, method="Nelder-Mead", options=options)
    memory, length, nugget, between = unpack(found.x)
    return Part(scale=scale, memory=memory, length=length, nugget=nugget, between=between)


def _packed(part: Part, spacing: float, pairs: Sequence[tuple[int, int]]) -> FloatArray:
    """The search's coordinates of a part's correlation."""
    ratio = min(max(part.memory / MOST_MEMORY, 1e-3), 1.0 - 1e-3)
    share = min(max((part.nugget - 0.01) / 0.98, 1e-3), 1.0 - 1e-3)
    length = math.log(part.length / spacing) if part.length > 0.0 else 0.0
    links = [] if part.between is None else [math.atanh(min(max(part.between[p], -0.99), 0.99)) for p in pairs]
    return np.array([math.log(ratio / (1.0 - ratio)), length, math.log(share / (1.0 - share)), *links])


def _time(steps: FloatArray, memory: float) -> FloatArray:
    gaps = np.abs(np.subtract.outer(steps, steps))
    return np.where(gaps == 0.0, 1.0 + RIDGE, max(memory, 0.0) ** gaps if memory > 0.0 else 0.0)


def _space(layout: Layout, length: float, nugget: float, between: FloatArray | None) -> FloatArray:
    channel, distance = layout.channel_numbers, layout.distances
    link = np.eye(len(layout.channels)) if between is None else between
    if length > 0.0:
        far = np.minimum(math.sqrt(3.0) * distance / length, FARTHEST)
        smooth = (1.0 + far) * np.exp(-far)
    else:
        smooth = np.where(distance == 0.0, 1.0, 0.0)
    held = (1.0 - nugget) * link[channel[:, None], channel[None]] * smooth
    return held + (nugget + RIDGE) * np.eye(len(channel))


def _valid(correlation: FloatArray) -> FloatArray:
    """The nearest-looking correlation matrix whose eigenvalues are positive."""
    values, vectors = np.linalg.eigh(correlation)
    if values[0] > 1e-3:
        return correlation
    fixed = (vectors * np.maximum(values, 1e-3)) @ vectors.T
    root = np.sqrt(np.diag(fixed))
    return fixed / np.outer(root, root)


@dataclass(frozen=True)
class Noise:
    """The covariance of the features that were seen, ready to solve with.

    Attributes:
        covariance: (n, n).
        seen: (t, s) which features those are.
        freedom: degrees of freedom that it is known with.
    """

    covariance: FloatArray
    seen: BoolArray
    freedom: float = math.inf

    @classmethod
    def of(cls, layout: Layout, parts: Sequence[tuple[float, Part]], seen: BoolArray) -> Noise:
        """The sum of parts, each with the factor on its variance."""
        index = np.flatnonzero(seen.reshape(-1))
        total = np.zeros((index.size, index.size))
        for factor, part in parts:
            total += factor * part.covariance(layout)[np.ix_(index, index)]
        ridge = RIDGE * float(np.mean(np.diag(total)))
        total[np.diag_indices_from(total)] += ridge
        # Welch (1947) and Satterthwaite: a sum of variances, each known with its own degrees of freedom.
        one_unit = seen & layout.common[None]
        variances = np.array([factor * float(np.mean(part.scale[one_unit] ** 2)) for factor, part in parts])
        doubt = float(np.sum(variances**2 / np.array([part.freedom for _, part in parts])))
        freedom = float(variances.sum()) ** 2 / doubt if doubt > 0.0 else math.inf
        return cls(total, seen, freedom)

    def pick(self, table: FloatArray) -> FloatArray:
        """(..., t, s) to the features that were seen (..., n)."""
        return table[..., self.seen]

    def spread(self, vector: FloatArray) -> FloatArray:
        """(n,) back to (t, s), 0 where nothing was seen."""
        table = np.zeros(self.seen.shape)
        table[self.seen] = vector
        return table

    @property
    def scale(self) -> FloatArray:
        """(n,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def plus(self, columns: FloatArray) -> Noise:
        """With low-rank noise (n, k) added: columns times independent standard normal numbers."""
        return replace(self, covariance=self.covariance + columns @ columns.T)

    def rows(self, chosen: BoolArray) -> Noise:
        """Only the features of some times (t,)."""
        keep = self.seen & chosen[:, None]
        inner = keep[self.seen]
        return Noise(self.covariance[np.ix_(inner, inner)], keep, self.freedom)

    def solver(self) -> Solver:
        """Its Cholesky factor."""
        return Solver(cho_factor(self.covariance, lower=True))


@dataclass(frozen=True)
class Solver:
    """Products with the inverse of a covariance.

    Attributes:
        factor: SciPy's Cholesky factor.
    """

    factor: tuple[FloatArray, bool]

    def solve(self, columns: FloatArray) -> FloatArray:
        """Inverse covariance times (n,) or (n, k)."""
        return cho_solve(self.factor, columns)

    def whiten(self, columns: FloatArray) -> FloatArray:
        """Inverse of the lower factor times (n,) or (n, k): noise becomes independent with variance 1."""
        return solve_triangular(self.factor[0], columns, lower=True)

    def sample(self, generator: np.random.Generator, count: int) -> FloatArray:
        """(n, count) draws of the noise."""
        lower = np.tril(self.factor[0])
        return lower @ generator.standard_normal((len(lower), count))
