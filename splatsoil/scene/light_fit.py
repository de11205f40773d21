"""The sun's direction and the sky's share by a robust fit to differences of log brightness.

Albedo varies slowly over the bed; shadows end, and slopes turn, within millimetres. So differences of log brightness
over a short distance depend on the illumination. The edge of the tool's shadow gives the sun's direction, brightness
within it the sky's share. Photographs blur that edge, which would look like more sky: for the share it is left out.

Where the tool's shadow moves over undisturbed soil, the change of brightness does not depend on albedo at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as functional
from scipy.optimize import minimize
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.scene.light import SOIL_REFLECTANCE, Light, towards
from splatsoil.scene.relief import Relief
from splatsoil.scene.shading import normals, sky_visibility_of, sun_cosines, sun_visibility_at
from splatsoil.splats.warp_torch import upload

Directions = Sequence[tuple[float, float]] | Sequence[FloatArray]
"""Azimuths and elevations, degrees."""

FINEST = 0.004
"""Smallest distance of compared points, m: about a pixel of the photographs the method was measured on."""

LAG = 3
"""Distance of compared cells: a shadow's edge is blurred over about two."""

_THINNED = 2
"""Every so many rows and columns of what changes elsewhere are enough: it is known of several moments and cameras."""

_TOOL_REFLECTANCE = 0.2
"""The tool's colour is not known yet; from black to bright metal this moves the sky's share by 0.01."""

_FEWEST_SHADED = 30
"""Cells in the tool's shadow, beside its edge, from which the sky's share can be told."""

_ELEVATIONS, _AZIMUTHS = np.arange(20.0, 81.0, 10.0), np.arange(-180.0, 180.0, 10.0)
_PLACES, _AROUND = 4, np.arange(-7.5, 7.6, 2.5)
"""Of the sun's directions tried, the best, and how far around them it is looked for more closely, degrees."""

_SHARES = np.arange(0.02, 0.981, 0.005)
"""Shares of the sky."""

_LEAST_CHANGE = 0.01
"""Changes of log brightness are not taken for better known than this."""


@dataclass(frozen=True)
class MovedShadow:
    """Brightness of undisturbed soil under the tool's shadow at another time, as one camera sees it.

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
    moved_shadows: Sequence[MovedShadow] = (),
) -> Light:
    """The illumination that explains the colours of a grid of points on a surface.

    Args:
        points: (rows · columns, 3) points of a regular grid in x and y, row by row, m.
        colours: (rows · columns, 3) linear colours; NaN where unknown.
        shape: rows and columns.
        relief: the surface.
        tool: the tool's pose in the kernels' form.
        blur: half width of a shadow's edge in the photographs, in rows and columns.
        moved_shadows: of the tool, at other times.
    """
    thin = torch.zeros(shape, dtype=torch.bool, device=points.device)
    thin[::_THINNED, ::_THINNED] = True
    thin = thin.reshape(-1)
    changes = [(p.tool, p.change[thin]) for p in moved_shadows if _known(p.change[thin]) >= _FEWEST_SHADED]
    problem = _Problem(_Bed(points, shape, relief, tool, thin), colours.clamp_min(1e-4).log(), changes)
    first = _start(problem)
    found = minimize(
        lambda v: problem.costs(None, [v[:2]], v[2:]).item(),
        first,
        method="Nelder-Mead",
        bounds=[(None, None), (5.0, 89.9), (_SHARES[0], _SHARES[-1])],
        options={
            "initial_simplex": first + np.array([[0, 0, 0], [6.0, 0, 0], [0, 5.0, 0], [0, 0, -0.1]]),
            "xatol": 0.02,
            "fatol": 1e-6,
            "maxfev": 250,
        },
    )
    at = (float(found.x[0]), float(found.x[1]))
    beside = problem.beside_edges(at, blur)
    ambient = [_SHARES[beside.costs(channel, [at], _SHARES)[0].argmin()] for channel in range(3)]
    level = torch.nanmedian(colours, dim=0).values.clamp_min(1e-3).cpu().numpy().astype(np.float64)
    return Light.from_angles(*at, np.array(ambient), level=level)


def _start(problem: _Problem) -> FloatArray:
    """Azimuth, elevation and the sky's share to search from: a narrow shadow is felt from a few degrees off at most."""
    tried, shares = [(azimuth, elevation) for elevation in _ELEVATIONS for azimuth in _AZIMUTHS], (0.4, 0.6, 0.8)
    costs = problem.costs(None, tried, shares)
    near = []
    for k in np.argsort(costs.min(axis=1), kind="stable")[:_PLACES]:
        share = shares[int(costs[k].argmin())]
        around = [(tried[k][0] + turn, tried[k][1] + rise) for turn in _AROUND for rise in _AROUND]
        near += [
            (cost, *at, share) for cost, at in zip(problem.costs(None, around, [share])[:, 0], around, strict=True)
        ]
    return np.array(min(near)[1:])


