"""Detection of transparent walls: whether photographs show soil at the sides of the bed's box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.stats import chi2

from splatsoil.arrays import FloatArray
from splatsoil.colour import linear
from splatsoil.measurement import Bed
from splatsoil.reconstruction.height_field import HeightField, around
from splatsoil.reconstruction.stereo import colours_seen
from splatsoil.reconstruction.surface import Geometry, scale_of, with_rim
from splatsoil.reconstruction.views import Views

_ALIKE = float(chi2.ppf(0.99, 2))
"""Squared Mahalanobis distance within which 99 % of one kind of colours lie."""

_RING = np.array([0.1, 0.2, 0.3])
"""Where around the bed the ground's colour is looked at, in square roots of the bed's area."""


def sides_seen(views: Views, bed: Bed, geometry: Geometry) -> bool:
    """Whether what is seen where the box's sides are, below the soil, has the soil's colour, and the ground around has
    another.

    Colour without brightness (chromaticity), which shade changes little, is compared with that of the soil's surface:
    two are of one kind if their medians differ by no more than colours of one kind do. Where soil goes on beyond the
    box, all around has its colour, and it has no sides to be seen.

    Args:
        views: the photographs.
        bed: the box.
        geometry: the soil's surface, found as if walls hid its sides.
    """
    surface, floor = geometry.surface, float(bed.lower[2])
    level = float(np.median(surface.height))
    cell = max(surface.cell)
    xy, outward = around(bed.lower[:2], bed.upper[:2], cell)
    # Where photographs look past the soil's edge its height is not known well: stay in the lower half.
    top = 0.5 * (np.minimum(surface.sample(xy), level) - floor)
    heights = floor + top[:, None] * np.array([0.25, 0.5, 0.75, 1.0])
    side = np.concatenate([np.column_stack([xy, z]) for z in heights.T])
    flat = replace(surface, height=np.full_like(surface.height, level))
    seen = _chromaticity(views, (side, np.tile(outward, (4, 1))), geometry.usable, with_rim(flat, bed, 0.0))
    cells = surface.points.reshape(-1, 3), surface.normals.reshape(-1, 3)
    soil = _chromaticity(views, cells, geometry.usable, geometry.occluder)
    length = scale_of(bed)
    ring = np.concatenate([around(bed.lower[:2] - out, bed.upper[:2] + out, cell)[0] for out in _RING * length])
    ground = np.column_stack([ring, np.full(len(ring), geometry.ground)])
    upward = np.tile([0.0, 0.0, 1.0], (len(ground), 1))
    beside = _chromaticity(views, (ground, upward), geometry.usable, with_rim(flat, bed, geometry.rim))
    return _alike(seen, soil) and not _alike(beside, soil)


def _alike(some: FloatArray, others: FloatArray) -> bool:
    """Whether two sets of colours (n, 2) are of one kind, by the distance of their medians in their mean spread."""
    if min(len(some), len(others)) < 3:
        return False
    apart = np.median(some, axis=0) - np.median(others, axis=0)
    spread = 0.5 * (np.cov(some.T) + np.cov(others.T))
    return bool(apart @ np.linalg.pinv(spread) @ apart < _ALIKE)


def _chromaticity(
    views: Views, discs: tuple[FloatArray, FloatArray], usable: torch.Tensor, occluder: HeightField
) -> FloatArray:
    """Red and green (m, 2) of the sum of linear red, green and blue, of those of n discs that are seen."""
    near = 0.1 * max(occluder.cell)
    seen = colours_seen(views, discs, usable, occluder, near, near)
    colours = linear(seen[np.isfinite(seen).all(axis=1)])
    return colours[:, :2] / np.maximum(colours.sum(axis=1, keepdims=True), 1e-6)
