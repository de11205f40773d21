"""Images of several scenes in one batch, each by its own camera, with one sort for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats.binning import bin_by_tile
from splatsoil.splats.projection import project_each
from splatsoil.splats.rasteriser import blend_each, check
from splatsoil.splats.steps import Steps, stepwise


@dataclass(frozen=True)
class Seen:
    """Gaussians with features, and the camera that sees them; arguments of `rasterise_features`.

    Attributes:
        means: (n, 3), m.
        covariances: (n, 3, 3), m².
        opacities: (n,).
        features: (n, k).
        camera: without distortion.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    camera: Camera


@stepwise
def rasterise_views(
    views: Sequence[Seen], *, background: Tensor | None = None, antialias: bool = False
) -> Steps[tuple[Tensor, Tensor]]:
    """Blend the features of one view or more, all of one size, number of features and device, without gradients: all
    Gaussians are in one list, sorted together, each view's tiles after the one's before.

    Args:
        views: what is seen by whom.
        background: (k,) behind everything; zeros by default.
        antialias: see `rasterise`.

    Returns:
        Features (v, h, w, k) and alpha (v, h, w), as by `rasterise_features` of each.
    """
    cameras = [v.camera for v in views]
    for v in views:
        check(v.means, v.covariances, v.opacities, v.camera)
    with torch.no_grad():
        projection = project_each([(v.means, v.covariances, v.opacities) for v in views], cameras, antialias)
        features = torch.cat([v.features for v in views])
        behind = features.new_zeros(features.shape[1]) if background is None else background
        bins = yield from bin_by_tile.steps(projection, features, cameras[0], [len(v.means) for v in views])
        image, transmittance = blend_each(bins, behind, cameras[0], len(views))
        return image, 1.0 - transmittance
