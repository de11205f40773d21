"""What of sun and sky reaches a surface: shadows of soil and tool, open sky, and light they send back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.scene import kernels
from splatsoil.scene.light import SUN_SOFTNESS, Light
from splatsoil.scene.relief import Relief, grid_of
from splatsoil.scene.sky import light_from_slopes, sky_openness
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.warp_torch import as_warp, launch, upload

FloatArray = npt.NDArray[np.float64]

_COARSE = 2
"""Cells between which light is sent back and forth, in cells of the relief."""

_BOUNCES = 2
"""How often light is sent back and forth between the soil's slopes."""

_TOOL_LIGHT = 0.5
"""Light on the side of the tool that a shaded point sees, in units of level ground's."""


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
        tool_light: (3,) light on the side of the tool that a shaded cell sees.
    """

    relief: Relief
    light: Light
    tool: Any
    openness: Tensor
    visible: Tensor
    bounced: Tensor
    sent: Tensor
    hidden: Tensor
    tool_light: FloatArray

    @cached_property
    def shades(self) -> Tensor:
        """(ny, nx, 8) normals, openness, visibility and bounced light, as a picture is lit by."""
        scalars = self.openness[..., None], self.visible[..., None]
        return torch.cat([self.relief.normal, *scalars, self.bounced], dim=2)

    def irradiance(self, points: Tensor, spread: float = 0.0) -> Tensor:
        """Light (n, 3) on points (n, 3) of the surface; a point stands for a patch of half width ``spread`` metres."""
        sky = self.relief.sample(self.openness, points)[:, None]
        ambient, direct = _ambient(self.light, points), direct_light(self, points, spread)[:, None]
        return ambient * sky + (1.0 - ambient) * direct + self.relief.sample(self.bounced, points)


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
    inputs = [as_warp(relief.height, wp.float32), grid_of(relief), light.kernel_form()]
    inputs += [march_step(relief), ceiling(relief), as_warp(visible, wp.float32)]
    launch(kernels.sun_visibility, tuple(visible.shape), inputs, visible)
    openness, hidden = yield from sky_openness.steps(relief, tool)
    none = relief.height.new_zeros((*relief.height.shape, 3))
    side = _TOOL_LIGHT * light.reflectance(tool_colour)
    dark = LitRelief(relief, light, tool, openness, visible, none, none, hidden, side)
    bounced, sent = yield from _bounced(dark)
    return replace(dark, bounced=bounced, sent=sent)


def _bounced(lit: LitRelief) -> Steps[tuple[Tensor, Tensor]]:
    """Light (ny, nx, 3) that comes from the soil around each cell and from the tool, instead of sky; and what each cell
    sends back."""
    relief, hidden = lit.relief, lit.hidden
    rough = yield from _coarser(relief).ranged()
    points = rough.points.reshape(-1, 3)
    first = lit.irradiance(points, 0.5 * rough.cell[0]).T.reshape(3, *rough.height.shape)
    ground = _row(lit.light.reflectance(lit.light.level), relief)[:, None, None]
    tool = _row(lit.tool_light, relief)[:, None, None]
    by_soil = (1.0 - lit.openness - hidden).clamp_min(0.0)
    share, by_tool = (_resized(m, (rough.height.shape[0], rough.height.shape[1])) for m in (by_soil, hidden))
    sent = ground * first
    for _ in range(_BOUNCES - 1):
        sent = ground * (first + share * light_from_slopes(rough, sent) + by_tool * tool)
    maps = torch.cat([light_from_slopes(rough, sent), sent])
    fine = functional.interpolate(maps[None], relief.height.shape, mode="bilinear", align_corners=False)[0]
    bounced = by_soil * fine[:3] + hidden * tool
    return bounced.permute(1, 2, 0).contiguous(), fine[3:].permute(1, 2, 0).contiguous()


def _row(values: npt.ArrayLike, relief: Relief) -> Tensor:
    """Three numbers as a tensor where the relief lives."""
    return upload(np.asarray(values, dtype=np.float64), relief.device)


def _ambient(light: Light, like: Tensor) -> Tensor:
    return upload(light.ambient, like.device)


def direct_light(lit: LitRelief, points: Tensor, spread: float = 0.0) -> Tensor:
    """The sun on points (n, 3) of the surface, (n,); 1 on level, open ground."""
    sun = _row(lit.light.direction, lit.relief)[None]
    return facing(sun, normals(lit.relief, points))[0] * sun_on_points(lit, points, spread)


def normals(relief: Relief, points: Tensor) -> Tensor:
    """Of the surface at points (n, 3) on it: (n, 3)."""
    return functional.normalize(relief.sample(relief.normal, points), dim=1)


def facing(suns: Tensor, normal: Tensor) -> Tensor:
    """Suns (k, 3) on open ground of normals (n, 3): (k, n), 1 where it is level."""
    return (suns @ normal.T).clamp_min(0.0) / suns[:, 2:]


def _coarser(relief: Relief) -> Relief:
    """The relief on fewer cells over the same rectangle."""
    ny, nx = relief.height.shape
    size = (max(2, ny // _COARSE), max(2, nx // _COARSE))
    cell = (relief.cell[0] * nx / size[1], relief.cell[1] * ny / size[0])
    origin = (relief.origin[0] + 0.5 * (cell[0] - relief.cell[0]), relief.origin[1] + 0.5 * (cell[1] - relief.cell[1]))
    return Relief.of_heights(_resized(relief.height, size), origin, cell)


def _resized(values: Tensor, size: tuple[int, int]) -> Tensor:
    """A map on another number of cells over the same rectangle, averaged when there are fewer."""
    shrinking = size[0] < values.shape[0]
    resized = torch.nn.functional.interpolate(
        values[None, None], size=size, mode="bilinear", align_corners=False, antialias=shrinking
    )
    return resized[0, 0].contiguous()


def sun_on_points(lit: LitRelief, points: Tensor, spread: float = 0.0) -> Tensor:
    """Share of the sun (n,) that soil and tool let through to points (n, 3) on the surface."""
    sun = _row(lit.light.direction, lit.relief)[None]
    return suns_on_points(lit.relief, lit.tool, sun, points, spread, lit.light.softness)[0]


def suns_on_points(
    relief: Relief, tool: Any, suns: Tensor, points: Tensor, spread: float, softness: float = SUN_SOFTNESS
) -> Tensor:
    """Share (k, n) of suns (k, 3) that soil and tool let through to points (n, 3) on the surface."""
    visible = torch.empty((len(suns), len(points)), dtype=torch.float32, device=points.device)
    inputs = [as_warp(points, wp.vec3), as_warp(relief.height, wp.float32), grid_of(relief), as_warp(suns, wp.vec3)]
    inputs += [float(softness), tool, march_step(relief), ceiling(relief), float(spread), as_warp(visible, wp.float32)]
    launch(kernels.suns_on_points, tuple(visible.shape), inputs, visible)
    return visible


def march_step(relief: Relief) -> float:
    """Horizontal step of rays over the relief, m."""
    return max(relief.cell)


def ceiling(relief: Relief) -> float:
    """A height that no soil reaches, m."""
    return relief.range[1] + 1e-3
