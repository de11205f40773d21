"""Where on the bed a pixel looks: its ray against the undisturbed surface."""

# ruff: noqa: UP018 - Warp takes a bare literal for a constant, so what a loop changes starts as float(...)

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
import warp as wp

from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.lit import march_step
from splatsoil.scene.relief import Relief, grid_of
from splatsoil.scene.tool import eye_of
from splatsoil.splats.warp_torch import as_warp, launch

FloatArray = npt.NDArray[np.float64]


def ground_of_pixels(
    relief: Relief, camera: Camera, lower: npt.ArrayLike, upper: npt.ArrayLike, rise: float = 0.0
) -> FloatArray:
    """Where the ray of each pixel meets the surface, within a rectangle.

    A ray that passes over a crest, and not over the rectangle's border, at no more than ``rise`` counts there: what is
    heaped upon the crest would be seen in this pixel. A ray that enters the rectangle beneath the surface, through the
    soil's side, has no place.

    Args:
        relief: the surface.
        camera: without distortion.
        lower: (2,) corner of the rectangle, m.
        upper: (2,) the opposite corner.
        rise: m.

    Returns:
        (h, w, 2) x and y in m; NaN where there is no such place.
    """
    place = torch.empty((camera.height, camera.width, 2), dtype=torch.float32, device=relief.device)
    low, high = (np.asarray(corner, dtype=np.float64) for corner in (lower, upper))
    bounds = wp.vec4(float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    floor = float(relief.height.min()) - march_step(relief)
    inputs = [eye_of(camera), as_warp(relief.height, wp.float32), grid_of(relief), bounds]
    inputs += [floor, march_step(relief), float(rise), as_warp(place, wp.vec2)]
    launch(_ground, (camera.height, camera.width), inputs, place)
    return place.cpu().numpy().astype(np.float64)


_FAR = 1.0e6
_NOWHERE = math.nan


@wp.func
def _height_over(
    height: wp.array2d(dtype=wp.float32), grid: kernels.Grid, origin: wp.vec3, ray: wp.vec3, t: float
) -> float:
    return origin[2] + t * ray[2] - kernels.sample(height, grid, origin[0] + t * ray[0], origin[1] + t * ray[1])


@wp.kernel(enable_backward=False)
def _ground(
    eye: kernels.Eye,
    height: wp.array2d(dtype=wp.float32),
    grid: kernels.Grid,
    bounds: wp.vec4,
    floor: float,
    step: float,
    rise: float,
    place: wp.array2d(dtype=wp.vec2),
) -> None:
    i, j = wp.tid()
    place[i, j] = wp.vec2(_NOWHERE, _NOWHERE)
    ray = wp.normalize(kernels.pixel_ray(eye, float(j) + 0.5, float(i) + 0.5))
    enter = float(0.0)
    leave = float(_FAR)
    for axis in range(2):
        if wp.abs(ray[axis]) > 1.0e-9:
            one = (bounds[axis] - eye.position[axis]) / ray[axis]
            other = (bounds[axis + 2] - eye.position[axis]) / ray[axis]
            enter = wp.max(enter, wp.min(one, other))
            leave = wp.min(leave, wp.max(one, other))
        elif eye.position[axis] < bounds[axis] or eye.position[axis] > bounds[axis + 2]:
            return
    if ray[2] < 0.0:
        leave = wp.min(leave, (floor - eye.position[2]) / ray[2])
    elif leave >= _FAR:
        return
    if leave <= enter:
        return
    t = enter
    gap = _height_over(height, grid, eye.position, ray, t)
    if gap < 0.0:
        return
    lowest = gap
    nearest = t
    # Slopes of 1.2 can't be stepped over; steeper ones are met a little late.
    closing = 1.0 / wp.max(1.2 * wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1]) - ray[2], 0.1)
    while t < leave:
        before = t
        t = wp.min(t + wp.clamp(gap * closing, 0.5 * step, 4.0 * step), leave)
        gap = _height_over(height, grid, eye.position, ray, t)
        if gap < 0.0:
            for _ in range(20):
                middle = 0.5 * (before + t)
                if _height_over(height, grid, eye.position, ray, middle) < 0.0:
                    t = middle
                else:
                    before = middle
            place[i, j] = wp.vec2(eye.position[0] + t * ray[0], eye.position[1] + t * ray[1])
            return
        if gap < lowest:
            lowest = gap
            nearest = t
    if lowest <= rise and nearest > enter and nearest < leave:
        place[i, j] = wp.vec2(eye.position[0] + nearest * ray[0], eye.position[1] + nearest * ray[1])
