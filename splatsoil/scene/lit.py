"""What of sun and sky reaches a surface: shadows of soil and tool, the sky they leave open, the light they send back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import trimesh
import warp as wp
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.light import Light
from splatsoil.scene.relief import Relief
from splatsoil.splats.warp_torch import as_warp, launch

FloatArray = npt.NDArray[np.float64]

_AZIMUTHS = 12

_COARSE = 2
"""Cells of the openness map in cells of the relief: openness varies slowly."""

_NEIGHBOURHOOD = 0.03
"""Standard deviation of the patch of soil whose light a point receives instead of sky, m: about half a trench."""

_TOOL_LIGHT = 0.5
"""Light on the side of the tool that a shaded point sees, in units of level ground's."""


_SCALE = 0.004
"""Size of the discs that stand for the tool among the splats, m; larger for large tools."""

_MOST = 10_000
"""Discs of a tool, about."""


class ToolBody:
    """The tool's mesh as rays meet it, and as flat Gaussians for its place among the splats; one for each device.

    Attributes:
        centres: (k, 3) middles of the discs, tool frame, m.
        covariances: (k, 3, 3), tool frame, m².
    """

    def __init__(self, mesh: trimesh.Trimesh | None, device: torch.device | str = "cpu") -> None:
        """Args: mesh in the tool's frame, metres, or None for no tool; device of the scene's tensors."""
        self._mesh: Any = None
        self._centre, self._radius = np.zeros(3), 0.0
        self.centres = torch.zeros((0, 3), device=device)
        self.covariances = torch.zeros((0, 3, 3), device=device)
        if mesh is not None:
            centres, covariances = _discs(mesh)
            self.centres, self.covariances = centres.to(device), covariances.to(device)
            wp.init()
            where = wp.device_from_torch(torch.device(device))
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

    def discs(self, rotation: npt.ArrayLike, position: npt.ArrayLike) -> tuple[Tensor, Tensor]:
        """Centres (k, 3) and covariances (k, 3, 3) of the discs at a pose, world frame."""
        r = self.centres.new_tensor(np.asarray(rotation, dtype=np.float64).tolist())
        x = self.centres.new_tensor(np.asarray(position, dtype=np.float64).tolist())
        return self.centres @ r.T + x, r @ self.covariances @ r.T

    def absent(self) -> Any:
        """No tool at all."""
        out = kernels.ToolPose()
        out.mesh = wp.uint64(0)
        return out


def _discs(mesh: trimesh.Trimesh) -> tuple[Tensor, Tensor]:
    """Flat Gaussians that cover a mesh: one for each face of a subdivision into small ones."""
    size = max(_SCALE, float(np.sqrt(2.0 * mesh.area / _MOST)))
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=1.5 * size, max_iter=20)
    corners = np.asarray(vertices)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(across, axis=1)
    kept = area > 1e-12
    normal = across[kept] / (2.0 * area[kept, None])
    plane = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    covariance = 0.5 * area[kept, None, None] * (plane + 0.01 * np.eye(3))
    return torch.from_numpy(corners[kept].mean(axis=1)).float(), torch.from_numpy(covariance).float()


def eye_of(camera: Camera) -> Any:
    """A camera without distortion in the kernels' form."""
    eye = kernels.Eye()
    eye.rotation = wp.mat33(*camera.world_to_camera[:3, :3].T.reshape(-1))
    eye.position = wp.vec3(*camera.position)
    eye.fx, eye.fy, eye.cx, eye.cy = camera.fx, camera.fy, camera.cx, camera.cy
    return eye


