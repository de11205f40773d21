"""Noise of features: what differs between observation and prediction although nothing is wrong with the model.

The covariance is a sum of parts, each separable: a scale for each feature, AR(1) in time, a correlation between
instruments and a Matérn-3/2 correlation in space with a nugget. See :mod:`.sampled_noise` for where they come from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dtrtrs

from splatsoil.experiment.features import Layout

from .waves import smooth_waves

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

STILL = 1e-4
"""Share of the largest standard deviation below which a feature isn't changed at all."""
FARTHEST = 500.0
"""Distance over a correlation's length at which nothing is left of it."""
RIDGE = 1e-6
"""Added to the diagonal of a correlation, for its Cholesky factor's sake, and, of the mean variance, to all others."""


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

    def across(self, layout: Layout) -> FloatArray:
        """(s, s) correlation between sites at one time."""
        return in_space(layout, self.length, self.nugget, self.between)

    def covariance(self, layout: Layout, seen: BoolArray) -> FloatArray:
        """(n, n) covariance of the features that were seen (t, s)."""
        return _separable(self.across(layout), in_time(layout.steps, self.memory), self.scale, seen)

    def solver(self, layout: Layout, seen: BoolArray) -> Solver:
        """Of that covariance: of its correlation, which is decomposed once however often scales change."""
        between = None if self.between is None else self.between.tobytes()
        lower = _correlation_factor(layout, self.memory, self.length, self.nugget, between, seen.tobytes())
        variance = self.scale[seen] ** 2
        return Solver(lower, np.sqrt(variance + RIDGE * float(np.mean(variance))))


def _separable(across: FloatArray, times: FloatArray, scale: FloatArray, seen: BoolArray) -> FloatArray:
    """(n, n) scale × correlation in space (s, s) × in time (t, t) of the features that were seen (t, s), in blocks of
    two times each."""
    sites = [np.flatnonzero(row) for row in seen]
    ends = np.cumsum([0, *(len(here) for here in sites)])
    out = np.empty((ends[-1], ends[-1]))
    for t, here in enumerate(sites):
        rows = scale[t, here][:, None] * across.take(here, axis=0)
        for u, there in enumerate(sites[: t + 1]):
            block = rows.take(there, axis=1) * (times[t, u] * scale[u, there])
            mine, other = slice(ends[t], ends[t + 1]), slice(ends[u], ends[u + 1])
            out[mine, other], out[other, mine] = block, block.T
    return out


@lru_cache(maxsize=6)
def _correlation_factor(
    layout: Layout, memory: float, length: float, nugget: float, between: bytes | None, seen: bytes
) -> FloatArray:
    """(n, n) lower Cholesky factor of a part's correlation. A floor asks for each of its parts' several times."""
    count = len(layout.channels)
    link = None if between is None else np.frombuffer(between).reshape(count, count)
    which = np.frombuffer(seen, dtype=bool).reshape(layout.shape)
    across = in_space(layout, length, nugget, link)
    return _factor(_separable(across, in_time(layout.steps, memory), np.ones(layout.shape), which))


def _factor(covariance: FloatArray) -> FloatArray:
    """(n, n) lower Cholesky factor.

    Raises:
        LinAlgError: not positive definite, or not finite.
    """
    lower, info = dpotrf(covariance.T, lower=1, clean=1)  # transposed: as LAPACK lays matrices out
    if info or not np.isfinite(lower.diagonal()).all():
        raise LinAlgError("a covariance isn't positive definite, or isn't finite")
    return np.asarray(lower)


def independent(scale: FloatArray, memory: float = 0.0) -> Part:
    """Noise of instruments: independent between sites."""
    return Part(scale=scale, memory=memory, nugget=1.0)


def extra_noise(layout: Layout, part: Part, seen: BoolArray, directions: FloatArray | None = None) -> FloatArray:
    """(n, r) low-rank noise by which a part has the variance that was found on slow waves and along directions (n, k).

    Everywhere else the part's own stays as it is.
    """
    if not np.any(part.scale[seen]):
        return np.zeros((int(seen.sum()), 0))
    changed = alive(part, seen)
    solver = part.solver(layout, changed)
    nothing = np.zeros((int(changed.sum()), 0))
    chosen = orthonormal(solver.whiten(nothing if directions is None else directions[changed[seen]]))
    waves = solver.whiten(smooth_waves(layout, changed) * part.scale[changed][:, None])
    waves = orthonormal(waves - chosen @ (chosen.T @ waves))
    parts = [math.sqrt(part.on_directions - 1.0) * chosen, math.sqrt(part.on_waves - 1.0) * waves]
    columns = solver.coloured(np.concatenate(parts, axis=1))
    out = np.zeros((int(seen.sum()), columns.shape[1]))
    out[changed[seen]] = columns
    return out


def alive(part: Part, seen: BoolArray) -> BoolArray:
    """(t, s) features that a part changes: other guesses of colours leave forces as they are, and what acts on these
    would hide all that acts on pictures."""
    return seen & (part.scale > STILL * float(part.scale[seen].max()))


