"""The rasteriser: `rasterise` and `rasterise_features`, differentiable torch functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import torch
import warp as wp
from torch import Tensor

from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.splats import constants, kernels_binning, kernels_cpu, kernels_cuda
from splatsoil.splats.binning import Bins, bin_by_tile
from splatsoil.splats.gaussians import Gaussians
from splatsoil.splats.projection import Projection, covariances_of, project
from splatsoil.splats.warp_torch import as_warp, launch, launch_parts, thread_count

_ENTRIES_PER_MILLISECOND = 8000
"""About how many pairs of a Gaussian and a tile one CPU core draws in a millisecond."""


@dataclass(frozen=True)
class Rendering:
    """A picture of Gaussians.

    Attributes:
        colour: (h, w, 3), over the background.
        alpha: (h, w), coverage in [0, 1].
        depth: (h, w), m: expected depth along the camera's z axis, Σwz / Σw; 0 where nothing is covered.
        projection: the Gaussians on the image plane (centres in px, visible reach, …).
    """

    colour: Tensor
    alpha: Tensor
    depth: Tensor
    projection: Projection


def rasterise(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
    antialias: bool = False,
) -> Rendering:
    """Draw Gaussians; differentiable with respect to all their tensors, on the device where these live.

    Args:
        gaussians: what to draw.
        camera: without distortion.
        background: colour behind everything (3,).
        antialias: blur by a pixel's own square only, and keep the total opacity of Gaussians smaller than a pixel
            (Mip-splatting).

    Raises:
        ParameterError: a camera with lens distortion (undistort the image and the camera first) or an empty image, or
            tensors that don't fit.
    """
    covariances = covariances_of(gaussians.scales, gaussians.quaternions)
    check(gaussians.means, covariances, gaussians.opacities, camera)
    projection = project(gaussians.means, covariances, gaussians.opacities, camera, antialias)
    features = torch.cat([gaussians.colours, projection.depths[:, None]], dim=1)
    behind = _behind(background, gaussians.colours)
    image, alpha = _composite(projection, features, camera, torch.cat([behind, behind.new_zeros(1)]))
    return Rendering(image[:, :, :3], alpha, image[:, :, 3] / alpha.clamp_min(1e-8), projection)


def rasterise_features(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | Sequence[float] | None = None,
    antialias: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blend any features (n, k), 1 ≤ k ≤ 8, with the weights that colours would get; differentiable in every tensor.

    Args:
        means: (n, 3), m.
        covariances: (n, 3, 3), m², symmetric.
        opacities: (n,).
        features: (n, k).
        camera: without distortion.
        background: (k,) behind everything; zeros by default.
        antialias: see `rasterise`.

    Returns:
        Σ wᵢ fᵢ + T·background (h, w, k), and how much of each pixel is covered, 1 − T (h, w).

    Raises:
        ParameterError: see `rasterise`.
    """
    if features.ndim != 2 or not 1 <= features.shape[1] <= constants.MAX_CHANNELS:
        raise ParameterError(
            f"features have shape {tuple(features.shape)}, expected (n, 1 to {constants.MAX_CHANNELS})"
        )
    check(means, covariances, opacities, camera)
    projection = project(means, covariances, opacities, camera, antialias)
    behind = _behind([0.0] * features.shape[1] if background is None else background, features)
    return _composite(projection, features, camera, behind)


def _behind(background: Tensor | Sequence[float], features: Tensor) -> Tensor:
    """The background's features (k,), as a tensor beside those of Gaussians (n, k)."""
    behind = torch.as_tensor(background, dtype=torch.float32, device=features.device)
    if behind.shape != features.shape[1:]:
        raise ParameterError(f"background has shape {tuple(behind.shape)}, expected ({features.shape[1]},)")
    return behind