def silhouette(tool: Any, camera: Camera, device: torch.device | str = "cpu") -> Tensor:
    """(h, w) bool: pixels of a camera without distortion that would show the tool (a pose from `ToolBody.at`, whose
    ToolBody lives on ``device``) if nothing hid it."""
    shows = torch.zeros((camera.height, camera.width), dtype=torch.uint8, device=device)
    where = wp.from_torch(shows, dtype=wp.uint8)
    launch(kernels.silhouette, (camera.height, camera.width), [eye_of(camera), tool, where], shows)
    return shows.bool()


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
    """

    relief: Relief
    light: Light
    tool: Any
    openness: Tensor
    visible: Tensor
    bounced: Tensor

    def irradiance(self, points: Tensor, spread: float = 0.0) -> Tensor:
        """Light (n, 3) on points (n, 3) of the surface; a point stands for a patch of half width ``spread`` metres."""
        sky = self.relief.sample(self.openness, points)[:, None]
        ambient, direct = _ambient(self.light, points), direct_light(self, points, spread)[:, None]
        return ambient * sky + (1.0 - ambient) * direct + self.relief.sample(self.bounced, points)


def grid_of(relief: Relief) -> Any:
    """Where the relief's maps lie, in the kernels' form."""
    grid = kernels.Grid()
    grid.x0, grid.y0 = relief.origin
    grid.inverse_x, grid.inverse_y = 1.0 / relief.cell[0], 1.0 / relief.cell[1]
    return grid


def light_relief(relief: Relief, light: Light, tool: Any, tool_colour: npt.ArrayLike = (0.0, 0.0, 0.0)) -> LitRelief:
    """Work out what of sky and sun reaches each cell of a surface.

    Args:
        relief: the surface.
        light: the light.
        tool: a pose from `ToolBody.at` or `ToolBody.absent`.
        tool_colour: (3,) linear colour of the tool in level ground's light.
    """
    visible = torch.empty_like(relief.height)
    inputs = [as_warp(relief.height, wp.float32), grid_of(relief), light.kernel_form()]
    inputs += [march_step(relief), ceiling(relief), as_warp(visible, wp.float32)]
    launch(kernels.sun_visibility, tuple(visible.shape), inputs, visible)
    openness, hidden = sky_openness(relief, tool)
    dark = LitRelief(relief, light, tool, openness, visible, relief.height.new_zeros((*relief.height.shape, 3)))
    return LitRelief(relief, light, tool, openness, visible, _bounced(dark, hidden, light.reflectance(tool_colour)))


def _bounced(lit: LitRelief, hidden: Tensor, tool_reflectance: FloatArray) -> Tensor:
    """Light (ny, nx, 3) that comes from the soil around each cell and from the tool, instead of sky.

    One bounce, and the soil that a cell sees stands for itself by the mean of its neighbourhood, as seen from above.
    """
    relief = lit.relief
    rough = _coarser(relief)
    points = rough.points.reshape(-1, 3)
    first = lit.irradiance(points, 0.5 * rough.cell[0]).T.reshape(3, *rough.height.shape)
    around = _blurred(first, _NEIGHBOURHOOD / rough.cell[1], _NEIGHBOURHOOD / rough.cell[0])
    around = functional.interpolate(around[None], relief.height.shape, mode="bilinear", align_corners=False)[0]
    soil = _row(lit.light.reflectance(lit.light.level), relief) * around.permute(1, 2, 0)
    tool = _TOOL_LIGHT * _row(tool_reflectance, relief)
    by_soil = (1.0 - lit.openness - hidden).clamp_min(0.0)
    return (by_soil[..., None] * soil + hidden[..., None] * tool).contiguous()


def _blurred(maps: Tensor, rows: float, columns: float) -> Tensor:
    """Gaussian blur of (k, ny, nx) by standard deviations in cells, the border held."""
    for axis, sigma in ((1, rows), (2, columns)):
        radius = min(max(1, round(2.5 * sigma)), maps.shape[axis] - 1)
        offsets = torch.arange(-radius, radius + 1, device=maps.device, dtype=torch.float32)
        weights = torch.exp(-0.5 * (offsets / sigma) ** 2)
        padding = (0, 0, radius, radius) if axis == 1 else (radius, radius, 0, 0)
        shape = (1, 1, -1, 1) if axis == 1 else (1, 1, 1, -1)
        padded = functional.pad(maps[:, None], padding, mode="replicate")
        maps = functional.conv2d(padded, (weights / weights.sum()).reshape(shape))[:, 0]
    return maps


def _row(values: npt.ArrayLike, relief: Relief) -> Tensor:
    """Three numbers as a tensor where the relief lives."""
    return torch.tensor(np.asarray(values, dtype=np.float64).tolist(), dtype=torch.float32, device=relief.device)


def _ambient(light: Light, like: Tensor) -> Tensor:
    return torch.tensor(light.ambient.tolist(), dtype=torch.float32, device=like.device)


def direct_light(lit: LitRelief, points: Tensor, spread: float = 0.0) -> Tensor:
    """The sun on points (n, 3) of the surface, (n,); 1 on level, open ground."""
    normal = functional.normalize(lit.relief.sample(lit.relief.normal, points), dim=1)
    sun = torch.tensor(lit.light.direction.tolist(), dtype=torch.float32, device=points.device)
    return (normal @ sun).clamp_min(0.0) / sun[2] * sun_on_points(lit, points, spread)


def _coarser(relief: Relief) -> Relief:
    """The relief on fewer cells over the same rectangle."""
    ny, nx = relief.height.shape
    size = (max(2, ny // _COARSE), max(2, nx // _COARSE))
    cell = (relief.cell[0] * nx / size[1], relief.cell[1] * ny / size[0])
    origin = (relief.origin[0] + 0.5 * (cell[0] - relief.cell[0]), relief.origin[1] + 0.5 * (cell[1] - relief.cell[1]))
    return Relief.of_heights(_resized(relief.height, size), origin, cell)


def sky_openness(relief: Relief, tool: Any) -> tuple[Tensor, Tensor]:
    """Two maps (ny, nx): the share of a uniform sky, weighted by the cosine, that reaches each cell (1 on an open plane),
    and the share that the tool alone hides."""
    rough = _coarser(relief)
    size = (rough.height.shape[0], rough.height.shape[1])
    grid = grid_of(rough)
    bottom, top, openness, hidden = (torch.empty_like(rough.height) for _ in range(4))
    reach = 1.0  # metres above and below the soil within which the tool is looked for
    low, high = float(rough.height.min()) - reach, float(rough.height.max()) + reach
    columns = [as_warp(bottom, wp.float32), as_warp(top, wp.float32)]
    launch(kernels.tool_columns, size, [grid, tool, high, low, *columns], openness)
    shape = [as_warp(rough.height, wp.float32), as_warp(rough.normal, wp.vec3), grid]
    steps = _steps(max(rough.cell), float(rough.height.max() - rough.height.min()), relief.device)
    outputs = [as_warp(openness, wp.float32), as_warp(hidden, wp.float32)]
    launch(kernels.sky_openness, size, [*shape, *columns, _AZIMUTHS, as_warp(steps, wp.float32), *outputs], openness)
    full = (relief.height.shape[0], relief.height.shape[1])
    return _resized(openness, full), _resized(hidden, full)


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
