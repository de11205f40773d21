"""Geometry from photographs: the soil's surface by stereo, the walls around it, the level of the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from scipy.ndimage import binary_propagation, distance_transform_edt
from scipy.spatial import cKDTree
from torch.nn import functional

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement import BIN, HEAP, TRANSPARENT, Bed
from splatsoil.reconstruction.height_field import HeightField, around
from splatsoil.reconstruction.presets import Preset
from splatsoil.reconstruction.stereo import Matching, draw, shrunk, visibility
from splatsoil.reconstruction.views import Views
from splatsoil.splats import Gaussians

Report = Callable[[str, float], None]

RIM = 0.04  # width of what is taken to border the bed (a bin's wall), in square roots of the bed's area
# How many times better the soil's level must explain the surroundings than the bed's floor, to be their height.
LEVEL_GAIN = 1.5
CELLS = 4  # along each side of the bed, at least: a cubic spline needs them
ROWS = 16  # heights swept at once
NEIGHBOURS = 24  # Gaussians that a height is drawn from
DOUBTFUL = 3.0  # times the median standard deviation: at the bed's border, the height of something behind it


@dataclass(frozen=True)
class Geometry:
    """Geometry of the scene by stereo, before any Gaussian is trained.

    Attributes:
        surface: the soil's surface over the bed's box, with standard deviations.
        occluder: `surface` with a rim as high as the walls or the soil beside it, and far below everything beyond.
        ground: height of the level ground around the bed, metres.
        usable: (v, h, w) float32, 1 where a photograph shows no tool and may be used.
        rim: the rim's width, metres.
        wall: height of the walls' top, metres; minus infinity without walls.
    """

    surface: HeightField
    occluder: HeightField
    ground: float
    usable: torch.Tensor
    rim: float
    wall: float


def scale_of(bed: Bed) -> float:
    """The bed's size: square root of its area, metres."""
    return float(np.sqrt(np.prod(bed.upper[:2] - bed.lower[:2])))


def footprint(views: Views, bed: Bed) -> float:
    """Side of a pixel on the bed in the median view, metres."""
    centre = (bed.lower + bed.upper) / 2
    return float(np.median([np.linalg.norm(c.position - centre) / np.sqrt(c.fx * c.fy) for c in views.cameras]))


def find_geometry(
    views: Views, bed: Bed, tool_silhouettes: torch.Tensor, preset: Preset, report: Report, *, container: str = BIN
) -> Geometry:
    """Heights of the soil over the bed's box.

    Args:
        views: the photographs to use; the work is done where they are.
        bed: the box that holds the soil.
        tool_silhouettes: (v, h, w) 1 where the tool hides what is behind it.
        preset: how much work.
        report: called with what is being done and how much of it is done.
        container: what holds the soil, see `measurement.Bed`. Without walls, photographs show the ground behind its
            edge.

    Raises:
        MeasurementError: the photographs are too far away, or determine no height in half of the bed or more.
    """
    length, device = scale_of(bed), views.images.device
    bare = container in (TRANSPARENT, HEAP)
    cell = max(length / preset.cells**0.5, 1.2 * footprint(views, bed))
    usable = views.valid * (1.0 - tool_silhouettes.to(device))
    step = float(bed.upper[2] - bed.lower[2]) / (preset.candidates - 1)
    coarse = HeightField.over(bed.lower, bed.upper, 2.0 * cell)
    if min(coarse.height.shape) < CELLS:
        raise MeasurementError(
            f"in half of the photographs a pixel covers {1e3 * footprint(views, bed):.3g} mm, too much to see the bed's"
            " relief; take them from nearer, and see that their poses are in metres",
            field="views",
        )
    matching = Matching(views, coarse, usable, torch.ones(len(views), *coarse.height.shape, device=device), bare)
    report("sweeping the bed's height", 0.0)
    height = matching.sweep(np.linspace(bed.lower[2], bed.upper[2], preset.candidates), sigma=1.5)
    report("refining heights", 0.4)
    height, deviation = matching.refine(height, reach=step, length=length, sigma=1.0)
    height, _ = without_backdrop(height, deviation, length)

    fine = HeightField.over(bed.lower, bed.upper, cell)
    height = replace(coarse, height=height).smooth(fine.points[..., :2])
    rim = 0.0 if bare else RIM * length
    wall = wall_top(views, bed, usable) if container == BIN else -np.inf
    for last in (False, True):
        report("refining heights", 0.6 + 0.2 * last)
        now = replace(fine, height=height)
        seen = visibility(views, now.points.reshape(-1, 3), with_rim(now, bed, rim, wall), clearance=1.5 * cell)
        matching = Matching(views, fine, usable, seen.reshape(len(views), *height.shape), bare)
        height, deviation = matching.refine(height, reach=0.5 * step, length=length, iterations=6 if last else 3)
        height, deviation = without_backdrop(height, deviation, length)
    # Around a heap the floor is bare: what is less high than a cell is wide is not told from it.
    least = bed.lower[2] + (0.5 * cell if container == HEAP else 0.0)
    surface = replace(fine, height=np.where(height > least, height, bed.lower[2]), deviation=deviation)
    occluder = with_rim(surface, bed, rim, wall)
    return Geometry(surface, occluder, ground_level(views, bed, surface, occluder, rim), usable, rim, wall)


