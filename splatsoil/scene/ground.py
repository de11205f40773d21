"""Which point of the bed each pixel shows: its ray against the undisturbed surface, and what stands in its way."""

# ruff: noqa: UP018 - Warp takes a bare literal for a constant, so what a loop changes starts as float(...)

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.kernels_maps import Surface, height_at
from splatsoil.scene.relief import Relief
from splatsoil.scene.tool import eye_of
from splatsoil.splats import Gaussians, rasterise_features
from splatsoil.splats.warp_torch import as_warp, launch

_FAR = 1.0e6
"""Beyond everything, m."""
_NOWHERE = math.nan

_PROMINENCE = 0.1
"""Behind a crest a ray must leave the surface by this share of ``rise``, or a rough plain would be full of crests."""


def ground_of_pixels(
    relief: Relief,
    camera: Camera,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    rise: float = 0.0,
    surroundings: Gaussians | None = None,
) -> FloatArray:
    """Where the ray of each pixel meets the surface, within a rectangle.

    A ray that passes over a crest, and not over the rectangle's border, at no more than ``rise`` counts there: what is
    heaped upon the crest would be seen in this pixel. A ray that comes through the relief's side, that soil outside
    the rectangle stops, or that the surroundings hide from the camera, has no place.

    Args:
        relief: the surface.
        camera: without distortion.
        lower: (2,) corner of the rectangle, m.
        upper: (2,) the opposite corner.
        rise: m; negative for the surface alone.
        surroundings: Gaussians that may stand in the way, as a wall of the bin does; none by default.

    Returns:
        (h, w, 2) x and y in m; NaN where there is no such place.
    """
    place = torch.empty((camera.height, camera.width, 3), dtype=torch.float32, device=relief.device)
    low, high = (np.asarray(corner, dtype=np.float64) for corner in (lower, upper))
    bounds = wp.vec4(float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    ny, nx = relief.height.shape
    (x0, y0), (dx, dy) = relief.origin, relief.cell
    ends = wp.vec4(x0 - 0.5 * dx, y0 - 0.5 * dy, x0 + (nx - 0.5) * dx, y0 + (ny - 0.5) * dy)
    inputs = [eye_of(camera), relief.surface, ends, bounds, relief.range[0] - max(relief.cell), float(rise)]
    launch(_ground, (camera.height, camera.width), [*inputs, as_warp(place, wp.vec3)], place)
    if surroundings is not None:
        place[_hidden(place, camera, surroundings.to(place.device))] = _NOWHERE
    return place[..., :2].cpu().numpy().astype(np.float64)


def _hidden(place: Tensor, camera: Camera, surroundings: Gaussians) -> Tensor:
    """(h, w) pixels in which Gaussians before the places (h, w, 3), NaN for none, show more than the places do.

    Each place is drawn as an opaque ball of a pixel's size among the Gaussians, in the order of depth.
    """
    known = torch.isfinite(place[..., 0])
    points = place[known]
    eye = torch.tensor(camera.position, dtype=torch.float32, device=place.device)
    size = (points - eye).norm(dim=1) * (0.5 / math.sqrt(camera.fx * camera.fy))
    around = surroundings.detach()
    balls = size.square()[:, None, None] * torch.eye(3, device=place.device)
    means, covariances = torch.cat([around.means, points]), torch.cat([around.covariances(), balls])
    opacities = torch.cat([around.opacities, size.new_ones(len(points))])
    of_place = torch.cat([size.new_zeros(len(around), 1), size.new_ones(len(points), 1)])
    with torch.no_grad():
        shown, alpha = rasterise_features(means, covariances, opacities, of_place, camera, antialias=True)
    return known & (shown[..., 0] < 0.5 * alpha)


@wp.func
def _gap(surface: Surface, origin: wp.vec3, ray: wp.vec3, t: float) -> float:
    return origin[2] + t * ray[2] - height_at(surface, origin[0] + t * ray[0], origin[1] + t * ray[1])


@wp.func
def _inside(bounds: wp.vec4, origin: wp.vec3, ray: wp.vec3, t: float) -> bool:
    x = origin[0] + t * ray[0]
    y = origin[1] + t * ray[1]
    return x >= bounds[0] and y >= bounds[1] and x <= bounds[2] and y <= bounds[3]


@wp.kernel(enable_backward=False)
def _ground(
    eye: kernels.Eye,
    surface: Surface,
    ends: wp.vec4,
    bounds: wp.vec4,
    floor: float,
    rise: float,
    place: wp.array2d(dtype=wp.vec3),
) -> None:
    i, j = wp.tid()
    place[i, j] = wp.vec3(_NOWHERE, _NOWHERE, _NOWHERE)
    ray = wp.normalize(kernels.pixel_ray(eye, float(j) + 0.5, float(i) + 0.5))
    enter = float(0.0)
    leave = float(_FAR)
    for axis in range(2):
        if wp.abs(ray[axis]) > 1.0e-9:
            one = (ends[axis] - eye.position[axis]) / ray[axis]
            other = (ends[axis + 2] - eye.position[axis]) / ray[axis]
            enter = wp.max(enter, wp.min(one, other))
            leave = wp.min(leave, wp.max(one, other))
        elif eye.position[axis] < ends[axis] or eye.position[axis] > ends[axis + 2]:
            return
    if ray[2] < 0.0:
        leave = wp.min(leave, (floor - eye.position[2]) / ray[2])
    elif leave >= _FAR:
        return
    if leave <= enter:
        return
    t = enter
    gap = _gap(surface, eye.position, ray, t)
    if gap < 0.0:
        return
    lowest = float(_FAR)
    nearest = float(0.0)
    away = float(0.0)
    # Slopes of 1.2 can't be stepped over; steeper ones are met a little late.
    closing = 1.0 / wp.max(1.2 * wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1]) - ray[2], 0.1)
    while t < leave:
        before = t
        longest = wp.where(gap < 2.0 * rise, surface.step, 4.0 * surface.step)
        t = wp.min(t + wp.clamp(gap * closing, 0.5 * surface.step, longest), leave)
        gap = _gap(surface, eye.position, ray, t)
        if gap < 0.0:
            for _ in range(20):
                middle = 0.5 * (before + t)
                if _gap(surface, eye.position, ray, middle) < 0.0:
                    t = middle
                else:
                    before = middle
            if _inside(bounds, eye.position, ray, t):
                place[i, j] = eye.position + t * ray
            return
        if gap < lowest:
            lowest = gap
            nearest = t
            away = gap
        away = wp.max(away, gap)
    if lowest <= rise and away - lowest >= _PROMINENCE * rise and _inside(bounds, eye.position, ray, nearest):
        place[i, j] = eye.position + nearest * ray
