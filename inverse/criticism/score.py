"""Score tests: would an effect that is off explain what is left, and how much of it?

With r the residual at the fitted parameters, Σ its covariance (noise, and parameters and nuisances with their prior
spread as low-rank noise, which projects them out) and G the derivatives of the prediction by an effect's parameters:

    U = GᵀΣ⁻¹r,   I = GᵀΣ⁻¹G,   estimate I⁻¹U,   LM = UᵀI⁻¹U

LM is the fall of χ² that switching the effect on would bring if the model were linear (Rao 1948; Breusch & Pagan 1980).
G holds chance, too, and is taken times the share of GᵀΣ⁻¹G that isn't, column by column: `dilution`.
Whether an effect is exactly absent is nobody's question: what is tested is that it is there in sizes too small to
matter at most (Hodges & Lehmann 1954, J. R. Stat. Soc. B 16:261), by the fall of χ² beyond what such sizes bring. The
others may be there in such sizes, too, and what stands along them widens the scores: `joint`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear
from scipy.stats import chi2, f, norm
from scipy.stats import t as student

from splatsoil.experiment.base import Calibration, Candidate

from .dilution import reliable
from .joint import BELIEF, SEEN_AT_ALL, Joint, dispersion, precision_of
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
            quantile of the chance of so large a statistic without it, with the sign of the size.
        p: chance of so large a fall beyond that of trivial sizes, if the effect is there in such a size.
        adjusted: chance that any effect of the library reaches so small a p.
        estimate: of the size, as its distance from off, in the parameter's unit.
        std: of that.
        detectable: smallest size that is found with 80 % power at the level used; on the side that shows less, where
            sides differ.
        survival: share of the effect's information that parameters and nuisances leave.
        reliability: share of that which isn't chance in the derivatives.
        steps: estimates of all its parameters, as distances from off.
        dispersion: by which the remainder along the other effects exceeds noise; z, p and std allow for it.
        lopsided: how many times as far the size is known, by ``std``, as on the side that shows less.
        stds: standard deviations of ``steps``.
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
    dispersion: float = 1.0
    reliability: float = 1.0
    lopsided: float = 1.0
    stds: Mapping[str, float] = field(default_factory=dict)

    def on_the_weaker_side(self, lopsided: float, meaningful: float) -> Score:
        """The same, what is detectable told of the side that shows less."""
        detectable = meaningful + lopsided * (self.detectable - meaningful)
        return replace(self, detectable=detectable, lopsided=lopsided)


@dataclass(frozen=True)
class Scorer:
    """All candidates against any residual with the same noise.

    Attributes:
        candidates: the effects.
        joint: what is known of their parameters together.
        places: which of its parameters measures each one.
        whole: (k,) information before anything was projected out.
        weights: (n, k) inverse covariance times derivatives: products with a residual are scores.
        reliability: (k,) share of each derivative's information that isn't chance.
        told: (k,) scores that a calibration adds.
        smallest: (draws,) least p-value of any candidate when there is nothing to find.
        level: family-wise level for which detectable sizes are stated.
    """

    candidates: tuple[Candidate, ...]
    joint: Joint
    places: tuple[int, ...]
    whole: FloatArray
    weights: FloatArray
    reliability: FloatArray
    told: FloatArray
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
        doubts: Mapping[str, FloatArray] | None = None,
        calibration: Calibration | None = None,
        level: float = 0.05,
        seed: int = 0,
    ) -> Scorer:
        """Prepare the test.

        Args:
            noise: of the residuals.
            nuisance: (n, q) derivatives by parameters and nuisances, each times its prior standard deviation.
            directions: (n, k) derivatives by each candidate's parameters, in the candidate's order.
            candidates: the effects, at least one.
            doubts: (n, k) likewise, half the differences of derivatives by two seeds, where there are two.
            calibration: what other pictures say of their parameters.
            level: see above.
            seed: of the draws.
        """
        columns = [directions[c.name].reshape(len(noise.covariance), -1) for c in candidates]
        ends = np.cumsum([c.shape[1] for c in columns])
        parts = tuple(slice(int(end) - c.shape[1], int(end)) for end, c in zip(ends, columns, strict=True))
        joined = np.concatenate(columns, axis=1)
        unsure = np.concatenate(
            [
                (doubts or {}).get(c.name, np.zeros_like(g)).reshape(g.shape)
                for c, g in zip(candidates, columns, strict=True)
            ],
            axis=1,
        )
        whole = np.sum(noise.solver.whiten(joined) ** 2, axis=0)
        solver = noise.solver.beside(nuisance)
        weights, chance = solver.solve(joined), solver.solve(unsure)
        reliability = reliable(np.sum(joined * weights, axis=0), np.sum(unsure * chance, axis=0))
        joined, weights, whole = reliability * joined, reliability * weights, reliability**2 * whole
        information = joined.T @ weights
        precision, centre = precision_of(calibration, [p.name for c in candidates for p in c.parameters])
        information = 0.5 * (information + information.T)
        places = tuple([p.name for p in c.parameters].index(c.size) for c in candidates)
        trivial = np.array([p.meaningful for c in candidates for p in c.parameters])
        joint = Joint(information, trivial, parts, precision)
        smallest = _smallest(candidates, places, joint, seed)
        told = precision @ centre
        return cls(
            tuple(candidates), joint, places, whole + np.diag(precision), weights, reliability, told, smallest, level
        )

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
        number = None if given is None else self.names.index(given)
        seen = self.weights.T @ residual
        gradient = seen + self.told
        raws = {i: self._one(i, gradient, number) for i in range(len(self.candidates)) if i != number}
        if not raws:
            return {}
        best = number
        if best is None:
            best = max(raws, key=lambda i: raws[i].statistic - self.price(self.candidates[i]))
        rest = self.joint.rest(best) @ self.joint.unexpected(seen, self.told)
        scale, freedom = float(dispersion(np.sum(rest**2), len(rest))), _freedom(len(rest))
        return {self.names[i]: self._score(i, raw, scale, freedom) for i, raw in raws.items()}

    def ranked(self, residual: FloatArray) -> list[str]:
        """Names by how much each effect would explain with all the others off, for its parameters; the best first."""
        gradient, falls = self.weights.T @ residual + self.told, {}
        for candidate, place, part in zip(self.candidates, self.places, self.joint.parts, strict=True):
            fall, _ = constrained(gradient[part], self.joint.whole[part, part], place, candidate.measure.sign)
            falls[candidate.name] = fall - self.price(candidate)
        return sorted(falls, key=lambda name: falls[name], reverse=True)

    def price(self, candidate: Candidate, *, refitted: bool = False) -> float:
        """χ² that an effect's parameters beyond its first must bring in (Schwarz 1978, over as many directions).

        A refit frees those that shape it, too.
        """
        shapes = len(candidate.shapes) if refitted else 0
        return _price(len(candidate.parameters) + shapes, len(self.whole))

    def confusion(self) -> FloatArray:
        """(m, m) correlation between the candidates' scores."""
        return _confusion(self.joint.whole, self.joint.parts)

    def _one(self, index: int, gradient: FloatArray, given: int | None) -> _Raw:
        """One candidate, before the remainder and multiplicity."""
        candidate, place = self.candidates[index], self.places[index]
        own, information = self.joint.alone(index, given)
        whole = self.whole[self.joint.parts[index]]
        if not np.all(np.isfinite(information)) or np.any(
            np.diag(information) <= SEEN_AT_ALL * np.maximum(whole, 1e-300)
        ):
            # Nothing of it is seen: an estimate of nothing, known to nothing.
            return _Raw(0.0, 0.0, 0.0, np.zeros(len(own)), np.full(len(own), math.inf), 0.0)
        scores = own @ gradient
        statistic, estimate = constrained(scores, information, place, candidate.measure.sign)
        most = self.joint.trivial[self.joint.parts[index]]
        trivial = fall_within(scores, information, most, place, candidate.measure.sign)
        variances = np.diag(np.linalg.pinv(information, hermitian=True))
        stds = np.where(variances > 0.0, np.sqrt(np.maximum(variances, 0.0)), math.inf)
        std = float(stds[place])
        ratio = float(scores[0]) / math.sqrt(float(information[0, 0])) if len(scores) == 1 else math.nan
        survival = float(1.0 / (std**2 * whole[place])) if whole[place] > 0.0 and math.isfinite(std) else 0.0
        return _Raw(statistic, max(statistic - trivial, 0.0), ratio, estimate, stds, min(survival, 1.0))

    def _score(self, index: int, raw: _Raw, scale: float, freedom: float) -> Score:
        candidate, place = self.candidates[index], self.places[index]
        sign, count = candidate.measure.sign, len(self.candidates)
        p, seen = (float(tail(s, len(candidate.parameters), sign, scale, freedom)) for s in (raw.beyond, raw.statistic))
        share = float(np.mean(self.smallest <= p))
        # Beyond what the draws resolve, Bonferroni's bound.
        adjusted = share if share > 20.0 / DRAWS else min(count * p, 1.0)
        sided = student.isf(self.level / count if sign else 0.5 * self.level / count, freedom)
        z = raw.ratio / math.sqrt(scale)
        if math.isnan(z):
            z = math.copysign(float(norm.isf(max(0.5 * seen, 1e-300))), float(raw.estimate[place]) or 1.0)
        stds = raw.stds * math.sqrt(scale)
        std = float(stds[place])
        return Score(
            name=candidate.name,
            statistic=raw.statistic,
            z=z,
            p=p,
            adjusted=adjusted,
            estimate=float(raw.estimate[place]),
            std=std,
            detectable=candidate.measure.meaningful + float(sided + norm.ppf(POWER)) * std,
            survival=raw.survival,
            steps={q.name: float(v) for q, v in zip(candidate.parameters, raw.estimate, strict=True)},
            dispersion=scale,
            reliability=float(self.reliability[self.joint.parts[index]][place]),
            stds={q.name: float(v) for q, v in zip(candidate.parameters, stds, strict=True)},
        )


