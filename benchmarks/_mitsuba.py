"""Another renderer's pictures of a stage: Mitsuba 3's path tracer in place of this project's.

`MitsubaStage` stands in for `splatsoil.synthetic.Stage`. It shares triangles, albedo and light with it, and neither
code nor sampling; fine patterns are of the same sizes and contrast, but not the same.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import zoom

from splatsoil.errors import ParameterError, RunError
from splatsoil.measurement import Camera
from splatsoil.synthetic.stage import Body, FloatImage, Light

FloatArray = npt.NDArray[np.float64]

#: Runs on any processor and needs no LLVM.
VARIANT = "scalar_rgb"
#: Light paths for each of the other tracer's: from the sky, which are of chance, and from the sun, which hardly are.
SKY_PATHS, SUN_PATHS = 4, 1
#: Paths meet seven surfaces at most.
INTEGRATOR = {"type": "path", "max_depth": 8}
#: Half the side of the ground, m, and of one tile of its pattern.
GROUND, TILE = 200.0, 1.0
#: Lengths of the fine pattern's octaves, m.
OCTAVES = (0.025, 0.007)
#: Longest edge of triangles that carry a fine pattern, m.
FINE = 0.006


def load_mitsuba() -> Any:
    """The package, ready; RunError when it isn't installed."""
    try:
        mitsuba = importlib.import_module("mitsuba")
    except ModuleNotFoundError as error:
        raise RunError("the package mitsuba is missing; install it: pip install 'splatsoil[independent]'") from error
    mitsuba.set_variant(VARIANT)
    return mitsuba


class MitsubaStage:
    """Bodies over a wide ground under a sun without width and an even sky; arguments are those of `Stage`.

    Raises:
        RunError: the package is missing.
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
        self._mitsuba = load_mitsuba()
        generator = np.random.default_rng(pattern)
        shapes = {"ground": self._ground(ground, np.broadcast_to(ground_colour, (3,)), ground_grain, generator)}
        for k, body in enumerate(bodies):
            shapes[f"body_{k}"] = self._mesh(f"body_{k}", _patterned(body, generator) if body.grain else body)
        # Radiance there is what falls on a surface over pi; here the pi is left out.
        sun, sky = _rgb(np.pi * light.sun), _rgb(light.sky)
        lights = (
            ({"type": "constant", "radiance": sky}, SKY_PATHS),
            ({"type": "directional", "direction": (-light.direction).tolist(), "irradiance": sun}, SUN_PATHS),
        )
        # A path asks one light only, so each light has a scene of its own: asked by turns, they would make noise.
        self._scenes = [
            (self._mitsuba.load_dict({"type": "scene", "integrator": INTEGRATOR, "light": lamp, **shapes}), paths)
            for lamp, paths in lights
        ]

    def radiance(self, camera: Camera, *, seed: int = 0, side: int = 4) -> FloatImage:
        """What the camera sees: (height, width, 3), linear.

        Args:
            camera: without distortion.
            seed: of the light paths.
            side: 5 side² paths make a pixel.

        Raises:
            ParameterError: the camera distorts.
        """
        if camera.has_distortion:
            raise ParameterError(f"camera {camera.name!r} distorts, which Mitsuba's cameras don't")
        light = [
            np.array(self._mitsuba.render(scene, sensor=self._sensor(camera, paths * side * side), seed=seed + k))
            for k, (scene, paths) in enumerate(self._scenes)
        ]
        return np.sum(light, axis=0, dtype=np.float32)

    def _sensor(self, camera: Camera, paths: int) -> Any:
        # Mitsuba's cameras look along +z with +x to the left.
        pose = camera.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
        return self._mitsuba.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx))),
                "principal_point_offset_x": 0.5 - camera.cx / camera.width,
                "principal_point_offset_y": 0.5 - camera.cy / camera.height,
                "near_clip": 1.0e-3,
                "far_clip": 4.0 * GROUND,
                "to_world": self._mitsuba.ScalarTransform4f(pose),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "pixel_format": "rgb",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": paths},
            }
        )

    def _mesh(self, name: str, body: Body) -> Any:
        matter = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        properties = self._mitsuba.Properties()
        properties["bsdf"] = self._mitsuba.load_dict({"type": "twosided", "matter": matter})
        mesh = self._mitsuba.Mesh(name, len(body.points), len(body.faces), has_vertex_normals=True, props=properties)
        mesh.add_attribute("vertex_color", 3, body.colours.astype(np.float32).ravel())
        values = self._mitsuba.traverse(mesh)
        values["vertex_positions"] = body.points.astype(np.float32).ravel()
        values["vertex_normals"] = body.normals.astype(np.float32).ravel()
        values["faces"] = body.faces.astype(np.uint32).ravel()
        values.update()
        return mesh

    def _ground(self, height: float, colour: FloatArray, grain: float, generator: np.random.Generator) -> Any:
        place = self._mitsuba.ScalarTransform4f().translate([0.0, 0.0, height]).scale(GROUND)
        reflectance: Any = _rgb(colour)
        if grain:
            count = round(2.0 * TILE / (OCTAVES[-1] / 2.0))
            tile = (1.0 + grain * _noise((count, count), 2.0 * TILE, generator))[..., None] * colour
            reflectance = {
                "type": "bitmap",
                "bitmap": self._mitsuba.Bitmap(np.clip(tile, 0.0, 1.0).astype(np.float32)),
                "raw": True,
                "to_uv": self._mitsuba.ScalarTransform4f().scale([GROUND / TILE, GROUND / TILE, 1.0]),
            }
        return {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "twosided", "matter": {"type": "diffuse", "reflectance": reflectance}},
        }


def _rgb(values: npt.ArrayLike) -> dict[str, Any]:
    return {"type": "rgb", "value": np.asarray(values, dtype=np.float64).tolist()}


def _noise(shape: tuple[int, ...], length: float, generator: np.random.Generator) -> FloatArray:
    """Two octaves of smooth noise in [-1, 1] over cubes or squares of this side, m."""
    out = np.zeros(shape)
    for octave, weight in zip(OCTAVES, (0.6, 0.4), strict=True):
        knots = max(2, round(length / octave))
        coarse = generator.uniform(-1.0, 1.0, (knots,) * len(shape))
        out += weight * zoom(coarse, np.array(shape) / knots, order=1, mode="grid-wrap", grid_mode=True)
    return out


def _patterned(body: Body, generator: np.random.Generator) -> Body:
    """The same with triangles fine enough to carry a pattern in their vertices."""
    points, faces = trimesh.remesh.subdivide_to_size(body.points, body.faces, FINE)
    mesh = trimesh.Trimesh(points, faces, process=False)
    corners = np.asarray(mesh.triangles).reshape(-1, 3)
    cube = _noise((96, 96, 96), 0.32, generator)
    low = corners.min(axis=0)
    place = np.floor((corners - low) / 0.32 * 96).astype(int) % 96
    factor = 1.0 + body.grain * cube[place[:, 0], place[:, 1], place[:, 2]]
    normals = np.repeat(np.asarray(mesh.face_normals), 3, axis=0)
    return Body(
        corners, np.arange(len(corners)).reshape(-1, 3), normals, np.clip(body.colours[:1] * factor[:, None], 0.0, 1.0)
    )
