"""Images of particles that carry Gaussians, under sun and sky, with the tool among them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.arrays import FloatArray, Image
from splatsoil.batches import in_batches
from splatsoil.measurement import Bed, Camera
from splatsoil.scene import kernels, kernels_visible
from splatsoil.scene.albedo import BRIGHTEST, SurfaceAlbedo, sampled_albedo
from splatsoil.scene.binding import Binding, bind
from splatsoil.scene.layers import Layers, Posed, layers_of
from splatsoil.scene.light import Light, encoded, linear
from splatsoil.scene.relief import SMOOTHING, Relief, relief_of_particles
from splatsoil.scene.shading import shade
from splatsoil.scene.tool import ToolBody
from splatsoil.splats import Gaussians
from splatsoil.splats.steps import Steps, finished, together
from splatsoil.splats.warp_torch import as_warp, launch, upload

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

_HIDDEN = 2.5
"""Particles this many spacings from the surface are not drawn."""

_AT_ONCE = 16
"""Pictures that are drawn beside each other on a GPU, whose memory holds the Gaussians of each tile until they are."""


@dataclass(frozen=True)
class Scene:
    """Soil that carries its albedo, a light, a tool, and surroundings that stay.

    Attributes:
        soil: the reconstruction's soil Gaussians, bound to the particles.
        soil_opacity: (s,).
        soil_albedo: (s, 3) sRGB-encoded albedo, see `light`.
        grain_albedo: (p, 3) the same for each particle's own Gaussian.
        surroundings: Gaussians that neither move nor change their colour.
        light: sun and sky.
        tool: the tool's mesh.
        tool_albedo: (3,) linear.
        bed: the bed's box.
        spacing: of the particles, m.
        background: (3,) sRGB where nothing is.
        smoothing: of the surface; see `relief_of_particles`.
        side_light: (4, 3) light on the soil's sides at the least x, the largest x, the least y and the largest y, in
            units of level ground's, where walls let them be seen; None where they hide them. It stays as it is.
    """

    soil: Binding
    soil_opacity: Tensor
    soil_albedo: Tensor
    grain_albedo: Tensor
    surroundings: Gaussians
    light: Light
    tool: ToolBody
    tool_albedo: FloatArray
    bed: Bed
    spacing: float
    background: FloatArray
    smoothing: float = SMOOTHING
    side_light: FloatArray | None = None

    @classmethod
    def of(
        cls, soil: Gaussians, particles: Tensor, spacing: float, surroundings: Gaussians | None = None, **parts: Any
    ) -> Scene:
        """A scene of soil's Gaussians, whose colours are its albedo, that ride on particles (p, 3) at rest, m.

        Args:
            soil: of the reconstruction.
            particles: on the device where the scene is drawn.
            spacing: of the particles, m.
            surroundings: none by default.
            parts: the other attributes by name.
        """
        return cls(
            soil=bind(soil.means, soil.covariances(), particles, spacing),
            soil_opacity=soil.opacities.contiguous(),
            soil_albedo=soil.colours.contiguous(),
            surroundings=soil[:0] if surroundings is None else surroundings,
            spacing=spacing,
            **parts,
        )

    @property
    def device(self) -> torch.device:
        """Where the scene is drawn."""
        return self.soil.rest.device

    @cached_property
    def surface_albedo(self) -> SurfaceAlbedo:
        """What photographs show of the soil's albedo, as a map."""
        rest, albedo = self.soil.rest, linear(self.soil_albedo)
        if self.side_light is not None:
            relief = relief_of_particles(self.soil.particles, self.spacing, self.bed.lower, self.bed.upper)
            on_top = nearer_side(rest, relief, self.bed) < 0
            rest, albedo = rest[on_top], albedo[on_top]
        return SurfaceAlbedo(rest, albedo, self.spacing, self.bed.lower, self.bed.upper)

    def with_particles(self, particles: Any) -> Scene:
        """The same soil on other particles (p, 3) at rest, m, of the same spacing (another jitter, say): light and
        surface albedo are kept, only the binding and the grains' albedo are made anew."""
        x = torch.as_tensor(np.asarray(particles), dtype=torch.float32).to(self.device).contiguous()
        relief = relief_of_particles(x, self.spacing, self.bed.lower, self.bed.upper)
        grains = encoded(self.surface_albedo.beneath(x, relief.depth_below(x)))
        return self.replace(soil=self.soil.to_particles(x, self.spacing), grain_albedo=grains)

    def with_sampled_albedo(self, seed: int) -> Scene:
        """The same soil with a random sample of the unknown albedo beneath its surface."""
        x, surface = self.soil.particles, self.surface_albedo
        relief = relief_of_particles(x, self.spacing, self.bed.lower, self.bed.upper)
        others = sampled_albedo(
            x,
            relief.depth_below(x) - self.spacing,  # photographs show the top layer
            linear(self.grain_albedo),
            surface.above(x),
            surface.length,
            np.random.default_rng(seed),
        )
        return self.replace(grain_albedo=encoded(others.clamp(0.0, BRIGHTEST)))

    @cached_property
    def _still(self) -> tuple[Tensor, ...]:
        """What is drawn of the surroundings: centres, covariances, opacities, and colours beside 0 for no soil."""
        around = self.surroundings
        return around.means, around.covariances(), around.opacities, functional.pad(around.colours, (0, 1))

    @cached_property
    def _sides(self) -> Tensor:
        """Sides that are seen, as the kernels take them: outward x and y, distance from the origin along these, light
        (4, 6); none (0, 6) where walls hide them."""
        if self.side_light is None:
            return self.soil_opacity.new_zeros((0, 6))
        planes = np.zeros((4, 6))
        planes[[0, 1, 2, 3], [0, 0, 1, 1]] = [-1.0, 1.0, -1.0, 1.0]
        planes[:, 2] = [-self.bed.lower[0], self.bed.upper[0], -self.bed.lower[1], self.bed.upper[1]]
        planes[:, 3:] = self.side_light
        return upload(planes, self.device)

    def replace(self, **changes: Any) -> Scene:
        """A copy with some parts replaced."""
        return replace(self, **changes)

    def shown(self, relief: Relief, centres: Tensor, particles: Tensor) -> tuple[Tensor, Tensor]:
        """Which soil Gaussians and which particles lie near enough to the surface to be drawn: masks (s,) and (p,)."""
        points = torch.cat([centres, particles])
        near = relief.within(_HIDDEN * self.spacing, points)
        if self.side_light is not None:
            near |= to_sides(points, self.bed)[0] < _HIDDEN * self.spacing
        return near[: len(centres)], near[len(centres) :]

    def pose(self, positions: Any, deformations: Any, tool: Pose | None) -> Posed:
        """Move, cull and shade everything for one moment.

        Args:
            positions: (p, 3) particles now, m (array or tensor).
            deformations: (p, 3, 3) visual deformation since rest, or None.
            tool: rotation (3, 3) and position (3,) of the tool's frame, or None for no tool.
        """
        return finished(self._posing(positions, deformations, tool))

    def poses(self, moments: Iterable[tuple[Any, Any, Pose | None]]) -> list[Posed]:
        """Everything moved, culled and shaded for several moments, by arguments of `pose`."""
        return in_batches(lambda some: together([self._posing(*m) for m in some]), list(moments), "moments")

    def _posing(self, positions: Any, deformations: Any, tool: Pose | None) -> Steps[Posed]:
        """Steps of `pose`."""
        x = upload(positions, self.device).contiguous()
        f = None if deformations is None else upload(deformations, self.device)
        relief = yield from relief_of_particles.steps(
            x, self.spacing, self.bed.lower, self.bed.upper, smoothing=self.smoothing
        )
        placed = self.tool.absent() if tool is None else self.tool.at(*tool)
        shading = yield from shade.steps(relief, self.light, placed, self.tool_albedo)
        centres, covariances = self.soil.carry(x, None if f is None else f.contiguous())
        # Numbers of what is drawn, not masks: a GPU makes the host wait for each mask that selects something.
        chosen = yield from _numbers_of(self.shown(relief, centres, x))
        counts = [*(len(numbers) for numbers in chosen), len(self.surroundings)]
        drawn = tuple(x.new_empty((sum(counts), *shape)) for shape in ((3,), (3, 3), (), (4,)))
        soil, grains, rest = zip(*(part.split(counts) for part in drawn), strict=True)
        inputs = [relief.surface, as_warp(self._sides, wp.float32), as_warp(chosen[0], wp.int32)]
        inputs += [visible_form(centres, covariances, self.soil_opacity), as_warp(self.soil_albedo, wp.vec3)]
        inputs += [as_warp(self.soil.thickness, wp.float32), _END, visible_form(*soil)]
        launch(kernels_visible.settle, counts[0], inputs, x)
        sizes = wp.vec3(*(size * self.spacing for size in (PARTICLE_SIZE, PARTICLE_THICKNESS, BURIED_SIZE)))
        inputs = [relief.surface, as_warp(self._sides, wp.float32), as_warp(chosen[1], wp.int32), as_warp(x, wp.vec3)]
        inputs += [as_warp(self.grain_albedo, wp.vec3), sizes, _END, PARTICLE_OPACITY, visible_form(*grains)]
        launch(kernels_visible.grains, counts[1], inputs, x)
        for part, still in zip(rest, self._still, strict=True):
            part.copy_(still)
        discs = (x.new_zeros((0, 3)), x.new_zeros((0, 3, 3))) if tool is None else self.tool.discs(*tool)
        centres, covariances, opacities, features = drawn
        nearest = torch.empty_like(centres)
        launch(kernels.nearest_of_tool, len(centres), [placed, *(as_warp(t, wp.vec3) for t in (centres, nearest))], x)
        own = slice(counts[0], counts[0] + counts[1])
        return Posed(centres, covariances, opacities, features, own, chosen[1], nearest, discs, shading)

    def recoloured(self, posed: Posed) -> Posed:
        """A posed scene of the same soil, its buried albedo replaced by this scene's."""
        features = posed.features.clone()
        # Photographs show the particles at the sides; their colours contain the irradiance.
        hidden = features[posed.grains, 3:] > 0.0
        features[posed.grains, :3] = torch.where(
            hidden, self.grain_albedo[posed.grain_numbers], features[posed.grains, :3]
        )
        return replace(posed, features=features)

    def layers(self, posed: Posed, camera: Camera) -> Layers:
        """What a camera without distortion sees of a posed scene."""
        seen = finished(self._layering([(posed, camera)]))
        return Layers(*(getattr(seen, field.name)[0] for field in fields(Layers)))

    def _layering(self, views: Sequence[tuple[Posed, Camera]]) -> Steps[Layers]:
        """Steps of the layers of views of one size."""
        return layers_of.steps(views, self.background, self.tool_albedo)

    def render(self, positions: Any, deformations: Any, tool: Pose | None, camera: Camera) -> Image:
        """The picture (h, w, 3) float32 sRGB in [0, 1] that an undistorted camera takes of particles and tool."""
        return self.picture(self.pose(positions, deformations, tool), camera)

    def picture(self, posed: Posed, camera: Camera) -> Image:
        """The picture (h, w, 3) float32 sRGB in [0, 1] of a posed scene; several cameras may share the posing."""
        return self.pictures([(posed, camera)])[0]

    def pictures(self, views: Iterable[tuple[Posed, Camera]]) -> list[Image]:
        """The `picture` of each posed scene by its camera."""
        seen = list(views)
        sizes: dict[tuple[int, int], list[int]] = {}
        for k, (_, camera) in enumerate(seen):
            sizes.setdefault((camera.height, camera.width), []).append(k)
        most = _AT_ONCE if self.device.type == "cuda" else 1
        out: dict[int, Image] = {}
        with torch.no_grad():
            for alike in sizes.values():
                for first in range(0, len(alike), most):
                    some = alike[first : first + most]
                    images = in_batches(lambda ks: self._images([seen[k] for k in ks]), some, "pictures")
                    out |= zip(some, images, strict=True)
        return [out[k] for k in range(len(seen))]

    def _images(self, views: Sequence[tuple[Posed, Camera]]) -> list[Image]:
        """Pictures of one size, drawn beside each other."""
        return list(finished(self._layering(views)).image.cpu().numpy().astype(np.float32))


