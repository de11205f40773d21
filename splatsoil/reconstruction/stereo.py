"""Multi-view stereo on a height field.

Soil seen from above is a height field, so the search in each cell is one-dimensional. Each photograph is projected onto
a candidate surface. The projections are compared there in small windows, each less its local mean, as exposures and
vignetting differ. Photographs that do not show a cell (outside of the image, behind the tool, a wall or a ridge) are
left out; robust weights reduce the effect of other outliers.

Two stages: a sweep over the whole height range, solved together with a smoothness term by alternation (quadratic
relaxation, as in DTAM, Newcombe et al., ICCV 2011); then Gauss-Newton on the same cost with a thin-plate prior, whose
strength is the curvature that a loose material's surface may have. The curvature of the cost gives each height its
standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu
from torch.nn import functional

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.views import Views

# Standard deviation of the surface's curvature (1/m times the bed's length in m): a heap with a radius of a tenth of
# the bed is not unusual, sharper edges are held by the data.
CURVATURE = 8.0
SLOPE = 0.5  # and of its slope, that of a pile at rest
FEWEST_VIEWS = 3.0


def _window(sigma: float) -> torch.Tensor:
    reach = int(np.ceil(2.5 * sigma))
    offset = torch.arange(-reach, reach + 1, dtype=torch.float32)
    weights = torch.exp(-0.5 * (offset / sigma) ** 2)
    return weights / weights.sum()


def _blur(values: torch.Tensor, window: torch.Tensor) -> torch.Tensor:
    """Separable convolution of the last two axes, zero beyond the border."""
    shape, window = values.shape, window.to(values.device)
    reach = len(window) // 2
    flat = values.reshape(-1, 1, shape[-2], shape[-1])
    flat = functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, reach))
    flat = functional.conv2d(flat, window.view(1, 1, -1, 1), padding=(reach, 0))
    return flat.reshape(shape)


def draw(views: Views, points: torch.Tensor, usable: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The photographs as seen at points: colours (v, 3, ny, nx) and whether each is to be trusted (v, ny, nx) in {0,
    1}.

    Args:
        views: the photographs.
        points: (ny, nx, 4) homogeneous world points.
        usable: (v, h, w) 1 where a pixel may be used.
    """
    pixels = torch.einsum("vij,yxj->vyxi", views.projection, points)
    depth = pixels[..., 2]
    flat = pixels[..., :2] / depth[..., None].clamp_min(1e-6)
    height, width = views.images.shape[-2:]
    grid = torch.stack([flat[..., 0] * (2.0 / width) - 1.0, flat[..., 1] * (2.0 / height) - 1.0], dim=-1)
    grid = grid.clamp(-4.0, 4.0)
    # one by one: to put them together would take as long as to draw them
    drawn, sure = (
        functional.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        for maps in (views.images, usable[:, None])
    )
    return drawn, ((sure[:, 0] > 0.999) & (depth > 0)).to(torch.float32)


