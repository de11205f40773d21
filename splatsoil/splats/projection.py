"""Gaussians in space to Gaussians on the image plane (EWA), as one Warp kernel for CPU and CUDA and its gradient.

The kernel is differentiated by Warp; `splatsoil.splats.reference` says the same in plain torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from splatsoil.splats import constants
from splatsoil.splats.camera import View
from splatsoil.splats.warp_torch import as_warp, launch

_DILATION = wp.constant(wp.float32(constants.DILATION))
_ALPHA_MIN = wp.constant(wp.float32(constants.ALPHA_MIN))
_ANTIALIAS_MIN = wp.constant(wp.float32(constants.ANTIALIAS_MIN))
_NEAR = wp.constant(wp.float32(constants.NEAR))
_TANGENT_LIMIT = wp.constant(wp.float32(constants.TANGENT_LIMIT))


@wp.struct
class Lens:
    """A `View` for kernels."""

    rotation: wp.mat33
    translation: wp.vec3
    focal: wp.vec2
    centre: wp.vec2
    size: wp.vec2
    orthographic: int
    antialias: int


@wp.func
def _clamped(value: float):
    return wp.max(-_TANGENT_LIMIT, wp.min(_TANGENT_LIMIT, value))


@wp.kernel(module="unique")
def _project(
    means: wp.array(dtype=wp.vec3),
    covariances: wp.array(dtype=wp.mat33),
    opacities: wp.array(dtype=float),
    lens: Lens,
    centres: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    strengths: wp.array(dtype=float),
    depths: wp.array(dtype=float),
    reaches: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    p = lens.rotation * means[i] + lens.translation
    z = p[2]
    depths[i] = z
    opacity = opacities[i]
    if (lens.orthographic == 1 or z > _NEAR) and opacity > _ALPHA_MIN:
        # rows of J·W: how the image moves with the world
        row_x = wp.vec3()
        row_y = wp.vec3()
        centre = wp.vec2()
        right = lens.rotation[0]
        down = lens.rotation[1]
        if lens.orthographic == 1:
            row_x = right * lens.focal[0]
            row_y = down * lens.focal[1]
            centre = wp.cw_mul(lens.focal, wp.vec2(p[0], p[1])) + lens.centre
        else:
            ahead = lens.rotation[2]
            inverse = 1.0 / z
            tx = p[0] * inverse
            ty = p[1] * inverse
            row_x = (right - ahead * _clamped(tx)) * (lens.focal[0] * inverse)
            row_y = (down - ahead * _clamped(ty)) * (lens.focal[1] * inverse)
            centre = wp.cw_mul(lens.focal, wp.vec2(tx, ty)) + lens.centre
        sx = covariances[i] * row_x
        sy = covariances[i] * row_y
        plain_xx = wp.dot(row_x, sx)
        plain_yy = wp.dot(row_y, sy)
        xy = wp.dot(row_x, sy)
        xx = plain_xx + _DILATION
        yy = plain_yy + _DILATION
        determinant = xx * yy - xy * xy
        strength = opacity
        if lens.antialias == 1:
            ratio = (plain_xx * plain_yy - xy * xy) / determinant
            strength = opacity * wp.sqrt(wp.max(_ANTIALIAS_MIN * _ANTIALIAS_MIN, ratio))
        centres[i] = centre
        conics[i] = wp.vec3(yy, -xy, xx) / determinant
        strengths[i] = strength
        if strength > _ALPHA_MIN and determinant > 0.0:
            cut = 2.0 * wp.log(strength / _ALPHA_MIN)
            reach = wp.vec2(wp.sqrt(cut * xx), wp.sqrt(cut * yy))
            inside_x = centre[0] + reach[0] > 0.5 and centre[0] - reach[0] < lens.size[0] - 0.5
            inside_y = centre[1] + reach[1] > 0.5 and centre[1] - reach[1] < lens.size[1] - 0.5
            if inside_x and inside_y:
                reaches[i] = reach


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


def _lens(view: View, antialias: bool) -> Any:
    lens = Lens()
    lens.rotation = wp.mat33(*view.rotation.reshape(-1).tolist())
    lens.translation = wp.vec3(*view.translation.tolist())
    lens.focal = wp.vec2(*view.focal)
    lens.centre = wp.vec2(*view.centre)
    lens.size = wp.vec2(float(view.width), float(view.height))
    lens.orthographic = int(view.orthographic)
    lens.antialias = int(antialias)
    return lens


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means: Tensor, covariances: Tensor, opacities: Tensor, view: View, antialias: bool
    ) -> tuple[Tensor, ...]:
        n = means.shape[0]
        outputs = tuple(means.new_zeros(shape) for shape in ((n, 2), (n, 3), (n,), (n,), (n, 2)))
        ctx.lens = _lens(view, antialias)
        ctx.save_for_backward(means, covariances, opacities, *outputs)
        launch(_project, n, _arrays((means, covariances, opacities), ctx.lens, outputs), means)
        ctx.mark_non_differentiable(outputs[4])
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, covariances, opacities, *outputs = ctx.saved_tensors
        inputs = (means, covariances, opacities)
        input_gradients = tuple(t.new_zeros(t.shape) for t in inputs)
        arrays = _arrays(inputs, ctx.lens, tuple(outputs))
        adjoints = _arrays(input_gradients, Lens(), (*gradients[:4], None))
        launch(
            _project, means.shape[0], arrays[:4], means,
            outputs=arrays[4:], adj_inputs=adjoints[:4], adj_outputs=adjoints[4:], adjoint=True,
        )  # fmt: skip
        return (*input_gradients, None, None)


def _arrays(inputs: tuple[Tensor, ...], lens: Any, outputs: tuple[Tensor | None, ...]) -> list[Any]:
    """Arguments of the kernel `_project` (or their adjoints) as Warp arrays."""
    types = (wp.vec3, wp.mat33, wp.float32), (wp.vec2, wp.vec3, wp.float32, wp.float32, wp.vec2)
    first = [as_warp(t, d) for t, d in zip(inputs, types[0], strict=True)]
    last = [None if t is None else as_warp(t, d) for t, d in zip(outputs, types[1], strict=True)]
    return [*first, lens, *last]


def project(means: Tensor, covariances: Tensor, opacities: Tensor, view: View, antialias: bool = False) -> Projection:
    """Project Gaussians; differentiable with respect to means, covariances and opacities (all but ``reaches``).

    Args:
        means: (n, 3), m, world frame.
        covariances: (n, 3, 3), m².
        opacities: (n,), in [0, 1].
        view: the camera.
        antialias: scale opacity by √(det Σ / det Σ′), so that the dilation does not make small Gaussians heavier.
    """
    return Projection(*_Project.apply(means, covariances, opacities, view, antialias))


@wp.kernel(module="unique")
def _covariance(
    scales: wp.array(dtype=wp.vec3), quaternions: wp.array(dtype=wp.vec4), covariances: wp.array(dtype=wp.mat33)
):
    i = wp.tid()
    q = wp.normalize(quaternions[i])
    rotation = wp.quat_to_matrix(wp.quaternion(q[1], q[2], q[3], q[0]))
    half = rotation * wp.diag(scales[i])
    covariances[i] = half * wp.transpose(half)


class _Covariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, quaternions: Tensor) -> Tensor:  # type: ignore[override]
        out = scales.new_empty((scales.shape[0], 3, 3))
        ctx.save_for_backward(scales, quaternions, out)
        arrays = [as_warp(scales, wp.vec3), as_warp(quaternions, wp.vec4), as_warp(out, wp.mat33)]
        launch(_covariance, scales.shape[0], arrays, scales)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        scales, quaternions, out = ctx.saved_tensors
        v_scales, v_quaternions = scales.new_zeros(scales.shape), quaternions.new_zeros(quaternions.shape)
        launch(
            _covariance, scales.shape[0], [as_warp(scales, wp.vec3), as_warp(quaternions, wp.vec4)], scales,
            outputs=[as_warp(out, wp.mat33)],
            adj_inputs=[as_warp(v_scales, wp.vec3), as_warp(v_quaternions, wp.vec4)],
            adj_outputs=[as_warp(gradient, wp.mat33)],
            adjoint=True,
        )  # fmt: skip
        return v_scales, v_quaternions


def covariances_of(scales: Tensor, quaternions: Tensor) -> Tensor:
    """R diag(s²) Rᵀ (n, 3, 3), as `Gaussians.covariances` but in one kernel each way."""
    return _Covariances.apply(scales, quaternions)