@dataclass(frozen=True)
class _Bed:
    """Points of a grid of rows and columns on a surface, the tool at rest, and the points ``thin`` (n,) among them."""

    points: Tensor
    shape: tuple[int, int]
    relief: Relief
    tool: object
    thin: Tensor

    def let_through(self, tool: object, directions: Directions, points: Tensor) -> Tensor:
        """(d, n) share of the sun that the tool, and soil that stands higher, let through to points."""
        suns = upload([towards(azimuth, elevation) for azimuth, elevation in directions], points.device)
        return sun_visibility_at(self.relief, tool, suns, points, 0.25 * FINEST)

    def edge(self, tool: object, at: tuple[float, float], width: int) -> tuple[Tensor, Tensor]:
        """(n,) points nearer to a shadow's edge than so many rows or columns, and those in full shadow."""
        sun = self.let_through(tool, [at], self.points).reshape(1, 1, *self.shape)
        highest, lowest = (functional.max_pool2d(sign * sun, 2 * width + 1, 1, width) for sign in (1.0, -1.0))
        return (highest + lowest > 0.02).reshape(-1), (sun < 0.02).reshape(-1)


class _LogIrradiance:
    """Log of the irradiance on points of a bed, 0 on level open ground, with the tool at one pose."""

    def __init__(self, bed: _Bed, tool: object, points: Tensor) -> None:
        self.bed, self.tool, self.points, self.normal = bed, tool, points, normals(bed.relief, points)
        maps = sky_visibility_of(bed.relief, tool)
        self.sky_visibility, hidden = (bed.relief.sample(share, points) for share in maps)
        # Soil and tool that hide the sky have half of level ground's irradiance.
        hiding = SOIL_REFLECTANCE * (1.0 - self.sky_visibility - hidden) + _TOOL_REFLECTANCE * hidden
        self.interreflection = 0.5 * hiding

    def of(self, directions: Directions, shares: Sequence[float] | FloatArray) -> Iterator[Tensor]:
        """(d, n) for suns from these directions, one share of the sky after the other."""
        suns = upload([towards(azimuth, elevation) for azimuth, elevation in directions], self.points.device)
        sun = sun_cosines(suns, self.normal) * self.bed.let_through(self.tool, directions, self.points)
        for share in shares:
            yield (share * self.sky_visibility + (1.0 - share) * sun + self.interreflection).clamp_min(1e-3).log()


