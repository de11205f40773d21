"""Cameras as the rasteriser sees them: a pinhole (``measurement.Camera``) or an orthographic one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatsoil.errors import ParameterError

FloatArray = npt.NDArray[np.float64]


@runtime_checkable
class PinholeCamera(Protocol):
    """What the rasteriser needs of a perspective camera; ``measurement.Camera`` has it."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def world_to_camera(self) -> FloatArray: ...
    @property
    def has_distortion(self) -> bool: ...


@dataclass(frozen=True)
class OrthographicCamera:
    """A camera whose rays are parallel: height maps from above, shadow maps from the sun.

    The optical axis goes through the middle of the image. Nothing is clipped: depth is negative behind the camera.

    Attributes:
        width: image width, px.
        height: image height, px.
        pixel_size: side of a pixel, m.
        camera_to_world: (4, 4), OpenGL axes (+x right, +y up, looking along −z), like ``measurement.Camera``.
    """

    width: int
    height: int
    pixel_size: float
    camera_to_world: FloatArray

    @property
    def world_to_camera(self) -> FloatArray:
        """(4, 4), OpenCV axes: +x right, +y down, +z forward."""
        return world_to_camera(self.camera_to_world)

    @property
    def position(self) -> FloatArray:
        """Middle of the image plane (3,), m."""
        return np.asarray(self.camera_to_world, dtype=np.float64)[:3, 3]

    @classmethod
    def looking(
        cls,
        direction: Sequence[float] | FloatArray,
        lower: Sequence[float] | FloatArray,
        upper: Sequence[float] | FloatArray,
        pixel_size: float,
        up: Sequence[float] = (0.0, 1.0, 0.0),
    ) -> OrthographicCamera:
        """A camera that looks along ``direction`` and just covers the box from ``lower`` to ``upper``.

        It stands where the box begins, so depth runs from 0 to the box's extent along ``direction``.

        Args:
            direction: viewing direction (3,), any length; (0, 0, −1) looks down. For a shadow map: from the sun to the
                scene.
            lower: smallest corner of the box (3,), m.
            upper: largest corner of the box (3,), m.
            pixel_size: side of a pixel, m.
            up: the direction that points up in the image; +x takes its place if it is parallel to ``direction``.
        """
        forward = np.asarray(direction, dtype=np.float64)
        length = np.linalg.norm(forward)
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if not length > 0 or not np.all(high >= low) or not pixel_size > 0:
            raise ParameterError("an orthographic camera needs a direction, lower <= upper and a positive pixel size")
        forward = forward / length
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(right) < 1e-9:
            right = np.cross(forward, np.array([1.0, 0.0, 0.0]))
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, forward), -forward])  # rows: right, up, backward
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        near, far = (corners @ axes.T).min(axis=0), (corners @ axes.T).max(axis=0)
        centre = np.array([0.5 * (near[0] + far[0]), 0.5 * (near[1] + far[1]), far[2]])
        pose = np.eye(4)
        pose[:3, :3] = axes.T
        pose[:3, 3] = axes.T @ centre
        size = np.maximum(np.ceil((far - near)[:2] / pixel_size - 1e-6).astype(int), 1)
        return cls(int(size[0]), int(size[1]), float(pixel_size), pose)


AnyCamera = PinholeCamera | OrthographicCamera


@dataclass(frozen=True)
class View:
    """A camera in the form the kernels take: x_px = f·x/z + c (perspective) or f·x + c (orthographic), OpenCV axes."""

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    rotation: FloatArray
    translation: FloatArray
    orthographic: bool

    @property
    def position(self) -> FloatArray:
        """Camera centre in the world (3,), m."""
        return -self.rotation.T @ self.translation

    @property
    def forward(self) -> FloatArray:
        """Viewing direction in the world (3,), unit length."""
        return self.rotation[2]


def view_of(camera: AnyCamera) -> View:
    """The kernels' form of a camera.

    Raises:
        ParameterError: the camera has lens distortion (undistort the image and the camera first) or an empty image.
    """
    if camera.width < 1 or camera.height < 1:
        raise ParameterError(f"the camera's image is empty ({camera.width} × {camera.height} px)")
    pose = np.asarray(camera.world_to_camera, dtype=np.float64)
    if isinstance(camera, OrthographicCamera):
        f = 1.0 / camera.pixel_size
        focal, centre = (f, f), (0.5 * camera.width, 0.5 * camera.height)
    else:
        if camera.has_distortion:
            raise ParameterError(
                "the rasteriser draws pinhole images: pass camera.undistorted() and an undistorted image"
            )
        focal, centre = (float(camera.fx), float(camera.fy)), (float(camera.cx), float(camera.cy))
    return View(
        width=int(camera.width),
        height=int(camera.height),
        focal=focal,
        centre=centre,
        rotation=pose[:3, :3],
        translation=pose[:3, 3],
        orthographic=isinstance(camera, OrthographicCamera),
    )


def world_to_camera(camera_to_world: npt.ArrayLike) -> FloatArray:
    """World to camera (4, 4) with OpenCV axes, from camera to world (4, 4) with OpenGL axes (a rigid motion)."""
    pose = np.asarray(camera_to_world, dtype=np.float64)
    rotation = (pose[:3, :3] * np.array([1.0, -1.0, -1.0])).T
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = -rotation @ pose[:3, 3]
    return out
