"""Differences of pictures regressed on derivatives, in bands of spatial frequency.

Each band (Burt & Adelson 1983, IEEE Trans. Commun. 31) is weighted by the inverse of its power: errors of
reconstruction are smooth, and white noise would be a wrong picture of them. Single outliers weigh less (Huber 1964,
Ann. Math. Statist. 35). The covariance is a jackknife over squares of the bed, which holds whatever the correlation
within a square is (Liang & Zeger 1986, Biometrika 73; Bell & McCaffrey 2002, Survey Methodology 28), and squares of
several sizes are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolImage = npt.NDArray[np.bool_]

SCALES = (8.0, 4.0, 2.0, 1.0)
"""Standard deviations of the Gaussians between which bands lie, pixels; the finest band ends at the last."""
SQUARES = (0.05, 0.1, 0.16)
"""Sides of squares of the bed that are left out one by one, m."""
HUBER = 2.0
"""Standard deviations beyond which a difference weighs less."""


@dataclass(frozen=True)
class Rows:
    """A picture's rows of a regression.

    Attributes:
        residual: (b, n) observed minus drawn, sRGB, in bands from coarse to fine at n pixels.
        slopes: (k, b, n) derivatives of what is drawn.
        groups: (g, n) the group that each pixel is in, for several ways to group them.
    """

    residual: FloatArray
    slopes: FloatArray
    groups: IntArray


def rows_of(
    residual: FloatArray, slopes: FloatArray, mask: BoolImage, groups: IntArray, aside: Sequence[FloatArray] = ()
) -> Rows:
    """Pictures (h, w) in bands, averaged over pixels in the mask alone; what is like one of ``aside`` is taken out."""
    area = [np.maximum(gaussian_filter(mask.astype(np.float64), s), 1e-6)[mask] for s in SCALES]

    def split(image: FloatArray) -> FloatArray:
        if not image.any():
            return np.zeros((len(SCALES), int(mask.sum())))
        smooth = [gaussian_filter(np.where(mask, image, 0.0), s)[mask] / a for s, a in zip(SCALES, area, strict=True)]
        return np.stack([smooth[0], *(fine - rough for rough, fine in pairwise(smooth))])

    bands = np.stack([split(image) for image in (residual, *slopes)])
    if aside:
        for b, vectors in enumerate(np.stack([split(image) for image in aside], axis=1)):
            _, size, rows = np.linalg.svd(vectors, full_matrices=False)
            rows = rows[size > 1e-6]
            bands[:, b] -= bands[:, b] @ rows.T @ rows
    return Rows(bands[0], bands[1:], groups)


def regression(
    rows: Sequence[Rows], bands: int, vague: FloatArray, value: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A step (k,) of the first k parameters, its covariance (k, k), how it leans (k, m) on the m other ones, and the
    information (k, k) that it would have if errors were white in each band."""
    k, prior = len(vague), np.diag(1.0 / vague**2)
    others = len(rows[0].slopes) - k
    # power of white noise in each band: integrals of squared Gaussians and differences of them
    gain = np.array([SCALES[0] ** -2.0, *(r**-2 + f**-2 - 4.0 / (r**2 + f**2) for r, f in pairwise(SCALES))])[
        :bands, None
    ]
    flat = [(r.slopes[:, :bands].reshape(len(r.slopes), -1), r.residual[:bands]) for r in rows]
    step = np.zeros(k)
    for _ in range(4):
        heavy, whole, pull = [], np.zeros((k, k + others)), np.zeros(k)
        for slopes, residual in flat:
            left = residual - (step @ slopes[:k]).reshape(residual.shape)
            level = np.maximum(1.4826 * _usual(np.abs(left), slopes[:k]), 1e-5)
            weight = gain / level**2 * np.minimum(1.0, HUBER * level / np.maximum(np.abs(left), 1e-12))
            heavy.append(slopes[:k] * weight.reshape(-1))
            whole, pull = whole + heavy[-1] @ slopes.T, pull + heavy[-1] @ left.reshape(-1)
        inner = whole[:, :k] + prior
        step = step + np.linalg.solve(inner, pull - prior @ (value + step))
    spreads = []
    for way in range(len(rows[0].groups)):
        parts: dict[int, FloatArray] = {}
        for (slopes, residual), weighted, row in zip(flat, heavy, rows, strict=True):
            left = residual - (step @ slopes[:k]).reshape(residual.shape)
            for g in np.unique(row.groups[way]):
                chosen = np.tile(row.groups[way] == g, bands)
                both = np.concatenate([slopes[:k, chosen], left.reshape(1, -1)[:, chosen]])
                parts[g] = parts.get(g, 0.0) + weighted[:, chosen] @ both.T
        part = np.array(list(parts.values()))
        if len(part) > 1:
            without = np.linalg.solve(inner - part[..., :k], -part[..., k:])[..., 0]
            spreads.append((len(part) - 1) / len(part) * without.T @ without)
    inverse: FloatArray = np.asarray(np.linalg.inv(inner))
    if not spreads:
        return step, np.diag(vague**2), np.zeros((k, others)), inner
    variance = np.array([np.diag(s) for s in spreads])
    scale = np.sqrt(variance.max(axis=0) / np.maximum(variance[0], 1e-300))
    lean: FloatArray = np.asarray(-inverse @ whole[:, k:])
    return step, spreads[0] * np.outer(scale, scale) + inverse, lean, inner


def _usual(off: FloatArray, slopes: FloatArray) -> FloatArray:
    """(b, 1) median of what pixels (b, n) are off, each counted by how much it tells: most of a picture may have no
    edges, and those of a tool that is off are no outliers.
    """
    power = slopes.reshape(len(slopes), *off.shape) ** 2
    weight = np.sum(power / np.maximum(power.mean(axis=-1, keepdims=True), 1e-300), axis=0)
    order = np.argsort(off, axis=1)
    reached = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    place = np.argmax(reached >= 0.5 * reached[:, -1:], axis=1)[:, None]
    return np.take_along_axis(np.take_along_axis(off, order, axis=1), place, axis=1)


def squares_of(place: FloatArray) -> IntArray:
    """(g, n) in which square of each size places (n, 2) in m lie."""
    return np.stack([np.floor(place / side).astype(np.int64) @ [4096, 1] for side in SQUARES])


def misfit(rows: Sequence[Rows]) -> float:
    """Mean logarithm of the median difference, over all bands and pictures."""
    return float(np.mean([np.log(np.median(np.abs(r.residual), axis=1) + 1e-6) for r in rows]))


def shrunk(step: FloatArray, covariance: FloatArray, information: FloatArray, size: FloatArray) -> FloatArray:
    """What of a step (k,) is left where steps are known to have a size (k,): a first step must not follow chance."""
    wide = np.diag(size**2)
    return wide @ np.linalg.solve(wide + shaped(np.diag(covariance), information), step)


def shaped(variance: FloatArray, information: FloatArray) -> FloatArray:
    """(k, k) covariance of given variances (k,), with the correlations that go with an information.

    Those of a jackknife over few squares, or of what few photographs show, are chance themselves.
    """
    inverse = np.linalg.inv(information)
    scale = np.sqrt(variance / np.diag(inverse))
    return np.asarray(inverse * np.outer(scale, scale))
