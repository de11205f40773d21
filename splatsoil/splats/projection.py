"""Gaussians in space to Gaussians on the image plane (EWA), as differentiable torch functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats import constants
from splatsoil.splats import kernels_projection as kernels
from splatsoil.splats.warp_torch import as_warp, launch


@dataclass(frozen=True)
class Projection:
    """n Gaussians on the image plane.

    Attributes:
        centres: (n, 2), px; pixel (row i, column j) has its centre at (j + ½, i + ½).
        conics: (n, 3), the inverse covariance's xx, xy, yy, px⁻².
        strengths: (n,), opacity times the antialiasing factor.
        depths: (n,), along the camera's z axis, m.
        reaches: (n, 2), half-width and half-height of the box in which opacity exceeds 1/255, px; 0 where not visible.
    """

    centres: Tensor
    conics: Tensor
    strengths: Tensor
    depths: Tensor
    reaches: Tensor

    @property
    def visible(self) -> Tensor:
        """(n,) bool: which Gaussians can touch the image."""
        return self.reaches[:, 0] > 0


def project(
    means: Tensor, covariances: Tensor, opacities: Tensor, camera: Camera, antialias: bool = False
) -> Projection:
    """Project Gaussians; differentiable with respect to means, covariances and opacities (all but ``reaches``).

    Args:
        means: (n, 3), m, world frame.
        covariances: (n, 3, 3), m².
        opacities: (n,), in [0, 1].
        camera: without distortion.
        antialias: dilate by a pixel's own variance only, and scale opacity by √(det Σ / det Σ′), so that the dilation
            does not make small Gaussians heavier.
    """
    return Projection(*_Project.apply(means, covariances, opacities, camera, antialias))


def project_each(
    gaussians: Sequence[tuple[Tensor, Tensor, Tensor]], cameras: Sequence[Camera], antialias: bool = False
) -> Projection:
    """Means, covariances and opacities of several scenes, each projected by its own camera, one after the other in one
    projection; without gradients."""
    return Projection(*_projected(gaussians, [_lens(camera, antialias) for camera in cameras]))


def covariances_of(scales: Tensor, quaternions: Tensor) -> Tensor:
    """R diag(s²) Rᵀ (n, 3, 3), as `Gaussians.covariances` but in one kernel each way."""
    return _Covariances.apply(scales, quaternions)


def _lens(camera: Camera, antialias: bool) -> Any:
    lens = kernels.Lens()
    pose = camera.world_to_camera
    lens.rotation, lens.translation = wp.mat33(*pose[:3, :3].reshape(-1).tolist()), wp.vec3(*pose[:3, 3].tolist())
    lens.focal, lens.centre = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
    lens.size = wp.vec2(float(camera.width), float(camera.height))
    lens.antialias = int(antialias)
    lens.dilation = constants.PIXEL_VARIANCE if antialias else constants.DILATION
    return lens


def _arrays(tensors: tuple[Tensor, ...], types: tuple[Any, ...]) -> list[Any]:
    return [as_warp(t, d) for t, d in zip(tensors, types, strict=True)]


def _projected(gaussians: Sequence[tuple[Tensor, Tensor, Tensor]], lenses: Sequence[Any]) -> tuple[Tensor, ...]:
    """What a `Projection` of several scenes is made of, each by its own lens."""
    counts, like = [len(means) for means, _, _ in gaussians], gaussians[0][0]
    outputs = tuple(like.new_zeros((sum(counts), *shape)) for shape in ((2,), (3,), (), (), (2,)))
    parts = zip(*(output.split(counts) for output in outputs), strict=True)
    for inputs, lens, part in zip(gaussians, lenses, parts, strict=True):
        launch(
            kernels.project_forward, len(inputs[0]), [*_arrays(inputs, _INPUTS), lens, *_arrays(part, _OUTPUTS)], like
        )
    return outputs


_INPUTS = (wp.vec3, wp.mat33, wp.float32)
_OUTPUTS = (wp.vec2, wp.vec3, wp.float32, wp.float32, wp.vec2)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covariances: Tensor, opacities: Tensor, camera: Camera, antialias: bool
    ) -> tuple[Tensor, ...]:
        inputs = (means, covariances, opacities)
        ctx.lens = _lens(camera, antialias)
        ctx.save_for_backward(*inputs)
        outputs = _projected([inputs], [ctx.lens])
        ctx.mark_non_differentiable(outputs[4])
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        results = tuple(t.new_zeros(t.shape) for t in inputs)
        arguments = [*_arrays(inputs, _INPUTS), ctx.lens, *_arrays(gradients[:4], _OUTPUTS[:4])]
        arguments += _arrays(results, _INPUTS)
        launch(kernels.project_backward, inputs[0].shape[0], arguments, inputs[0])
        return (*results, None, None)


class _Covariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, quaternions: Tensor) -> Tensor:
        out = scales.new_empty((scales.shape[0], 3, 3))
        ctx.save_for_backward(scales, quaternions)
        arguments = _arrays((scales, quaternions, out), (wp.vec3, wp.vec4, wp.mat33))
        launch(kernels.covariance_forward, scales.shape[0], arguments, scales)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        scales, quaternions = ctx.saved_tensors
        v_scales, v_quaternions = scales.new_empty(scales.shape), scales.new_empty(quaternions.shape)
        tensors = (scales, quaternions, gradients[0], v_scales, v_quaternions)
        arguments = _arrays(tensors, (wp.vec3, wp.vec4, wp.mat33, wp.vec3, wp.vec4))
        launch(kernels.covariance_backward, scales.shape[0], arguments, scales)
        return v_scales, v_quaternions