def wall_top(views: Views, bed: Bed, usable: torch.Tensor) -> float:
    """Height of the walls' top, metres, by a plane sweep (Collins 1996) along their inner edge.

    Photographs agree on the colour of a place that is on an opaque body, and mostly of one within a plain one, but not
    of one in the air (Kutulakos & Seitz 2000): the top is where their disagreement rises most. Without walls this is
    about the height of the ground there.

    Args:
        views: the photographs.
        bed: the box; its walls are equally high.
        usable: (v, h, w) 1 where a pixel may be used.
    """
    step = footprint(views, bed)
    edge, _ = around(bed.lower[:2] - step, bed.upper[:2] + step, 2.0 * step)
    top = max(float(views.positions[:, 2].min()), float(bed.upper[2])) + 2.0 * step
    heights = np.arange(float(bed.lower[2]), top, step)
    xy, z = (torch.tensor(a, dtype=torch.float32, device=views.images.device) for a in (edge, heights))
    places = functional.pad(xy.expand(len(z), -1, -1), (0, 2), value=1.0)
    places[..., 2] = z[:, None]
    swept = []
    for some in places.split(ROWS):
        colours, seen = draw(views, some, usable)
        count = seen.sum(dim=0)
        mean = (colours * seen[:, None]).sum(dim=0) / count.clamp_min(1.0)
        error = torch.log1p(((colours - mean) ** 2).sum(dim=1) / (27.0 * views.noise**2))
        swept.append(torch.stack([(seen * error).sum(dim=0), count]))
    total, count = torch.cat(swept, dim=1).cpu().numpy().astype(np.float64)
    return float(heights[int(np.argmax(np.diff(shrunk(total, count).mean(axis=1))))])


