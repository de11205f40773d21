"""The path tracer's scene: triangles, ground, sun and sky.

A path tracer that shares nothing with the splats: pictures drawn by what reconstructs them would hide its faults.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
import warp as wp

from splatsoil.arrays import FloatArray, Image
from splatsoil.colour import encoded
from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.splats.warp_torch import launch_parts, thread_count
from splatsoil.synthetic import tracing

SUN_RADIUS = 0.0047
"""Tangent of the sun's angular radius."""
_PATH_COST = 1.5e-3
"""Milliseconds a path takes on a CPU, roughly; decides only how many threads are worth their start."""


@dataclass(frozen=True, eq=False)
class Body:
    """Triangles with their looks.

    Attributes:
        points: (n, 3) vertices, m.
        faces: (m, 3) their indices.
        normals: (n, 3) shading normals, unit.
        colours: (n, 3) albedo, linear.
        grain: contrast of a fine pattern fixed in the world; 0 for none.
    """

    points: FloatArray
    faces: npt.NDArray[np.int64]
    normals: FloatArray
    colours: FloatArray
    grain: float = 0.0

    @classmethod
    def flat(cls, mesh: trimesh.Trimesh, colour: npt.ArrayLike, grain: float = 0.0) -> Body:
        """A mesh of one colour (3,), linear, every face with its own normal."""
        points = np.asarray(mesh.triangles, dtype=np.float64).reshape(-1, 3)
        normals = np.repeat(np.asarray(mesh.face_normals, dtype=np.float64), 3, axis=0)
        colours = np.broadcast_to(np.asarray(colour, dtype=np.float64), points.shape)
        return cls(points, np.arange(len(points)).reshape(-1, 3), normals, colours, grain)


@dataclass(frozen=True)
class Light:
    """Sun and sky.

    Attributes:
        direction: unit vector (3,) to the sun.
        sun: (3,) light of the sun on a surface that faces it; red, green, blue, linear.
        sky: (3,) light of the whole, even sky on a level plane.
        softness: tangent of the sun's angular radius.
    """

    direction: FloatArray
    sun: FloatArray
    sky: FloatArray
    softness: float = SUN_RADIUS

    @classmethod
    def from_angles(
        cls, azimuth: float, elevation: float, sun: npt.ArrayLike, sky: npt.ArrayLike, softness: float = SUN_RADIUS
    ) -> Light:
        """Angles in degrees; the azimuth counts from +x towards +y.

        Raises:
            ParameterError: a sun that is not above the horizon.
        """
        if not 0.0 < elevation <= 90.0:
            raise ParameterError(f"the sun must stand above the horizon; {elevation:g} deg does not")
        turn, rise = math.radians(azimuth), math.radians(elevation)
        direction = np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
        sun, sky = (np.broadcast_to(np.asarray(s, dtype=np.float64), (3,)).copy() for s in (sun, sky))
        return cls(direction, sun, sky, softness)


class Stage:
    """Bodies over an endless ground.

    Args:
        bodies: what stands on it; at least one.
        light: sun and sky.
        ground: height of the ground, m.
        ground_colour: its albedo (3,), linear.
        ground_grain: contrast of its fine pattern.
        pattern: seed of fine patterns.
        device: Warp device name.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        light: Light,
        *,
        ground: float = 0.0,
        ground_colour: npt.ArrayLike = (0.3, 0.3, 0.3),
        ground_grain: float = 0.0,
        pattern: int = 0,
        device: str = "cpu",
    ) -> None:
        wp.config.quiet = True
        self.device = device
        starts = np.cumsum([0, *(len(b.points) for b in bodies)])
        corners = np.concatenate([b.faces + s for b, s in zip(bodies, starts[:-1], strict=True)]).reshape(-1)
        grain = np.concatenate([np.full(len(b.points), b.grain) for b in bodies])

        def vectors(name: str) -> wp.array:
            rows = np.concatenate([getattr(b, name) for b in bodies]).astype(np.float32)
            return wp.array(rows, dtype=wp.vec3, device=device)

        stage = tracing.Stage()
        stage.corners = wp.array(corners.astype(np.int32), dtype=int, device=device)
        self._mesh = wp.Mesh(vectors("points"), stage.corners)
        stage.mesh = self._mesh.id
        stage.normals, stage.colours = vectors("normals"), vectors("colours")
        stage.grain = wp.array(grain.astype(np.float32), dtype=float, device=device)
        stage.ground, stage.ground_grain = float(ground), float(ground_grain)
        stage.ground_colour = wp.vec3(*(float(c) for c in np.broadcast_to(ground_colour, (3,))))
        across = np.cross(light.direction, np.eye(3)[int(np.argmin(np.abs(light.direction)))])
        across *= light.softness / np.linalg.norm(across)
        along = np.cross(light.direction, across)
        stage.sun_direction = wp.vec3(*light.direction.tolist())
        stage.sun_across, stage.sun_along = wp.vec3(*across.tolist()), wp.vec3(*along.tolist())
        stage.sun, stage.sky = wp.vec3(*light.sun.tolist()), wp.vec3(*light.sky.tolist())
        stage.pattern = pattern
        self._stage = stage

    def radiance(self, camera: Camera, *, seed: int = 0, side: int = 4) -> Image:
        """What the camera sees, lens distortion and all: (height, width, 3), linear; black where no ray of it leads.

        Args:
            camera: calibration and pose.
            seed: of the light paths.
            side: each pixel is the mean of side² paths.
        """
        columns, rows = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
        _, rays = camera.rays(np.stack([columns, rows], axis=-1))
        rays = rays.reshape(camera.height + 1, camera.width + 1, 3)
        blind = np.asarray(~np.isfinite(rays).all(axis=2))
        # Between a pixel's corners directions are interpolated: for a pixel of 3 mrad that is exact to a microradian.
        directions = wp.array(np.nan_to_num(rays).astype(np.float32), dtype=wp.vec3, device=self.device)
        count = camera.width * camera.height
        out = wp.zeros(count, dtype=wp.vec3, device=self.device)
        inputs = [self._stage, wp.vec3(*camera.position.tolist()), directions, camera.width, side, seed, out]
        if self.device == "cpu":
            threads = thread_count(count * side * side * _PATH_COST)
            bounds = [count * k // threads for k in range(threads + 1)]
            launch_parts(tracing.trace, bounds, inputs)
        else:
            wp.launch(tracing.trace, dim=count, inputs=[0, *inputs], device=self.device)
        image = out.numpy().reshape(camera.height, camera.width, 3)
        unseen = blind[:-1, :-1] | blind[1:, :-1] | blind[:-1, 1:] | blind[1:, 1:]
        image[unseen] = 0.0
        return image


def photograph(radiance: Image, noise: float, generator: np.random.Generator) -> npt.NDArray[np.uint8]:
    """What a sensor makes of linear radiance: (h, w, 3) sRGB, uint8, with Gaussian noise of ``noise`` in [0, 1]."""
    clipped = np.clip(radiance.astype(np.float64), 0.0, 1.0)
    noisy = encoded(clipped) + noise * generator.standard_normal(clipped.shape)
    return np.round(255.0 * np.clip(noisy, 0.0, 1.0)).astype(np.uint8)
