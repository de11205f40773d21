# mypy: ignore-errors
# (Warp reads the annotations of kernels as types of its own)
"""Warp kernels, for CPU and CUDA: covariances of Gaussians, their projection to the image plane, and both gradients.

`splatsoil.splats.reference` says the same in plain torch. The gradients are written out by hand: half the time of
generated ones.
"""

from __future__ import annotations

import warp as wp

from splatsoil.splats import constants

_ALPHA_MIN = wp.constant(wp.float32(constants.ALPHA_MIN))
_ANTIALIAS_MIN = wp.constant(wp.float32(constants.ANTIALIAS_MIN))
_NEAR = wp.constant(wp.float32(constants.NEAR))
_REACH_TO_EYE = wp.constant(wp.float32(constants.REACH_TO_EYE))
_TANGENT_LIMIT = wp.constant(wp.float32(constants.TANGENT_LIMIT))
_LARGEST = wp.constant(wp.float32(1e30))  # beyond it single precision overflows; such splats are millions of px wide


@wp.struct
class Lens:
    """A camera for kernels: x_px = focal·x/z + centre, OpenCV axes."""

    rotation: wp.mat33
    translation: wp.vec3
    focal: wp.vec2
    centre: wp.vec2
    size: wp.vec2
    antialias: int
    dilation: float


@wp.struct
class Footprint:
    """How the image moves with the world around a point, and the covariance on the image plane."""

    row_x: wp.vec3
    row_y: wp.vec3
    sx: wp.vec3
    sy: wp.vec3
    plain_xx: float
    plain_yy: float
    xx: float
    yy: float
    xy: float
    determinant: float


@wp.func
def _clamped(value: float):
    return wp.clamp(value, -_TANGENT_LIMIT, _TANGENT_LIMIT)


@wp.func
def _before_camera(p: wp.vec3, covariance: wp.mat33, lens: Lens):
    """Whether a Gaussian lies far enough before the camera's plane to be drawn; p: the mean in the camera's frame."""
    ahead = lens.rotation[2]
    variance = wp.dot(ahead, covariance * ahead)
    return p[2] > _NEAR and p[2] * p[2] > _REACH_TO_EYE * _REACH_TO_EYE * variance


@wp.func
def _footprint(p: wp.vec3, covariance: wp.mat33, lens: Lens):
    """p: the mean in the camera's frame; J·W row by row, then J·W·Σ·(J·W)ᵀ with and without the dilation."""
    f = Footprint()
    inverse = 1.0 / p[2]
    ahead = lens.rotation[2]
    f.row_x = (lens.rotation[0] - ahead * _clamped(p[0] * inverse)) * (lens.focal[0] * inverse)
    f.row_y = (lens.rotation[1] - ahead * _clamped(p[1] * inverse)) * (lens.focal[1] * inverse)
    f.sx = covariance * f.row_x
    f.sy = covariance * f.row_y
    f.plain_xx = wp.dot(f.row_x, f.sx)
    f.plain_yy = wp.dot(f.row_y, f.sy)
    f.xy = wp.dot(f.row_x, f.sy)
    f.xx = f.plain_xx + lens.dilation
    f.yy = f.plain_yy + lens.dilation
    f.determinant = f.xx * f.yy - f.xy * f.xy
    return f


