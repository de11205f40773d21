"""Gaussians of the surroundings that reach into the soil.

Opaque soil hides what lies beneath it, so training may leave large Gaussians of the surroundings there. They would be
seen where a tool digs. The bed contains soil alone.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.splats import Gaussians

_VISIBLE = 0.02
"""Opacity in the soil from which a Gaussian reaches into it. Measured on both example sets with their true particles:
less takes away more of the surroundings and betters nothing, five times as much leaves a haze in a deep trench."""

_MARGIN = 0.02
"""Share of the bed's narrower side, along its walls, that the walls' Gaussians may reach into."""

_HIGHEST = 0.8
"""Share of the soil's height, from the floor, in which there must be nothing else."""

_REACH = 2.8
"""Standard deviations at which even an opaque Gaussian falls below `_VISIBLE`."""


def reaching_into_soil(gaussians: Gaussians, surface: HeightField, floor: float) -> Tensor:
    """Which of n Gaussians (n,) reach into the soil, visibly if it weren't there; where there is none, none does.

    Args:
        gaussians: of anything but soil.
        surface: the soil's, over the whole bed.
        floor: height of the bed's floor, m.
    """
    half = 0.5 * np.array(surface.cell)
    low = np.array([surface.x[0] - half[0], surface.y[0] - half[1], floor])
    high = np.array([surface.x[-1] + half[0], surface.y[-1] + half[1], floor])
    margin = _MARGIN * float((high - low)[:2].min())
    low[:2] += margin
    high[:2] -= margin
    means, scales = (t.detach().cpu().numpy().astype(np.float64) for t in (gaussians.means, gaussians.scales))
    # The soil's height where a Gaussian comes nearest to it.
    heights = surface.sample(np.clip(means[:, :2], low[:2], high[:2]))
    tops = floor + _HIGHEST * np.maximum(np.nan_to_num(heights, nan=floor) - floor, 1e-6)
    highest = np.column_stack([np.broadcast_to(high[:2], (len(means), 2)), tops])
    away = np.linalg.norm(means - np.clip(means, low, highest), axis=1)
    near = np.flatnonzero(away < _REACH * scales.max(axis=1, initial=0.0))
    turned = gaussians[torch.from_numpy(near).to(gaussians.means.device)].rotations().detach().cpu().numpy()
    # Where in the box the Gaussian is densest: the squared distance is measured by its inverse covariance.
    whitening = np.swapaxes(turned.astype(np.float64), 1, 2) / scales[near][:, :, None]
    metric = np.swapaxes(whitening, 1, 2) @ whitening
    square = _nearest_square(metric, low - means[near], highest[near] - means[near])
    densest = gaussians.opacities.detach().cpu().numpy()[near] * np.exp(-0.5 * square)
    out = np.zeros(len(means), dtype=bool)
    out[near] = (densest > _VISIBLE) & ~(heights[near] <= floor)
    return torch.from_numpy(out).to(gaussians.means.device)


def _nearest_square(metric: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Least x'Mx (n,) over boxes: metrics M (n, 3, 3), positive definite; corners (n, 3).

    A convex function is least in the box where it is least on one of the box's 27 faces (itself, its sides, edges and
    corners), taken as unbounded, at a place that lies in the box.
    """
    best = np.full(len(metric), np.inf)
    for sides in itertools.product((None, low, high), repeat=3):
        fixed = [axis for axis, side in enumerate(sides) if side is not None]
        free = [axis for axis, side in enumerate(sides) if side is None]
        x = np.zeros_like(low)
        for axis in fixed:
            side = sides[axis]
            assert side is not None
            x[:, axis] = side[:, axis]
        if free:
            inner, across = metric[:, free][:, :, free], metric[:, free][:, :, fixed]
            x[:, free] = -np.linalg.solve(inner, across @ x[:, fixed, None])[..., 0]
        slack = 1e-9 * (high - low)
        inside = np.all((x >= low - slack) & (x <= high + slack), axis=1)
        square = np.einsum("ni,nij,nj->n", x, metric, x)
        best = np.where(inside, np.minimum(best, square), best)
    return best
