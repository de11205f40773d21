"""Score tests: would an effect that is off explain what is left, and how much of it?

With r the residual at the fitted parameters, Σ its covariance (noise, and parameters and nuisances with their prior
spread as low-rank noise, which projects them out) and G the derivatives of the prediction by an effect's parameters:

    U = GᵀΣ⁻¹r,   I = GᵀΣ⁻¹G,   estimate I⁻¹U,   LM = UᵀI⁻¹U

LM is the fall of χ² that switching the effect on would bring if the model were linear (Rao 1948; Breusch & Pagan 1980).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, norm

from splatsoil.experiment.base import Candidate

from .noise import Noise

FloatArray = npt.NDArray[np.float64]

DRAWS = 20_000
"""Draws of the scores under no effect, from which adjusted p-values come."""
POWER = 0.8
"""With which an effect of the smallest detectable size is found."""


@dataclass(frozen=True)
class Score:
    """What the test says of one effect.

    Attributes:
        name: the effect's.
        statistic: LM, the predicted fall of χ²; 0 where the estimate has the wrong sign.
        z: the size's estimate in units of its standard deviation; for an effect with several parameters the normal
            quantile of its p-value, with the sign of the size.
        p: chance of so large a statistic without the effect.
        adjusted: chance that any effect of the library reaches so small a p.
        estimate: of the size, as its distance from off, in the parameter's unit.
        std: of that.
        detectable: smallest size that is found with 80 % power at the level used.
        survival: share of the effect's information that parameters and nuisances leave.
        steps: estimates of all its parameters, as distances from off.
    """

    name: str
    statistic: float
    z: float
    p: float
    adjusted: float
    estimate: float
    std: float
    detectable: float
    survival: float
    steps: Mapping[str, float]


@dataclass(frozen=True)
class Scorer:
    """All candidates against any residual with the same noise.

    Attributes:
        candidates: the effects.
        parts: where each one's parameters stand in the joined columns.
        places: which of its parameters measures it.
        information: (k, k) of all parameters, parameters of the model and nuisances projected out.
        whole: (k,) information before that projection.
        weights: (n, k) inverse covariance times derivatives: products with a residual are scores.
        smallest: (draws,) least p-value of any candidate when there is nothing to find.
        level: family-wise level for which detectable sizes are stated.
    """

    candidates: tuple[Candidate, ...]
    parts: tuple[slice, ...]
    places: tuple[int, ...]
    information: FloatArray
    whole: FloatArray
    weights: FloatArray
    smallest: FloatArray
    level: float

    @classmethod
    def of(
        cls,
        noise: Noise,
        nuisance: FloatArray,
        directions: Mapping[str, FloatArray],
        candidates: Sequence[Candidate],
        *,
        level: float = 0.05,
        seed: int = 0,
    ) -> Scorer:
        """Prepare the test.

        Args:
            noise: of the residuals.
            nuisance: (n, q) derivatives by parameters and nuisances, each times its prior standard deviation.
            directions: (n, k) derivatives by each candidate's parameters, in the candidate's order.
            candidates: the effects, at least one.
            level: see above.
            seed: of the draws.
        """
        columns = [directions[c.name].reshape(len(noise.covariance), -1) for c in candidates]
        ends = np.cumsum([c.shape[1] for c in columns])
        parts = tuple(slice(int(end) - c.shape[1], int(end)) for end, c in zip(ends, columns, strict=True))
        joined = np.concatenate(columns, axis=1)
        bare = noise.solver()
        whole = np.sum(bare.whiten(joined) ** 2, axis=0)
        weights = bare.solve(joined)
        if nuisance.size:
            solved = bare.solve(nuisance)
            inner = np.linalg.solve(np.eye(nuisance.shape[1]) + nuisance.T @ solved, nuisance.T @ weights)
            weights = weights - solved @ inner
        information = joined.T @ weights
        information = 0.5 * (information + information.T)
        places = tuple([p.name for p in c.parameters].index(c.size) for c in candidates)
        smallest = _smallest(candidates, places, parts, information, seed)
        return cls(tuple(candidates), parts, places, information, whole, weights, smallest, level)

    @property
    def names(self) -> tuple[str, ...]:
        """The candidates' names."""
        return tuple(c.name for c in self.candidates)

    def score(self, residual: FloatArray, *, given: str | None = None) -> dict[str, Score]:
        """Scores by name for a residual (n,).

        Args:
            residual: observed minus predicted.
            given: an effect taken to be on, whose parameters are projected out; it is not scored itself.
        """
        gradient, information = self.weights.T @ residual, self.information
        chosen = list(range(len(self.candidates)))
        if given is not None:
            part = self.parts[self.names.index(given)]
            gain = information[:, part] @ np.linalg.pinv(information[part, part])
            gradient, information = gradient - gain @ gradient[part], information - gain @ information[part]
            chosen = [i for i in chosen if self.names[i] != given]
        return {self.names[i]: self._score(i, gradient, information) for i in chosen}

    def confusion(self) -> FloatArray:
        """(m, m) correlation between the candidates' scores."""
        return _confusion(self.information, self.parts)

    def _score(self, index: int, gradient: FloatArray, information: FloatArray) -> Score:
        candidate, part, place = self.candidates[index], self.parts[index], self.places[index]
        raw = _one(candidate, place, gradient[part], information[part, part], self.whole[part])
        share, count = float(np.mean(self.smallest <= raw.p)), len(self.candidates)
        # Beyond what the draws resolve, Bonferroni's bound.
        adjusted = share if share > 20.0 / DRAWS else min(count * raw.p, 1.0)
        sided = norm.isf(self.level / count if candidate.measure.sign else 0.5 * self.level / count)
        return Score(
            name=candidate.name,
            statistic=raw.statistic,
            z=raw.z,
            p=raw.p,
            adjusted=adjusted,
            estimate=float(raw.estimate[place]),
            std=raw.std,
            detectable=float(sided + norm.ppf(POWER)) * raw.std,
            survival=raw.survival,
            steps={q.name: float(v) for q, v in zip(candidate.parameters, raw.estimate, strict=True)},
        )


