"""Instruments of a synthetic experiment: photographs, video, height grids and depth maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
import trimesh
import warp as wp

from splatsoil.arrays import FloatArray, Image
from splatsoil.measurement import HEAP, OPEN, TRANSPARENT, Camera, HeightMaps, Picture
from splatsoil.mpm import Trajectory
from splatsoil.observation import Observation
from splatsoil.synthetic.appearance import Appearance
from splatsoil.synthetic.setups import Setup
from splatsoil.synthetic.soil_surface import soil_surface
from splatsoil.synthetic.stage import Body, Stage, photograph

NOISE = 1.5 / 255.0
"""Standard deviation of the sensor's noise, sRGB."""
PATHS = 4
"""Each pixel is the mean of this many light paths, squared."""
WALL = 0.03
"""Thickness of the bin's walls and floor, as a share of the bed's narrower side."""
FIELD = 5.0
"""How far open ground goes on, in lengths of the bed."""
GRAIN = 0.1
"""Contrast of the fine pattern of bin and ground."""
CELL = 0.01
"""Side of the cells of a grid of heights, m."""
GRID_NOISE, DEPTH_NOISE = 5e-4, 1e-3
"""Standard deviation of a height in a grid and of a depth, m: a laser scanner and a structured-light camera."""
_FAR = wp.constant(100.0)


class Renderer(Protocol):
    """What pictures of a stage are taken with: takes `Stage`'s arguments, and has its `Stage.radiance`."""

    def radiance(self, camera: Camera, *, seed: int = 0, side: int = 4) -> Image: ...


@dataclass
class Recorder:
    """Takes the pictures of one simulated run, and measures its surfaces.

    Attributes:
        setup: tool, bed and cameras.
        trajectory: particles at all frames of the video; without force where it has none of any frame.
        appearance: sun, sky and colours.
        seed: of light paths and noise.
        device: Warp device name.
        observation: how the video cameras, their clock, their light and the drawn tool differ from what the set will
            say.
        progress: called with the share of the pictures that is done.
        renderer: makes what pictures are taken of, from `Stage`'s arguments.
    """

    setup: Setup
    trajectory: Trajectory
    appearance: Appearance
    seed: int = 0
    device: str = "cpu"
    observation: Observation = field(default_factory=Observation)
    progress: Callable[[float], None] = lambda share: None
    renderer: Callable[..., Renderer] = Stage
    _done: int = field(default=0, init=False)

    def photographs(self) -> tuple[list[Picture], list[Picture]]:
        """Views and video, the video's pictures by frame and then by camera."""
        setup = self.setup
        rest = self.trajectory.positions[self.trajectory.frames.index(0)].astype(np.float64)
        colours = self.appearance.sand_albedo(rest, setup.bed)
        views: list[Picture] = []
        video: list[Picture] = []
        undisturbed = (setup.frames[0], Observation())
        stage = self.stage(*undisturbed, colours)
        for i, camera in enumerate(setup.views):
            views.append(Picture(camera, self._expose(self._light(stage, camera, 0, i), 0, i)))
        for frame in setup.frames:
            if (frame, self.observation) != undisturbed:
                stage = self.stage(frame, self.observation, colours)
            for which, camera in enumerate(setup.video.values(), start=1):
                stands = self.observation.camera(camera, which - 1)
                for number in self._numbers(frame):
                    time = number / setup.frame_rate
                    seen = self._light(stage, stands, which, number).astype(np.float64)
                    light = self.observation.exposed(seen, time).astype(np.float32)
                    video.append(Picture(camera, self._expose(light, which, number), number, time))
        order = {name: k for k, name in enumerate(setup.video)}
        video.sort(key=lambda picture: (picture.frame, order[picture.camera.name]))
        return views, video

    def heights(self) -> HeightMaps:
        """A grid over the bed at each frame of the video, pre-roll included: soil and tool as seen from above."""
        generator = np.random.default_rng([self.seed, 6])
        low, high = self.setup.bed.lower, self.setup.bed.upper
        nx, ny = (max(1, int((high[k] - low[k]) / CELL + 1e-6)) for k in (0, 1))
        x, y = (low[k] + CELL * (np.arange(n) + 0.5) for k, n in ((0, nx), (1, ny)))
        above = np.stack([*np.meshgrid(x, y), np.full((ny, nx), high[2] + 1.0)], axis=-1).reshape(-1, 3)
        down = np.tile([0.0, 0.0, -1.0], (len(above), 1))
        grids = {}
        for frame, mesh in self._meshes():
            still = above[0, 2] - _distances(mesh, above, down).reshape(ny, nx)
            for number in self._numbers(frame):
                grids[number] = still + GRID_NOISE * generator.standard_normal(still.shape)
        return HeightMaps(low[:2], CELL, dict(sorted(grids.items())), GRID_NOISE)

    def with_depth(self, video: list[Picture]) -> list[Picture]:
        """Pictures of the video with depth maps; 0 where rays meet neither soil nor tool."""
        generator = np.random.default_rng([self.seed, 7])
        depths: dict[tuple[str, int | None], npt.NDArray[np.float32]] = {}
        for frame, mesh in self._meshes():
            for name, camera in self.setup.video.items():
                pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1) + 0.5
                origins, rays = camera.rays(pixels)
                along = rays @ -camera.camera_to_world[:3, 2]
                still = (along * _distances(mesh, origins, rays)).reshape(camera.height, camera.width)
                for number in self._numbers(frame):
                    noisy = still + DEPTH_NOISE * generator.standard_normal(still.shape)
                    depths[name, number] = np.nan_to_num(noisy).astype(np.float32)
        return [replace(picture, depth=depths[picture.camera.name, picture.frame]) for picture in video]

    def stage(self, frame: int, seen: Observation, colours: FloatArray) -> Renderer:
        """Soil, tool, bin and ground of one frame of the video; particle albedo (n, 3), linear."""
        appearance = replace(
            self.appearance,
            azimuth=self.appearance.azimuth + seen.sun_azimuth,
            elevation=self.appearance.elevation + seen.sun_elevation,
            sky_share=self.appearance.sky_share + seen.sky_share,
        )
        soil, tool = self._bodies(frame, seen, colours)
        walls, ground = surroundings_of(self.setup)
        colour = appearance.sand if self.setup.bed.container == OPEN else appearance.bin
        return self.renderer(
            [soil, Body.flat(tool, appearance.tool), *(Body.flat(wall, colour, GRAIN) for wall in walls)],
            appearance.light,
            ground=ground,
            ground_colour=appearance.ground,
            ground_grain=GRAIN,
            pattern=appearance.seed,
            device=self.device,
        )

    def _bodies(self, frame: int, seen: Observation, colours: FloatArray | None = None) -> tuple[Body, trimesh.Trimesh]:
        """The soil's surface and the placed tool at a frame of the video."""
        setup, moment = self.setup, frame + seen.time_offset * self.setup.frame_rate
        particles, _ = self.trajectory.at(moment)
        colours = np.zeros((len(particles), 3)) if colours is None else colours
        sides = setup.bed.container in (TRANSPARENT, HEAP)
        soil = soil_surface(particles, colours, self.trajectory.spacing, setup.bed.domain, sides=sides)
        rotation, position = seen.tool(setup.tool.motion.pose(moment / setup.frame_rate))
        tool = setup.tool.mesh
        return soil, trimesh.Trimesh(tool.vertices @ rotation.T + position, tool.faces, process=False)

    def _meshes(self) -> Iterator[tuple[int, wp.Mesh]]:
        """Soil and tool, for rays, of each frame of the video."""
        for frame in self.setup.frames:
            soil, tool = self._bodies(frame, self.observation)
            points = np.concatenate([soil.points, tool.vertices]).astype(np.float32)
            faces = np.concatenate([soil.faces, tool.faces + len(soil.points)]).astype(np.int32)
            corners = wp.array(points, dtype=wp.vec3, device=self.device)
            yield frame, wp.Mesh(corners, wp.array(faces.reshape(-1), dtype=wp.int32, device=self.device))

    def _numbers(self, frame: int) -> tuple[int, ...]:
        """Frames that show what a frame shows: nothing moves in the pre-roll, but it has its own light paths and noise,
        and so measures all of both."""
        return (*self.setup.pre_roll, frame) if frame == self.setup.frames[0] else (frame,)

    def _light(self, stage: Renderer, camera: Camera, which: int, number: int) -> Image:
        paths = self._generator(4, which, number).integers(2**31)
        image = stage.radiance(camera, seed=int(paths), side=PATHS)
        self._done += 1
        setup = self.setup
        total = len(setup.views) + len(setup.video) * (len(setup.pre_roll) + len(setup.frames))
        self.progress(self._done / total)
        return image

    def _expose(self, light: Image, which: int, number: int) -> npt.NDArray[np.uint8]:
        return photograph(light, NOISE, self._generator(5, which, number))

    def _generator(self, use: int, which: int, number: int) -> np.random.Generator:
        # Seeds may not be negative, which the pre-roll's numbers are.
        return np.random.default_rng([self.seed, use, which, number % 2**32])