def without_backdrop(height: FloatArray, deviation: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Heights (ny, nx) in which doubtful cells that reach in from the border repeat their nearest sure neighbour.

    Photographs that look past a corner of the bed agree on the plain ground behind it at any height, so a corner may
    be drawn up to a spire. It is known several times worse than sand; inside the bed the curvature prior bridges what
    is, here nothing lies beyond.

    Args:
        height: (ny, nx) in m.
        deviation: (ny, nx) standard deviations in m.
        length: the bed's, m: the standard deviation of a height that was replaced.

    Returns:
        Heights and their standard deviations.
    """
    doubtful = ~(deviation <= DOUBTFUL * np.median(deviation))
    border = np.ones_like(doubtful)
    border[1:-1, 1:-1] = False
    reached = binary_propagation(border & doubtful, mask=doubtful)
    nearest = distance_transform_edt(reached, return_distances=False, return_indices=True)
    return height[tuple(nearest)], np.where(reached, length, deviation)


def with_rim(surface: HeightField, bed: Bed, rim: float, wall: float = -np.inf) -> HeightField:
    """The surface, a border of `rim` metres as high as the soil beside it, or as a wall's top at height `wall`, and far
    below everything beyond."""
    cell = min(surface.cell)
    margin = rim + 2.0 * cell
    outer = HeightField.over(bed.lower[:2] - margin, bed.upper[:2] + margin, cell)
    place = outer.points[..., :2]
    low = bed.lower[2] - 10.0 * scale_of(bed)
    beyond = bed.beyond(place)
    height = np.where(beyond > 0.0, np.maximum(surface.sample(place), wall), surface.sample(place))
    return replace(outer, height=np.where(beyond <= rim, height, low))


def ground_level(views: Views, bed: Bed, surface: HeightField, occluder: HeightField, rim: float) -> float:
    """Height of the surroundings: the bed's floor (a bin on the ground), or the soil's level (a bed in a field).

    The floor unless the photographs agree much better on what the soil's level beyond the rim looks like.
    """
    length = scale_of(bed)
    level = float(np.median(np.concatenate([surface.height[[0, -1]].ravel(), surface.height[:, [0, -1]].ravel()])))
    floor = float(bed.lower[2])
    outer = HeightField.over(bed.lower[:2] - 0.4 * length, bed.upper[:2] + 0.4 * length, length / 60.0)
    around = torch.from_numpy(bed.beyond(outer.points) > rim).to(views.images.device)
    misfit = []
    for z in (floor, level):
        plane = replace(outer, height=np.full_like(outer.height, z)).points.reshape(-1, 3)
        seen = visibility(views, plane, occluder, clearance=length / 200.0, steps=64)
        matching = Matching(views, outer, views.valid, seen.reshape(len(views), *around.shape) * around)
        error, weight = matching.disagreement(z, 1.0, levels=True)
        several = (weight.sum(0) >= 3).to(torch.float32)
        value = (several * weight * torch.log1p(error / (27.0 * views.noise**2))).sum()
        misfit.append(float(value / (several * weight).sum().clamp_min(1.0)))
    return level if misfit[0] > LEVEL_GAIN * misfit[1] else floor


def surface_through(soil: Gaussians, start: HeightField) -> HeightField:
    """The surface through trained Gaussians: a plane through the centres around each cell, weighted by opacity and
    nearness.

    The depth that a camera above would see is not used: it blends centres front to back, and on a slope those in front
    are the higher ones, which raises the surface by a good part of a Gaussian's radius times the slope.

    Args:
        soil: the Gaussians on the surface.
        start: cells; Gaussians that are far from its heights count little, and where there are none its heights stay.
    """
    place = soil.means.detach().cpu().numpy().astype(np.float64)
    cells = start.points.reshape(-1, 3)
    count = min(NEIGHBOURS, len(place))
    if count < 3:
        return start
    distance, index = cKDTree(place[:, :2]).query(cells[:, :2], k=count)
    size = max(start.cell)
    offset = place[index] - cells[:, None]
    weight = soil.opacities.detach().cpu().numpy().astype(np.float64)[index] * np.exp(-0.5 * (distance / size) ** 2)
    weight /= 1.0 + (offset[..., 2] / size) ** 2
    columns = np.stack([np.ones_like(distance), offset[..., 0] / size, offset[..., 1] / size], axis=-1)
    # A trace of "no slope" keeps cells at the border, whose neighbours may lie in a row, solvable.
    matrix = np.einsum("nk,nka,nkb->nab", weight, columns, columns) + np.diag([0.0, 1e-3, 1e-3])
    vector = np.einsum("nk,nka,nk->na", weight, columns, offset[..., 2])
    known = weight.sum(axis=1) > 0.1
    correction = np.zeros(len(cells))
    correction[known] = np.linalg.solve(matrix[known], vector[known][..., None])[:, 0, 0]
    return replace(start, height=start.height + correction.reshape(start.height.shape))


def soil_mesh(surface: HeightField, bed: Bed) -> trimesh.Trimesh:
    """The soil as a watertight solid: the surface on top, the box's sides and floor; metres, world frame.

    The top reaches the box's sides (the outermost heights are carried on over half a cell).
    """
    x = np.concatenate([[bed.lower[0]], surface.x, [bed.upper[0]]])
    y = np.concatenate([[bed.lower[1]], surface.y, [bed.upper[1]]])
    xs, ys = np.meshgrid(x, y)
    floor = float(bed.lower[2])
    thin = 1e-4 * scale_of(bed)
    top = np.maximum(surface.sample(np.stack([xs, ys], axis=-1)), floor + thin)
    ny, nx = xs.shape
    upper = np.stack([xs, ys, top], axis=-1).reshape(-1, 3)
    lower = np.stack([xs, ys, np.full_like(xs, floor)], axis=-1).reshape(-1, 3)
    index = np.arange(nx * ny).reshape(ny, nx)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    sheet = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    border = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    after = np.roll(border, -1)
    below = nx * ny
    sides = np.concatenate(
        [np.stack([border, border + below, after + below], 1), np.stack([border, after + below, after], 1)]
    )
    faces = np.concatenate([sheet, sheet[:, ::-1] + below, sides])
    return trimesh.Trimesh(np.concatenate([upper, lower]), faces, process=False)
