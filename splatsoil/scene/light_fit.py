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
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as functional
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from splatsoil.scene.light import SOIL_REFLECTANCE, Light, towards
from splatsoil.scene.lit import facing, normals, open_sky, suns_on_points
from splatsoil.scene.relief import Relief
from splatsoil.splats.steps import finished
from splatsoil.splats.warp_torch import upload

FloatArray = npt.NDArray[np.float64]
Directions = Sequence[tuple[float, float]]
"""Azimuths and elevations, degrees."""

FINEST = 0.004
"""Smallest distance of compared points, m: about a pixel of the photographs the method was measured on."""

LAG = 3
"""Distance of compared cells: a shadow's edge is blurred over about two."""

_TOOL_REFLECTANCE = 0.2
"""The tool's colour is not known yet; from black to bright metal this moves the sky's share by 0.01."""

_FEWEST_SHADED = 30
"""Cells in the tool's shadow, beside its edge, from which the sky's share can be told."""

_ELEVATIONS, _AZIMUTHS = np.arange(20.0, 81.0, 10.0), np.arange(-180.0, 180.0, 10.0)
_SHARES = (0.4, 0.6, 0.8)
_PLACES, _AROUND = 4, (-7.5, -5.0, -2.5, 0.0, 2.5, 5.0, 7.5)
"""Of the sun's directions tried, the best, and how far around them it is looked for more closely, degrees."""

_THINNED = 2
"""Every so many rows and columns of what changed elsewhere are enough to find where to search."""

_AT_ONCE = 1 << 20
"""Numbers that are worked out together for many directions."""

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
        shadowed: share of the bed's area that lies in the shadow of the tool, and of soil that stands higher.
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
    lights = {key: _Sunlit.of(points, relief, there) for key, there in tools.items()}
    parts = [_Passed.of(lights[id(p.tool)], p.change) for p in telling]
    problem = _Problem(_Sunlit.of(points, relief, tool), colours.clamp_min(1e-4).log(), shape, parts)
    first = _start(problem.thinned())
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
    shadowed = float(1.0 - problem.still.let_through([(azimuth, elevation)]).mean())
    return LightEstimate(light, 1.0 - float(found.fun) / max(problem.nothing(), 1e-12), shadowed)


def _start(problem: _Problem) -> FloatArray:
    """Azimuth, elevation and the sky's share to search from: a narrow shadow is felt from a few degrees off at most."""
    tried = [(azimuth, elevation) for elevation in _ELEVATIONS for azimuth in _AZIMUTHS]
    costs = problem.costs(None, tried, _SHARES)
    best = np.argsort(costs.min(axis=1), kind="stable")[:_PLACES]
    near = []
    for k in best:
        (azimuth, elevation), share = tried[k], _SHARES[int(costs[k].argmin())]
        around = [(azimuth + turn, elevation + rise) for turn in _AROUND for rise in _AROUND]
        costs_there = problem.costs(None, around, [share])[:, 0]
        near += [(cost, *at, share) for cost, at in zip(costs_there, around, strict=True)]
    return np.array(min(near)[1:])


