"""What of sun and sky reaches a surface: shadows of soil and tool, open sky, and light they send back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels, kernels_sky
from splatsoil.scene.kernels_maps import Maps, Shade, ToolPose
from splatsoil.scene.light import Light
from splatsoil.scene.relief import Relief
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

FloatArray = npt.NDArray[np.float64]

_COARSE = 2
"""Cells between which light is sent back and forth, in cells of the relief."""


_REACH = 1.0
"""Above and below the soil within which the tool is looked for, m."""


@dataclass(frozen=True)
class LitRelief:
    """A surface under a light.

    Attributes:
        relief: the surface.
        light: the light.
        tool: the tool's pose in the kernels' form; it must not outlive its ToolBody.
        openness: (ny, nx) share of the sky that each cell sees.
        visible: (ny, nx) share of the sun that the soil lets through to each cell (the tool's shadow is not in it).
        bounced: (ny, nx, 3) light from soil and tool that stand in the sky's way.
        sent: (ny, nx, 3) light that each cell sends back.
        hidden: (ny, nx) share of the sky that the tool takes from each cell.
    """

    relief: Relief
    light: Light
    tool: Any
    openness: Tensor
    visible: Tensor
    bounced: Tensor
    sent: Tensor
    hidden: Tensor

    @cached_property
    def maps(self) -> Any:
        """What a picture is lit by, in the kernels' form."""
        scalars = self.openness[..., None], self.visible[..., None]
        out = Maps()
        shades = torch.cat([self.relief.normal, *scalars, self.bounced], dim=2)
        out.shades = wp.from_torch(shades, dtype=Shade)
        out.sent, out.hidden = wp.from_torch(self.sent, dtype=wp.vec3), wp.from_torch(self.hidden)
        return out

    def irradiance(self, points: Tensor, spread: float = 0.0) -> Tensor:
        """Light (n, 3) on points (n, 3) of the surface; a point stands for a patch of half width ``spread`` metres."""
        sky = self.relief.sample(self.openness, points)
        direct = direct_light(self.relief, self.light, self.tool, points, spread)
        return _mixed(self.light, sky, direct) + self.relief.sample(self.bounced, points)


@stepwise
def light_relief(
    relief: Relief, light: Light, tool: Any, tool_colour: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> Steps[LitRelief]:
    """Work out what of sky and sun reaches each cell of a surface.

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
    openness, hidden = open_sky(relief, tool)
    ground, side = (upload(v, relief.device) for v in (light.reflectance(light.level), light.tool_side(tool_colour)))
    rough = yield from _coarser(relief).ranged()
    sky, tools = (_resized(m[None], rough.height.shape)[0] for m in (openness, hidden))
    direct = direct_light(relief, light, tool, rough.points.reshape(-1, 3), 0.5 * rough.cell[0])
    first = _mixed(light, sky.reshape(-1), direct).reshape(rough.normal.shape)
    by_tool = tools[..., None] * side
    once = _look_around(rough, ground * (first + by_tool), ToolPose())[0]
    # It goes on between slopes as within a sphere, each place of which sees the same share of the others.
    by_soil = once / (1.0 - ground * (1.0 - sky - tools)[..., None])
    maps = torch.cat([by_soil, ground * (first + by_soil + by_tool)], dim=-1).permute(2, 0, 1)
    fine = _resized(maps, relief.height.shape).permute(1, 2, 0)
    bounced, sent = fine[..., :3] + hidden[..., None] * side, fine[..., 3:].contiguous()
    return LitRelief(relief, light, tool, openness, visible, bounced, sent, hidden)


def open_sky(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """Shares (ny, nx) of the sky's light, weighted by the cosine, that soil and tool leave open to each cell (1 on an
    open plane), and that the tool alone takes."""
    return _look_around(relief, None, tool)[1:]


def _look_around(relief: Relief, sent: Tensor | None, tool: Any) -> tuple[Tensor, Tensor, Tensor]:
    """What each cell sees around it, by the horizon in a dozen directions.

    Args:
        relief: the surface.
        sent: (ny, nx, 3) light sent back by each cell, the same in all directions; None for none.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.

    Returns:
        Light from the soil (ny, nx, 3); the share of the sky (ny, nx) that soil and tool leave open, and the share that
        the tool alone takes.
    """
    like, maps = relief.normal, Maps()
    light, sky = torch.empty_like(like), like.new_empty((*like.shape[:2], 2))
    if sent is not None:
        maps.sent = wp.from_torch(sent, dtype=wp.vec3)
    if tool.mesh:
        maps.columns = wp.from_torch(_tool_columns(relief, tool), dtype=wp.vec2)
    inputs = [relief.surface, maps, tool, as_warp(light, wp.vec3), as_warp(sky, wp.vec2)]
    launch(kernels_sky.cells_look_around, tuple(relief.height.shape), inputs, like)
    openness, hidden = sky.unbind(dim=-1)
    return light, openness - hidden, hidden.contiguous()


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
    visible = suns_on_points(relief, tool, sun, points, spread)
    return (facing(sun, normals(relief, points)) * visible)[0]


def normals(relief: Relief, points: Tensor) -> Tensor:
    """Of the surface at points (n, 3) on it: (n, 3)."""
    return functional.normalize(relief.sample(relief.normal, points), dim=1)


def facing(suns: Tensor, normal: Tensor) -> Tensor:
    """Suns (k, 3) on open ground of normals (n, 3): (k, n), 1 where it is level."""
    return (suns @ normal.T).clamp_min(0.0) / suns[:, 2:]


def suns_on_points(relief: Relief, tool: Any, suns: Tensor, points: Tensor, spread: float) -> Tensor:
    """Share (k, n) of suns (k, 3) that soil and tool let through to points (n, 3) on the surface, each of which stands
    for a patch of half width ``spread`` metres."""
    visible = torch.empty((len(suns), len(points)), dtype=torch.float32, device=points.device)
    inputs = [as_warp(points, wp.vec3), float(spread), relief.surface, as_warp(suns, wp.vec3), tool]
    launch(kernels.suns_on_points, tuple(visible.shape), [*inputs, as_warp(visible, wp.float32)], visible)
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
