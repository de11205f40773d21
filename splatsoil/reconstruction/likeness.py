"""Photometric checks of the fixed cameras' poses, lenses and scale, against the scene reconstructed from the views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.measurement import Bed
from splatsoil.reconstruction.views import Views
from splatsoil.splats import Gaussians, rasterise


@dataclass(frozen=True)
class Likeness:
    """Robust correlation of pictures with the drawn scene, where they show soil.

    It does not depend on exposure and white balance, nor on a few pixels, as where a wall hides soil.

    Attributes:
        correlation: (v,) correlation of each picture with what is drawn; NaN where it shows no soil.
        control: (v,) the same with the drawn soil turned by half a turn in the image, for the null hypothesis.
    """

    correlation: FloatArray
    control: FloatArray

    def unrelated(self, fixed: int) -> BoolArray:
        """Which of the last ``fixed`` pictures are no more like the scene than any picture is upside down.

        A rank test: of pictures that have nothing in common with the scene, one in v + 1 passes. It has no result
        where one of the others does not pass.
        """
        by_chance = np.max(self.control, initial=-1.0, where=np.isfinite(self.control))
        valid = not np.any(self.correlation[:-fixed] <= by_chance)
        return (self.correlation[-fixed:] <= by_chance) & valid


@dataclass(frozen=True)
class Pictures:
    """Pictures beside what is drawn of a scene.

    Attributes:
        gaussians: the scene, on the device where it is to be drawn.
        views: the pictures.
        usable: (v, h, w) 1 where they may be used.
        bed: the box that holds the soil.
        level: height of the soil, m.
        background: sRGB colour behind all Gaussians.
    """

    gaussians: Gaussians
    views: Views
    usable: torch.Tensor
    bed: Bed
    level: float
    background: tuple[float, ...]

    def likeness(self) -> Likeness:
        """Correlation of each picture with the scene."""
        out = []
        for ours, theirs, seen in map(self._soil, range(len(self.views.cameras))):
            turned = _correlation(ours[::-1, ::-1], theirs, seen & seen[::-1, ::-1])
            out.append((_correlation(ours, theirs, seen), turned))
        return Likeness(*np.array(out).reshape(-1, 2).T)

    def displacements(self, fixed: int) -> FloatArray:
        """Displacement (fixed,) of the soil in the last pictures from where it is drawn: root mean square over its
        pixels, px; NaN where there is no soil."""
        last = len(self.views.cameras)
        return np.array([_displacement(*self._soil(k)) for k in range(last - fixed, last)])

    def _soil(self, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64], BoolArray]:
        """Of a picture the box (h, w) around its soil: grey levels as drawn, as observed; which pixels show soil."""
        camera = self.views.cameras[k]
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        origin, ray = camera.rays(np.stack([columns, rows], axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (self.level - origin[:, 2]) / ray[:, 2]
            place = (origin + away[:, None] * ray)[:, :2]
            soil = (away > 0.0) & (self.bed.beyond(place) < 0.0)
        seen = soil.reshape(camera.height, camera.width)
        seen = seen & (self.usable[k, : camera.height, : camera.width] > 0.0).cpu().numpy()
        if not seen.any():
            none = np.zeros((0, 0))
            return none, none, none.astype(bool)
        with torch.no_grad():
            drawn = rasterise(self.gaussians, camera, background=self.background, antialias=True).colour
        box = tuple(slice(where.min(), where.max() + 1) for where in np.nonzero(seen))
        ours, theirs = (p.mean(dim=2).cpu().numpy()[box].astype(np.float64) for p in (drawn, self.views.photograph(k)))
        return ours, theirs, seen[box]


def _displacement(drawn: NDArray[np.float64], photograph: NDArray[np.float64], seen: BoolArray) -> float:
    """Root mean square, px, of the affine map of one picture onto the other.

    The map, a gain and an offset minimise Geman and McClure's function of the differences, by Gauss-Newton steps from
    coarse to fine (Lucas & Kanade 1981; Baker & Matthews 2004, IJCV 56:221): a wall over less than half of the soil
    does not count.
    """
    if np.count_nonzero(seen) < 9:  # as many as unknowns, and one more
        return float("nan")
    places = np.argwhere(seen).astype(np.float64)
    away = places - places.mean(axis=0)
    basis = np.column_stack([np.ones(len(away)), away / np.sqrt(np.mean(away**2))])
    moved = np.zeros((3, 2))
    for blur in (4.0, 2.0, 1.0):
        weight = np.maximum(gaussian_filter(seen.astype(np.float64), blur), 1e-6)
        ours, theirs = (gaussian_filter(np.where(seen, p, 0.0), blur) / weight for p in (drawn, photograph))
        counts = np.ones(len(away))
        for _ in range(20):
            at = (places + basis @ moved).T
            here, down, right = (map_coordinates(p, at, order=1, mode="nearest") for p in (ours, *np.gradient(ours)))
            light = np.column_stack([here, np.ones(len(here))])
            slopes = np.column_stack([down[:, None] * basis, right[:, None] * basis, light])
            left = theirs[seen] - here
            step = np.linalg.lstsq(slopes * counts[:, None], left * counts, rcond=None)[0]
            left = left - slopes @ step
            spread = 1.4826 * np.median(np.abs(left)) + 1e-9
            counts = 1.0 / (1.0 + (left / (2.0 * spread)) ** 2)
            moved += step[:6].reshape(2, 3).T / max(1.0 + step[6], 0.2)
    return float(np.sqrt(np.mean(np.sum((basis @ moved) ** 2, axis=1))))


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64], where: BoolArray) -> float:
    """By the median absolute deviations of sum and difference (Gnanadesikan & Kettenring 1972, Biometrics 28:81), NaN
    where there is nothing to compare."""

    def scaled(values: FloatArray) -> FloatArray:
        away = values - np.median(values)
        return np.asarray(away / np.median(np.abs(away)))

    def squared(values: FloatArray) -> float:
        return float(np.median(np.abs(values - np.median(values)))) ** 2

    if np.count_nonzero(where) < 2:
        return float("nan")
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (scaled(image[where].astype(np.float64)) for image in (one, other))
        alike, apart = squared(a + b), squared(a - b)
    return (alike - apart) / (alike + apart) if np.isfinite(alike) else float("nan")
