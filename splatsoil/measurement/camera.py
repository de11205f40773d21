"""A calibrated camera: intrinsics, lens distortion and pose.

Pixel coordinates follow OpenGL, COLMAP and nerfstudio: the centre of the pixel in column j and row i lies at
(j + 0.5, i + 0.5), and the image covers [0, width] x [0, height]. The pose is stored as nerfstudio does (camera to
world, OpenGL axes: +x right, +y up, looking down -z); projection uses OpenCV axes (+x right, +y down, +z forward).

Distortion is the one nerfstudio's OPENCV model has, on normalised coordinates (x, y) with r² = x² + y²:
    d = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸
    x' = d x + 2 p1 x y + p2 (r² + 2 x²),    y' = d y + 2 p2 x y + p1 (r² + 2 y²)
which is OpenCV's as long as k4 = 0 (OpenCV's k4 starts a denominator). OPENCV_FISHEYE is OpenCV's fisheye model:
    theta' = theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray

FISHEYE = "OPENCV_FISHEYE"
CAMERA_MODELS = ("OPENCV", "PINHOLE", FISHEYE)

# Names that COLMAP and nerfstudio have for lenses -> our model, and COLMAP's parameters ("f" stands for both focal
# lengths). From COLMAP's src/colmap/sensor/models.h.
LENSES: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("PINHOLE", ("f", "cx", "cy")),
    "PINHOLE": ("PINHOLE", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": ("OPENCV", ("f", "cx", "cy", "k1")),
    "RADIAL": ("OPENCV", ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (FISHEYE, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (FISHEYE, ("f", "cx", "cy", "k1", "k2")),
}

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes <-> OpenCV camera axes
_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-9  # normalised coordinates: far below a thousandth of a pixel for any focal length in use


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera at a place.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        fx: focal length along x in pixels.
        fy: focal length along y in pixels.
        cx: principal point, x in pixels from the image's left edge.
        cy: principal point, y in pixels from the image's top edge.
        camera_to_world: (4, 4) float64 rigid motion, OpenGL axes, metres.
        k1, k2, k3, k4, p1, p2: distortion, by the module's formulas.
        name: what the measurement set calls it; may be empty.
        model: one of CAMERA_MODELS.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: FloatArray
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    name: str = ""
    model: str = "OPENCV"

    def __post_init__(self) -> None:
        matrix = np.array(self.camera_to_world, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"camera_to_world must be (4, 4), not {matrix.shape}")
        if self.model not in CAMERA_MODELS:
            raise ValueError(f"unknown camera model {self.model!r}; known are {', '.join(CAMERA_MODELS)}")
        matrix.setflags(write=False)
        object.__setattr__(self, "camera_to_world", matrix)

    @property
    def position(self) -> FloatArray:
        """The centre of projection (3,) in the world, metres."""
        return self.camera_to_world[:3, 3].copy()

    @property
    def world_to_camera(self) -> FloatArray:
        """(4, 4) float64, world to camera, OpenCV axes."""
        rotation = self.camera_to_world[:3, :3].T
        inverse = np.eye(4)
        inverse[:3, :3] = rotation
        inverse[:3, 3] = -rotation @ self.camera_to_world[:3, 3]
        return _FLIP @ inverse

    @property
    def intrinsics(self) -> FloatArray:
        """The calibration matrix (3, 3) in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> tuple[float, float, float, float, float, float]:
        """(k1, k2, k3, k4, p1, p2)."""
        return self.k1, self.k2, self.k3, self.k4, self.p1, self.p2

    @property
    def has_distortion(self) -> bool:
        """Whether straight lines are bent: always so for a fisheye, else when any coefficient is non-zero."""
        return self.model == FISHEYE or any(c != 0.0 for c in self.distortion)

    def project(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """World points (n, 3) to pixels (n, 2) and depths (n,) along the camera's axis in metres.

        Pixels are NaN for points that no ray of the lens reaches: those at or behind the camera's plane (except for a
        fisheye) and those beyond the angle at which the distortion polynomial turns back.
        """
        world = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        matrix = self.world_to_camera
        local = world @ matrix[:3, :3].T + matrix[:3, 3]
        depth = local[:, 2]
        if self.model == FISHEYE:
            radius = np.hypot(local[:, 0], local[:, 1])
            theta = np.arctan2(radius, depth)
            bent, slope = _fisheye(theta, self.distortion)
            bent[(slope <= 0.0) | (theta > self._turning_point())] = np.nan
            # On the axis bent/radius tends to 1/depth.
            gain = np.divide(bent, radius, out=1.0 / np.where(depth == 0.0, np.nan, depth), where=radius > 0.0)
            distorted = local[:, :2] * gain[:, None]
        else:
            safe = np.where(depth > 0.0, depth, np.nan)
            distorted = self._distort(local[:, :2] / safe[:, None])
        return distorted * [self.fx, self.fy] + [self.cx, self.cy], depth

    def rays(self, pixels: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) to ray origins (n, 3) and unit directions (n, 3) in the world.

        Directions are NaN where no direction maps to the pixel (beyond the edge of a strongly bent image).
        """
        image = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        plane = (image - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.model == FISHEYE:
            radius = np.hypot(plane[:, 0], plane[:, 1])
            theta = self._unbend_fisheye(radius)
            unit = np.divide(plane, radius[:, None], out=np.zeros_like(plane), where=radius[:, None] > 0.0)
            local = np.concatenate([np.sin(theta)[:, None] * unit, np.cos(theta)[:, None]], axis=1)
        else:
            local = np.concatenate([self._undistort(plane), np.ones((len(plane), 1))], axis=1)
            local /= np.linalg.norm(local, axis=1, keepdims=True)
        directions = (local * [1.0, -1.0, -1.0]) @ self.camera_to_world[:3, :3].T
        return np.broadcast_to(self.position, directions.shape).copy(), directions

    def undistorted(self) -> Camera:
        """The pinhole camera of the same size, calibration matrix and pose."""
        return replace(self, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0, model="PINHOLE")

    def undistortion_map(self) -> FloatArray:
        """For each pixel centre of ``undistorted()``, where this camera's image shows it: (height, width, 2) pixels.

        NaN where the lens sees nothing there; values outside [0, width] x [0, height] lie beyond the image.
        """
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pinhole = self.undistorted()
        origins, directions = pinhole.rays(np.stack([x, y], axis=-1))
        pixels, _ = self.project(origins + directions)
        return pixels.reshape(self.height, self.width, 2)

    def moved(self, similarity: FloatArray) -> Camera:
        """The camera in another world, given the (4, 4) scale, rotation and translation that takes this one there."""
        pose = similarity @ self.camera_to_world
        pose[:3, :3] /= np.cbrt(np.linalg.det(similarity[:3, :3]))
        return replace(self, camera_to_world=pose)

    def scaled(self, factor: float) -> Camera:
        """The camera of the image resized by ``factor``; the size is rounded to whole pixels, the rest follows."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The camera of the image's part ``[y0:y0+height, x0:x0+width]``; it may reach beyond the image."""
        if width < 1 or height < 1:
            raise ValueError(f"a crop needs at least one pixel, not {width} x {height}")
        return replace(self, width=width, height=height, cx=self.cx - x0, cy=self.cy - y0)

    def _distort(self, plane: FloatArray) -> FloatArray:
        """Normalised coordinates (n, 2) to distorted ones, NaN beyond the fold."""
        if not any(c != 0.0 for c in self.distortion):
            return plane
        out, jacobian = _brown(plane, self.distortion)
        folded = ~(np.linalg.det(jacobian) > 0.0) | ~(np.hypot(plane[:, 0], plane[:, 1]) < self._turning_point())
        out[folded] = np.nan
        return out

    def _undistort(self, plane: FloatArray) -> FloatArray:
        """Inverse of _distort by Newton's method, NaN where it finds no solution on this side of the fold."""
        if not any(c != 0.0 for c in self.distortion):
            return plane.copy()
        limit = self._turning_point()
        guess = plane.copy()
        # Start inside the fold: Newton's iteration from outside of it may end on the far branch.
        radius = np.hypot(guess[:, 0], guess[:, 1])
        guess *= np.minimum(1.0, np.divide(0.9 * limit, radius, out=np.ones_like(radius), where=radius > 0.0))[:, None]
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                value, jacobian = _brown(guess, self.distortion)
                residual = value - plane
                if np.nanmax(np.abs(residual), initial=0.0) < _NEWTON_TOLERANCE * 1e-3:
                    break
                (a, b), (c, d) = jacobian[:, 0].T, jacobian[:, 1].T
                det = a * d - b * c
                step = np.stack(
                    [d * residual[:, 0] - b * residual[:, 1], a * residual[:, 1] - c * residual[:, 0]], axis=1
                )
                guess = guess - step / det[:, None]
            value, jacobian = _brown(guess, self.distortion)
            good = np.abs(value - plane).max(axis=1) < _NEWTON_TOLERANCE
            good &= (np.linalg.det(jacobian) > 0.0) & (np.hypot(guess[:, 0], guess[:, 1]) < limit)
        guess[~good] = np.nan
        return guess

    def _unbend_fisheye(self, radius: FloatArray) -> FloatArray:
        """Angles theta (n,) whose distorted value is ``radius``, by Newton's method; NaN where there is none."""
        limit = self._turning_point()
        theta = np.minimum(radius, 0.9 * limit)
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                value, slope = _fisheye(theta, self.distortion)
                theta = theta - (value - radius) / slope
            value, slope = _fisheye(theta, self.distortion)
            good = (np.abs(value - radius) < _NEWTON_TOLERANCE) & (slope > 0.0) & (theta >= 0.0) & (theta <= limit)
        return np.where(good, theta, np.nan)

    def _turning_point(self) -> float:
        """Where the radial polynomial stops growing: a radius on the normalised plane, or an angle for a fisheye."""
        k1, k2, k3, k4 = self.distortion[:4]
        # d/dr of r (1 + k1 r² + …) as a polynomial in s = r².
        roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        positive = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0.0)]
        turn = float(np.sqrt(positive.min())) if positive.size else np.inf
        return min(turn, np.pi) if self.model == FISHEYE else turn


def _brown(plane: FloatArray, coefficients: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Distorted coordinates (n, 2) of ``plane`` (n, 2), and their Jacobian (n, 2, 2)."""
    k1, k2, k3, k4, p1, p2 = coefficients
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4))  # dd/d(r²)
    out = np.stack(
        [
            d * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            d * y + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
        ],
        axis=1,
    )
    cross = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian = np.empty((len(plane), 2, 2))
    jacobian[:, 0, 0] = d + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    jacobian[:, 0, 1] = cross
    jacobian[:, 1, 0] = cross
    jacobian[:, 1, 1] = d + 2.0 * slope * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    return out, jacobian


def _fisheye(theta: FloatArray, coefficients: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Distorted angle (n,) of ``theta`` (n,), and its derivative (n,)."""
    k1, k2, k3, k4 = coefficients[:4]
    t = theta * theta
    value = theta * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return value, slope
