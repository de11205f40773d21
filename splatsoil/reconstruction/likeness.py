"""Photometric check of the fixed cameras' poses, lenses and scale, against the scene reconstructed from the views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

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

    def unlike(self, fixed: int) -> BoolArray:
        """Which of the last ``fixed`` pictures are less like the scene than any other: a rank test, by which one of
        v + 1 is said to differ that does not."""
        others = self.correlation[:-fixed][np.isfinite(self.correlation[:-fixed])]
        return self.correlation[-fixed:] < others.min() if len(others) else np.zeros(fixed, dtype=bool)

    def unrelated(self, fixed: int) -> BoolArray:
        """Which of the last ``fixed`` pictures are no more like the scene than any picture is upside down.

        A rank test: of pictures that have nothing in common with the scene, one in v + 1 passes. It has no result
        where one of the others does not pass.
        """
        by_chance = np.max(self.control, initial=-1.0, where=np.isfinite(self.control))
        valid = not np.any(self.correlation[:-fixed] <= by_chance)
        return (self.correlation[-fixed:] <= by_chance) & valid


def likeness(
    gaussians: Gaussians, views: Views, usable: torch.Tensor, bed: Bed, level: float, background: tuple[float, ...]
) -> Likeness:
    """Correlation of each picture with the scene.

    Args:
        gaussians: the scene, on the device where it is to be drawn.
        views: the pictures.
        usable: (v, h, w) 1 where they may be used.
        bed: the box that holds the soil.
        level: height of the soil, metres.
        background: sRGB colour behind all Gaussians.
    """
    out = []
    for k, camera in enumerate(views.cameras):
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        origin, ray = camera.rays(np.stack([columns, rows], axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (level - origin[:, 2]) / ray[:, 2]
            place = (origin + away[:, None] * ray)[:, :2]
            soil = (away > 0.0) & (bed.beyond(place) < 0.0)
        seen = soil.reshape(camera.height, camera.width)
        seen = seen & (usable[k, : camera.height, : camera.width] > 0.0).cpu().numpy()
        if not seen.any():
            out.append((np.nan, np.nan))
            continue
        with torch.no_grad():
            drawn = rasterise(gaussians, camera, background=background, antialias=True).colour
        box = tuple(slice(where.min(), where.max() + 1) for where in np.nonzero(seen))
        ours, theirs = (p.mean(dim=2).cpu().numpy()[box] for p in (drawn, views.photograph(k)))
        seen = seen[box]
        out.append((_correlation(ours, theirs, seen), _correlation(ours[::-1, ::-1], theirs, seen & seen[::-1, ::-1])))
    return Likeness(*np.array(out).reshape(-1, 2).T)


def _correlation(one: NDArray[np.float32], other: NDArray[np.float32], where: BoolArray) -> float:
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
