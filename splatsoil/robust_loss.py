"""The robust loss of residual pictures: averaged over centimetres at several scales, quadratic where the mean is small,
linear where it is large. `splatsoil.comparison` says which residuals, and in which units.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

SCALES = (0.0125, 0.025)
"""Standard deviations of the averaging, m on the bed: about the size of chance lumps, and twice that."""

SATURATION = 0.05
"""sRGB difference (averaged over centimetres) beyond which the robust loss grows linearly."""


def robust_losses(
    residuals: Sequence[npt.NDArray[np.float32]], masks: Sequence[npt.NDArray[np.bool_]], pixels_per_metre: float
) -> npt.NDArray[np.float64]:
    """(n, scales) the loss of residuals (h, w, 3) over the pixels (h, w) that count, at each of `SCALES`."""
    residual = torch.from_numpy(np.stack(residuals).astype(np.float32)).permute(0, 3, 1, 2)
    weight = torch.from_numpy(np.stack(masks)).float()[:, None]
    sigmas = [scale * pixels_per_metre for scale in SCALES]
    return np.stack([_robust(*_averaged(residual, weight, sigma)).numpy() for sigma in sigmas], axis=1)


def _averaged(residual: Tensor, weight: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Gaussian mean (n, 3, h', w') of what counts of a residual (n, 3, h, w), and the share (n, 1, h', w') that does.

    Pixels are pooled first where the Gaussian is wide enough not to notice.
    """
    factor = max(1, int(sigma / 2.0))
    both = torch.cat([residual * weight, weight], dim=1)
    both = torch.nn.functional.avg_pool2d(both, factor, ceil_mode=True, count_include_pad=False)
    width = sigma / factor
    size = 2 * max(1, round(3.0 * width)) + 1
    size = min(size, 2 * ((min(both.shape[2:]) - 1) // 2) + 1)
    both = gaussian_blur2d(both, (size, size), (width, width), border_type="constant")
    share = both[:, 3:]
    return both[:, :3] / share.clamp_min(1e-6), share


def _robust(mean: Tensor, share: Tensor) -> Tensor:
    """(n,) loss of averaged residuals: quadratic where small, linear where large, weighted by what counts."""
    square = mean.square().mean(dim=1, keepdim=True)
    loss = SATURATION**2 * (torch.sqrt(1.0 + 2.0 * square / SATURATION**2) - 1.0)
    return (loss * share).sum(dim=(1, 2, 3)).double() / share.sum(dim=(1, 2, 3)).clamp_min(1e-6).double()
