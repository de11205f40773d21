"""What a camera sees of particles that carry Gaussians, under a light, with the tool among them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.measurement import Bed, Camera, Measurement
from splatsoil.scene import kernels
from splatsoil.scene.albedo import SurfaceAlbedo
from splatsoil.scene.binding import Binding
from splatsoil.scene.kernels_colour import WIDTH, develop
from splatsoil.scene.light import Light, linear
from splatsoil.scene.lit import LitRelief, ceiling, light_relief, march_step
from splatsoil.scene.relief import SMOOTHING, Relief, grid_of, relief_of_particles
from splatsoil.scene.tool import ToolBody, eye_of
from splatsoil.splats import Gaussians, rasterise_features
from splatsoil.splats.steps import Steps, finished, together
from splatsoil.splats.warp_torch import as_warp, launch, launch_parts, thread_count, upload

FloatArray = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]
Pose = tuple[npt.ArrayLike, npt.ArrayLike]

PARTICLE_SIZE, PARTICLE_THICKNESS = 0.4, 0.2
"""Standard deviations of a particle's own Gaussian along the surface and across it, in particle spacings: so it ends
where soil does, half a spacing over its uppermost particles."""

BURIED_SIZE = 0.6
"""Standard deviation, in particle spacings, of the Gaussian of a particle so deep that it ends beneath the surface all
the same. A steep wall cuts layers of flat ones on edge, and what lies behind the soil would shine through."""

_END = 2.0
"""Standard deviations from their centres at which Gaussians end: seen along the ground many overlap, opaque so far."""

PARTICLE_OPACITY = 0.95

TOOL_OPACITY = 0.95
"""Of the discs that stand for the tool; from this weight on a pixel's tool counts as unhidden."""

_HIDDEN = 2.5
"""Particles this many spacings from the surface are not drawn."""

_REACH = 10.0
"""How far behind the splats the surface that a pixel shows is looked for, in particle spacings."""

_AT_ONCE = 16
"""Pictures that are drawn beside each other on a GPU, whose memory holds the Gaussians of each tile until they are."""

_PIXELS_PER_MILLISECOND = 5000
"""About how many pixels one CPU core lights in a millisecond."""


@dataclass(frozen=True)
class Posed:
    """A scene at one moment: soil moved, lit, tool in place.

    Attributes:
        centres: (n, 3) Gaussians that can be seen: soil, then surroundings.
        covariances: (n, 3, 3).
        opacities: (n,).
        features: (n, 4): albedo (soil) or colour (surroundings) in sRGB, and 1 for soil.
        grains: the particles' own Gaussians among them.
        discs: centres (k, 3) and covariances (k, 3, 3) of the discs that stand for the tool.
        lit: the soil's surface under the light, with the tool's pose.
    """

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    grains: slice
    discs: tuple[Tensor, Tensor]
    lit: LitRelief

    @cached_property
    def tool_points(self) -> FloatArray:
        """(k, 3) the discs' centres, m."""
        return self.discs[0].cpu().numpy().astype(np.float64)


