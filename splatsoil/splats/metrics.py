"""Image similarity: PSNR and a differentiable SSIM."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from splatsoil.errors import ParameterError
from splatsoil.splats import kernels_ssim
from splatsoil.splats.kernels_ssim import C1, C2, WINDOW
from splatsoil.splats.warp_torch import as_warp, launch_parts, thread_count

SIGMA = 1.5
"""Standard deviation of the SSIM window, px."""

_NUMBERS_PER_MILLISECOND = 100_000
"""About how many pixels times channels one CPU core compares in a millisecond."""


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of two pictures with values in [0, 1], dB; infinite when they are equal."""
    _check(a, b)
    return -10.0 * torch.log10(torch.mean((a - b) ** 2))


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of two pictures (h, w) or (h, w, c) with values in [0, 1]; 1 when they are equal.

    The convention of the splatting papers: Gaussian window of 11 px (σ = 1.5), zeros beyond the border, the mean over
    all pixels and channels; a loss is ``1 - ssim(a, b)``. Differentiable in both pictures.
    """
    _check(a, b)
    return ssim_map(a, b).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity of every pixel and channel, shaped like ``a``; see `ssim`."""
    _check(a, b)
    channels = a[0, 0].numel()
    if a.device.type == "cpu" and a.dtype == b.dtype == torch.float32 and channels <= kernels_ssim.MAX_CHANNELS:
        return _Similarity.apply(a, b)
    return ssim_map_torch(a, b)


def window(dtype: torch.dtype = torch.float64) -> Tensor:
    """The normalised one-dimensional SSIM window (11,)."""
    half = WINDOW // 2
    weights = [math.exp(-0.5 * (i / SIGMA) ** 2) for i in range(-half, half + 1)]
    return torch.tensor([w / math.fsum(weights) for w in weights], dtype=dtype)


def _check(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape or a.ndim not in (2, 3):
        raise ParameterError(f"pictures of shapes {tuple(a.shape)} and {tuple(b.shape)} cannot be compared")


def ssim_map_torch(a: Tensor, b: Tensor) -> Tensor:
    """`ssim_map` by autograd: the path for CUDA and other float types, and the check of the CPU kernels.

    The blur is two products with banded matrices, few calls for a GPU to wait for: convolutions on CUDA may round to
    ten bits (TF32), which spoils variances, as products do only if they are told to.
    """
    x, y = (t.reshape(t.shape[0], t.shape[1], -1).permute(2, 0, 1) for t in (a, b))
    moments = torch.cat([x, y, x * x, y * y, x * y])
    down, along = (_band(n, moments.dtype, a.device) for n in a.shape[:2])
    mx, my, xx, yy, xy = (down @ moments @ along).chunk(5)
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    out = (2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))
    return out.permute(1, 2, 0).reshape(a.shape)


@lru_cache(maxsize=16)
def _band(n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(n, n) symmetric: the window about each pixel of a row, zeros beyond its ends."""
    half, weights = WINDOW // 2, window()
    rows = torch.zeros((n, n + 2 * half), dtype=torch.float64)
    for i in range(WINDOW):
        rows.diagonal(i).fill_(float(weights[i]))
    return rows[:, half : half + n].to(device, dtype).contiguous()


class _Similarity(torch.autograd.Function):
    """SSIM map by the CPU kernels; the partial derivatives by the three blurred moments are kept for backward."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        height, row = a.shape[0], a[0].numel()
        channels = row // a.shape[1]
        pictures = [t.contiguous() for t in (a, b)]
        out = torch.empty_like(pictures[0])
        slopes = [a.new_empty((3 if needed else 0, height, row)) for needed in ctx.needs_input_grad]
        arrays = [as_warp(t.reshape(-1), wp.float32) for t in (*pictures, window(torch.float32), out, *slopes)]
        _launch_bands(kernels_ssim.similarity, [height, row, channels, *arrays])
        ctx.save_for_backward(*pictures, *slopes)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        a, b, *slopes = ctx.saved_tensors
        height, row = a.shape[0], a[0].numel()
        channels = row // a.shape[1]
        results: list[Tensor | None] = []
        for own, other, partial, needed in ((a, b, slopes[0], 0), (b, a, slopes[1], 1)):
            if not ctx.needs_input_grad[needed]:
                results.append(None)
                continue
            out = torch.empty_like(own)
            tensors = (own, other, gradient, window(torch.float32), partial, out)
            arrays = [as_warp(t.reshape(-1), wp.float32) for t in tensors]
            _launch_bands(kernels_ssim.similarity_gradient, [height, row, channels, *arrays])
            results.append(out)
        return results[0], results[1]


def _launch_bands(kernel: Any, inputs: list[Any]) -> None:
    """Run a kernel over bands of rows, by as many threads as pay; ``inputs`` begin with the picture's size."""
    bands = -(-inputs[0] // kernels_ssim.BAND)
    threads = thread_count(inputs[0] * inputs[1] / _NUMBERS_PER_MILLISECOND)
    launch_parts(kernel, [bands * i // threads for i in range(threads + 1)], inputs)