@dataclass(frozen=True)
class _Raw:
    statistic: float
    z: float
    p: float
    estimate: FloatArray
    std: float
    survival: float


def _one(candidate: Candidate, place: int, gradient: FloatArray, information: FloatArray, whole: FloatArray) -> _Raw:
    """One candidate, before multiplicity."""
    if not np.all(np.isfinite(information)) or np.any(np.diag(information) <= 1e-12 * np.maximum(whole, 1e-300)):
        # Nothing of it is seen: an estimate of nothing, known to nothing.
        return _Raw(0.0, 0.0, 1.0, np.zeros(len(gradient)), math.inf, 0.0)
    statistic, estimate = constrained(gradient, information, place, candidate.measure.sign)
    inverse = np.linalg.pinv(information)
    std = math.sqrt(max(float(inverse[place, place]), 0.0)) or math.inf
    p = tail(statistic, len(gradient), candidate.measure.sign)
    if len(gradient) == 1:
        z = float(gradient[0]) / math.sqrt(float(information[0, 0]))
    else:
        z = math.copysign(float(norm.isf(max(0.5 * p, 1e-300))), float(estimate[place]) or 1.0)
    survival = float(1.0 / (std**2 * whole[place])) if whole[place] > 0.0 and math.isfinite(std) else 0.0
    return _Raw(statistic, z, p, estimate, std, min(survival, 1.0))


def constrained(gradient: FloatArray, information: FloatArray, place: int, sign: int) -> tuple[float, FloatArray]:
    """LM and estimate (k,), the parameter at ``place`` kept on its side of off where it has a sign."""
    inverse = np.linalg.pinv(information)
    estimate = inverse @ gradient
    if sign and sign * estimate[place] < 0.0:
        rest = np.array([i for i in range(len(gradient)) if i != place], dtype=int)
        estimate = np.zeros(len(gradient))
        if rest.size:
            estimate[rest] = np.linalg.pinv(information[np.ix_(rest, rest)]) @ gradient[rest]
        return float(gradient @ estimate), estimate
    return float(gradient @ estimate), estimate


def tail(statistic: float, count: int, sign: int) -> float:
    """Chance of a larger LM with ``count`` parameters: χ², or half of it where one parameter keeps to one side."""
    if statistic <= 0.0:
        return 1.0
    if not sign:
        return float(chi2.sf(statistic, count))
    lower = chi2.sf(statistic, count - 1) if count > 1 else 0.0
    return float(0.5 * chi2.sf(statistic, count) + 0.5 * lower)


def _smallest(
    candidates: Sequence[Candidate],
    places: Sequence[int],
    parts: Sequence[slice],
    information: FloatArray,
    seed: int,
) -> FloatArray:
    """(draws,) least p-value of all candidates under no effect (Westfall & Young 1993)."""
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = generator.standard_normal((DRAWS, len(root))) @ root.T
    smallest = np.ones(DRAWS)
    for candidate, place, part in zip(candidates, places, parts, strict=True):
        smallest = np.minimum(smallest, _tails(draws[:, part], information[part, part], place, candidate.measure.sign))
    return smallest


def _tails(gradients: FloatArray, information: FloatArray, place: int, sign: int) -> FloatArray:
    """p-values (d,) of many score vectors (d, k)."""
    count = gradients.shape[1]
    if np.any(np.diag(information) <= 0.0):
        return np.ones(len(gradients))
    inverse = np.linalg.pinv(information)
    statistic = np.einsum("di,ij,dj->d", gradients, inverse, gradients)
    if not sign:
        return chi2.sf(statistic, count)
    wrong = sign * (gradients @ inverse[place]) < 0.0
    rest = [i for i in range(count) if i != place]
    if rest:
        part = np.linalg.pinv(information[np.ix_(rest, rest)])
        less = np.einsum("di,ij,dj->d", gradients[:, rest], part, gradients[:, rest])
    else:
        less = np.zeros(len(gradients))
    statistic = np.where(wrong, less, statistic)
    out = 0.5 * chi2.sf(statistic, count) + (0.5 * chi2.sf(statistic, count - 1) if count > 1 else 0.0)
    return np.where(statistic <= 0.0, 1.0, out)


def _confusion(information: FloatArray, parts: Sequence[slice]) -> FloatArray:
    """Largest canonical correlation between the candidates' directions, signed for single parameters."""
    count = len(parts)
    out = np.eye(count)
    for j in range(count):
        for k in range(j):
            a, b = information[parts[j], parts[j]], information[parts[k], parts[k]]
            cross = information[parts[j], parts[k]]
            if np.any(np.diag(a) <= 0.0) or np.any(np.diag(b) <= 0.0):
                out[j, k] = out[k, j] = 0.0
                continue
            if cross.size == 1:
                value = float(cross[0, 0] / math.sqrt(a[0, 0] * b[0, 0]))
            else:
                singular = np.linalg.svd(_root(a) @ cross @ _root(b), compute_uv=False)
                value = float(singular[0])
            out[j, k] = out[k, j] = float(np.clip(value, -1.0, 1.0))
    return out


def _root(matrix: FloatArray) -> FloatArray:
    """Inverse square root of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    good = values > 1e-9 * max(float(values[-1]), 1e-300)
    scale = np.zeros_like(values)
    scale[good] = values[good] ** -0.5
    return (vectors * scale) @ vectors.T
