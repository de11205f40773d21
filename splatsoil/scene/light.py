"""Sun and sky, and what of them reaches the soil.

The colour carried by Gaussians is albedo, in units of the colour that level, open, sunlit soil shows: linear radiance is
albedo times

    E = ambient · openness + (1 − ambient) · max(n·l, 0)/l_z · visible + bounce · (1 − openness)      (per channel)

with n the surface's normal, l the direction to the sun, openness the share of a uniform sky (weighted by the cosine) that
soil and tool leave open, visible the share of the sun that they let through, and bounce the light that the hidden part of
the sky's place, lit soil, sends back. E is 1 on level ground, so the images' exposure and white balance stay inside the
albedo, and a direction and an ambient share a channel describe the light. All of this is in linear colour, which sRGB
images are turned into first: in sRGB sums of light would be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import trimesh
import warp as wp
from torch import Tensor

from splatsoil.errors import ParameterError
from splatsoil.scene import kernels
from splatsoil.scene.relief import Relief
from splatsoil.splats.warp_torch import as_warp, launch, warp_device

FloatArray = npt.NDArray[np.float64]

SOIL_REFLECTANCE = 0.4
"""Share of light that dry sand sends back (0.35 to 0.45 in the visible), for the light that trench walls lend each other."""

SUN_SOFTNESS = 0.0047
"""Tangent of the sun's angular radius."""

_AZIMUTHS = 12
_SKY_CELL = 2
"""Cells of the openness map in cells of the relief: openness varies slowly."""


@dataclass(frozen=True)
class Light:
    """Sun and sky over a scene.

    Attributes:
        direction: unit vector (3,) towards the sun, world frame, z > 0.
        ambient: (3,) share of the light on level, open ground that comes from the sky; red, green, blue.
        bounce: (3,) light from a direction in which soil stands instead of sky, in the same unit.
        softness: tangent of the half width of the sun, for the edge of shadows.
    """

    direction: FloatArray
    ambient: FloatArray
    bounce: FloatArray = field(default_factory=lambda: np.full(3, SOIL_REFLECTANCE))
    softness: float = SUN_SOFTNESS

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, dtype=np.float64).reshape(3)
        ambient = np.broadcast_to(np.asarray(self.ambient, dtype=np.float64), (3,)).copy()
        bounce = np.broadcast_to(np.asarray(self.bounce, dtype=np.float64), (3,)).copy()
        length = float(np.linalg.norm(direction))
        if not length > 0.0 or not direction[2] / length > 1e-3:
            raise ParameterError(f"the sun must stand above the horizon; its direction is {direction.tolist()}")
        if not np.all((ambient >= 0.0) & (ambient <= 1.0)):
            raise ParameterError(f"ambient shares lie between 0 and 1, not {ambient.tolist()}")
        for name, value in (("direction", direction / length), ("ambient", ambient), ("bounce", bounce)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def from_angles(cls, azimuth: float, elevation: float, ambient: npt.ArrayLike, **options: Any) -> Light:
        """A light from the sun's azimuth (degrees from +x towards +y) and elevation (degrees above the horizon)."""
        a, e = math.radians(azimuth), math.radians(elevation)
        direction = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        return cls(direction, np.asarray(ambient, dtype=np.float64), **options)

    @property
    def azimuth(self) -> float:
        """Degrees from +x towards +y."""
        return math.degrees(math.atan2(self.direction[1], self.direction[0]))

    @property
    def elevation(self) -> float:
        """Degrees above the horizon."""
        return math.degrees(math.asin(min(1.0, float(self.direction[2]))))

    def kernel_form(self) -> Any:
        """The numbers as the kernels take them."""
        out = kernels.Illumination()
        out.sun = wp.vec3(*self.direction)
        out.ambient = wp.vec3(*self.ambient)
        out.bounce = wp.vec3(*self.bounce)
        out.softness = float(self.softness)
        return out


class ToolBody:
    """The tool's mesh as the ray kernels take it; one for each device."""

    def __init__(self, mesh: trimesh.Trimesh | None, device: torch.device | str = "cpu") -> None:
        """Args: mesh in the tool's frame, metres, or None for no tool; device of the scene's tensors."""
        self._mesh: Any = None
        self._centre, self._radius = np.zeros(3), 0.0
        if mesh is not None:
            wp.init()
            where = warp_device(torch.empty(0, device=device))
            vertices = np.asarray(mesh.vertices, dtype=np.float32)
            faces = np.asarray(mesh.faces, dtype=np.int32).reshape(-1)
            self._mesh = wp.Mesh(
                wp.array(vertices, dtype=wp.vec3, device=where), wp.array(faces, dtype=wp.int32, device=where)
            )
            self._centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)).astype(np.float64)
            self._radius = float(np.linalg.norm(vertices - self._centre, axis=1).max()) + 1e-4

    def at(self, rotation: npt.ArrayLike, position: npt.ArrayLike) -> Any:
        """The tool at a pose (rotation (3, 3) tool to world, position (3,) m) in the kernels' form."""
        r, x = np.asarray(rotation, dtype=np.float64), np.asarray(position, dtype=np.float64)
        out = kernels.ToolPose()
        out.mesh = wp.uint64(0 if self._mesh is None else self._mesh.id)
        out.rotation = wp.mat33(*r.reshape(-1))
        out.position = wp.vec3(*x)
        out.centre = wp.vec3(*(r @ self._centre + x))
        out.radius = self._radius
        return out

    def absent(self) -> Any:
        """No tool at all."""
        out = kernels.ToolPose()
        out.mesh = wp.uint64(0)
        return out