@dataclass(frozen=True)
class Layers:
    """What one camera sees, before light and colour meet; tensors on the scene's device.

    Attributes:
        colour: (h, w, 3) sRGB of all but the tool: albedo where soil is, colour elsewhere.
        soil: (h, w) share of soil in that.
        depth: (h, w) of that, along the camera's axis, m; 0 where nothing is.
        light: (h, w, 3) light on the soil; 1 elsewhere.
        tool: (h, w, 4) the tool's linear radiance times its share of the pixel, and that share.
    """

    colour: Tensor
    soil: Tensor
    depth: Tensor
    light: Tensor
    tool: Tensor

    @property
    def image(self) -> Tensor:
        """(h, w, 3) sRGB in [0, 1]: colour in its light where it is soil, behind what the tool leaves of the pixel."""
        image = torch.empty_like(self.colour, memory_format=torch.contiguous_format)
        count = self.soil.numel()
        parts = [as_warp(t.reshape(-1), wp.float32) for t in (self.colour, self.soil, self.light, self.tool, image)]
        launch(develop, -(-count // WIDTH), [count, *parts], image)
        return image


@dataclass(frozen=True)
class Scene:
    """Soil that carries its albedo, a light, a tool, and surroundings that stay.

    Attributes:
        soil: the reconstruction's soil Gaussians, bound to the particles.
        soil_opacity: (s,).
        soil_albedo: (s, 3) sRGB-encoded albedo, see `light`.
        grain_albedo: (p, 3) the same for each particle's own Gaussian.
        surroundings: Gaussians that neither move nor change their colour.
        surrounding_shapes: their covariances (m, 3, 3), m².
        light: sun and sky.
        tool: the tool's mesh.
        tool_albedo: (3,) linear.
        bed: the bed's box.
        spacing: of the particles, m.
        background: (3,) sRGB where nothing is.
        smoothing: of the surface; see `relief_of_particles`.
    """

    soil: Binding
    soil_opacity: Tensor
    soil_albedo: Tensor
    grain_albedo: Tensor
    surroundings: Gaussians
    surrounding_shapes: Tensor
    light: Light
    tool: ToolBody
    tool_albedo: FloatArray
    bed: Bed
    spacing: float
    background: FloatArray
    smoothing: float = SMOOTHING

    @property
    def device(self) -> torch.device:
        """Where the scene is drawn."""
        return self.soil.rest.device

    @cached_property
    def surface_albedo(self) -> SurfaceAlbedo:
        """What photographs show of the soil's albedo, as a map."""
        rest, albedo = self.soil.rest, linear(self.soil_albedo)
        return SurfaceAlbedo(rest, albedo, self.spacing, self.bed.lower, self.bed.upper)

    @classmethod
    def from_reconstruction(
        cls, reconstruction: Any, measurement: Measurement, particles: Any, spacing: float, **options: Any
    ) -> Scene:
        """A scene from photographs of the undisturbed bed: light estimated, albedo taken from colours, Gaussians bound.

        Args:
            reconstruction: has ``gaussians`` (sRGB colours) and masks ``soil`` and ``tool`` (n,).
            measurement: the set it was made from.
            particles: (p, 3) at rest, m: those that will move.
            spacing: side of the cube of soil a particle stands for, m.
            options: ``light`` (a `Light`; estimated if left out), ``intrinsic`` (light and albedo that were found
                before, an `Intrinsic`; nothing is estimated then), ``device``, ``rounds`` (of refining the albedo),
                ``background`` (3,) sRGB (the reconstruction's if left out).
        """
        from splatsoil.scene.build import build_scene

        return build_scene(reconstruction, measurement, particles, spacing, **options)

    def with_particles(self, particles: Any) -> Scene:
        """The same soil on other particles (p, 3) at rest, m, of the same spacing (another jitter, say): light and
        surface albedo are kept, only the binding and the grains' albedo are made anew."""
        from splatsoil.scene.build import rebound

        return rebound(self, particles)

    def with_other_albedo(self, seed: int) -> Scene:
        """The same soil, coloured otherwise beneath its surface, where photographs leave the colour open."""
        from splatsoil.scene.build import reguessed

        return reguessed(self, seed)

    def replace(self, **changes: Any) -> Scene:
        """A copy with some parts replaced."""
        return replace(self, **changes)

    def shown(self, relief: Relief, centres: Tensor, particles: Tensor) -> tuple[Tensor, Tensor]:
        """Which soil Gaussians and which particles lie near enough to the surface to be drawn: masks (s,) and (p,)."""
        near = relief.within(_HIDDEN * self.spacing, torch.cat([centres, particles]))
        return near[: len(centres)], near[len(centres) :]

    def pose(self, positions: Any, deformations: Any, tool: Pose | None) -> Posed:
        """Move, hide and light everything for one moment.

        Args:
            positions: (p, 3) particles now, m (array or tensor).
            deformations: (p, 3, 3) visual deformation since rest, or None.
            tool: rotation (3, 3) and position (3,) of the tool's frame, or None for no tool.
        """
        return finished(self._posing(positions, deformations, tool))

    def poses(self, moments: Iterable[tuple[Any, Any, Pose | None]]) -> list[Posed]:
        """Everything moved, hidden and lit for several moments, by arguments of `pose`."""
        return together([self._posing(*moment) for moment in moments])

    def _posing(self, positions: Any, deformations: Any, tool: Pose | None) -> Steps[Posed]:
        """Steps of `pose`."""
        x = upload(positions, self.device).contiguous()
        f = None if deformations is None else upload(deformations, self.device)
        relief = yield from relief_of_particles.steps(
            x, self.spacing, self.bed.lower, self.bed.upper, smoothing=self.smoothing
        )
        placed = self.tool.absent() if tool is None else self.tool.at(*tool)
        lit = yield from light_relief.steps(relief, self.light, placed, self.tool_albedo)
        centres, covariances = self.soil.carry(x, None if f is None else f.contiguous())
        # Numbers of what is drawn, not masks: a GPU makes the host wait for each mask that selects something.
        shown, near = yield from _numbers_of(self.shown(relief, centres, x))
        grains = x[near]
        count = len(grains)
        around = self.surroundings
        settled = _settled(relief, centres[shown], covariances[shown], self.soil.thickness[shown])
        parts = (
            (*settled, self.soil_opacity[shown], self.soil_albedo[shown]),
            (
                grains,
                _grain_shapes(relief, grains, self.spacing),
                x.new_full((count,), PARTICLE_OPACITY),
                self.grain_albedo[near],
            ),
            (around.means, self.surrounding_shapes, around.opacities, around.colours),
        )
        is_soil = (1.0, 1.0, 0.0)
        features = torch.cat([functional.pad(p[3], (0, 1), value=v) for p, v in zip(parts, is_soil, strict=True)])
        grain_part = slice(len(shown), len(shown) + count)
        discs = (x.new_zeros((0, 3)), x.new_zeros((0, 3, 3))) if tool is None else self.tool.discs(*tool)
        centres, covariances, opacities = (torch.cat([p[k] for p in parts]) for k in range(3))
        return Posed(centres, covariances, opacities, features, grain_part, discs, lit)

    def layers(self, posed: Posed, camera: Camera) -> Layers:
        """What a camera without distortion sees of a posed scene."""
        return finished(self._layering(posed, camera))

    def _layering(self, posed: Posed, camera: Camera) -> Steps[Layers]:
        """Steps of `layers`."""
        view = upload(camera.world_to_camera, self.device)
        along = posed.centres @ view[2, :3] + view[2, 3]
        features = torch.cat([posed.features, along[:, None]], dim=1)
        behind = upload([*self.background, 0.0, 0.0], self.device)
        drawn = yield from rasterise_features.steps(
            posed.centres, posed.covariances, posed.opacities, features, camera, background=behind, antialias=True
        )
        covered = drawn.alpha.clamp_min(1e-3)
        depth = torch.where(drawn.alpha > 0.3, drawn.image[..., 4] / covered, 0.0).contiguous()
        # Soil is opaque: what shines through between its Gaussians is not there.
        ground = (drawn.alpha > 0.3) & (drawn.image[..., 3] > 0.5 * drawn.alpha)
        filled = drawn.image[..., :4] - (1.0 - drawn.alpha[..., None]) * behind[:4]
        seen = torch.where(ground[..., None], filled / covered[..., None], drawn.image[..., :4])
        colour, soil = seen[..., :3], seen[..., 3].contiguous()
        unhidden = yield from _tool_among_splats(posed, camera)
        light, tool = _illuminated(posed.lit, camera, depth, soil, unhidden, self.tool_albedo, _REACH * self.spacing)
        return Layers(colour, soil, depth, light, tool)

    def render(self, positions: Any, deformations: Any, tool: Pose | None, camera: Camera) -> FloatImage:
        """The picture (h, w, 3) float32 sRGB in [0, 1] that an undistorted camera takes of particles and tool."""
        return self.picture(self.pose(positions, deformations, tool), camera)

    def picture(self, posed: Posed, camera: Camera) -> FloatImage:
        """The picture (h, w, 3) float32 sRGB in [0, 1] of a posed scene; several cameras may share the posing."""
        return self.pictures([(posed, camera)])[0]

    def pictures(self, views: Iterable[tuple[Posed, Camera]]) -> list[FloatImage]:
        """The `picture` of each posed scene by its camera."""

        def seen(posed: Posed, camera: Camera) -> Steps[Tensor]:
            return (yield from self._layering(posed, camera)).image

        works, out = [seen(*view) for view in views], list[FloatImage]()
        with torch.no_grad():
            for k in range(0, len(works), _AT_ONCE):
                out += [image.cpu().numpy().astype(np.float32) for image in together(works[k : k + _AT_ONCE])]
        return out


def _settled(relief: Relief, centres: Tensor, shapes: Tensor, thickness: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (n, 3) and covariances (n, 3, 3) of soil Gaussians, none of which reaches out of the surface.

    Soil that is sheared turns and stretches what it carries, so that flat Gaussians stand up in it, and seen along the
    ground a heap would end pixels too late. Those that reach out are laid flat again, as thin as at rest, and moved in.
    """
    normal = functional.normalize(relief.sample(relief.normal, centres), dim=1)
    along = (shapes @ normal[:, :, None])[..., 0]
    across = (along * normal).sum(dim=1)
    depth = relief.depth_below(centres)
    out = depth < _END * across.sqrt()
    mixed = normal[:, :, None] * along[:, None, :]
    square = normal[:, :, None] * normal[:, None, :]
    flat = shapes - mixed - mixed.transpose(1, 2) + (across + thickness.square())[:, None, None] * square
    excess = torch.where(out, _END * thickness - depth, 0.0).clamp_min(0.0)
    moved = centres - excess[:, None] * normal
    return moved.contiguous(), torch.where(out[:, None, None], flat, shapes).contiguous()


def _grain_shapes(relief: Relief, grains: Tensor, spacing: float) -> Tensor:
    """Covariances (p, 3, 3) of particles' own Gaussians at (p, 3): flat along the surface over them, round beneath."""
    normal = functional.normalize(relief.sample(relief.normal, grains), dim=1)
    along, across = (PARTICLE_SIZE * spacing) ** 2, (PARTICLE_THICKNESS * spacing) ** 2
    whole = along * torch.eye(3, device=grains.device)
    flat = whole - (along - across) * normal[:, :, None] * normal[:, None, :]
    buried = relief.depth_below(grains) > _END * BURIED_SIZE * spacing
    round_ = (BURIED_SIZE * spacing) ** 2 * torch.eye(3, device=grains.device)
    return torch.where(buried[:, None, None], round_, flat).contiguous()


def _numbers_of(masks: Sequence[Tensor]) -> Steps[list[Tensor]]:
    """Where each mask (n,) holds."""
    if not masks[0].is_cuda:
        return [mask.nonzero()[:, 0] for mask in masks]
    counts = yield torch.stack([mask.sum() for mask in masks])
    # where they hold first, in order: to select by a mask is to ask how often it holds once more
    return [(~m).to(torch.uint8).argsort(stable=True)[: int(c)] for m, c in zip(masks, counts, strict=True)]


def _tool_among_splats(posed: Posed, camera: Camera) -> Steps[Tensor]:
    """(h, w) how much of the tool the particles before it leave to be seen, where it is; drawn only around it.

    Only particles count, which no tool lets through; what they carry may poke through a thin blade.
    """
    out = posed.centres.new_zeros((camera.height, camera.width))
    centres, covariances = posed.discs
    if len(centres) == 0:
        return out
    pixels, _ = camera.project(posed.tool_points)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if len(pixels) == 0:
        return out
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [camera.width, camera.height])
    if np.any(high <= low):
        return out
    x0, y0, width, height = int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])
    parts = (
        torch.cat([posed.centres[posed.grains], centres]),
        torch.cat([posed.covariances[posed.grains], covariances]),
        torch.cat([posed.opacities[posed.grains], out.new_full((len(centres),), TOOL_OPACITY)]),
    )
    mark = torch.zeros((len(parts[0]), 1), device=out.device)
    mark[-len(centres) :] = 1.0
    drawn = yield from rasterise_features.steps(*parts, mark, camera.cropped(x0, y0, width, height), antialias=True)
    out[y0 : y0 + height, x0 : x0 + width] = (drawn.image[..., 0] / TOOL_OPACITY).clamp_max(1.0)
    return out


