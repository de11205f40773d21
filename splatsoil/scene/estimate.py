"""The light estimated from photographs of the undisturbed bed.

Albedo varies from place to place and its blotches look like slopes; where a shadow ends, or a slope turns, brightness
changes over millimetres while the albedo does not know of it. So differences of log brightness over a short distance
are compared with those that a light predicts, with a robust loss: the tool's shadow, where there is one, gives the
sun's direction by its edge and the sky's share by what is left inside it, and slopes add what they know. Photographs
blur a shadow's edge, which would look like more sky: for the share, the edge itself is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
import warp as wp
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from splatsoil.measurement import Frame, Measurement
from splatsoil.scene import kernels
from splatsoil.scene.light import SOIL_REFLECTANCE, Light, linear
from splatsoil.scene.lit import LitRelief, ceiling, direct_light, march_step, sun_on_points
from splatsoil.scene.relief import Relief, grid_of
from splatsoil.scene.sky import sky_openness
from splatsoil.scene.tool import ToolBody
from splatsoil.splats.warp_torch import as_warp, launch

FloatArray = npt.NDArray[np.float64]

_CELLS = 200
"""Cells along the longer side of the bed at which colours are compared."""

_FINEST = 0.004
"""Smallest cell, m: about a pixel of the photographs the method was measured on."""

_MARGIN = 0.03
"""Strip along the walls that is left out, m: walls shade it and hide it."""

_LAG = 3
"""Distance of compared cells: a shadow's edge is blurred over about two."""

_BLUR = 1.5
"""How far photographs blur an edge, in their pixels: the eye's pixel and the interpolation between pixels."""

_TOOL_REFLECTANCE = 0.2
"""The tool's colour is not known yet; from black to bright metal this moves the sky's share by 0.01."""

_FEWEST_SHADED = 30
"""Cells in the tool's shadow, beside its edge, from which the sky's share can be told."""


@dataclass(frozen=True)
class LightEstimate:
    """A light and how well it explains what was seen.

    Attributes:
        light: the light.
        explained: share of the (robust) spread of brightness differences that the light explains; near 0 means that the
            photographs show neither shadow nor slope and the light is a guess.
        shadowed: share of the bed's area that lies in the tool's shadow.
    """

    light: Light
    explained: float
    shadowed: float


def still_frames(measurement: Measurement) -> list[Frame]:
    """Every photograph in which nothing has moved: the views, the pre-roll and frame 0 of the video."""
    still = [f for f in measurement.video if f.frame is not None and f.frame <= 0]
    return [*measurement.views, *still]


def seen_colours(
    points: Tensor, frames: Sequence[Frame], relief: Relief, tool: object, *, slack: float = 0.004
) -> tuple[Tensor, Tensor]:
    """Linear colours of points on the surface, the median over the photographs that see them.

    Args:
        points: (n, 3), m.
        frames: photographs.
        relief: the surface, for what hides what.
        tool: the tool's pose in these photographs, in the kernels' form.
        slack: how far a point may lie beneath the surface and still count as seen, m.

    Returns:
        (n, 3) colours, NaN where no photograph sees the point, and (n,) how many do.
    """
    samples = torch.full((len(frames), len(points), 3), math.nan)
    where = points.double().cpu().numpy()
    for k, frame in enumerate(frames):
        camera = frame.camera
        pixels, depth = camera.project(where)
        seen = torch.empty(len(points), dtype=torch.float32, device=points.device)
        inputs = [
            as_warp(points, wp.vec3),
            wp.vec3(*camera.position),
            as_warp(relief.height, wp.float32),
            grid_of(relief),
        ]
        inputs += [tool, march_step(relief), ceiling(relief), slack, as_warp(seen, wp.float32)]
        launch(kernels.points_seen, len(points), inputs, points)
        inside = (
            (depth > 0) & (pixels > 1.0).all(axis=1) & (pixels < [camera.width - 1.0, camera.height - 1.0]).all(axis=1)
        )
        visible = (seen.cpu().numpy() > 0.5) & inside
        image = linear(torch.from_numpy(np.ascontiguousarray(frame.image())))
        normalised = torch.from_numpy(2.0 * pixels[visible] / [camera.width, camera.height] - 1.0).float()
        picked = functional.grid_sample(
            image.permute(2, 0, 1)[None], normalised[None, None], mode="bilinear", align_corners=False
        )
        samples[k, torch.from_numpy(visible)] = picked[0, :, 0].T
    count = torch.isfinite(samples[:, :, 0]).sum(dim=0)
    return samples.nanmedian(dim=0).values.to(points.device), count.to(points.device)