@wp.kernel(enable_backward=False, module="unique")
def project_forward(
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
    """The outputs are zero beforehand; a Gaussian that is not drawn keeps them, but for its depth."""
    i = wp.tid()
    p = lens.rotation * means[i] + lens.translation
    depths[i] = p[2]
    opacity = opacities[i]
    if opacity > _ALPHA_MIN and _before_camera(p, covariances[i], lens):
        f = _footprint(p, covariances[i], lens)
        place = wp.vec2(p[0], p[1]) / p[2]
        centre = wp.cw_mul(lens.focal, place) + lens.centre
        strength = opacity
        if lens.antialias == 1:
            ratio = (f.plain_xx * f.plain_yy - f.xy * f.xy) / f.determinant
            strength = opacity * wp.sqrt(wp.max(_ANTIALIAS_MIN * _ANTIALIAS_MIN, ratio))
        centres[i] = centre
        conics[i] = wp.vec3(f.yy, -f.xy, f.xx) / f.determinant
        strengths[i] = strength
        if strength > _ALPHA_MIN and f.determinant > 0.0 and f.determinant < _LARGEST:
            cut = 2.0 * wp.log(strength / _ALPHA_MIN)
            reach = wp.vec2(wp.sqrt(cut * f.xx), wp.sqrt(cut * f.yy))
            inside_x = centre[0] + reach[0] > 0.5 and centre[0] - reach[0] < lens.size[0] - 0.5
            inside_y = centre[1] + reach[1] > 0.5 and centre[1] - reach[1] < lens.size[1] - 0.5
            if inside_x and inside_y:
                reaches[i] = reach


@wp.kernel(enable_backward=False, module="unique")
def project_backward(
    means: wp.array(dtype=wp.vec3),
    covariances: wp.array(dtype=wp.mat33),
    opacities: wp.array(dtype=float),
    lens: Lens,
    v_centres: wp.array(dtype=wp.vec2),
    v_conics: wp.array(dtype=wp.vec3),
    v_strengths: wp.array(dtype=float),
    v_depths: wp.array(dtype=float),
    v_means: wp.array(dtype=wp.vec3),
    v_covariances: wp.array(dtype=wp.mat33),
    v_opacities: wp.array(dtype=float),
):
    """Gradients by means, covariances (symmetric) and opacities."""
    i = wp.tid()
    p = lens.rotation * means[i] + lens.translation
    opacity = opacities[i]
    v_p = wp.vec3(0.0, 0.0, v_depths[i])
    if opacity > _ALPHA_MIN and _before_camera(p, covariances[i], lens):
        f = _footprint(p, covariances[i], lens)
        a = f.yy / f.determinant
        b = -f.xy / f.determinant
        c = f.xx / f.determinant
        v = v_conics[i]
        v_xx = -(a * a * v[0] + a * b * v[1] + b * b * v[2])
        v_yy = -(b * b * v[0] + b * c * v[1] + c * c * v[2])
        v_xy = -(2.0 * a * b * v[0] + (a * c + b * b) * v[1] + 2.0 * b * c * v[2])
        factor = wp.float32(1.0)
        if lens.antialias == 1:
            ratio = (f.plain_xx * f.plain_yy - f.xy * f.xy) / f.determinant
            factor = _ANTIALIAS_MIN
            if ratio > _ANTIALIAS_MIN * _ANTIALIAS_MIN:
                factor = wp.sqrt(ratio)
                v_ratio = 0.5 * v_strengths[i] * opacity / (factor * f.determinant)
                v_xx += v_ratio * (f.plain_yy - ratio * f.yy)
                v_yy += v_ratio * (f.plain_xx - ratio * f.xx)
                v_xy += v_ratio * 2.0 * f.xy * (ratio - 1.0)
        v_opacities[i] = v_strengths[i] * factor
        mixed = wp.outer(f.row_x, f.row_y)
        v_covariances[i] = (
            v_xx * wp.outer(f.row_x, f.row_x)
            + v_yy * wp.outer(f.row_y, f.row_y)
            + 0.5 * v_xy * (mixed + wp.transpose(mixed))
        )
        v_place = wp.cw_mul(lens.focal, v_centres[i])
        v_row_x = 2.0 * v_xx * f.sx + v_xy * f.sy
        v_row_y = 2.0 * v_yy * f.sy + v_xy * f.sx
        inverse = 1.0 / p[2]
        tx = p[0] * inverse
        ty = p[1] * inverse
        v_tx = v_place[0]
        v_ty = v_place[1]
        ahead = lens.rotation[2]
        if wp.abs(tx) < _TANGENT_LIMIT:
            v_tx -= lens.focal[0] * inverse * wp.dot(v_row_x, ahead)
        if wp.abs(ty) < _TANGENT_LIMIT:
            v_ty -= lens.focal[1] * inverse * wp.dot(v_row_y, ahead)
        # both rows are proportional to 1/z
        v_z = (wp.dot(v_row_x, f.row_x) + wp.dot(v_row_y, f.row_y) + v_tx * tx + v_ty * ty) * inverse
        v_p += wp.vec3(v_tx * inverse, v_ty * inverse, -v_z)
    v_means[i] = wp.transpose(lens.rotation) * v_p


@wp.func
def _rotation(q: wp.vec4):
    """Rotation matrix of a unit quaternion, wxyz."""
    return wp.quat_to_matrix(wp.quaternion(q[1], q[2], q[3], q[0]))


@wp.kernel(enable_backward=False, module="unique")
def covariance_forward(
    scales: wp.array(dtype=wp.vec3), quaternions: wp.array(dtype=wp.vec4), covariances: wp.array(dtype=wp.mat33)
):
    """R diag(s²) Rᵀ."""
    i = wp.tid()
    half = _rotation(wp.normalize(quaternions[i])) * wp.diag(scales[i])
    covariances[i] = half * wp.transpose(half)


@wp.kernel(enable_backward=False, module="unique")
def covariance_backward(
    scales: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    v_covariances: wp.array(dtype=wp.mat33),
    v_scales: wp.array(dtype=wp.vec3),
    v_quaternions: wp.array(dtype=wp.vec4),
):
    """With M = R diag(s) and Σ = M Mᵀ the gradient by M is (V + Vᵀ) M."""
    i = wp.tid()
    length = wp.length(quaternions[i])
    q = quaternions[i] / length
    s = scales[i]
    r = _rotation(q)
    v = v_covariances[i]
    v_half = (v + wp.transpose(v)) * (r * wp.diag(s))
    product = wp.cw_mul(r, v_half)
    v_scales[i] = product[0] + product[1] + product[2]
    g = v_half * wp.diag(s)
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    v_w = 2.0 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    v_x = 2.0 * (w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]))
    v_x -= 4.0 * x * (g[1, 1] + g[2, 2])
    v_y = 2.0 * (w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]))
    v_y -= 4.0 * y * (g[0, 0] + g[2, 2])
    v_z = 2.0 * (w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]))
    v_z -= 4.0 * z * (g[0, 0] + g[1, 1])
    v_q = wp.vec4(v_w, v_x, v_y, v_z)
    v_quaternions[i] = (v_q - q * wp.dot(q, v_q)) / length
