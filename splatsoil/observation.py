"""Observation model: errors of camera pose, exposure, clock, focus, light and tool pose.

It does not change the simulation. Everything is off by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate1d
from scipy.spatial.transform import Rotation
from scipy.special import ive

from splatsoil.arrays import FloatArray, Image
from splatsoil.colour import encoded, linear
from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera

Pose = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class CameraShift:
    """Error of a camera's pose in its own axes; rotation is about the centre of projection.

    Attributes:
        pan: rotation to the right, degrees.
        tilt: rotation upwards, degrees.
        roll: rotation clockwise, seen from behind, degrees.
        right, up, forward: shift, m.
    """

    pan: float = 0.0
    tilt: float = 0.0
    roll: float = 0.0
    right: float = 0.0
    up: float = 0.0
    forward: float = 0.0


@dataclass(frozen=True)
class Observation:
    """Differences between ideal and real cameras.

    Attributes:
        cameras: shift of each camera, in the measurement's order; further ones have none.
        gain: factor of linear colour (exposure time, aperture).
        drift: growth rate of the gain's natural logarithm from time 0 on, 1/s.
        offset: linear colour added to every channel (stray light, black level), as a share of white.
        time_offset: delay of pictures relative to their frame number, s.
        tool_shift: (3,) shift of the drawn tool in the world, m; the simulation does not use it.
        tool_turn: rotation of the drawn tool about the vertical through its origin, from +x towards +y, degrees.
        blur: standard deviation of a Gaussian blur of linear colour, pixels.
        sun_azimuth: rotation of the sun from +x towards +y, degrees.
        sun_elevation: rise of the sun, degrees.
        sky_share: increase of the sky's share of the light on level, open ground.
    """

    cameras: tuple[CameraShift, ...] = ()
    gain: float = 1.0
    drift: float = 0.0
    offset: float = 0.0
    time_offset: float = 0.0
    tool_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tool_turn: float = 0.0
    blur: float = 0.0
    sun_azimuth: float = 0.0
    sun_elevation: float = 0.0
    sky_share: float = 0.0

    def __post_init__(self) -> None:
        if not self.gain > 0.0:
            raise ParameterError(f"an exposure's gain is positive, not {self.gain}")
        if not self.blur >= 0.0:
            raise ParameterError(f"a blur is 0 pixels or more, not {self.blur}")

    def camera(self, camera: Camera, index: int) -> Camera:
        """The real pose of camera ``index`` of the measurement."""
        if index >= len(self.cameras) or self.cameras[index] == CameraShift():
            return camera
        shift = self.cameras[index]
        # Camera axes are OpenGL's: +x right, +y up, looking down -z.
        turn = Rotation.from_euler("YXZ", [-shift.pan, shift.tilt, -shift.roll], degrees=True).as_matrix()
        change = np.eye(4)
        change[:3, :3] = turn
        change[:3, 3] = [shift.right, shift.up, -shift.forward]
        return replace(camera, camera_to_world=camera.camera_to_world @ change)

    def tool(self, pose: Pose) -> Pose:
        """Pose of the drawn tool for a ``pose``: rotation (3, 3), tool to world, and position (3,) in m."""
        if self.tool_turn == 0.0 and not any(self.tool_shift):
            return pose
        turn = Rotation.from_euler("z", self.tool_turn, degrees=True).as_matrix()
        return turn @ pose[0], np.asarray(pose[1]) + np.array(self.tool_shift)

    @property
    def of_scene(self) -> Observation:
        """The part that changes the scene: time, light, tool pose."""
        return replace(self, cameras=(), gain=1.0, drift=0.0, offset=0.0, blur=0.0)

    @property
    def changes_light(self) -> bool:
        """Whether sun and sky differ from those estimated."""
        return bool(self.sun_azimuth or self.sun_elevation or self.sky_share)

    def image(self, image: Image, time: float) -> Image:
        """The camera's picture of an ideal picture (h, w, 3), sRGB in [0, 1], at ``time`` in s."""
        if self.gain == 1.0 and self.drift == 0.0 and self.offset == 0.0 and self.blur == 0.0:
            return image
        colour = self.exposed(linear(image.astype(np.float64)), time)
        return encoded(np.clip(colour, 0.0, 1.0)).astype(np.float32)

    def exposed(self, colour: FloatArray, time: float) -> FloatArray:
        """Sensor values of linear colour (h, w, 3) at ``time`` in s."""
        gain = self.gain * math.exp(self.drift * max(time, 0.0))
        return gain * blurred(colour, self.blur) + self.offset


def blurred(image: FloatArray, sigma: float) -> FloatArray:
    """An image (h, w, k) under a Gaussian blur of ``sigma`` pixels, its border held.

    The kernel is the discrete Gaussian exp(-σ²) I_n(σ²), whose variance is σ² exactly, however small σ is (Lindeberg
    1990, IEEE PAMI 12, sec. III-C).
    """
    if sigma == 0.0:
        return image
    radius = max(2, math.ceil(5.0 * sigma + 1.0))
    weights = ive(np.abs(np.arange(-radius, radius + 1)), sigma**2)
    weights /= weights.sum()
    for axis in (0, 1):
        image = correlate1d(image, weights, axis=axis, mode="nearest")
    return image