@dataclass(frozen=True)
class _Sunlit:
    """Light on points of a surface with the tool at one place.

    Attributes:
        points: (n, 3), m.
        relief: the surface.
        tool: its pose in the kernels' form.
        normal: (n, 3) of the surface.
        openness: (n,) share of the sky that a point sees.
        returned: (n,) what soil and tool in the sky's way send back: half of level ground's light.
    """

    points: Tensor
    relief: Relief
    tool: object
    normal: Tensor
    openness: Tensor
    returned: Tensor

    @classmethod
    def of(cls, points: Tensor, relief: Relief, tool: object) -> _Sunlit:
        rough, _, *shares = finished(open_sky(relief, tool))
        openness, hidden = (rough.sample(share, points) for share in shares)
        returned = 0.5 * (SOIL_REFLECTANCE * (1.0 - openness - hidden) + _TOOL_REFLECTANCE * hidden)
        return cls(points, relief, tool, normals(relief, points), openness, returned)

    def at(self, chosen: Tensor) -> _Sunlit:
        """On some of the points (k,)."""
        points, normal, openness, returned = (
            values[chosen].contiguous() for values in (self.points, self.normal, self.openness, self.returned)
        )
        return replace(self, points=points, normal=normal, openness=openness, returned=returned)

    def suns(self, directions: Directions) -> Tensor:
        """(d, n) the sun on the points from directions, 1 on level open ground."""
        return facing(self._towards(directions), self.normal) * self.let_through(directions)

    def log_light(self, suns: Tensor, ambient: float) -> Tensor:
        """(d, n) log of the light of suns (d, n) and a sky, 0 on level open ground."""
        return (ambient * self.openness + (1.0 - ambient) * suns + self.returned).clamp_min(1e-3).log()

    def let_through(self, directions: Directions) -> Tensor:
        """(d, n) share of the sun that the tool, and soil that stands higher, let through to each point."""
        suns = self._towards(directions)
        return suns_on_points(self.relief, self.tool, suns, self.points, 0.25 * FINEST)

    def edge(self, at: tuple[float, float], width: int, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """(rows, columns) points nearer to a shadow's edge than so many rows or columns, and those in full shadow."""
        sun = self.let_through([at]).reshape(1, 1, *shape)
        highest, lowest = (functional.max_pool2d(sign * sun, 2 * width + 1, 1, width) for sign in (1.0, -1.0))
        return (highest + lowest > 0.02)[0, 0], (sun < 0.02)[0, 0]

    def _towards(self, directions: Directions) -> Tensor:
        """(d, 3) unit vectors."""
        where = [towards(azimuth, elevation) for azimuth, elevation in directions]
        return upload(where, self.points.device)


@dataclass(frozen=True)
class _Passed:
    """A `Passing` and its light.

    Attributes:
        sunlit: on all points of the grid.
        change: (n, 3) of them.
        known: (k,) the points of which it is known.
        there: the light on these.
    """

    sunlit: _Sunlit
    change: Tensor
    known: Tensor
    there: _Sunlit

    @classmethod
    def of(cls, sunlit: _Sunlit, change: Tensor) -> _Passed:
        known = torch.isfinite(change).all(dim=1).nonzero()[:, 0]
        return cls(sunlit, change, known, sunlit.at(known))

    def without(self, places: Tensor) -> _Passed:
        """With nothing known of places (rows, columns)."""
        return _Passed.of(self.sunlit, _without(places, self.change))

    def seen(self, channel: int | None) -> Tensor:
        """(k,) change of one colour, or of all, where it is known."""
        return _channel(self.change[self.known], channel)


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
        self.scales = [max(_middle(_centred(p.seen(None))), _LEAST_CHANGE) for p in passed]
        # A few places known of a moment must not weigh as much as all of the bed.
        self.shares = [len(p.known) / len(p.change) for p in passed]
        self._lately: tuple[Directions, list[Tensor]] | None = None

    def thinned(self) -> _Problem:
        """The same with what changed elsewhere at fewer places, each of which weighs more."""
        dropped = torch.ones(self.shape, dtype=torch.bool, device=self.brightness.device)
        dropped[::_THINNED, ::_THINNED] = False
        fewer = [part.without(dropped) for part in self.passed]
        kept = [few if len(few.known) >= _FEWEST_SHADED else part for few, part in zip(fewer, self.passed, strict=True)]
        thin = _Problem(self.still, self.brightness, self.shape, kept, self.lag)
        thin.scales, thin.shares = self.scales, self.shares
        return thin

    def differences(self, values: Tensor) -> Tensor:
        """Differences (..., m) of values (..., n) over the lag along both axes of the grid."""
        grid, lag = values.reshape(*values.shape[:-1], *self.shape), self.lag
        along_y = grid[..., lag:, :] - grid[..., :-lag, :]
        along_x = grid[..., lag:] - grid[..., :-lag]
        return torch.cat([along_y.flatten(-2), along_x.flatten(-2)], dim=-1)

    def beside_edges(self, azimuth: float, elevation: float, blur: int) -> _Problem:
        """The same without shadows' edges, their blur taken off both sides, by differences that reach across.

        Where all shadows are too narrow for that, less is taken off; nothing where hardly any shadow is left then.
        """
        widest, at = min(blur, (min(self.shape) // 2 - LAG) // 2), (azimuth, elevation)
        for width in range(widest, 0, -1):
            edge, shaded = self.still.edge(at, width, self.shape)
            enough = _enough(shaded & ~edge, self.brightness)
            passed = []
            for part in self.passed:
                there, then = part.sunlit.edge(at, width, self.shape)
                enough |= _enough((shaded ^ then) & ~(edge | there), part.change)
                beside = part.without(edge | there)
                if len(beside.known) >= _FEWEST_SHADED:
                    passed.append(beside)
            clear = _Problem(self.still, _without(edge, self.brightness), self.shape, passed, 2 * width + LAG)
            if enough and math.isfinite(clear.scale):
                return clear
        return self

    def cost(self, channel: int | None, azimuth: float, elevation: float, ambient: float) -> float:
        """Loss of a light in one colour or in grey; the sky's share is held between 0 and 1, the sun above the
        horizon."""
        if not 5.0 <= elevation <= 89.9 or not 0.02 <= ambient <= 0.98:
            return 1e3
        return float(self.costs(channel, [(azimuth, elevation)], [ambient])[0, 0])

    def costs(self, channel: int | None, directions: Directions, shares: Sequence[float]) -> FloatArray:
        """(d, s) loss of each of the directions with each of the sky's shares."""
        still = self.differences(_channel(self.brightness, channel))
        changes = [part.seen(channel) for part in self.passed]
        chunk = max(1, _AT_ONCE // len(self.brightness))
        out = []
        for start in range(0, len(directions), chunk):
            suns, *others = self._suns(directions[start : start + chunk])
            columns = []
            for share in shares:
                rest = self.still.log_light(suns, share)
                total = _spread(still - self.differences(rest), self.scale)
                for k, part in enumerate(self.passed):
                    predicted = part.there.log_light(others[k], share) - rest[:, part.known]
                    total = total + self.shares[k] * _spread(_centred(changes[k] - predicted), self.scales[k])
                columns.append(total)
            out.append(torch.stack(columns, dim=1))
        return torch.cat(out).cpu().numpy().astype(np.float64)

    def nothing(self) -> float:
        """Loss of a light that is the same everywhere."""
        total = _spread(self.differences(_channel(self.brightness, None)), self.scale)
        for part, scale, share in zip(self.passed, self.scales, self.shares, strict=True):
            total = total + share * _spread(_centred(part.seen(None)), scale)
        return float(total)

    def _suns(self, directions: Directions) -> list[Tensor]:
        """The sun on the bed at rest, and on what is known of each part; the last ones are kept."""
        if self._lately is None or self._lately[0] != directions:
            lit = [self.still, *(part.there for part in self.passed)]
            self._lately = (list(directions), [where.suns(directions) for where in lit])
        return self._lately[1]


def _channel(values: Tensor, channel: int | None) -> Tensor:
    """One colour of (n, 3), or their mean."""
    return values.mean(dim=1) if channel is None else values[:, channel]


def _spread(residual: Tensor, scale: float) -> Tensor:
    """Mean pseudo-Huber loss along the last axis of the residuals that are known."""
    loss = torch.sqrt(1.0 + (residual / scale) ** 2) - 1.0
    return loss.nanmean(dim=-1)


def _centred(values: Tensor) -> Tensor:
    """Without what changes all of the bed alike: an exposure that drifts. Along the last axis."""
    return values - values.median(dim=-1, keepdim=True).values


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
