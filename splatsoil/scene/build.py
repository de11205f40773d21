"""A scene from a reconstruction and photographs of the undisturbed bed: illumination, albedo, binding."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.measurement import TRANSPARENT, Bed, Frame, Measurement
from splatsoil.scene import albedo as albedos
from splatsoil.scene.estimate import estimate_light, still_frames
from splatsoil.scene.intrinsic import Intrinsic
from splatsoil.scene.layers import Posed
from splatsoil.scene.light import Light, encoded, linear
from splatsoil.scene.relief import Relief, relief_of_particles
from splatsoil.scene.render import Scene, nearer_side, to_sides
from splatsoil.scene.shading import Shading, shade
from splatsoil.scene.tool import ToolBody
from splatsoil.splats import Gaussians

if TYPE_CHECKING:
    from splatsoil.reconstruction import Reconstruction


_FOOTPRINT = 0.002
"""Half width of the patch of surface that a Gaussian's colour was seen on, m, for shadows' edges."""

_NEAREST = 9
"""Gaussians of a side whose median a particle behind it is like: a few that no photograph shows have any colour."""

_EDGE = 3
"""Pixels around the tool that are not used: lenses, blur and JPEG blocks mix colours there."""


def build_scene(
    reconstruction: Reconstruction,
    measurement: Measurement,
    particles: Any,
    spacing: float,
    *,
    light: Light | None = None,
    intrinsic: Intrinsic | None = None,
    device: torch.device | str = "cpu",
) -> Scene:
    """A scene from photographs of the undisturbed bed: light estimated, albedo taken from colours, Gaussians bound.

    Args:
        reconstruction: Gaussians, and which of them are soil and tool.
        measurement: the set it was made from.
        particles: (p, 3) at rest, m: those that will move.
        spacing: side of the cube of soil a particle stands for, m.
        light: estimated if left out.
        intrinsic: light and albedo that were found before; nothing is estimated then.
        device: where the scene is drawn.

    Raises:
        ParameterError: particles of another shape, or a reconstruction without soil.
    """
    x = torch.as_tensor(np.asarray(particles), dtype=torch.float32).to(device).contiguous()
    if x.ndim != 2 or x.shape[1] != 3 or len(x) == 0:
        raise ParameterError(f"particles have shape {tuple(x.shape)}, expected (n, 3) with n > 0")
    everything = reconstruction.gaussians.detach().to(device)
    soil_mask, tool_mask = (
        torch.as_tensor(np.asarray(m)).to(device, torch.bool) for m in (reconstruction.soil, reconstruction.tool)
    )
    soil, around = everything[soil_mask], everything[~soil_mask & ~tool_mask]
    if len(soil) == 0:
        raise ParameterError("the reconstruction has no soil")
    body = ToolBody(measurement.tool.mesh, device)
    bed = measurement.bed.domain
    relief = relief_of_particles(x, spacing, bed.lower, bed.upper)
    if intrinsic is not None:
        light = intrinsic.light
    elif light is None:
        light = estimate_light(measurement, relief, body)
    motion = measurement.tool.motion
    start = motion.pose(float(motion.times[0]))
    scene = Scene.of(
        soil,
        x,
        spacing,
        around,
        grain_albedo=x.new_full(x.shape, 0.5),
        light=light,
        tool=body,
        tool_albedo=np.ones(3),
        bed=bed,
        background=np.asarray(reconstruction.background, dtype=np.float64),
        side_light=_side_light(soil, relief, light, bed) if reconstruction.container == TRANSPARENT else None,
    )
    if intrinsic is not None:
        return intrinsic.coloured(scene)
    frames = still_frames(measurement)
    with torch.no_grad():
        posed = scene.pose(x, None, start)
        scene = scene.replace(tool_albedo=albedos.tool_albedo(frames, lambda camera: scene.layers(posed, camera).tool))
        shading = shade(relief, light, body.at(*start), scene.tool_albedo)
        scene = scene.replace(**_albedo(soil, shading, scene))
        return _refined(scene, scene.pose(x, None, start), frames)


def _side_light(soil: Gaussians, relief: Relief, light: Light, bed: Bed) -> FloatArray:
    """Light (4, 3) on the soil's sides, see `Scene`: their soil is on the mean that of the surface, so it is what their
    mean colour is brighter than level ground's."""
    side = nearer_side(soil.means, relief, bed)
    colours = linear(soil.colours)
    seen = [colours[side == k].mean(dim=0) for k in range(4) if (side == k).any()]
    usual = torch.stack(seen).mean(dim=0) if seen else colours.mean(dim=0)
    means = [colours[side == k].mean(dim=0) if (side == k).any() else usual for k in range(4)]
    return torch.stack(means).cpu().numpy().astype(np.float64) / light.level