def estimate_light(measurement: Measurement, relief: Relief, body: ToolBody) -> LightEstimate:
    """Sun and sky over a measurement set, from its photographs before anything moves.

    Args:
        measurement: the set; its tool stands where its motion begins.
        relief: the undisturbed surface.
        body: the tool.
    """
    motion = measurement.tool.motion
    tool = body.at(*motion.pose(float(motion.times[0])))
    lower, upper = np.asarray(measurement.bed.lower), np.asarray(measurement.bed.upper)
    points, shape = _cells(relief, lower, upper)
    colours, count = seen_colours(points, still_frames(measurement), relief, tool)
    colours[count < 2] = math.nan
    middle = 0.5 * (lower + upper)
    pixel = float(np.median([np.linalg.norm(v.camera.position - middle) / v.camera.fx for v in measurement.views]))
    across = float((points[1] - points[0]).norm())
    return fit_light(points, colours, shape, relief, tool, blur=max(1, math.ceil(_BLUR * pixel / across)))


def fit_light(
    points: Tensor, colours: Tensor, shape: tuple[int, int], relief: Relief, tool: object, *, blur: int = 1
) -> LightEstimate:
    """The light that explains the colours of a grid of points on a surface.

    Args:
        points: (rows · columns, 3) points of a regular grid in x and y, row by row, m.
        colours: (rows · columns, 3) linear colours; NaN where unknown.
        shape: rows and columns.
        relief: the surface.
        tool: the tool's pose in the kernels' form.
        blur: half width of a shadow's edge in the photographs, in rows and columns.
    """
    problem = _Problem(points, colours, shape, relief, tool)
    grey = problem.brightness.mean(dim=1)
    start = min(
        (problem.cost(grey, azimuth, elevation, share), azimuth, elevation, share)
        for elevation in (20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
        for azimuth in np.arange(-180.0, 180.0, 10.0)
        for share in (0.4, 0.6, 0.8)
    )
    first = np.array(start[1:])
    simplex = first + np.array([[0, 0, 0], [6.0, 0, 0], [0, 5.0, 0], [0, 0, -0.1]])
    found = minimize(
        lambda v: problem.cost(grey, *v),
        first,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-6, "maxfev": 250},
    )
    azimuth, elevation = float(found.x[0]), float(np.clip(found.x[1], 5.0, 89.9))
    beside = problem.beside_edges(azimuth, elevation, blur)
    ambient = [
        minimize_scalar(
            lambda a, c=channel: beside.cost(beside.brightness[:, c], azimuth, elevation, a),
            bounds=(0.02, 0.98), method="bounded", options={"xatol": 1e-3},
        ).x
        for channel in range(3)
    ]  # fmt: skip
    level = torch.nanmedian(colours, dim=0).values.clamp_min(1e-3).cpu().numpy().astype(np.float64)
    light = Light.from_angles(azimuth, elevation, np.array(ambient), level=level)
    nothing = float(problem.spread(problem.differences(grey)))
    shadowed = float(1.0 - problem.tool_light(light).mean())
    return LightEstimate(light, 1.0 - float(found.fun) / max(nothing, 1e-12), shadowed)


