"""What no parameter explains: the model's own error, seen in the part of a residual that lies outside the emulator's
basis, and carried by its structure into the part inside.

A simulator that is wrong is wrong smoothly: neighbouring blocks, later frames and the other camera see the same error.
Taking blocks as independent would make any posterior razor-sharp and wrong. So the remainder's variance and its
correlations in time, space and between cameras are measured (by moments), and a separable covariance

    σ² · cameras ⊗ ρ^|frames| ⊗ exp(−distance/ℓ)

is projected into the basis. It assumes that the error's visible part is like the rest of it; that is an assumption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: A remainder within this many times what simulations leave of each other is chance, and no misfit.
TOLERANCE = 1.5
#: Correlations that no finite sample can be trusted to exceed.
MOST_CORRELATED = 0.98


class Place(Protocol):
    """Where a block feature was taken: camera, frame number, and place on the bed in m."""

    @property
    def camera(self) -> str: ...
    @property
    def frame(self) -> int: ...
    @property
    def x(self) -> float: ...
    @property
    def y(self) -> float: ...


@dataclass(frozen=True)
class Misfit:
    """Size and structure of the model's error.

    Attributes:
        ratio: mean square of the remainder, where parameters act, over what chance and noise leave; about 1 for a model
            that is right.
        std: standard deviation σ of a block's error where parameters act, in units of the remainder; 0 where there is
            none to be seen.
        time: correlation ρ between successive frames.
        length: ℓ in m.
        cameras: correlation between cameras that see the same place.
        covariance: (p, p) in the basis; zeros where there is none.
    """

    ratio: float
    std: float
    time: float
    length: float
    cameras: float
    covariance: FloatArray

    @property
    def present(self) -> bool:
        """Whether the likelihood has to know of it."""
        return self.std > 0.0


def measure(
    remainder: FloatArray, expected: FloatArray, basis: FloatArray, places: Sequence[Place] | None = None
) -> Misfit:
    """Measure the misfit.

    Args:
        remainder: (b,) the residual's part outside the basis, in any unit.
        expected: (b,) the variance there of chance and noise.
        basis: (b, p) orthonormal.
        places: of the features. Without them, blocks are taken as independent.
    """
    p = basis.shape[1]
    # What is carried into the basis is the error where the basis is: most features never change, and err little.
    leverage = np.sum(basis**2, axis=1) / p
    known = float(leverage @ expected)
    square = float(leverage @ remainder**2)
    ratio = square / max(known, 1e-300)
    excess = square - known
    if ratio <= TOLERANCE or excess <= 0.0:
        return Misfit(ratio, 0.0, 0.0, 0.0, 0.0, np.zeros((p, p)))
    if places is None:
        return Misfit(ratio, excess**0.5, 0.0, 0.0, 0.0, excess * np.eye(p))
    lattice = _Lattice(places)
    field = lattice.spread(remainder[:, None])[..., 0]
    weight = lattice.spread(leverage[:, None])[..., 0]

    def correlation(one: Any, other: Any) -> float:
        return _correlation(field[one], field[other], np.sqrt(weight[one] * weight[other]), excess)

    time = correlation(np.s_[:, :-1], np.s_[:, 1:])
    cameras = correlation(np.s_[:1], np.s_[1:]) if len(field) > 1 else 0.0
    (here, there), distance = lattice.neighbours()
    beside = correlation(np.s_[..., here], np.s_[..., there])
    length = distance / -np.log(max(beside, 1e-3))
    covariance = excess * lattice.project(basis, time, length, cameras)
    return Misfit(ratio, excess**0.5, time, float(length), cameras, covariance)


def _correlation(one: FloatArray, other: FloatArray, weight: FloatArray, variance: float) -> float:
    """Mean product of pairs over the variance; pairs of which one wasn't seen (NaN) don't count."""
    products = one * other
    good = np.isfinite(products)
    total = float(weight[good].sum())
    if total == 0.0:
        return 0.0
    return float(np.clip(weight[good] @ products[good] / total / variance, 0.0, MOST_CORRELATED))


class _Lattice:
    """Cameras × frames × places, and which feature stands where."""

    def __init__(self, places: Sequence[Place]) -> None:
        cameras = sorted({b.camera for b in places})
        frames = sorted({b.frame for b in places})
        spots = sorted({(round(b.x, 6), round(b.y, 6)) for b in places})
        where = {spot: k for k, spot in enumerate(spots)}
        self.camera = np.array([cameras.index(b.camera) for b in places])
        self.frame = np.array([frames.index(b.frame) for b in places])
        self.spot = np.array([where[round(b.x, 6), round(b.y, 6)] for b in places])
        self.spots = np.array(spots)
        self.shape = (len(cameras), len(frames), len(spots))

    def spread(self, columns: FloatArray, empty: float = np.nan) -> FloatArray:
        """(b, k) to (cameras, frames, places, k)."""
        out = np.full((*self.shape, columns.shape[1]), empty)
        out[self.camera, self.frame, self.spot] = columns
        return out

    def distances(self) -> FloatArray:
        return np.linalg.norm(self.spots[:, None] - self.spots[None], axis=-1)

    def neighbours(self) -> tuple[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]], float]:
        """Pairs of places next to each other, and how far apart these are."""
        distances = self.distances()
        if len(distances) < 2:
            nothing = np.zeros(0, dtype=np.int64)
            return (nothing, nothing), 1.0
        nearest = float(distances[distances > 0.0].min())
        rows, columns = np.nonzero(np.triu((distances > 0.0) & (distances < 1.2 * nearest)))
        return (rows, columns), nearest

    def project(self, basis: FloatArray, time: float, length: float, cameras: float) -> FloatArray:
        """Bᵀ C B for the separable correlation C; places that aren't features carry zeros and so do not count."""
        spread = self.spread(basis, empty=0.0)
        among = np.full((self.shape[0],) * 2, cameras) + (1.0 - cameras) * np.eye(self.shape[0])
        frames = np.arange(self.shape[1])
        along = time ** np.abs(frames[:, None] - frames[None]) if time > 0.0 else np.eye(len(frames))
        across = np.exp(-self.distances() / length)
        smeared = np.einsum("ij,jfsp->ifsp", among, spread)
        smeared = np.einsum("ij,cjsp->cisp", along, smeared)
        smeared = np.einsum("ij,cfjp->cfip", across, smeared)
        return np.einsum("cfsp,cfsq->pq", spread, smeared)
