"""Shading of a surface by sun and sky: visibility of both, and interreflection between soil and tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels, kernels_horizon
from splatsoil.scene.kernels_maps import Maps, Shade, ToolPose
from splatsoil.scene.light import Light
from splatsoil.scene.relief import Relief
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

_COARSE = 2
"""Cells of the interreflection, in cells of the relief."""


_REACH = 1.0
"""Above and below the soil within which the tool is looked for, m."""


@dataclass(frozen=True)
class Shading:
    """Shading maps of a surface under sun and sky.

    Attributes:
        relief: the surface.
        light: the light.
        tool: the tool's pose in the kernels' form; it must not outlive its ToolBody.
        sky_visibility: (ny, nx) share of the sky that each cell sees, weighted by the cosine.
        sun_visibility: (ny, nx) share of the sun that each cell sees past the soil, without the tool's shadow.
        interreflection: (ny, nx, 3) irradiance from soil and tool that hide the sky.
        radiosity: (ny, nx, 3) of each cell.
        tool_occlusion: (ny, nx) share of the sky that the tool hides from each cell.
    """

    relief: Relief
    light: Light
    tool: Any
    sky_visibility: Tensor
    sun_visibility: Tensor
    interreflection: Tensor
    radiosity: Tensor
    tool_occlusion: Tensor

    @cached_property
    def maps(self) -> Any:
        """The maps in the kernels' form."""
        scalars = self.sky_visibility[..., None], self.sun_visibility[..., None]
        out = Maps()
        shades = torch.cat([self.relief.normal, *scalars, self.interreflection], dim=2)
        out.shades = wp.from_torch(shades, dtype=Shade)
        out.radiosity = wp.from_torch(self.radiosity, dtype=wp.vec3)
        out.tool_occlusion = wp.from_torch(self.tool_occlusion)
        return out

    def irradiance(self, points: Tensor, spread: float = 0.0) -> Tensor:
        """Irradiance (n, 3) at points (n, 3) of the surface, each a patch of half width ``spread`` metres."""
        sky = self.relief.sample(self.sky_visibility, points)
        direct = direct_light(self.relief, self.light, self.tool, points, spread)
        return _mixed(self.light, sky, direct) + self.relief.sample(self.interreflection, points)


