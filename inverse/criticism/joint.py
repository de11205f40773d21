"""All effects at once: what is left for one of them when the others may each be there in a size too small to matter.

Nothing is ever exactly absent. A sun half a degree off, a slope of half a degree, a little cohesion: each candidate's
smallest meaningful size is the spread of what it may be although nothing worth naming is missing, and with that spread
it is a nuisance for all the others (an interval null: Berger & Delampady 1987, Statist. Sci. 2:317). And no library
holds all that is wrong: what stands along the other effects' directions once the best one is taken out measures how far
the misfit exceeds the noise (Birge's ratio), and widens every score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Calibration

FloatArray = npt.NDArray[np.float64]

BELIEF = 10.0
"""Directions' worth of belief that the noise is what it is said to be."""
SEEN_AT_ALL = 1e-12
"""Share of a direction's information that must survive for it to count."""
DISTINCT = 1e-6
"""Smallest share of the largest eigenvalue that still is a direction of its own."""


@dataclass(frozen=True)
class Joint:
    """Sufficient statistics of all candidates' parameters.

    Attributes:
        information: (k, k) of all parameters, the model's own parameters and nuisances projected out.
        trivial: (k,) standard deviation of sizes too small to matter.
        parts: where each candidate's parameters stand.
        precision: (k, k) information that a calibration adds; 0 without one.
    """

    information: FloatArray
    trivial: FloatArray
    parts: tuple[slice, ...]
    precision: FloatArray

    @property
    def whole(self) -> FloatArray:
        """(k, k) information of features and calibration together."""
        return self.information + self.precision

    @cached_property
    def likely(self) -> FloatArray:
        """(k, k) covariance of trivial sizes, once a calibration is known."""
        # (D⁻¹ + P)⁻¹ = S (1 + S P S)⁻¹ S with D = S², which lets sizes be 0.
        size = self.trivial
        inner = np.linalg.inv(np.eye(len(size)) + size[:, None] * self.precision * size)
        return size[:, None] * inner * size

    def alone(self, index: int, given: int | None = None) -> tuple[FloatArray, FloatArray]:
        """(p, k) what of all scores (k,) is a candidate's own, and its information (p, p).

        The others are there in trivial sizes; ``given`` in any size.
        """
        part, whole = self.parts[index], self.whole
        own = np.zeros((part.stop - part.start, len(whole)))
        own[:, part] = np.eye(len(own))
        others = self._others([index])
        precision = self._precision(others, given)
        gain = whole[part][:, others] @ np.linalg.pinv(whole[np.ix_(others, others)] + precision, hermitian=True)
        own[:, others] -= gain
        information = own @ whole[:, part]
        return own, 0.5 * (information + information.T)

    def unexpected(self, scores: FloatArray, told: FloatArray) -> FloatArray:
        """(…, k) the features' scores without what trivial sizes make that a calibration's scores (…, k) tell of."""
        return scores - told @ self.likely @ self.information

    def rest(self, best: int) -> FloatArray:
        """(v, k) directions in which unexpected scores are independent with variance 1, the best effect taken out."""
        part, whole = self.parts[best], self.information
        others = self._others([best])
        own = np.zeros((len(others), len(whole)))
        own[:, others] = np.eye(len(others))
        own[:, part] = -whole[others][:, part] @ np.linalg.pinv(whole[part, part], hermitian=True)
        left = own @ whole @ own.T
        spread = left + left @ self.likely[np.ix_(others, others)] @ left
        size = np.sqrt(np.maximum(np.diag(spread), 1e-300))
        values, vectors = np.linalg.eigh(spread / np.outer(size, size))
        kept = values > DISTINCT * max(float(values.max(initial=0.0)), 1e-300)
        return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T @ (own / size[:, None]))

    def draw(self, generator: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Trivial sizes (d, k), and the scores (d, k) of features and of a calibration that they and noise make."""
        sizes = generator.standard_normal((count, len(self.trivial))) * self.trivial
        seen, told = (_scores(generator, sizes, known) for known in (self.information, self.precision))
        return sizes, seen, told

    def _others(self, without: Sequence[int]) -> npt.NDArray[np.int64]:
        """Parameters of the other candidates, those that are seen at all."""
        seen = np.diag(self.whole) > 0.0
        for index in without:
            seen[self.parts[index]] = False
        return np.flatnonzero(seen)

    def _precision(self, chosen: npt.NDArray[np.int64], given: int | None) -> FloatArray:
        with np.errstate(divide="ignore"):
            precision = self.trivial[chosen] ** -2.0
        # Nothing smaller matters: a parameter without a meaningful size is held at off.
        largest = 1e12 * float(np.max(np.diag(self.whole), initial=1.0))
        precision = np.minimum(precision, largest)
        if given is not None:
            part = self.parts[given]
            precision[(chosen >= part.start) & (chosen < part.stop)] = 0.0
        return np.diag(precision)


def _scores(generator: np.random.Generator, sizes: FloatArray, information: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(generator.standard_normal(sizes.shape) @ root.T + sizes @ information)


def dispersion(squares: npt.ArrayLike, freedom: int) -> FloatArray:
    """How far a remainder's sum of squares over ``freedom`` directions exceeds that of noise, and 1 at least."""
    return np.maximum((np.asarray(squares) + BELIEF) / (freedom + BELIEF), 1.0)


def precision_of(calibration: Calibration | None, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Inverse covariance (k, k) and centre (k,), as distances from off, of the named parameters; 0 where nothing is
    known of one, and the others not asked for marginalised."""
    precision, centre = np.zeros((len(names), len(names))), np.zeros(len(names))
    if calibration is None:
        return precision, centre
    there = [k for k, name in enumerate(names) if name in calibration.names]
    theirs = [calibration.names.index(names[k]) for k in there]
    if there:
        precision[np.ix_(there, there)] = np.linalg.inv(calibration.covariance[np.ix_(theirs, theirs)])
        centre[there] = calibration.estimate[theirs]
    return precision, centre