def to_sides(points: Tensor, bed: Bed) -> tuple[Tensor, Tensor]:
    """Distance (n,) of points (n, 3) to the nearest of the bed's sides, m, negative outside of the box; and which it
    is, in the order of `Scene.side_light`."""
    x, y, low, high = points[:, 0], points[:, 1], bed.lower.tolist(), bed.upper.tolist()
    nearest = torch.stack([x - low[0], high[0] - x, y - low[1], high[1] - y]).min(dim=0)
    return nearest.values, nearest.indices


def nearer_side(points: Tensor, relief: Relief, bed: Bed) -> Tensor:
    """Which of the bed's sides points (n, 3) lie nearer to than to the surface: (n,), -1 for none."""
    distance, which = to_sides(points, bed)
    return torch.where(distance < relief.depth_below(points), which, -1)


def visible_form(centres: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor | None = None) -> Any:
    """Gaussians in the form of the kernels of `kernels_visible`."""
    out = kernels_visible.Visible()
    out.centres = wp.from_torch(centres, dtype=wp.vec3)
    out.covariances = wp.from_torch(covariances, dtype=wp.mat33)
    out.opacities = wp.from_torch(opacities)
    if features is not None:
        out.features = wp.from_torch(features, dtype=wp.vec4)
    return out


def _numbers_of(masks: Sequence[Tensor]) -> Steps[list[Tensor]]:
    """Where each mask (n,) holds, int32."""
    if not masks[0].is_cuda:
        return [mask.nonzero()[:, 0].to(torch.int32) for mask in masks]
    counts = yield torch.stack([mask.sum() for mask in masks])
    # where they hold first, in order: to select by a mask is to ask how often it holds once more
    order = [(~mask).to(torch.uint8).argsort(stable=True) for mask in masks]
    return [numbers[: int(count)].to(torch.int32) for numbers, count in zip(order, counts, strict=True)]
