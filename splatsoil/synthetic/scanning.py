"""Heights of a simulated surface as a scanner above it and depth cameras measure them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from splatsoil.measurement import HEAP, TRANSPARENT, HeightMaps, Picture
from splatsoil.mpm import Trajectory
from splatsoil.observation import Observation
from splatsoil.synthetic.setups import Setup
from splatsoil.synthetic.soil_surface import soil_surface

FloatArray = npt.NDArray[np.float64]

CELL = 0.01
"""Side of a grid's cell, m."""
GRID_NOISE, DEPTH_NOISE = 5e-4, 1e-3
"""Standard deviation of a height in a grid and of a depth, m: a laser scanner and a structured-light camera."""
_FAR = wp.constant(100.0)


@dataclass
class Scanner:
    """Measures one simulated run: the surfaces of soil and tool that rays meet first, and noise.

    Attributes:
        setup: tool, bed and cameras.
        trajectory: particles at all frames of the video.
        seed: of the noise.
        device: Warp device name.
        observation: how clock and tool differ from what the set will say.
    """

    setup: Setup
    trajectory: Trajectory
    seed: int
    device: str = "cpu"
    observation: Observation = field(default_factory=Observation)

    def heights(self) -> HeightMaps:
        """A grid over the bed at each frame of the video, pre-roll included."""
        setup, generator = self.setup, np.random.default_rng([self.seed, 6])
        low, high = setup.bed.lower, setup.bed.upper
        nx, ny = (max(1, int((high[k] - low[k]) / CELL + 1e-6)) for k in (0, 1))
        x, y = (low[k] + CELL * (np.arange(n) + 0.5) for k, n in ((0, nx), (1, ny)))
        above = np.stack([*np.meshgrid(x, y), np.full((ny, nx), high[2] + 1.0)], axis=-1).reshape(-1, 3)
        down = np.tile([0.0, 0.0, -1.0], (len(above), 1))
        grids = {}
        for frame, mesh in self._meshes():
            still = above[0, 2] - _distances(mesh, above, down, self.device).reshape(ny, nx)
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
                still = (along * _distances(mesh, origins, rays, self.device)).reshape(camera.height, camera.width)
                for number in self._numbers(frame):
                    noisy = still + DEPTH_NOISE * generator.standard_normal(still.shape)
                    depths[name, number] = np.nan_to_num(noisy).astype(np.float32)
        return [replace(picture, depth=depths[picture.camera.name, picture.frame]) for picture in video]

    def _numbers(self, frame: int) -> tuple[int, ...]:
        """Frames of which a frame's surface is that of."""
        return (*self.setup.pre_roll, frame) if frame == self.setup.frames[0] else (frame,)

    def _meshes(self) -> Iterator[tuple[int, wp.Mesh]]:
        """Soil and tool of each frame of the video."""
        setup, tool = self.setup, self.setup.tool
        for frame in setup.frames:
            moment = frame + self.observation.time_offset * setup.frame_rate
            particles, _ = self.trajectory.at(moment)
            sides = setup.bed.container in (TRANSPARENT, HEAP)
            colours = np.zeros((len(particles), 3))
            soil = soil_surface(particles, colours, self.trajectory.spacing, setup.bed.domain, sides=sides)
            rotation, position = self.observation.tool(tool.motion.pose(moment / setup.frame_rate))
            points = np.concatenate([soil.points, tool.mesh.vertices @ rotation.T + position]).astype(np.float32)
            faces = np.concatenate([soil.faces, tool.mesh.faces + len(soil.points)]).astype(np.int32)
            corners = wp.array(points, dtype=wp.vec3, device=self.device)
            yield frame, wp.Mesh(corners, wp.array(faces.reshape(-1), dtype=wp.int32, device=self.device))


def _distances(mesh: wp.Mesh, origins: FloatArray, rays: FloatArray, device: str) -> FloatArray:
    """(n,) how far rays (n, 3) of unit length from origins (n, 3) reach, m; NaN where they meet nothing."""
    out = wp.zeros(len(rays), dtype=float, device=device)
    ends = [wp.array(v.astype(np.float32), dtype=wp.vec3, device=device) for v in (origins, np.nan_to_num(rays))]
    wp.launch(_meet, dim=len(rays), inputs=[mesh.id, *ends, out], device=device)
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
