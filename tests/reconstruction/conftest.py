"""A small scene with a known surface, photographed by a ray-caster that shares no code with what is tested.

Soil with a textured, wavy surface in a bin on level ground, and a box-shaped tool that hovers over it; sun and ambient
light with cast shadows of the tool. Rays come from `Camera.rays`, whose own tests hold it against OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import trimesh

from splatsoil.measurement import Bed, Camera, Tool, ToolMotion
from splatsoil.reconstruction import HeightField

Function = Callable[[np.ndarray, np.ndarray], np.ndarray]

TOOL_HALF = np.array([0.01, 0.06, 0.05])


def value_noise(x: np.ndarray, y: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Smooth noise in [0, 1] with features of about `size` metres: random numbers on a lattice, blended."""
    table = np.random.default_rng(seed).random((64, 64))
    u, v = x / size, y / size
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    at = lambda p, q: table[p % 64, q % 64]  # noqa: E731
    low = at(i, j) * (1 - a) + at(i + 1, j) * a
    return low * (1 - b) + (at(i, j + 1) * (1 - a) + at(i + 1, j + 1) * a) * b


@dataclass(frozen=True)
class Scene:
    """What stands where, in metres.

    Attributes:
        bed: box of the soil.
        wave: half the height of the surface's waves.
        grain: size of the texture's features.
        contrast: of the texture, 0 to 1.
        wall: thickness of the bin's walls; 0 for a bed in a field, where soil and texture go on beyond the box; None
            for no walls, so that the soil's sides are seen.
        rim: how far the walls stand over the soil's mean level.
        heap: whether the soil slopes down to the floor within the box.
        sun: direction to the sun.
        tool_centre: of the box-shaped tool.
        noise: standard deviation of the pixels.
        stretch: of the waves along x and y.
    """

    bed: Bed = field(default_factory=lambda: Bed(np.array([1.0, -0.5, 0.3]), np.array([1.6, -0.1, 0.5]), 1600.0))
    wave: float = 0.015
    grain: float = 0.02
    contrast: float = 0.6
    wall: float | None = 0.02
    rim: float = 0.0
    heap: bool = False
    sun: tuple[float, float, float] = (0.4, 0.3, 0.85)
    tool_height: float = 0.12
    noise: float = 0.005
    stretch: float = 1.0
    seed: int = 5

    @property
    def level(self) -> float:
        """Mean height of the soil."""
        return float(self.bed.lower[2] + 0.55 * self.bed.extents[2])

    @property
    def tool_centre(self) -> np.ndarray:
        middle = (self.bed.lower + self.bed.upper)[:2] / 2
        return np.array([middle[0] - 0.1, middle[1], self.level + self.tool_height])

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The soil's surface."""
        u, v = x - self.bed.lower[0], y - self.bed.lower[1]
        if self.heap:
            inside = np.minimum.reduce([u, v, self.bed.extents[0] - u, self.bed.extents[1] - v]) - 0.05
            return self.bed.lower[2] + np.minimum(0.5 * np.maximum(inside, 0.0), 0.06)
        return self.level + self.wave * (
            np.sin(2 * np.pi * u / (0.31 * self.stretch)) * np.cos(2 * np.pi * v / (0.27 * self.stretch))
            + 0.4 * np.cos(7 * u / self.stretch)
        )

    def surface(self, cells: HeightField) -> HeightField:
        """That, on the cells of another surface."""
        return HeightField(cells.x, cells.y, self.height(*np.meshgrid(cells.x, cells.y)))

    def soil_colour(self, x: np.ndarray, y: np.ndarray, z: np.ndarray | float = 0.0) -> np.ndarray:
        x, y = x + 0.7 * z, y + 1.3 * z  # blotches of sides, too
        noise = 0.6 * value_noise(x, y, self.grain, self.seed) + 0.4 * value_noise(x, y, self.grain / 2, self.seed + 1)
        return (0.55 + self.contrast * (noise - 0.5))[..., None] * np.array([1.0, 0.86, 0.66])

    def tool(self, touches: bool = True) -> Tool:
        """The tool, hovering first and dipping into the soil later (a set's tool must)."""
        positions = np.tile(self.tool_centre, (5, 1))
        if touches:
            positions[1:, 2] -= np.linspace(0.05, 0.17, 4)
        motion = ToolMotion(np.arange(5), np.arange(5) / 50.0, positions, np.tile([1.0, 0, 0, 0], (5, 1)))
        return Tool(trimesh.creation.box(2 * TOOL_HALF), motion)

    def render(self, camera: Camera, seed: int = 0) -> np.ndarray:
        """(h, w, 3) photograph, float in [0, 1]."""
        return self._cast(camera, seed)[0]

    def shows_wall(self, camera: Camera) -> np.ndarray:
        """(h, w) pixels whose ray, which the tool does not stop, ends at a wall."""
        return self._cast(camera, 0)[1]

    def _cast(self, camera: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        origin, ray = camera.rays(np.stack([columns.ravel(), rows.ravel()], 1))
        lower, upper, thick = self.bed.lower, self.bed.upper, self.wall
        sun = np.array(self.sun) / np.linalg.norm(self.sun)
        top = self.level + max(1.5 * self.wave, self.rim)

        def terrain(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Height, and kind: 0 ground, 1 wall, 2 soil."""
            out = np.maximum.reduce([lower[0] - x, x - upper[0], lower[1] - y, y - upper[1]])
            if thick == 0.0:
                return self.height(x, y), np.full(x.shape, 2)
            kind = np.where(out < 0, 2, np.where(out < (thick or 0.0), 1, 0))
            if self.heap:
                kind = np.where((kind == 2) & (self.height(x, y) <= lower[2]), 0, kind)
            return np.where(kind == 2, self.height(x, y), np.where(kind == 1, self.level + self.rim, lower[2])), kind

        # March from where a ray enters the slab under `top`, then bisect.
        near = np.maximum((top - origin[:, 2]) / ray[:, 2], 0.0)
        far = (lower[2] - 1e-6 - origin[:, 2]) / ray[:, 2]
        start, end, found = near.copy(), far.copy(), np.zeros(len(ray), dtype=bool)
        steps = 160
        for k in range(1, steps + 1):
            t = near + (far - near) * k / steps
            p = origin + t[:, None] * ray
            below = (p[:, 2] <= terrain(p[:, 0], p[:, 1])[0]) & ~found
            end[below] = t[below]
            start[below] = (near + (far - near) * (k - 1) / steps)[below]
            found |= below
        for _ in range(20):
            t = (start + end) / 2
            p = origin + t[:, None] * ray
            below = p[:, 2] <= terrain(p[:, 0], p[:, 1])[0]
            end, start = np.where(below, t, end), np.where(below, start, t)
        point = origin + end[:, None] * ray
        kind = terrain(point[:, 0], point[:, 1])[1]
        colour = np.empty((len(ray), 3))
        colour[kind == 0] = [0.55, 0.6, 0.65]
        colour[kind == 1] = [0.8, 0.82, 0.82]
        colour[kind == 2] = self.soil_colour(point[:, 0], point[:, 1])[kind == 2]
        e = 1e-4
        x, y = point[:, 0], point[:, 1]
        slope_x = (self.height(x + e, y) - self.height(x - e, y)) / (2 * e)
        slope_y = (self.height(x, y + e) - self.height(x, y - e)) / (2 * e)
        normal = np.stack([-slope_x, -slope_y, np.ones(len(ray))], 1)
        if thick is None and not self.heap:
            # Met well beneath the surface: an upright side.
            sunk = (kind == 2) & (point[:, 2] < self.height(point[:, 0], point[:, 1]) - 2e-3)
            colour[sunk] = self.soil_colour(*point.T)[sunk]
            out = np.stack(
                [lower[0] - point[:, 0], point[:, 0] - upper[0], lower[1] - point[:, 1], point[:, 1] - upper[1]]
            )
            outward = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])[out.argmax(0)]
            normal[sunk] = outward[sunk]
        normal[kind < 2] = [0.0, 0.0, 1.0]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        lit = ~self._meets_tool(point, np.tile(sun, (len(ray), 1)))[0]
        shade = 0.35 + 0.65 * np.maximum(normal @ sun, 0.0) * lit
        colour *= shade[:, None]
        hit, at, face = self._meets_tool(origin, ray)
        hit &= at < end
        colour[hit] = np.array([0.2, 0.3, 0.7]) * (0.35 + 0.65 * np.maximum(face[hit] @ sun, 0.0))[:, None]
        grain = np.random.default_rng(seed).normal(0.0, self.noise, colour.shape)
        photograph = np.clip(colour + grain, 0.0, 1.0).astype(np.float32)
        return photograph.reshape(camera.height, camera.width, 3), (kind == 1).reshape(camera.height, camera.width)

    def _meets_tool(self, origin: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slab test: whether, how far along, and the face's normal."""
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (self.tool_centre - TOOL_HALF - origin) / ray
            two = (self.tool_centre + TOOL_HALF - origin) / ray
        first, last = np.minimum(one, two), np.maximum(one, two)
        axis = first.argmax(1)
        enter, leave = first.max(1), last.min(1)
        normal = np.zeros_like(ray)
        normal[np.arange(len(ray)), axis] = -np.sign(ray[np.arange(len(ray)), axis])
        return (enter < leave) & (enter > 1e-6), enter, normal

    def cameras(
        self,
        count: int,
        width: int,
        height: int,
        *,
        distance: float = 1.1,
        rise: tuple[float, float] = (35.0, 80.0),
        **lens: float,
    ) -> list[Camera]:
        """Cameras on a dome, between two elevations in degrees, that look at the bed's middle; `lens` replaces
        intrinsics."""
        target = np.array([*(self.bed.lower + self.bed.upper)[:2] / 2, self.level])
        size = float(np.linalg.norm(self.bed.extents[:2]))
        result = []
        for k in range(count):
            turn, high = 2.39996 * k, np.radians(rise[0] + (rise[1] - rise[0]) * (k + 0.5) / count)
            away = np.array([np.cos(high) * np.cos(turn), np.cos(high) * np.sin(turn), np.sin(high)])
            right = np.cross([0.0, 0.0, 1.0], away)
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(away, right), away], 1)
            pose[:3, 3] = target + 1.5 * distance * size * away
            focal = 1.25 * width * distance
            camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
            result.append(replace(camera, **lens))
        return result


@pytest.fixture(scope="session")
def scene() -> Scene:
    """The default scene."""
    return Scene()