@dataclass(frozen=True)
class Matching:
    """Photographs compared with each other on candidate surfaces.

    Attributes:
        views: the photographs.
        grid: the cells whose heights are sought; its own heights do not count.
        usable: (v, h, w) 1 where a pixel may be used.
        weight: (v, ny, nx) what each photograph counts at each cell.
        normalised: whether differences are divided by what the two vary by, as in normalised cross-correlation: plain
            ground then agrees with nothing, where else it agrees with itself at any height.
    """

    views: Views
    grid: HeightField
    usable: torch.Tensor
    weight: torch.Tensor
    normalised: bool = False

    def disagreement(
        self, height: FloatArray | float, sigma: float, *, levels: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """How much each photograph differs from the others' mean around each cell.

        Args:
            height: (ny, nx) candidate surface, or one level, metres.
            sigma: the window's standard deviation in cells.
            levels: whether mean colours count, too.

        Returns:
            (v, ny, nx) windowed mean square difference summed over the channels, and (v, ny, nx) the weights that
            remain (0 where a photograph does not show the cell).
        """
        surface = replace(self.grid, height=np.broadcast_to(height, self.grid.height.shape)).points
        points = torch.tensor(surface, dtype=torch.float32, device=self.weight.device)
        colours, seen = draw(self.views, functional.pad(points, (0, 1), value=1.0), self.usable)
        weight = (self.weight * seen)[:, None]
        near, wide = _window(sigma), _window(max(2.0 * sigma, 4.0))
        if not levels:
            colours = colours - _blur(colours * weight, wide) / _blur(weight, wide).clamp_min(1e-6)
        mean = (colours * weight).sum(0) / weight.sum(0).clamp_min(1e-6)
        square = ((colours - mean) ** 2).sum(1, keepdim=True)
        error = _blur(square * weight, near) / _blur(weight, near).clamp_min(1e-6)
        if self.normalised:
            both = (colours**2 + mean**2).sum(1, keepdim=True)
            error = error / (_blur(both * weight, near) / _blur(weight, near).clamp_min(1e-6)).clamp_min(1e-6)
        return error[:, 0], weight[:, 0]

    def sweep(self, heights: FloatArray, *, sigma: float) -> FloatArray:
        """(ny, nx) the best of evenly spaced heights (k,) in each cell under a smoothness term; good to about a step.

        ``sigma`` is the window's standard deviation in cells.
        """
        scale = (3.0 * self.views.noise) ** 2 * 3.0
        costs, counts = [], []
        for z in heights:
            error, left = self.disagreement(z, sigma)
            # What is normalised is bounded, and needs no robust form.
            costs.append((left * (error if self.normalised else torch.log1p(error / scale))).sum(0))
            counts.append(left.sum(0))
        total, count = (torch.stack(parts).cpu().numpy().astype(float) for parts in (costs, counts))
        cost = shrunk(total, count)
        step = float(heights[1] - heights[0])
        smoothness = Smoothness(self.grid.height.shape)
        depth = np.maximum(np.median(cost, axis=0) - cost.min(axis=0), 0.0)
        trusted = depth**2
        trusted /= max(float(trusted.mean()), 1e-12)
        height = heights[cost.argmin(axis=0)]
        typical = max(float(np.median(depth)), 1e-6)
        for width in (24.0, 12.0, 6.0, 3.0, 1.5):
            # A plate of stiffness s bends over about s^(1/4) cells.
            flat = smoothness.plate(trusted, height, (0.7 * width) ** 4 / 4.0, 0.0)
            coupled = cost + typical * ((heights[:, None, None] - flat) / (width * step)) ** 2
            height = heights[coupled.argmin(axis=0)]
        return smoothness.plate(trusted, height, 1.0, 0.0)

    def refine(
        self, height: FloatArray, *, reach: float, length: float, iterations: int = 8, sigma: float = 1.5
    ) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton from a good start.

        Args:
            height: (ny, nx) start, metres.
            reach: distance of the first trial heights above and below, metres; it shrinks to a third.
            length: the bed's longest side, metres, which scales the curvature prior.
            iterations: how many steps.
            sigma: the last window's standard deviation in cells; the first is twice as wide.

        Returns:
            (ny, nx) heights and (ny, nx) their standard deviations, metres.

        Raises:
            MeasurementError: the photographs tell no height in half of the cells or more.
        """
        smoothness, cell = Smoothness(height.shape), max(self.grid.cell)
        prior = 1.0 / (CURVATURE / length * cell**2) ** 2
        tension = 1.0 / (SLOPE * cell) ** 2
        current = np.array(height, dtype=np.float64)
        information = np.zeros_like(current)
        for k in range(iterations):
            progress = k / max(iterations - 1, 1)
            delta = reach * (1.0 / 3.0) ** progress
            width = sigma * 2.0 ** (1.0 - progress)
            trials = [self.disagreement(current + offset, width) for offset in (-delta, 0.0, delta)]
            error, left = trials[1]
            known = torch.where(left > 0, error, torch.nan)
            middle = torch.nan_to_num(torch.nanmedian(known, dim=0).values, nan=0.0)
            typical = float(middle.median())
            variance = typical if self.normalised else max(typical, (self.views.noise**2) * 3.0 / 4.0)
            spread = middle.clamp_min(variance)
            robust = left / (1.0 + error / (4.0 * spread)) ** 2
            below, here, above = [((robust * e).sum(0) / spread).cpu().numpy().astype(np.float64) for e, _ in trials]
            # Half the sum of squares over the variance per channel is the negative log-likelihood.
            slope = 3.0 * (above - below) / (4.0 * delta)
            information = np.maximum(3.0 * (above - 2.0 * here + below) / (2.0 * delta**2), 0.0)
            floor = 1e-3 * float(np.median(information))
            if not floor > 0.0:
                # Where a height means nothing to the photographs, its misfit curves upwards or downwards by chance.
                raise MeasurementError(
                    "the photographs do not tell the height of half of the bed: several must show each place of it,"
                    " sharply and from different directions; are they taken of it, and their poses right?",
                    field="views",
                )
            damped = information + floor
            move = np.clip(-slope / damped, -2.0 * delta, 2.0 * delta)
            current = smoothness.plate(damped, current + move, prior, tension)
        # The inverse's diagonal is dear; for a uniform weight w and stiffness s it is 1/(8 √(w s)), at most 1/w.
        certain = np.maximum(information, 1e-12)
        return current, np.minimum(np.minimum((64.0 * certain * prior) ** -0.25, certain**-0.5), length)


class Smoothness:
    """Sparse energies of heights on a grid (ny, nx), as matrices over its cells.

    Attributes:
        bending: Σ h_xx² + 2 h_xy² + h_yy², second differences between cells.
        tension: Σ h_x² + h_y², first differences.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        def along(y: list[float], x: list[float]) -> sparse.csr_array:
            """These differences along y of these along x."""
            parts = (
                sparse.diags_array(row, offsets=range(len(row)), shape=(n + 1 - len(row), n))
                for row, n in zip((y, x), shape, strict=True)
            )
            return sparse.kron(*parts, "csr")

        same, first, second = [1.0], [-1.0, 1.0], [1.0, -2.0, 1.0]
        x, y, xy = along(same, first), along(first, same), along(first, first)
        xx, yy = along(same, second), along(second, same)
        self.bending = xx.T @ xx + yy.T @ yy + 2.0 * (xy.T @ xy)
        self.tension = x.T @ x + y.T @ y

    def plate(self, weight: FloatArray, target: FloatArray, stiffness: float, tension: float) -> FloatArray:
        """argmin Σ weight (h − target)² + stiffness · bending(h) + tension · tension(h), heights (ny, nx)."""
        diagonal = weight.ravel() + 1e-9 * float(weight.mean())
        energy = stiffness * self.bending + tension * self.tension
        system = sparse.csc_matrix(sparse.diags_array(diagonal) + energy)
        return splu(system, permc_spec="MMD_AT_PLUS_A").solve(diagonal * target.ravel()).reshape(target.shape)


def shrunk(total: FloatArray, count: FloatArray) -> FloatArray:
    """Mean disagreement (…) of sums (…) over so many photographs (…), shrunk towards the usual one, as two agree by
    chance more easily than twenty."""
    usual = total.sum() / max(count.sum(), 1.0)
    return (total + FEWEST_VIEWS * usual) / (count + FEWEST_VIEWS)


def colours_seen(
    views: Views,
    discs: tuple[FloatArray, FloatArray],
    usable: torch.Tensor,
    occluder: HeightField,
    lift: float,
    clearance: float,
) -> FloatArray:
    """(n, 3) median colour of discs over the photographs that see their fronts; NaN where none does.

    Args:
        views: the photographs.
        discs: (n, 3) centres and (n, 3) normals, metres.
        usable: (v, h, w) 1 where a pixel may be used.
        occluder: what may hide discs.
        lift: how far along its normal a disc is looked for: the occluder is as coarse as its cells, metres.
        clearance: see `visibility`.
    """
    points, normals = (torch.tensor(a, dtype=torch.float32, device=views.images.device) for a in discs)
    drawn, sure = draw(views, functional.pad(points, (0, 1), value=1.0)[None], usable)
    facing = ((views.positions[:, None] - points) * normals).sum(-1) > 0
    weight = sure[:, 0] * facing * visibility(views, discs[0] + lift * discs[1], occluder, clearance=clearance)
    known = torch.where((weight > 0)[:, None], drawn[:, :, 0], torch.nan)
    return known.nanmedian(dim=0).values.T.cpu().numpy().astype(np.float64)


def visibility(
    views: Views, points: FloatArray, surface: HeightField, *, clearance: float, steps: int = 32
) -> torch.Tensor:
    """(v, n) float32, 1 where a point is not hidden from a camera by a height field, by marching along the ray.

    Args:
        views: the cameras.
        points: (n, 3) world points, metres.
        surface: what may hide them.
        clearance: how far above the ray the surface must rise to count, metres.
        steps: samples between the point and where its ray leaves the surface's highest level.
    """
    top, device = float(np.nanmax(surface.height)) + clearance, views.positions.device
    grid = torch.tensor(np.nan_to_num(surface.height, nan=-1e9), dtype=torch.float32, device=device)[None, None]
    low = np.array([surface.x[0], surface.y[0]]) - np.array(surface.cell) / 2
    high = np.array([surface.x[-1], surface.y[-1]]) + np.array(surface.cell) / 2
    start = torch.tensor(points, dtype=torch.float32, device=device)
    fraction = ((torch.arange(steps, device=device) + 0.5) / steps) ** 1.5
    result = torch.ones(len(views), len(points), device=device)
    for k in range(len(views)):
        direction = views.positions[k] - start
        rise = direction[:, 2].clamp_min(1e-6)
        along = ((top - start[:, 2]) / rise).clamp(0.0, 1.0)
        ray = start[:, None] + (fraction[None, :, None] * along[:, None, None]) * direction[:, None]
        where = torch.stack(
            [(ray[..., a] - float(low[a])) * (2.0 / float(high[a] - low[a])) - 1.0 for a in (0, 1)], dim=-1
        )
        level = functional.grid_sample(grid, where[None], mode="bilinear", padding_mode="border", align_corners=False)
        outside = (where.abs() > 1.0).any(-1)
        hidden = ((level[0, 0] - ray[..., 2] > clearance) & ~outside).any(-1)
        result[k] = (~hidden).to(torch.float32)
    return result
