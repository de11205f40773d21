"""All pictures of a set: photographs before anything moves, and the fixed cameras' video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.measurement import HEAP, OPEN, TRANSPARENT, Camera, Picture
from splatsoil.mpm import Trajectory
from splatsoil.observation import Observation
from splatsoil.synthetic.appearance import Appearance
from splatsoil.synthetic.setups import Setup
from splatsoil.synthetic.soil_surface import soil_surface
from splatsoil.synthetic.stage import Body, FloatImage, Stage, photograph

FloatArray = npt.NDArray[np.float64]

NOISE = 1.5 / 255.0
"""Standard deviation of the sensor's noise, sRGB."""
PATHS = 4
"""Each pixel is the mean of this many light paths, squared."""
WALL = 0.03
"""Thickness of the bin's walls and floor, as a share of the bed's narrower side."""
RIM = 0.006
"""How far the bin's walls stand over the soil along them, m."""
FIELD = 5.0
"""How far open ground goes on, in lengths of the bed."""
GRAIN = 0.1
"""Contrast of the fine pattern of bin and ground."""


class Renderer(Protocol):
    """What pictures of a stage are taken with: takes `Stage`'s arguments, and has its `Stage.radiance`."""

    def radiance(self, camera: Camera, *, seed: int = 0, side: int = 4) -> FloatImage: ...


@dataclass
class Photographer:
    """Takes the pictures of one simulated run.

    Attributes:
        setup: tool, bed and cameras.
        trajectory: particles at all frames of the video.
        look: sun, sky and colours.
        seed: of light paths and sensor noise.
        device: Warp device name.
        progress: called with the share of the pictures that is done.
        observation: how the video cameras, their light and the drawn tool differ from what the set will say.
        renderer: makes a stage of `Stage`'s arguments.
    """

    setup: Setup
    trajectory: Trajectory
    look: Appearance
    seed: int
    device: str = "cpu"
    progress: Callable[[float], None] = lambda share: None
    observation: Observation = field(default_factory=Observation)
    renderer: Callable[..., Renderer] = Stage
    _done: int = field(default=0, init=False)

    def take(self) -> tuple[list[Picture], list[Picture]]:
        """Views and video, the video's pictures by frame and then by camera."""
        setup = self.setup
        rest = self.trajectory.positions[self.trajectory.frames.index(0)].astype(np.float64)
        colours = self.look.sand_albedo(rest, setup.bed)
        views: list[Picture] = []
        video: list[Picture] = []
        undisturbed = (setup.frames[0], Observation())
        stage = self.stage(*undisturbed, colours)
        for i, camera in enumerate(setup.views):
            views.append(Picture(camera, self._expose(self._light(stage, camera, 0, i), 0, i)))
        for frame in setup.frames:
            if (frame, self.observation) != undisturbed:
                stage = self.stage(frame, self.observation, colours)
            # Nothing moves in the pre-roll, but it has its own light paths: it measures all of the pictures' noise.
            numbers = (*setup.pre_roll, frame) if frame == setup.frames[0] else (frame,)
            for which, camera in enumerate(setup.video.values(), start=1):
                stands = self.observation.camera(camera, which - 1)
                for number in numbers:
                    time = number / setup.frame_rate
                    seen = self._light(stage, stands, which, number).astype(np.float64)
                    light = self.observation.exposed(seen, time).astype(np.float32)
                    video.append(Picture(camera, self._expose(light, which, number), number, time))
        order = {name: k for k, name in enumerate(setup.video)}
        video.sort(key=lambda picture: (picture.frame, order[picture.camera.name]))
        return views, video

    def stage(self, frame: int, seen: Observation, colours: FloatArray) -> Renderer:
        """Soil, tool, bin and ground of one frame of the video; particle albedo (n, 3), linear."""
        setup = self.setup
        look = replace(
            self.look,
            azimuth=self.look.azimuth + seen.sun_azimuth,
            elevation=self.look.elevation + seen.sun_elevation,
            sky_share=self.look.sky_share + seen.sky_share,
        )
        moment = frame + seen.time_offset * setup.frame_rate
        particles, _ = self.trajectory.at(moment)
        sides = setup.bed.container in (TRANSPARENT, HEAP)
        soil = soil_surface(particles, colours, self.trajectory.spacing, setup.bed.domain, sides=sides)
        rotation, position = seen.tool(setup.tool.motion.pose(moment / setup.frame_rate))
        tool = setup.tool.mesh
        placed = trimesh.Trimesh(tool.vertices @ rotation.T + position, tool.faces, process=False)
        walls, ground = surroundings_of(setup)
        colour = look.sand if setup.bed.container == OPEN else look.bin
        return self.renderer(
            [soil, Body.flat(placed, look.tool), *(Body.flat(wall, colour, GRAIN) for wall in walls)],
            look.light,
            ground=ground,
            ground_colour=look.ground,
            ground_grain=GRAIN,
            pattern=look.seed,
            device=self.device,
        )

    def _light(self, stage: Renderer, camera: Camera, which: int, number: int) -> FloatImage:
        paths = self._generator(4, which, number).integers(2**31)
        image = stage.radiance(camera, seed=int(paths), side=PATHS)
        self._done += 1
        setup = self.setup
        total = len(setup.views) + len(setup.video) * (len(setup.pre_roll) + len(setup.frames))
        self.progress(self._done / total)
        return image

    def _expose(self, light: FloatImage, which: int, number: int) -> npt.NDArray[np.uint8]:
        return photograph(light, NOISE, self._generator(5, which, number))

    def _generator(self, use: int, which: int, number: int) -> np.random.Generator:
        # Seeds may not be negative, which the pre-roll's numbers are.
        return np.random.default_rng([self.seed, use, which, number % 2**32])


def surroundings_of(setup: Setup) -> tuple[list[trimesh.Trimesh], float]:
    """Floor and walls around the soil, or the soil that it goes on into; and the height in m of the ground."""
    bed, height = setup.bed.domain, setup.surface.height
    thick = WALL * float(bed.extents[:2].min())
    edges = np.concatenate([height[0], height[-1], height[:, 0], height[:, -1]])
    top = float(edges.max()) + RIM
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