@stepwise
def shade(relief: Relief, light: Light, tool: Any, tool_colour: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Steps[Shading]:
    """Shade each cell of a surface.

    Args:
        relief: the surface.
        light: the light.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.
        tool_colour: (3,) linear colour of the tool in level ground's light.
    """
    yield from relief.ranged()
    visible = torch.empty_like(relief.height)
    inputs = [relief.surface, light.kernel_form(), as_warp(visible, wp.float32)]
    launch(kernels.sun_visibility, tuple(visible.shape), inputs, visible)
    sky_visibility, tool_occlusion = sky_visibility_of(relief, tool)
    reflected = light.reflectance(light.level), light.tool_radiosity(tool_colour)
    ground, side = (upload(v, relief.device) for v in reflected)
    rough = yield from _coarser(relief).ranged()
    sky, tools = (_resized(m[None], rough.height.shape)[0] for m in (sky_visibility, tool_occlusion))
    direct = direct_light(relief, light, tool, rough.points.reshape(-1, 3), 0.5 * rough.cell[0])
    first = _mixed(light, sky.reshape(-1), direct).reshape(rough.normal.shape)
    by_tool = tools[..., None] * side
    once = _scan(rough, ground * (first + by_tool), ToolPose())[0]
    # Further bounces as within a sphere, each point of which sees the same share of the others.
    by_soil = once / (1.0 - ground * (1.0 - sky - tools)[..., None])
    maps = torch.cat([by_soil, ground * (first + by_soil + by_tool)], dim=-1).permute(2, 0, 1)
    fine = _resized(maps, relief.height.shape).permute(1, 2, 0)
    interreflection, radiosity = fine[..., :3] + tool_occlusion[..., None] * side, fine[..., 3:].contiguous()
    return Shading(relief, light, tool, sky_visibility, visible, interreflection, radiosity, tool_occlusion)


def sky_visibility_of(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """Shares (ny, nx) of the sky's light, weighted by the cosine, that soil and tool leave open to each cell (1 on an
    open plane), and that the tool alone takes."""
    return _scan(relief, None, tool)[1:]


def _scan(relief: Relief, radiosity: Tensor | None, tool: Any) -> tuple[Tensor, Tensor, Tensor]:
    """What each cell sees around it, by the horizon in a dozen directions.

    Args:
        relief: the surface.
        radiosity: (ny, nx, 3) of each cell, the same in all directions; None for none.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.

    Returns:
        Light from the soil (ny, nx, 3); the share of the sky (ny, nx) that soil and tool leave open, and the share that
        the tool alone takes.
    """
    like, maps = relief.normal, Maps()
    light, sky = torch.empty_like(like), like.new_empty((*like.shape[:2], 2))
    if radiosity is not None:
        maps.radiosity = wp.from_torch(radiosity, dtype=wp.vec3)
    if tool.mesh:
        maps.columns = wp.from_torch(_tool_columns(relief, tool), dtype=wp.vec2)
    inputs = [relief.surface, maps, tool, as_warp(light, wp.vec3), as_warp(sky, wp.vec2)]
    launch(kernels_horizon.scan_cells, tuple(relief.height.shape), inputs, like)
    sky_visibility, tool_occlusion = sky.unbind(dim=-1)
    return light, sky_visibility - tool_occlusion, tool_occlusion.contiguous()


def _tool_columns(relief: Relief, tool: Any) -> Tensor:
    """Lowest and highest point (ny, nx, 2) of the tool over each cell, m; the lowest over the highest where there is
    none."""
    columns = relief.height.new_empty((*relief.height.shape, 2))
    low, high = relief.range[0] - _REACH, relief.range[1] + _REACH
    inputs = [relief.surface, tool, high, low, as_warp(columns, wp.vec2)]
    launch(kernels.tool_columns, tuple(relief.height.shape), inputs, columns)
    return columns


def _mixed(light: Light, sky: Tensor, direct: Tensor) -> Tensor:
    """(n, 3) of shares of sky and sun (n,)."""
    ambient = upload(light.ambient, sky.device)
    return ambient * sky[:, None] + (1.0 - ambient) * direct[:, None]


def direct_light(relief: Relief, light: Light, tool: Any, points: Tensor, spread: float = 0.0) -> Tensor:
    """The sun on points (n, 3) of the surface, (n,); 1 on level, open ground."""
    sun = upload(light.direction[None], relief.device)
    visible = sun_visibility_at(relief, tool, sun, points, spread)
    return (sun_cosines(sun, normals(relief, points)) * visible)[0]


def normals(relief: Relief, points: Tensor) -> Tensor:
    """Of the surface at points (n, 3) on it: (n, 3)."""
    return functional.normalize(relief.sample(relief.normal, points), dim=1)


def sun_cosines(suns: Tensor, normal: Tensor) -> Tensor:
    """Suns (k, 3) on open ground of normals (n, 3): (k, n), 1 where it is level."""
    return (suns @ normal.T).clamp_min(0.0) / suns[:, 2:]


def sun_visibility_at(relief: Relief, tool: Any, suns: Tensor, points: Tensor, spread: float) -> Tensor:
    """Share (k, n) of suns (k, 3) that soil and tool let through to points (n, 3) on the surface, each of which stands
    for a patch of half width ``spread`` metres."""
    visible = torch.empty((len(suns), len(points)), dtype=torch.float32, device=points.device)
    inputs = [as_warp(points, wp.vec3), float(spread), relief.surface, as_warp(suns, wp.vec3), tool]
    launch(kernels.sun_visibility_at, tuple(visible.shape), [*inputs, as_warp(visible, wp.float32)], visible)
    return visible


def _coarser(relief: Relief) -> Relief:
    """The relief on fewer cells over the same rectangle."""
    ny, nx = relief.height.shape
    size = (max(2, ny // _COARSE), max(2, nx // _COARSE))
    cell = (relief.cell[0] * nx / size[1], relief.cell[1] * ny / size[0])
    origin = (relief.origin[0] + 0.5 * (cell[0] - relief.cell[0]), relief.origin[1] + 0.5 * (cell[1] - relief.cell[1]))
    return Relief.of_heights(_resized(relief.height[None], size)[0], origin, cell)


def _resized(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Maps (k, ny, nx) on another number of cells over the same rectangle, averaged where there are fewer."""
    shrinking = size[0] < maps.shape[1]
    return functional.interpolate(maps[None], tuple(size), mode="bilinear", antialias=shrinking)[0]
