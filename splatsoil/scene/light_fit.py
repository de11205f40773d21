"""The light that explains how colours differ over a bed at rest, and what the tool's shadow changes.

Albedo varies from place to place and its blotches look like slopes; where a shadow ends, or a slope turns, brightness
changes over millimetres while the albedo does not know of it. So differences of log brightness over a short distance
are compared with those that a light predicts, with a robust loss: the tool's shadow, where there is one, gives the
sun's direction by its edge and the sky's share by what is left inside it, and slopes add what they know. Photographs
blur a shadow's edge, which would look like more sky: for the share, the edge itself is left out.

Where the tool's shadow passes on over untouched soil, what a place loses and gains by it owes nothing to the albedo: a
dark blotch in the shadow at rest would look like less sky, a pale one like more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from splatsoil.scene.light import SOIL_REFLECTANCE, Light
from splatsoil.scene.lit import LitRelief, facing, normals, sun_on_points
from splatsoil.scene.relief import Relief
from splatsoil.scene.sky import sky_openness

FloatArray = npt.NDArray[np.float64]

FINEST = 0.004
"""Smallest distance of compared points, m: about a pixel of the photographs the method was measured on."""

LAG = 3
"""Distance of compared cells: a shadow's edge is blurred over about two."""

_TOOL_REFLECTANCE = 0.2
"""The tool's colour is not known yet; from black to bright metal this moves the sky's share by 0.01."""

_FEWEST_SHADED = 30
"""Cells in the tool's shadow, beside its edge, from which the sky's share can be told."""

_PLACES, _AROUND = 4, (-7.5, -5.0, -2.5, 0.0, 2.5, 5.0, 7.5)
"""Of the sun's directions tried, the best, and how far around them it is looked for more closely, degrees."""

_LEAST_CHANGE = 0.01
"""Changes of log brightness are not taken for better known than this."""


@dataclass(frozen=True)
class LightEstimate:
    """A light and how well it explains what was seen.

    Attributes:
        light: the light.
        explained: share of the (robust) spread of brightness differences, and of changes by the shadow that passes,
            that the light explains; near 0 means that the pictures show neither shadow nor slope and the light is a
            guess.
        shadowed: share of the bed's area that lies in the tool's shadow.
    """

    light: Light
    explained: float
    shadowed: float


@dataclass(frozen=True)
class Passing:
    """The tool somewhere else, its shadow on soil that hasn't moved, as one camera sees it.

    Attributes:
        tool: its pose in the kernels' form.
        change: (n, 3) log of the points' linear colours then over those at rest; NaN where unknown.
    """

    tool: object
    change: Tensor


def fit_light(
    points: Tensor,
    colours: Tensor,
    shape: tuple[int, int],
    relief: Relief,
    tool: object,
    *,
    blur: int = 1,
    passing: Sequence[Passing] = (),
) -> LightEstimate:
    """The light that explains the colours of a grid of points on a surface.

    Args:
        points: (rows · columns, 3) points of a regular grid in x and y, row by row, m.
        colours: (rows · columns, 3) linear colours; NaN where unknown.
        shape: rows and columns.
        relief: the surface.
        tool: the tool's pose in the kernels' form.
        blur: half width of a shadow's edge in the photographs, in rows and columns.
        passing: what the tool's shadow did elsewhere.
    """
    telling = [p for p in passing if _tells(p)]
    # Cameras that look at the same moment share its light.
    tools = {id(p.tool): p.tool for p in telling}
    lights = {key: _Sunlit(points, relief, there) for key, there in tools.items()}
    parts = [_Passed(lights[id(p.tool)], p.change) for p in telling]
    problem = _Problem(_Sunlit(points, relief, tool), colours.clamp_min(1e-4).log(), shape, parts)
    first = _start(problem)
    simplex = first + np.array([[0, 0, 0], [6.0, 0, 0], [0, 5.0, 0], [0, 0, -0.1]])
    found = minimize(
        lambda v: problem.cost(None, *v),
        first,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-6, "maxfev": 250},
    )
    azimuth, elevation = float(found.x[0]), float(np.clip(found.x[1], 5.0, 89.9))
    beside = problem.beside_edges(azimuth, elevation, blur)
    ambient = [
        minimize_scalar(
            lambda a, c=channel: beside.cost(c, azimuth, elevation, a),
            bounds=(0.02, 0.98), method="bounded", options={"xatol": 1e-3},
        ).x
        for channel in range(3)
    ]  # fmt: skip
    level = torch.nanmedian(colours, dim=0).values.clamp_min(1e-3).cpu().numpy().astype(np.float64)
    light = Light.from_angles(azimuth, elevation, np.array(ambient), level=level)
    shadowed = float(1.0 - problem.still.tool_light(light).mean())
    return LightEstimate(light, 1.0 - float(found.fun) / max(problem.nothing(), 1e-12), shadowed)