def check(means: Tensor, covariances: Tensor, opacities: Tensor, camera: Camera) -> None:
    """Refuse what isn't Gaussians, and a camera whose picture is empty or bent.

    Raises:
        ParameterError: see `rasterise`.
    """
    if camera.width < 1 or camera.height < 1:
        raise ParameterError(f"the camera's image is empty ({camera.width} × {camera.height} px)")
    if camera.has_distortion:
        raise ParameterError("the rasteriser draws pinhole images: pass camera.undistorted() and an undistorted image")
    n = means.shape[0]
    for name, tensor, shape in (
        ("means", means, (n, 3)), ("covariances", covariances, (n, 3, 3)), ("opacities", opacities, (n,)),
    ):  # fmt: skip
        if tuple(tensor.shape) != shape:
            raise ParameterError(f"{name} have shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != torch.float32:
            raise ParameterError(f"{name} are {tensor.dtype}; the rasteriser takes torch.float32")


def _composite(projection: Projection, features: Tensor, camera: Camera, background: Tensor) -> tuple[Tensor, Tensor]:
    p, bins = projection, bin_by_tile(projection, features, camera)
    image, transmittance = _Composite.apply(p.centres, p.conics, p.strengths, features, background, bins, camera)
    return image, 1.0 - transmittance


class _Composite(torch.autograd.Function):
    """Blend projected Gaussians front to back."""

    @staticmethod
    def forward(
        ctx: Any,
        centres: Tensor,
        conics: Tensor,
        strengths: Tensor,
        features: Tensor,
        background: Tensor,
        bins: Bins,
        camera: Camera,
    ) -> tuple[Tensor, Tensor]:
        (image,), (transmittance,) = blend_each(bins, background, camera, 1)
        ctx.bins, ctx.camera = bins, camera
        ctx.save_for_backward(conics, strengths, image, transmittance)
        return image, transmittance

    @staticmethod
    def backward(ctx: Any, v_image: Tensor, v_transmittance: Tensor) -> tuple[Tensor | None, ...]:
        conics, strengths, image, transmittance = ctx.saved_tensors
        bins: Bins = ctx.bins
        n, channels = conics.shape[0], image.shape[2]
        kernels = _kernels(image)
        gradients = image.new_zeros((bins.ranks.shape[0], kernels.PARTS, kernels_binning.MOMENTS + channels))
        tensors = (image, transmittance, v_image, v_transmittance, gradients)
        inputs = [*_tile_arguments(bins, ctx.camera), as_warp(bins.entries, wp.int32)]
        inputs += [as_warp(t.reshape(-1), wp.float32) for t in tensors]
        _launch_tiles(kernels.backward_kernel(channels), bins, inputs, image)
        gradients = gradients.sum(dim=1) if kernels.PARTS > 1 else gradients[:, 0]
        shapes = ((n, 2), (n, 3), (n,), (n, channels))
        outputs = [image.new_zeros(shape) for shape in shapes]
        row = wp.types.vector(length=kernels_binning.MOMENTS + channels, dtype=wp.float32)
        types = (wp.vec2, wp.vec3, wp.float32, wp.types.vector(length=channels, dtype=wp.float32))
        arrays = [as_warp(bins.order, wp.int32), as_warp(bins.ends, wp.int32), as_warp(gradients, row)]
        arrays += [as_warp(conics, wp.vec3), as_warp(strengths, wp.float32)]
        arrays += [as_warp(t, d) for t, d in zip(outputs, types, strict=True)]
        launch(kernels_binning.gather_kernel(channels), bins.order.shape[0], arrays, image)
        v_background = torch.einsum("hw,hwk->k", transmittance, v_image) if ctx.needs_input_grad[4] else None
        return (*outputs, v_background, None, None)


def blend_each(bins: Bins, background: Tensor, camera: Camera, count: int) -> tuple[Tensor, Tensor]:
    """Features (v, h, w, k) and transmittance (v, h, w) of ``count`` views of one size, whose tiles follow each
    other."""
    channels, tiles = len(background), bins.tiles_x * bins.tiles_y
    images = background.new_empty((count, camera.height, camera.width, channels))
    transmittances = background.new_empty((count, camera.height, camera.width))
    kernels = _kernels(background)
    kernel = kernels.forward_kernel(channels)
    # A GPU draws all views in one launch: one by itself leaves most of it idle.
    at_once = count if kernels is kernels_cuda else 1
    for k in range(0, count, at_once):
        mine = replace(bins, starts=bins.starts[k * tiles : (k + at_once) * tiles + 1])
        tensors = (background, images[k : k + at_once], transmittances[k : k + at_once])
        inputs = [*_tile_arguments(mine, camera), *(as_warp(t.reshape(-1), wp.float32) for t in tensors)]
        _launch_tiles(kernel, mine, inputs, background)
    return images, transmittances


def _kernels(like: Tensor) -> ModuleType:
    """The tile kernels for the device of ``like``."""
    return kernels_cuda if like.is_cuda else kernels_cpu


def _launch_tiles(kernel: Any, bins: Bins, inputs: list[Any], like: Tensor) -> None:
    """Run a tile kernel over all tiles; on the CPU by as many threads as pay, with equal numbers of entries."""
    tiles = len(bins.starts) - 1
    if like.is_cuda:
        launch(kernel, tiles * kernels_cuda.THREADS, [0, *inputs], like, block=kernels_cuda.THREADS)
        return
    first, end = int(bins.starts[0]), int(bins.starts[-1])
    threads = thread_count((end - first) / _ENTRIES_PER_MILLISECOND)
    shares = first + torch.arange(1, threads) * (end - first) // threads
    inner = torch.searchsorted(bins.starts, shares.to(torch.int32)).tolist()
    launch_parts(kernel, [0, *inner, tiles], inputs)


def _tile_arguments(bins: Bins, camera: Camera) -> list[Any]:
    """What both tile kernels take first, after the number of the first tile."""
    rows, starts, ranks = as_warp(bins.rows, wp.float32), as_warp(bins.starts, wp.int32), as_warp(bins.ranks, wp.int32)
    return [camera.width, camera.height, bins.tiles_x, rows, starts, ranks]