def surroundings_of(setup: Setup) -> tuple[list[trimesh.Trimesh], float]:
    """Floor and walls around the soil, or the soil that it goes on into; and the height in m of the ground."""
    bed, height = setup.bed.domain, setup.surface.height
    thick = WALL * float(bed.extents[:2].min())
    edges = np.concatenate([height[0], height[-1], height[:, 0], height[:, -1]])
    top = float(edges.max()) + setup.rim
    if setup.bed.container == HEAP:
        return [], float(bed.lower[2])
    if setup.bed.container == OPEN:
        thick, top = FIELD * float(bed.extents[:2].max()), float(np.median(edges))
    (x0, y0, z0), (x1, y1) = bed.lower.tolist(), bed.upper[:2].tolist()
    boxes = (
        ((x0 - thick, y0 - thick, z0 - thick), (x1 + thick, y1 + thick, z0)),
        ((x0 - thick, y0 - thick, z0), (x0, y1 + thick, top)),
        ((x1, y0 - thick, z0), (x1 + thick, y1 + thick, top)),
        ((x0, y0 - thick, z0), (x1, y0, top)),
        ((x0, y1, z0), (x1, y1 + thick, top)),
    )
    shown = boxes[:1] if setup.bed.container == TRANSPARENT else boxes
    return [trimesh.creation.box(bounds=box) for box in shown], z0 - thick


def _distances(mesh: wp.Mesh, origins: FloatArray, rays: FloatArray) -> FloatArray:
    """(n,) how far rays (n, 3) of unit length from origins (n, 3) reach, m; NaN where they meet nothing."""
    out = wp.zeros(len(rays), dtype=float, device=mesh.device)
    ends = [wp.array(v.astype(np.float32), dtype=wp.vec3, device=mesh.device) for v in (origins, np.nan_to_num(rays))]
    wp.launch(_meet, dim=len(rays), inputs=[mesh.id, *ends, out], device=mesh.device)
    found = out.numpy().astype(np.float64)
    return np.where((found > 0.0) & np.isfinite(rays).all(axis=1), found, np.nan)


@wp.kernel(enable_backward=False)
def _meet(
    mesh: wp.uint64, origins: wp.array(dtype=wp.vec3), rays: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
) -> None:
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], rays[i], _FAR)
    if query.result:
        out[i] = query.t