@dataclass(frozen=True)
class LitRelief:
    """A surface under a light.

    Attributes:
        relief: the surface.
        light: the light.
        tool: the tool's pose in the kernels' form; it must not outlive its ToolBody.
        openness: (ny, nx) share of the sky that each cell sees.
        visible: (ny, nx) share of the sun that the soil lets through to each cell (the tool's shadow is not in it).
    """

    relief: Relief
    light: Light
    tool: Any
    openness: Tensor
    visible: Tensor

    def irradiance(self, points: Tensor, spread: float = 0.0) -> Tensor:
        """Light (n, 3) on points (n, 3) of the surface; a point stands for a patch of half width ``spread`` metres."""
        n = self.relief.sample(self.relief.normal, points)
        n = torch.nn.functional.normalize(n, dim=1)
        sun = torch.tensor(self.light.direction.tolist(), dtype=torch.float32, device=points.device)
        ambient = torch.tensor(self.light.ambient.tolist(), dtype=torch.float32, device=points.device)
        bounce = torch.tensor(self.light.bounce.tolist(), dtype=torch.float32, device=points.device)
        sky = self.relief.sample(self.openness, points)[:, None]
        direct = ((n @ sun).clamp_min(0.0) / sun[2] * sun_on_points(self, points, spread))[:, None]
        return ambient * sky + (1.0 - ambient) * direct + bounce * (1.0 - sky)


def grid_of(relief: Relief) -> Any:
    """Where the relief's maps lie, in the kernels' form."""
    grid = kernels.Grid()
    grid.x0, grid.y0 = relief.origin
    grid.inverse_x, grid.inverse_y = 1.0 / relief.cell[0], 1.0 / relief.cell[1]
    return grid


def light_relief(relief: Relief, light: Light, tool: Any, *, openness: Tensor | None = None) -> LitRelief:
    """Work out what of sky and sun reaches each cell of a surface.

    Args:
        relief: the surface.
        light: the light.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.
        openness: the map if it is known already (it does not depend on the sun).
    """
    visible = torch.empty_like(relief.height)
    inputs = [
        as_warp(relief.height, wp.float32),
        grid_of(relief),
        light.kernel_form(),
        march_step(relief),
        ceiling(relief),
    ]
    launch(kernels.sun_visibility, tuple(visible.shape), [*inputs, as_warp(visible, wp.float32)], visible)
    return LitRelief(relief, light, tool, sky_openness(relief, tool) if openness is None else openness, visible)