def _start(problem: _Problem) -> FloatArray:
    """Azimuth, elevation and the sky's share to search from: a narrow shadow is felt from a few degrees off at most."""
    tried = sorted(
        (problem.cost(None, azimuth, elevation, share), azimuth, elevation, share)
        for elevation in (20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
        for azimuth in np.arange(-180.0, 180.0, 10.0)
        for share in (0.4, 0.6, 0.8)
    )
    best: dict[tuple[float, float], float] = {}
    for _, azimuth, elevation, share in tried:
        best.setdefault((azimuth, elevation), share)
    near = [
        (azimuth + turn, elevation + rise, share)
        for (azimuth, elevation), share in islice(best.items(), _PLACES)
        for turn in _AROUND
        for rise in _AROUND
    ]
    return np.array(min((problem.cost(None, *at), *at) for at in near)[1:])


class _Sunlit:
    """Light on points of a surface with the tool at one place."""

    def __init__(self, points: Tensor, relief: Relief, tool: object) -> None:
        self.points, self.relief, self.tool = points, relief, tool
        self.normal = normals(relief, points)
        openness, hidden = (relief.sample(share, points) for share in sky_openness(relief, tool))
        # The soil and the tool in the sky's way send back half of level ground's light.
        self.openness = openness
        self.returned = 0.5 * (SOIL_REFLECTANCE * (1.0 - openness - hidden) + _TOOL_REFLECTANCE * hidden)
        self._known: tuple[float, float, Tensor] | None = None

    def log_light(self, azimuth: float, elevation: float, ambient: float) -> Tensor:
        """(n,) log of the light, 0 on level open ground; the sun's part of the last direction is kept."""
        if self._known is None or self._known[:2] != (azimuth, elevation):
            light = Light.from_angles(azimuth, elevation, 0.5)
            self._known = (azimuth, elevation, facing(light, self.normal) * self.tool_light(light))
        e = ambient * self.openness + (1.0 - ambient) * self._known[2] + self.returned
        return e.clamp_min(1e-3).log()

    def tool_light(self, light: Light) -> Tensor:
        """Share of the sun that the tool lets through to each point."""
        return sun_on_points(self._open(light), self.points, 0.25 * FINEST)

    def edge(self, light: Light, width: int, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """(rows, columns) points nearer to a shadow's edge than so many rows or columns, and those in full shadow."""
        sun = self.tool_light(light).reshape(1, 1, *shape)
        highest, lowest = (functional.max_pool2d(sign * sun, 2 * width + 1, 1, width) for sign in (1.0, -1.0))
        return (highest + lowest > 0.02)[0, 0], (sun < 0.02)[0, 0]

    def _open(self, light: Light) -> LitRelief:
        """The relief with no shadow of its own: before anything has moved it is too gentle for one."""
        everything = torch.ones_like(self.relief.height)
        return LitRelief(self.relief, light, self.tool, everything, everything, everything[..., None].expand(-1, -1, 3))


@dataclass(frozen=True)
class _Passed:
    """A `Passing` and its light."""

    sunlit: _Sunlit
    change: Tensor


class _Problem:
    """Robust fit of differences of log brightness: between places of a grid at rest, and between times."""

    def __init__(
        self,
        still: _Sunlit,
        brightness: Tensor,
        shape: tuple[int, int],
        passed: Sequence[_Passed] = (),
        lag: int = LAG,
    ) -> None:
        self.still, self.brightness, self.shape, self.passed, self.lag = still, brightness, shape, passed, lag
        self.scale = _middle(self.differences(_channel(brightness, None)))
        self.scales = [max(_middle(_centred(_channel(p.change, None))), _LEAST_CHANGE) for p in passed]
        # A few places known of a moment must not weigh as much as all of the bed.
        self.shares = [_known(p.change) / len(p.change) for p in passed]

    def differences(self, values: Tensor) -> Tensor:
        """Differences over the lag along both axes of the grid."""
        grid, lag = values.reshape(self.shape), self.lag
        return torch.cat([(grid[lag:] - grid[:-lag]).reshape(-1), (grid[:, lag:] - grid[:, :-lag]).reshape(-1)])

    def beside_edges(self, azimuth: float, elevation: float, blur: int) -> _Problem:
        """The same without shadows' edges, their blur taken off both sides, by differences that reach across.

        Where all shadows are too narrow for that, less is taken off; nothing where hardly any shadow is left then.
        """
        light = Light.from_angles(azimuth, elevation, 0.5)
        widest = min(blur, (min(self.shape) // 2 - LAG) // 2)
        for width in range(widest, 0, -1):
            edge, shaded = self.still.edge(light, width, self.shape)
            enough = _enough(shaded & ~edge, self.brightness)
            passed = []
            for part in self.passed:
                there, then = part.sunlit.edge(light, width, self.shape)
                enough |= _enough((shaded ^ then) & ~(edge | there), part.change)
                change = _without(edge | there, part.change)
                if _known(change) >= _FEWEST_SHADED:
                    passed.append(_Passed(part.sunlit, change))
            beside = _Problem(self.still, _without(edge, self.brightness), self.shape, passed, 2 * width + LAG)
            if enough and math.isfinite(beside.scale):
                return beside
        return self

    def cost(self, channel: int | None, azimuth: float, elevation: float, ambient: float) -> float:
        """Loss of a light in one colour or in grey; the sky's share is held between 0 and 1, the sun above the
        horizon."""
        if not 5.0 <= elevation <= 89.9 or not 0.02 <= ambient <= 0.98:
            return 1e3
        rest = self.still.log_light(azimuth, elevation, ambient)
        total = _spread(self.differences(_channel(self.brightness, channel) - rest), self.scale)
        for part, scale, share in zip(self.passed, self.scales, self.shares, strict=True):
            predicted = part.sunlit.log_light(azimuth, elevation, ambient) - rest
            total += share * _spread(_centred(_channel(part.change, channel) - predicted), scale)
        return total

    def nothing(self) -> float:
        """Loss of a light that is the same everywhere."""
        total = _spread(self.differences(_channel(self.brightness, None)), self.scale)
        for part, scale, share in zip(self.passed, self.scales, self.shares, strict=True):
            total += share * _spread(_centred(_channel(part.change, None)), scale)
        return total


def _channel(values: Tensor, channel: int | None) -> Tensor:
    """One colour of (n, 3), or their mean."""
    return values.mean(dim=1) if channel is None else values[:, channel]


def _spread(residual: Tensor, scale: float) -> float:
    """Mean pseudo-Huber loss of the residuals that are known."""
    known = residual[torch.isfinite(residual)]
    return float((torch.sqrt(1.0 + (known / scale) ** 2) - 1.0).mean())


def _centred(values: Tensor) -> Tensor:
    """Without what changes all of the bed alike: an exposure that drifts."""
    return values - values.nanmedian()


def _middle(values: Tensor) -> float:
    """Standard deviation by the median of those that are known."""
    return 1.4826 * float(values[torch.isfinite(values)].abs().median())


def _enough(chosen: Tensor, values: Tensor) -> bool:
    """Whether enough of the chosen points (rows, columns) are known."""
    return _known(_without(~chosen, values)) >= _FEWEST_SHADED


def _known(values: Tensor) -> int:
    """How many places are known."""
    return int(torch.isfinite(values).all(dim=1).sum())


def _without(edge: Tensor, values: Tensor) -> Tensor:
    out = values.clone()
    out[edge.reshape(-1)] = math.nan
    return out


def _tells(passing: Passing) -> bool:
    """Whether enough is known of it."""
    return _known(passing.change) >= _FEWEST_SHADED