def orthonormal(columns: FloatArray) -> FloatArray:
    """(n, r) of the span of columns (n, k), whatever their lengths."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)]
    if not columns.size:
        return np.zeros((len(columns), 0))
    basis = columns / np.linalg.norm(columns, axis=0)
    # By their products with each other, twice: the first time leaves errors where columns hardly differ. A tenth of
    # the time of a singular value decomposition.
    for _ in range(2):
        values, vectors = np.linalg.eigh(basis.T @ basis)
        kept = values > 1e-12 * values[-1]
        basis = basis @ (vectors[:, kept] / np.sqrt(values[kept]))
    return np.asarray(basis)


def in_time(steps: FloatArray, memory: float) -> FloatArray:
    """(t, t) correlation between times, of a memory from one to the next."""
    gaps = np.abs(np.subtract.outer(steps, steps))
    return np.where(gaps == 0.0, 1.0 + RIDGE, max(memory, 0.0) ** gaps if memory > 0.0 else 0.0)


def in_space(layout: Layout, length: float, nugget: float, between: FloatArray | None) -> FloatArray:
    """(s, s) correlation between sites; see :class:`Part`."""
    channel, distance = layout.channel_numbers, layout.distances
    link = np.eye(len(layout.channels)) if between is None else between
    if length > 0.0:
        far = np.minimum(math.sqrt(3.0) * distance / length, FARTHEST)
        smooth = (1.0 + far) * np.exp(-far)
    else:
        smooth = np.where(distance == 0.0, 1.0, 0.0)
    held = (1.0 - nugget) * link[channel[:, None], channel[None]] * smooth
    return held + (nugget + RIDGE) * np.eye(len(channel))


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
        count = np.count_nonzero(seen)
        total = np.zeros((count, count))
        for factor, part in parts:
            total += factor * part.covariance(layout, seen)
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

    @cached_property
    def solver(self) -> Solver:
        """Of its Cholesky factor."""
        return Solver(_factor(self.covariance))


@dataclass(frozen=True)
class Solver:
    """Products with the inverse of a covariance D L Lᵀ D + F Fᵀ, which has been decomposed.

    Attributes:
        lower: (n, n) L.
        scale: (n,) of which D is the diagonal; 1 everywhere if there is none.
        columns: (n, q) L⁻¹D⁻¹F, low-rank noise beside; None for none.
        modes: eigenvalues (q,) and eigenvectors (q, q) of what these columns give with themselves.
    """

    lower: FloatArray
    scale: FloatArray | None = None
    columns: FloatArray | None = None
    modes: tuple[FloatArray, FloatArray] | None = None

    def beside(self, columns: FloatArray) -> Solver:
        """With low-rank noise (n, q) more: columns times independent standard normal numbers. Nothing large is
        decomposed again (Woodbury)."""
        white = Solver(self.lower, self.scale).whiten(columns)
        if self.columns is not None:
            white = np.concatenate([self.columns, white], axis=1)
        if not white.shape[1]:
            return self
        values, vectors = np.linalg.eigh(white.T @ white)
        return replace(self, columns=white, modes=(np.maximum(values, 0.0), vectors))

    def solve(self, columns: FloatArray) -> FloatArray:
        """Inverse covariance times (n,) or (n, k)."""
        white = self._shrunk(self._bare(columns), 1.0)
        out = triangular(self.lower, white, transposed=True)
        return out if self.scale is None else (out.T / self.scale).T

    def whiten(self, columns: FloatArray) -> FloatArray:
        """A root of the inverse times (n,) or (n, k): noise becomes independent with variance 1."""
        return self._shrunk(self._bare(columns), 0.5)

    def coloured(self, columns: FloatArray) -> FloatArray:
        """The inverse of `whiten`: of (n, k) independent numbers, noise."""
        out = self.lower @ self._shrunk(columns, -0.5)
        return out if self.scale is None else (out.T * self.scale).T

    def sample(self, generator: np.random.Generator, count: int) -> FloatArray:
        """(n, count) draws of the noise."""
        return self.coloured(generator.standard_normal((len(self.lower), count)))

    def _bare(self, columns: FloatArray) -> FloatArray:
        """Whitened as if there were no low-rank noise."""
        scaled = columns if self.scale is None else (np.asarray(columns).T / self.scale).T
        return triangular(self.lower, np.asarray_chkfinite(scaled))

    def _shrunk(self, white: FloatArray, power: float) -> FloatArray:
        """(1 + G Gᵀ)^-power times (n,) or (n, k), with the low-rank columns G."""
        if self.columns is None or self.modes is None:
            return white
        values, vectors = self.modes
        # ((1 + v)^-p - 1) / v, also where v is next to nothing
        gain = np.expm1(-power * np.log1p(values)) / np.where(values > 0.0, values, 1.0)
        gain = np.where(values > 0.0, gain, -power)
        along = vectors.T @ (self.columns.T @ white)
        return white + self.columns @ (vectors @ (gain * along.T).T)


def triangular(lower: FloatArray, columns: FloatArray, *, transposed: bool = False) -> FloatArray:
    """Inverse of a lower triangular matrix, or of its transpose, times (n,) or (n, k)."""
    if not columns.size:
        return np.array(columns, dtype=np.float64)
    out, _ = dtrtrs(lower, columns, lower=1, trans=int(transposed))
    return np.asarray(out).reshape(np.shape(columns))