def sky_openness(relief: Relief, tool: Any) -> Tensor:
    """(ny, nx) the share of a uniform sky that reaches each cell, weighted by the cosine; 1 on an open plane."""
    ny, nx = relief.height.shape
    rows = max(2, ny // _SKY_CELL)
    columns = max(2, nx // _SKY_CELL)
    size = (rows, columns)
    cell = (relief.cell[0] * nx / columns, relief.cell[1] * ny / rows)
    origin = (relief.origin[0] + 0.5 * (cell[0] - relief.cell[0]), relief.origin[1] + 0.5 * (cell[1] - relief.cell[1]))
    rough = Relief.of_heights(_resized(relief.height, size), origin, cell)
    grid = grid_of(rough)
    bottom, top, openness = (torch.empty_like(rough.height) for _ in range(3))
    reach = 1.0  # metres above and below the soil within which the tool is looked for
    low, high = float(rough.height.min()) - reach, float(rough.height.max()) + reach
    columns_out = [as_warp(bottom, wp.float32), as_warp(top, wp.float32)]
    launch(kernels.tool_columns, size, [grid, tool, high, low, *columns_out], openness)
    shape = [as_warp(rough.height, wp.float32), as_warp(rough.normal, wp.vec3), grid]
    steps = as_warp(_steps(max(cell), float(rough.height.max() - rough.height.min()), relief.device), wp.float32)
    outputs = [*columns_out, _AZIMUTHS, steps, as_warp(openness, wp.float32)]
    launch(kernels.sky_openness, size, [*shape, *outputs], openness)
    return _resized(openness, (ny, nx))


def _steps(cell: float, relief_height: float, device: torch.device) -> Tensor:
    """Distances at which the horizon is looked up: even at first, then growing; blockers beyond them hide little sky."""
    reach = max(4.0 * relief_height, 0.15)
    out = [cell]
    while out[-1] < reach:
        out.append(out[-1] + max(cell, 0.2 * out[-1]))
    return torch.tensor(out, dtype=torch.float32, device=device)


def _resized(values: Tensor, size: tuple[int, int]) -> Tensor:
    """A map on another number of cells over the same rectangle, averaged when there are fewer."""
    options = {"size": size, "mode": "bilinear", "align_corners": False, "antialias": size[0] < values.shape[0]}
    return torch.nn.functional.interpolate(values[None, None], **options)[0, 0].contiguous()


def sun_on_points(lit: LitRelief, points: Tensor, spread: float = 0.0) -> Tensor:
    """Share of the sun (n,) that soil and tool let through to points (n, 3) on the surface."""
    relief = lit.relief
    visible = torch.empty(len(points), dtype=torch.float32, device=points.device)
    inputs = [as_warp(points, wp.vec3), as_warp(relief.height, wp.float32), grid_of(relief), lit.light.kernel_form()]
    inputs += [lit.tool, march_step(relief), ceiling(relief), float(spread), as_warp(visible, wp.float32)]
    launch(kernels.sun_on_points, len(points), inputs, visible)
    return visible


def march_step(relief: Relief) -> float:
    """Horizontal step of rays over the relief, m."""
    return max(relief.cell)


def ceiling(relief: Relief) -> float:
    """A height that no soil reaches, m."""
    return float(relief.height.max()) + 1e-3


def linear(srgb: Tensor) -> Tensor:
    """sRGB values in [0, 1] to linear ones (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(colour: Tensor) -> Tensor:
    """Linear values, not negative, to sRGB; values above 1 stay above 1."""
    return torch.where(colour <= 0.0031308, colour * 12.92, 1.055 * colour.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
