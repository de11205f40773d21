"""Image layers of one moment: the albedo that Gaussians draw, the irradiance on the soil, and the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.light import encoded, linear
from splatsoil.scene.shading import Shading
from splatsoil.scene.tool import eye_of
from splatsoil.splats.steps import Steps, stepwise
from splatsoil.splats.views import Seen, rasterise_views
from splatsoil.splats.warp_torch import launch, launch_parts, thread_count, upload

TOOL_OPACITY = 0.95
"""Of the discs that stand for the tool."""

_PIXELS_PER_MILLISECOND = 5000
"""About how many pixels one CPU core shades in a millisecond."""


@dataclass(frozen=True)
class Posed:
    """A scene at one moment: soil moved and shaded, tool in place.

    Attributes:
        centres: (n, 3) Gaussians that can be seen: soil, then surroundings.
        covariances: (n, 3, 3).
        opacities: (n,).
        features: (n, 4): albedo (soil) or colour (surroundings) in sRGB, and 1 for soil.
        grains: the particles' own Gaussians among them.
        grain_numbers: (g,) int32: the particles whose own these are.
        nearest: (n, 3) of each, the point of the tool that is nearest to it, m.
        discs: centres (k, 3) and covariances (k, 3, 3) of the discs that stand for the tool.
        shading: the soil's surface under the light, with the tool's pose.
    """

    centres: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    grains: slice
    grain_numbers: Tensor
    nearest: Tensor
    discs: tuple[Tensor, Tensor]
    shading: Shading


@dataclass(frozen=True)
class Layers:
    """Layers of one camera's image, or of several images, each with an axis in front; tensors on the scene's device.

    Attributes:
        colour: (h, w, 3) sRGB of all but the tool: albedo where soil is, colour elsewhere.
        soil: (h, w) share of soil in that.
        depth: (h, w) of that, along the camera's axis, m; 0 where nothing is.
        light: (h, w, 3) irradiance on the soil over that of level ground; 1 elsewhere.
        tool: (h, w, 4) the tool's linear radiance times its share of the pixel, and that share.
    """

    colour: Tensor
    soil: Tensor
    depth: Tensor
    light: Tensor
    tool: Tensor

    @property
    def image(self) -> Tensor:
        """(h, w, 3) sRGB in [0, 1]: albedo times irradiance where it is soil, composited with the tool."""
        shown = linear(self.colour) * (1.0 + self.soil[..., None] * (self.light - 1.0))
        return encoded(shown * (1.0 - self.tool[..., 3:]) + self.tool[..., :3]).clamp(0.0, 1.0)


@stepwise
def layers_of(
    views: Sequence[tuple[Posed, Camera]], background: npt.ArrayLike, tool_albedo: FloatArray
) -> Steps[Layers]:
    """Layers of posed scenes, as cameras without distortion, all of one image size, see them.

    Args:
        views: scene and camera of each image; what is returned has an axis for them in front.
        background: (3,) sRGB where nothing is.
        tool_albedo: (3,) linear.
    """
    device = views[0][0].centres.device
    behind = upload([*np.asarray(background, dtype=np.float64), 0.0, 0.0, 0.0], device)
    seen = []
    for posed, camera in views:
        view = upload(camera.world_to_camera, device)
        along = posed.centres @ view[2, :3] + view[2, 3]
        # Before the tool is what lies nearer to the camera than the tool's nearest point.
        towards = posed.centres - upload(camera.position, device)
        before = ((posed.centres - posed.nearest) * towards).sum(dim=1) < 0.0
        features = torch.cat([posed.features, along[:, None], before[:, None]], dim=1)
        seen.append(Seen(posed.centres, posed.covariances, posed.opacities, features, camera))
    image, alpha = yield from rasterise_views.steps(seen, background=behind, antialias=True)
    covered = alpha.clamp_min(1e-3)
    depth = torch.where(alpha > 0.3, image[..., 4] / covered, 0.0).contiguous()
    # Soil is opaque: what shines through between its Gaussians is not there.
    ground = (alpha > 0.3) & (image[..., 3] > 0.5 * alpha)
    filled = image[..., :4] - (1.0 - alpha[..., None]) * behind[:4]
    shown = torch.where(ground[..., None], filled / covered[..., None], image[..., :4])
    colour, soil, front = shown[..., :3], shown[..., 3].contiguous(), image[..., 5].contiguous()
    light, tool = (torch.empty((*depth.shape, k), dtype=torch.float32, device=device) for k in (3, 4))
    for k, (posed, camera) in enumerate(views):
        pixels = kernels.Pixels()
        pixels.depth, pixels.soil, pixels.before = (wp.from_torch(m[k]) for m in (depth, soil, front))
        pixels.light, pixels.tool = wp.from_torch(light[k], dtype=wp.vec3), wp.from_torch(tool[k], dtype=wp.vec4)
        _illuminate(posed.shading, camera, pixels, tool_albedo)
    return Layers(colour, soil, depth, light, tool)


def _illuminate(shading: Shading, camera: Camera, pixels: Any, tool_albedo: FloatArray) -> None:
    """Write the irradiance on the soil, and the tool's radiance and share, of each pixel."""
    like, count = shading.sky_visibility, camera.height * camera.width
    light = shading.light.kernel_form(tool_albedo)
    inputs = [eye_of(camera), shading.relief.surface, shading.maps, light, shading.tool, pixels]
    if like.is_cuda:
        launch(kernels.illuminate, count, [0, *inputs], like)
    else:
        threads = thread_count(count / _PIXELS_PER_MILLISECOND)
        launch_parts(kernels.illuminate, [count * k // threads for k in range(threads + 1)], inputs)