@dataclass(frozen=True)
class _Raw:
    """One candidate's LM, what of it is beyond trivial sizes, a single parameter's score over its spread (NaN for
    several), estimate, stds and survival."""

    statistic: float
    beyond: float
    ratio: float
    estimate: FloatArray
    stds: FloatArray
    survival: float


def _price(parameters: int, freedom: int) -> float:
    return (parameters - 1) * math.log(max(freedom, 2))


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


def fall_within(gradient: FloatArray, information: FloatArray, most: FloatArray, place: int, sign: int) -> float:
    """Largest fall of χ² by parameters (k,) no larger than ``most`` (k,), the one at ``place`` on its side of off.

    The fall 2 Uᵀθ − θᵀIθ is one of least squares, here in bounds.
    """
    free = np.flatnonzero(most > 0.0)
    if not free.size:
        return 0.0
    values, vectors = np.linalg.eigh(information[np.ix_(free, free)])
    size = np.sqrt(np.maximum(values, SEEN_AT_ALL * values[-1]))
    target = (vectors.T @ gradient[free]) / size
    low, high = -most[free], most[free].copy()
    if sign:
        (high if sign < 0 else low)[free == place] = 0.0
    return float(target @ target - 2.0 * lsq_linear(size[:, None] * vectors.T, target, bounds=(low, high)).cost)


