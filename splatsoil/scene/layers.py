"""What cameras see of soil, tool and surroundings at one moment: Gaussians, and the light where they show soil."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.kernels_colour import WIDTH, develop
from splatsoil.scene.kernels_maps import Shade
from splatsoil.scene.lit import LitRelief, ceiling, march_step
from splatsoil.scene.relief import grid_of
from splatsoil.scene.sky import reach
from splatsoil.scene.tool import eye_of
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.views import Seen, rasterise_views
from splatsoil.splats.warp_torch import as_warp, launch, launch_parts, thread_count, upload

FloatArray = npt.NDArray[np.float64]

TOOL_OPACITY = 0.95
"""Of the discs that stand for the tool; from this weight on a pixel's tool counts as unhidden."""

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
        grain_numbers: (g,) int32: the particles whose own these are.
        discs: centres (k, 3) and covariances (k, 3, 3) of the discs that stand for the tool.
        tool_box: (8, 3) corners of a box around the tool, m; none where there is no tool.
        lit: the soil's surface under the light, with the tool's pose.
    """

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    grains: slice
    grain_numbers: Tensor
    discs: tuple[Tensor, Tensor]
    tool_box: FloatArray
    lit: LitRelief

    @cached_property
    def before_tool(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Centres, covariances, opacities and features of the grains, which no tool lets through, and of the tool's
        discs, which the one feature marks."""
        discs, covariances = self.discs
        count, few = self.grains.stop - self.grains.start, len(discs)
        return (
            torch.cat([self.centres[self.grains], discs]),
            torch.cat([self.covariances[self.grains], covariances]),
            torch.cat([self.opacities[self.grains], discs.new_full((few,), TOOL_OPACITY)]),
            functional.pad(discs.new_ones((few, 1)), (0, 0, count, 0)),
        )


@dataclass(frozen=True)
class Layers:
    """What one camera sees, before light and colour meet, or several, each with an axis in front; tensors on the
    scene's device.

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
        """(h, w, 3) sRGB in [0, 1]: colour in its light where it is soil, behind what the tool leaves of the
        pixel."""
        image = torch.empty_like(self.colour, memory_format=torch.contiguous_format)
        count = self.soil.numel()
        parts = [as_warp(t.reshape(-1), wp.float32) for t in (self.colour, self.soil, self.light, self.tool, image)]
        launch(develop, -(-count // WIDTH), [count, *parts], image)
        return image


@stepwise
def layers_of(
    views: Sequence[tuple[Posed, Camera]], background: npt.ArrayLike, tool_albedo: FloatArray
) -> Steps[Layers]:
    """What cameras without distortion, all of one size, see of posed scenes.

    Args:
        views: of each, with an axis in front in what is returned.
        background: (3,) sRGB where nothing is.
        tool_albedo: (3,) linear.
    """
    device = views[0][0].centres.device
    behind = upload([*np.asarray(background, dtype=np.float64), 0.0, 0.0], device)
    seen = []
    for posed, camera in views:
        view = upload(camera.world_to_camera, device)
        along = posed.centres @ view[2, :3] + view[2, 3]
        features = torch.cat([posed.features, along[:, None]], dim=1)
        seen.append(Seen(posed.centres, posed.covariances, posed.opacities, features, camera))
    image, alpha = yield from rasterise_views.steps(seen, background=behind, antialias=True)
    covered = alpha.clamp_min(1e-3)
    depth = torch.where(alpha > 0.3, image[..., 4] / covered, 0.0).contiguous()
    # Soil is opaque: what shines through between its Gaussians is not there.
    ground = (alpha > 0.3) & (image[..., 3] > 0.5 * alpha)
    filled = image[..., :4] - (1.0 - alpha[..., None]) * behind[:4]
    shown = torch.where(ground[..., None], filled / covered[..., None], image[..., :4])
    colour, soil = shown[..., :3], shown[..., 3].contiguous()
    unhidden = yield from _tools_among_splats(views)
    light, tool = (torch.empty((*depth.shape, k), dtype=torch.float32, device=device) for k in (3, 4))
    for k, (posed, camera) in enumerate(views):
        maps = depth[k], soil[k], unhidden[k], light[k], tool[k]
        _illuminate(posed.lit, camera, *maps, tool_albedo)
    return Layers(colour, soil, depth, light, tool)


def _tools_among_splats(views: Sequence[tuple[Posed, Camera]]) -> Steps[Tensor]:
    """(v, h, w) how much of the tool the particles before it leave to be seen, where it is; drawn only around it.

    Only particles count, which no tool lets through; what they carry may poke through a thin blade.
    """
    camera = views[0][1]
    out = views[0][0].centres.new_zeros((len(views), camera.height, camera.width))
    boxes = {k: box for k, (posed, camera) in enumerate(views) if (box := _box_of_tool(posed, camera)) is not None}
    if not boxes:
        return out
    # As large as the largest one: views are drawn together.
    width, height = (max(high[i] - low[i] for low, high in boxes.values()) for i in (0, 1))
    seen, windows = [], []
    for k, (low, _) in boxes.items():
        posed, camera = views[k]
        x0, y0 = min(low[0], camera.width - width), min(low[1], camera.height - height)
        seen.append(Seen(*posed.before_tool, camera.cropped(x0, y0, width, height)))
        windows.append(out[k, y0 : y0 + height, x0 : x0 + width])
    marked, _ = yield from rasterise_views.steps(seen, antialias=True)
    for window, marks in zip(windows, (marked[..., 0] / TOOL_OPACITY).clamp_max(1.0), strict=True):
        window.copy_(marks)
    return out


def _box_of_tool(posed: Posed, camera: Camera) -> tuple[list[int], list[int]] | None:
    """First and one-past-last column and row around the tool in a picture, if it is in it."""
    if len(posed.tool_box) == 0:
        return None
    size = [camera.width, camera.height]
    pixels, _ = camera.project(posed.tool_box)
    if not np.isfinite(pixels).all():  # it reaches behind the camera
        return [0, 0], size
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, size)
    return None if np.any(high <= low) else (low.tolist(), high.tolist())


def _illuminate(
    lit: LitRelief,
    camera: Camera,
    depth: Tensor,
    soil: Tensor,
    unhidden: Tensor,
    light: Tensor,
    tool: Tensor,
    tool_albedo: FloatArray,
) -> None:
    """Write light on the soil (h, w, 3) and the tool's share (h, w, 4) of each pixel."""
    relief = lit.relief
    maps = [*(as_warp(m, wp.float32) for m in (depth, soil, unhidden, relief.height))]
    numbers = [grid_of(relief), lit.light.kernel_form(), lit.tool, wp.vec3(*tool_albedo), march_step(relief)]
    outputs = [as_warp(light, wp.vec3), as_warp(tool, wp.vec4)]
    shades = as_warp(lit.shades, Shade)
    low, thick = relief.layers
    filling = [as_warp(relief.filling, wp.float32), wp.vec2(low, 1.0 / thick)]
    around = [as_warp(lit.sent, wp.vec3), as_warp(lit.hidden, wp.float32), wp.vec3(*lit.tool_light), reach(relief)]
    inputs = [eye_of(camera), *maps, shades, *filling, *around, *numbers, ceiling(relief), *outputs]
    pixels = camera.height * camera.width
    if depth.is_cuda:
        launch(kernels.illuminate, pixels, [0, *inputs], depth)
    else:
        threads = thread_count(pixels / _PIXELS_PER_MILLISECOND)
        launch_parts(kernels.illuminate, [pixels * k // threads for k in range(threads + 1)], inputs)