def _illuminated(
    lit: LitRelief,
    camera: Camera,
    depth: Tensor,
    soil: Tensor,
    unhidden: Tensor,
    tool_albedo: FloatArray,
    reach: float,
) -> tuple[Tensor, Tensor]:
    """Light on the soil (h, w, 3) and the tool's share (h, w, 4) of each pixel."""
    relief = lit.relief
    size = (camera.height, camera.width)
    light = torch.empty((*size, 3), dtype=torch.float32, device=depth.device)
    tool = torch.empty((*size, 4), dtype=torch.float32, device=depth.device)
    shades = torch.cat([relief.normal, lit.openness[..., None], lit.visible[..., None], lit.bounced], dim=2)
    maps = [*(as_warp(m, wp.float32) for m in (depth, soil, unhidden, relief.height)), as_warp(shades, kernels.Shade)]
    numbers = [grid_of(relief), lit.light.kernel_form(), lit.tool, wp.vec3(*tool_albedo), march_step(relief)]
    outputs = [as_warp(light, wp.vec3), as_warp(tool, wp.vec4)]
    inputs = [eye_of(camera), *maps, *numbers, ceiling(relief), reach, *outputs]
    pixels = size[0] * size[1]
    if depth.is_cuda:
        launch(kernels.illuminate, pixels, [0, *inputs], depth)
    else:
        threads = thread_count(pixels / _PIXELS_PER_MILLISECOND)
        launch_parts(kernels.illuminate, [pixels * k // threads for k in range(threads + 1)], inputs)
    return light, tool