def tail(statistic: float | FloatArray, count: int, sign: int, scale: float | FloatArray, freedom: float) -> FloatArray:
    """Chance of a larger LM with ``count`` parameters, or half of it where one parameter keeps to one side.

    LM over its parameters and the remainder's ``scale`` is F, the scale being known with ``freedom``.
    """
    ratio = np.asarray(statistic) / scale

    def beyond(parameters: int) -> FloatArray:
        if math.isinf(freedom):
            return np.asarray(chi2.sf(ratio, parameters))
        return np.asarray(f.sf(ratio / parameters, parameters, freedom))

    out = beyond(count)
    if sign:
        out = 0.5 * out + (0.5 * beyond(count - 1) if count > 1 else 0.0)
    return np.where(ratio <= 0.0, 1.0, out)


def _freedom(directions: int) -> float:
    """Degrees of freedom of the remainder's dispersion; without a remainder the noise is taken as known."""
    return directions + BELIEF if directions else math.inf


def _smallest(candidates: Sequence[Candidate], places: Sequence[int], joint: Joint, seed: int) -> FloatArray:
    """(draws,) least p-value of all candidates when none is there in a size that matters (Westfall & Young 1993)."""
    sizes, seen, told = joint.draw(np.random.default_rng(seed), DRAWS)
    scores, unexpected = seen + told, joint.unexpected(seen, told)
    falls = np.zeros((DRAWS, len(candidates)))
    for k, (candidate, place, part) in enumerate(zip(candidates, places, joint.parts, strict=True)):
        own, information = joint.alone(k)
        # Each is tested for being off: its own trivial size isn't in its score.
        mine = scores @ own.T - sizes[:, part] @ information
        falls[:, k] = _falls(mine, information, place, candidate.measure.sign)
    best = np.argmax(falls - [_price(len(c.parameters), len(joint.trivial)) for c in candidates], axis=1)
    smallest = np.ones(DRAWS)
    for b in np.unique(best):
        rows, rest = best == b, joint.rest(int(b))
        scale, freedom = dispersion(np.sum((unexpected[rows] @ rest.T) ** 2, axis=1), len(rest)), _freedom(len(rest))
        for k, candidate in enumerate(candidates):
            p = tail(falls[rows, k], len(candidate.parameters), candidate.measure.sign, scale, freedom)
            smallest[rows] = np.minimum(smallest[rows], p)
    return smallest


def _falls(gradients: FloatArray, information: FloatArray, place: int, sign: int) -> FloatArray:
    """LM (d,) of many score vectors (d, k)."""
    if np.any(np.diag(information) <= 0.0):
        return np.zeros(len(gradients))
    count, inverse = gradients.shape[1], np.linalg.pinv(information)
    statistic = np.einsum("di,ij,dj->d", gradients, inverse, gradients)
    if not sign:
        return statistic
    less = np.zeros(len(gradients))
    rest = [i for i in range(count) if i != place]
    if rest:
        part = np.linalg.pinv(information[np.ix_(rest, rest)])
        less = np.einsum("di,ij,dj->d", gradients[:, rest], part, gradients[:, rest])
    return np.where(sign * (gradients @ inverse[place]) < 0.0, less, statistic)


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