class _Problem:
    """Robust fit of log-brightness differences on a grid."""

    def __init__(
        self,
        points: Tensor,
        colours: Tensor,
        shape: tuple[int, int],
        relief: Relief,
        tool: object,
        lag: int = _LAG,
    ) -> None:
        self.points, self.shape, self.relief, self.tool, self.lag = points, shape, relief, tool, lag
        self.brightness = colours.clamp_min(1e-4).log()
        openness, hidden = (relief.sample(share, points) for share in sky_openness(relief, tool))
        # The soil and the tool in the sky's way send back half of level ground's light.
        self.openness = openness
        self.returned = 0.5 * (SOIL_REFLECTANCE * (1.0 - openness - hidden) + _TOOL_REFLECTANCE * hidden)
        self._known: tuple[float, float, Tensor] | None = None
        self.scale = 1.0
        grey = self.differences(self.brightness.mean(dim=1))
        self.scale = 1.4826 * float(grey[torch.isfinite(grey)].abs().median())

    def differences(self, values: Tensor) -> Tensor:
        """Differences over the lag along both axes of the grid."""
        grid, lag = values.reshape(self.shape), self.lag
        return torch.cat([(grid[lag:] - grid[:-lag]).reshape(-1), (grid[:, lag:] - grid[:, :-lag]).reshape(-1)])

    def beside_edges(self, azimuth: float, elevation: float, blur: int) -> _Problem:
        """The same without the shadow's edge, its blur taken off both sides, by differences that reach across.

        Of a shadow too narrow for that, less is taken off; nothing where hardly any shadow is left then.
        """
        sun = self.tool_light(Light.from_angles(azimuth, elevation, 0.5)).reshape(1, 1, *self.shape)
        known = torch.isfinite(self.brightness).all(dim=1).reshape(self.shape)
        for width in range(min(blur, (min(self.shape) // 2 - _LAG) // 2), 0, -1):
            highest, lowest = (functional.max_pool2d(sign * sun, 2 * width + 1, 1, width) for sign in (1.0, -1.0))
            edge = (highest + lowest > 0.02)[0, 0]
            if int(((sun[0, 0] < 0.02) & ~edge & known).sum()) >= _FEWEST_SHADED:
                colours = self.brightness.exp()
                colours[edge.reshape(-1)] = math.nan
                return _Problem(self.points, colours, self.shape, self.relief, self.tool, lag=2 * width + _LAG)
        return self

    def spread(self, residual: Tensor) -> Tensor:
        """Mean pseudo-Huber loss of the residuals that are known."""
        known = residual[torch.isfinite(residual)]
        return (torch.sqrt(1.0 + (known / self.scale) ** 2) - 1.0).mean()

    def cost(self, brightness: Tensor, azimuth: float, elevation: float, ambient: float) -> float:
        """Loss of a light; the sky's share is held between 0 and 1, the sun above the horizon."""
        if not 5.0 <= elevation <= 89.9 or not 0.02 <= ambient <= 0.98:
            return 1e3
        direct = self._direct(azimuth, elevation)
        e = ambient * self.openness + (1.0 - ambient) * direct + self.returned
        return float(self.spread(self.differences(brightness - e.clamp_min(1e-3).log())))

    def tool_light(self, light: Light) -> Tensor:
        """Share of the sun that the tool lets through to each point."""
        return sun_on_points(self._open(light), self.points, 0.25 * _FINEST)

    def _open(self, light: Light) -> LitRelief:
        """The relief with no shadow of its own: before anything has moved it is too gentle for one."""
        everything = torch.ones_like(self.relief.height)
        return LitRelief(self.relief, light, self.tool, everything, everything, everything[..., None].expand(-1, -1, 3))

    def _direct(self, azimuth: float, elevation: float) -> Tensor:
        """The sun's light on each point, 1 on level open ground; that of the last direction is kept."""
        if self._known is None or self._known[:2] != (azimuth, elevation):
            light = Light.from_angles(azimuth, elevation, 0.5)
            self._known = (azimuth, elevation, direct_light(self._open(light), self.points, 0.25 * _FINEST))
        return self._known[2]


def _cells(relief: Relief, lower: FloatArray, upper: FloatArray) -> tuple[Tensor, tuple[int, int]]:
    """Points of a regular grid on the surface, away from the walls."""
    extent = upper[:2] - lower[:2]
    margin = min(_MARGIN, 0.1 * float(extent.min()))
    size = max(_FINEST, float(extent.max()) / _CELLS)
    nx, ny = (max(4 * _LAG, int((extent[k] - 2 * margin) / size)) for k in (0, 1))
    x = torch.linspace(float(lower[0] + margin), float(upper[0] - margin), nx, device=relief.device)
    y = torch.linspace(float(lower[1] + margin), float(upper[1] - margin), ny, device=relief.device)
    ys, xs = torch.meshgrid(y, x, indexing="ij")
    flat = torch.stack([xs.reshape(-1), ys.reshape(-1)], dim=1)
    return torch.cat([flat, relief.sample(relief.height, flat)[:, None]], dim=1), (ny, nx)