class _Problem:
    """Robust fit of differences of log brightness: between places of a grid at rest, and between times."""

    def __init__(self, bed: _Bed, brightness: Tensor, changes: Sequence[tuple[object, Tensor]], lag: int = LAG) -> None:
        self.bed, self.brightness, self.changes, self.lag = bed, brightness, changes, lag
        self.still = _LogIrradiance(bed, bed.tool, bed.points)
        # Cameras that look at the same moment share its light.
        tools = {id(tool): tool for tool, _ in changes}
        self.later = {key: _LogIrradiance(bed, tool, bed.points[bed.thin].contiguous()) for key, tool in tools.items()}
        self.scale = _middle(self.differences(_channel(brightness, None)))
        self.scales = [max(_middle(_centred(_channel(change, None))), _LEAST_CHANGE) for _, change in changes]
        # A few places known of a moment must not weigh as much as all of the bed.
        self.weights = [_known(change) / len(change) for _, change in changes]

    def differences(self, values: Tensor) -> Tensor:
        """Differences (..., m) of values (..., n) over the lag along both axes of the grid."""
        grid, lag = values.reshape(*values.shape[:-1], *self.bed.shape), self.lag
        along_y, along_x = grid[..., lag:, :] - grid[..., :-lag, :], grid[..., lag:] - grid[..., :-lag]
        return torch.cat([along_y.flatten(-2), along_x.flatten(-2)], dim=-1)

    def beside_edges(self, at: tuple[float, float], blur: int) -> _Problem:
        """The same without shadows' edges, their blur taken off both sides, by differences that reach across.

        Where all shadows are too narrow for that, less is taken off; nothing where hardly any shadow is left then.
        """
        bed = self.bed
        for width in range(min(blur, (min(bed.shape) // 2 - LAG) // 2), 0, -1):
            edge, shaded = bed.edge(bed.tool, at, width)
            enough = _known(self.brightness[shaded & ~edge]) >= _FEWEST_SHADED
            changes = []
            for tool, change in self.changes:
                there, then = bed.edge(tool, at, width)
                clear = change.clone()
                clear[(edge | there)[bed.thin]] = math.nan
                enough |= _known(clear[(shaded ^ then)[bed.thin]]) >= _FEWEST_SHADED
                if _known(clear) >= _FEWEST_SHADED:
                    changes.append((tool, clear))
            brightness = self.brightness.clone()
            brightness[edge] = math.nan
            beside = _Problem(bed, brightness, changes, 2 * width + LAG)
            if enough and math.isfinite(beside.scale):
                return beside
        return self

    def costs(self, channel: int | None, directions: Directions, shares: Sequence[float] | FloatArray) -> FloatArray:
        """(d, s) loss of each of the directions with each of the sky's shares, in one colour or in grey."""
        seen = self.differences(_channel(self.brightness, channel))
        changes = [_channel(change, channel) for _, change in self.changes]
        lights = [self.still.of(directions, shares), *(later.of(directions, shares) for later in self.later.values())]
        columns = []
        for still, *others in zip(*lights, strict=True):
            later = dict(zip(self.later, others, strict=True))
            total = _spread(seen - self.differences(still), self.scale)
            for (tool, _), change, scale, weight in zip(self.changes, changes, self.scales, self.weights, strict=True):
                predicted = later[id(tool)] - still[:, self.bed.thin]
                total = total + weight * _spread(_centred(change - predicted), scale)
            columns.append(total)
        return torch.stack(columns, dim=1).cpu().numpy().astype(np.float64)


def _channel(values: Tensor, channel: int | None) -> Tensor:
    """One colour of (n, 3), or their mean."""
    return values.mean(dim=1) if channel is None else values[:, channel]


def _spread(residual: Tensor, scale: float) -> Tensor:
    """Mean pseudo-Huber loss along the last axis of the residuals that are known."""
    loss = torch.sqrt(1.0 + (residual / scale) ** 2) - 1.0
    return loss.nanmean(dim=-1)


def _centred(values: Tensor) -> Tensor:
    """Without what changes all of the bed alike: an exposure that drifts. Along the last axis."""
    return values - values.nanmedian(dim=-1, keepdim=True).values


def _middle(values: Tensor) -> float:
    """Standard deviation by the median of those that are known."""
    return 1.4826 * float(values.abs().nanmedian())


def _known(values: Tensor) -> int:
    """How many places (n, 3) are known."""
    return int(torch.isfinite(values).all(dim=1).sum())