def _albedo(soil: Gaussians, shading: Shading, scene: Scene) -> dict[str, Tensor]:
    """First albedo of soil and grains: the reconstruction's colours with the light on them taken out."""
    grains, bed = scene.soil.particles, scene.bed
    light = shading.irradiance(soil.means.contiguous(), _FOOTPRINT)
    on_top = torch.ones(len(soil), dtype=torch.bool, device=light.device)
    if scene.side_light is not None:
        side = nearer_side(soil.means, shading.relief, bed)
        on_top = side < 0
        light[~on_top] = torch.from_numpy(scene.side_light).to(light)[side[~on_top]]
    albedo = (linear(soil.colours) / light.clamp_min(0.05)).clamp(0.0, albedos.BRIGHTEST)
    surface = albedos.SurfaceAlbedo(soil.means[on_top], albedo[on_top], scene.spacing, bed.lower, bed.upper)
    beneath = surface.beneath(grains, shading.relief.depth_below(grains))
    if not on_top.all():
        # The layer behind a side that is seen has its colours.
        behind = nearer_side(grains, shading.relief, bed) >= 0
        behind &= to_sides(grains, bed)[0] < scene.spacing
        k = min(_NEAREST, int((~on_top).sum()))
        _, nearest = cKDTree(soil.means[~on_top].cpu().numpy()).query(
            grains[behind].cpu().numpy(), k=[*range(1, k + 1)]
        )
        beneath[behind] = albedo[~on_top][torch.from_numpy(nearest).to(albedo.device)].median(dim=1).values
    return {"soil_albedo": encoded(albedo), "grain_albedo": encoded(beneath)}


def _refined(scene: Scene, posed: Posed, frames: list[Frame]) -> Scene:
    """The scene with its visible albedo made to agree with the photographs, each pixel's light taken out."""
    targets = []
    for frame in frames:
        camera = frame.camera.undistorted()
        layers = scene.layers(posed, camera)
        image = torch.from_numpy(np.ascontiguousarray(frame.undistorted_image())).to(scene.device)
        good = torch.from_numpy(np.ascontiguousarray(frame.undistorted_mask())).to(scene.device)
        tool = torch.nn.functional.max_pool2d(layers.tool[None, None, ..., 3], 2 * _EDGE + 1, 1, _EDGE)[0, 0]
        sure = (layers.soil > 0.95) & (tool == 0.0) & good
        unlit = encoded((linear(image) / layers.light.clamp_min(0.05)).clamp(0.0, albedos.BRIGHTEST))
        targets.append((camera, unlit, sure.float()))
    shown, near = scene.shown(posed.shading.relief, scene.soil.rest, scene.soil.particles)
    count = int(shown.sum()) + int(near.sum())
    parts = (posed.centres[:count], posed.covariances[:count], posed.opacities[:count])
    found = albedos.refined(*parts, posed.features[:count, :3], targets)
    soil, grains = scene.soil_albedo.clone(), scene.grain_albedo.clone()
    on_top = posed.features[:count, 3:] > 0.0  # not at a side, whose colour is not in the light that was taken out
    first = int(shown.sum())
    soil[shown] = torch.where(on_top[:first], found[:first], soil[shown])
    grains[near] = torch.where(on_top[first:], found[first:], grains[near])
    return scene.replace(soil_albedo=soil, grain_albedo=grains)
