"""Initial Gaussians: discs on soil, tool and surroundings, coloured by the photographs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Bed
from splatsoil.reconstruction.height_field import HeightField, around
from splatsoil.reconstruction.stereo import colours_seen
from splatsoil.reconstruction.surface import Geometry, scale_of
from splatsoil.reconstruction.views import Views, surface_points
from splatsoil.splats import Gaussians

SURROUNDINGS, SOIL, TOOL, SIDE = 0, 1, 2, 3

FLATNESS = 0.15  # a disc's thickness over its radius
OVERLAP = 0.6  # a disc's standard deviation over the distance to the next disc
PIXELS = 8.0  # distance between the surroundings' first discs as the nearest view sees them
BEYOND = 0.8  # half of the span of these rays over the image's, more than 0.5: other cameras will look a little farther
FAR = 6.0  # beyond so many bed sizes the ground gives way to a sphere around everything


@dataclass(frozen=True)
class Seeds:
    """Discs before they are trained.

    Attributes:
        points: (n, 3) centres, metres.
        normals: (n, 3) unit.
        spacing: (n,) distance to the neighbours, metres.
        label: (n,) SURROUNDINGS, SOIL (its surface), TOOL or SIDE (of the soil).
    """

    points: FloatArray
    normals: FloatArray
    spacing: FloatArray
    label: NDArray[np.int8]

    @classmethod
    def of(cls, points: FloatArray, normals: FloatArray, spacing: float | FloatArray, label: int) -> Seeds:
        n = len(points)
        return cls(points, normals, np.broadcast_to(spacing, (n,)).astype(float), np.full(n, label, dtype=np.int8))

    @staticmethod
    def join(parts: list[Seeds]) -> Seeds:
        return Seeds(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Seeds)))


def seed_soil(surface: HeightField, bed: Bed, spacing: float) -> Seeds:
    """Discs on the surface, in rows `spacing` apart, every other row shifted by half of it."""
    width, depth = (bed.upper - bed.lower)[:2]
    columns, rows = max(1, round(width / spacing)), max(1, round(depth / spacing))
    x, y = np.meshgrid((np.arange(columns) + 0.25) / columns, (np.arange(rows) + 0.5) / rows)
    x[1::2] += 0.5 / columns
    xy = np.stack([bed.lower[0] + width * x.ravel(), bed.lower[1] + depth * y.ravel()], axis=1)
    normals = np.stack([replace(surface, height=n).sample(xy) for n in np.moveaxis(surface.normals, -1, 0)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Seeds.of(np.column_stack([xy, surface.smooth(xy)]), normals, spacing, SOIL)


def seed_tool(mesh: trimesh.Trimesh, spacing: float, most: int) -> Seeds:
    """Discs on a mesh in world coordinates, at most about `most` of them."""
    spacing = max(spacing, float(np.sqrt(mesh.area / most)))
    points, face = surface_points(mesh, 0.5 * spacing)
    # Both sides of a thin blade need their discs: thin out by facing, too.
    key = np.column_stack(
        [np.floor((points - mesh.bounds[0]) / spacing), np.sign(np.round(mesh.face_normals[face], 3))]
    )
    _, first = np.unique(key.astype(np.int64), axis=0, return_index=True)
    points, face = points[np.sort(first)], face[np.sort(first)]
    return Seeds.of(points, np.asarray(mesh.face_normals[face]), spacing, TOOL)


def seed_rim(geometry: Geometry, bed: Bed, spacing: float) -> Seeds:
    """Discs on a border around the bed: its top, as high as the walls or the soil beside it; its outer side, down to
    the ground; and the walls' inner sides, down to the soil."""
    parts = []
    lower, upper = bed.lower[:2], bed.upper[:2]
    for inset in np.arange(0.5 * spacing, geometry.rim, spacing):
        xy, _ = around(lower - inset, upper + inset, spacing)
        top = np.column_stack([xy, np.maximum(geometry.surface.sample(xy), geometry.wall)])
        parts.append(Seeds.of(top, np.tile([0.0, 0.0, 1.0], (len(top), 1)), spacing, SURROUNDINGS))
    xy, outward = around(lower - geometry.rim, upper + geometry.rim, spacing)
    top = np.maximum(geometry.surface.sample(xy), geometry.wall)
    parts.append(_upright(xy, outward, np.full(len(xy), geometry.ground), top, spacing, SURROUNDINGS))
    xy, outward = around(lower, upper, spacing)
    parts.append(
        _upright(xy, -outward, geometry.surface.sample(xy), np.full(len(xy), geometry.wall), spacing, SURROUNDINGS)
    )
    return Seeds.join(parts)


def seed_sides(geometry: Geometry, bed: Bed, spacing: float) -> Seeds:
    """Discs on the sides of the bed's box, from its floor to the soil's surface."""
    xy, outward = around(bed.lower[:2], bed.upper[:2], spacing)
    return _upright(xy, outward, np.full(len(xy), bed.lower[2]), geometry.surface.sample(xy), spacing, SIDE)


def _upright(
    xy: FloatArray, normals: FloatArray, low: FloatArray, high: FloatArray, spacing: float, label: int
) -> Seeds:
    """Discs on upright faces through points (n, 2) with normals (n, 3), from one height (n,) to another."""
    count = np.maximum(np.ceil((high - low) / spacing - 0.5), 0.0)
    level, which = np.nonzero(np.arange(count.max(initial=0.0))[:, None] < count)
    points = np.column_stack([xy[which], low[which] + (level + 0.5) * spacing])
    return Seeds.of(points, normals[which], spacing, label)


def seed_far(views: Views, bed: Bed, geometry: Geometry) -> Seeds:
    """Discs on the ground and, beyond it, on a sphere around everything, wherever the photographs look.

    Every so many pixels a ray is followed to the ground, or to the sphere when it misses or the ground is too far;
    where rays fall close together in angle as seen from their cameras, one disc is kept.
    """
    length = scale_of(bed)
    centre = np.array([*(bed.lower + bed.upper)[:2] / 2, geometry.ground])
    radius = FAR * max(length, float(np.linalg.norm(views.positions.cpu().numpy() - centre, axis=1).max()))
    points, normals, spacings = [], [], []
    for camera in views.cameras:
        columns = np.arange((0.5 - BEYOND) * camera.width, (0.5 + BEYOND) * camera.width, PIXELS)
        rows = np.arange((0.5 - BEYOND) * camera.height, (0.5 + BEYOND) * camera.height, PIXELS)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        origin, direction = camera.rays(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (geometry.ground - origin[:, 2]) / direction[:, 2]
        landed = origin + distance[:, None] * direction
        on_ground = np.isfinite(distance) & (distance > 0) & (np.linalg.norm(landed - centre, axis=1) < radius)
        offset = origin - centre
        along = (offset * direction).sum(1)
        to_sphere = -along + np.sqrt(np.maximum(along**2 - (offset**2).sum(1) + radius**2, 0.0))
        distance = np.where(on_ground, distance, to_sphere)
        hit = origin + distance[:, None] * direction
        points.append(hit)
        inward = (centre - hit) / radius
        normals.append(np.where(on_ground[:, None], [0.0, 0.0, 1.0], inward))
        slant = np.where(on_ground, np.maximum(-direction[:, 2], 0.2), 1.0)
        spacings.append(distance * PIXELS / np.sqrt(camera.fx * camera.fy) / slant**0.5)
    every, facing, spacing = np.concatenate(points), np.concatenate(normals), np.concatenate(spacings)
    kept = _thinned(every, spacing, bed.beyond(every) > geometry.rim)
    return Seeds.of(every[kept], facing[kept], spacing[kept], SURROUNDINGS)


def _thinned(points: FloatArray, spacing: FloatArray, allowed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Indices of points no closer together than about their spacing: one per cell of grids whose size doubles."""
    level = np.floor(np.log2(spacing / spacing[allowed].min())).astype(np.int64)
    kept = []
    for k in np.unique(level[allowed]):
        here = np.flatnonzero(allowed & (level == k))
        size = spacing[allowed].min() * 2.0**k * 1.4
        _, first = np.unique(np.floor(points[here] / size).astype(np.int64), axis=0, return_index=True)
        kept.append(here[np.sort(first)])
    # A coarse disc where finer ones lie already would only blur them.
    result = kept[:1]
    for group in kept[1:]:
        distance, _ = cKDTree(points[np.concatenate(result)]).query(points[group])
        result.append(group[distance > 0.8 * spacing[group]])
    return np.concatenate(result)


def disc_colours(views: Views, geometry: Geometry, seeds: Seeds, *, batch: int = 8192) -> FloatArray:
    """(n, 3) median colour of each disc over the photographs that see it.

    Discs that none sees get the colour of the nearest one that is seen.
    """
    colour = np.full((len(seeds.points), 3), np.nan)
    cell = max(geometry.occluder.cell)
    tool = seeds.label == TOOL
    for usable, kind in ((geometry.usable, np.flatnonzero(~tool)), (views.valid, np.flatnonzero(tool))):
        for start in range(0, len(kind), batch):
            part = kind[start : start + batch]
            disc = seeds.points[part], seeds.normals[part]
            colour[part] = colours_seen(views, disc, usable, geometry.occluder, 1.5 * cell, 0.5 * cell)
    blind = np.isnan(colour).any(axis=1)
    if blind.all():
        colour[:] = 0.5
    elif blind.any():
        _, nearest = cKDTree(seeds.points[~blind]).query(seeds.points[blind])
        colour[blind] = colour[~blind][nearest]
    return colour


def discs(seeds: Seeds, colours: FloatArray, opacity: float) -> Gaussians:
    """Flat Gaussians whose shortest axis is the seed's normal."""
    normal = seeds.normals / np.linalg.norm(seeds.normals, axis=1, keepdims=True)
    # The rotation that takes z to the normal; for a normal of −z, half a turn about x.
    quaternion = np.column_stack([1.0 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(len(normal))])
    quaternion[normal[:, 2] < -0.999999] = [0.0, 1.0, 0.0, 0.0]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    scales = (OVERLAP * seeds.spacing)[:, None] * np.array([1.0, 1.0, FLATNESS])
    means, spread, turn, shade = (
        torch.tensor(a, dtype=torch.float32) for a in (seeds.points, scales, quaternion, colours)
    )
    return Gaussians(means, spread, turn, torch.full((len(normal),), opacity), shade)


def first_gaussians(
    views: Views, bed: Bed, tool: trimesh.Trimesh, geometry: Geometry, spacing: float, *, sides: bool = False
) -> tuple[Gaussians, torch.Tensor]:
    """All Gaussians before training, and their labels (n,) int8.

    Args:
        views: the photographs to train on.
        bed: the box that holds the soil.
        tool: mesh in world coordinates.
        geometry: what stereo found.
        spacing: distance between the soil's discs, metres.
        sides: whether the soil's sides are seen.
    """
    parts = [
        seed_soil(geometry.surface, bed, spacing),
        seed_tool(tool, spacing, most=3000),
        seed_sides(geometry, bed, spacing) if sides else seed_rim(geometry, bed, 1.3 * spacing),
        seed_far(views, bed, geometry),
    ]
    seeds = Seeds.join(parts)
    return discs(seeds, disc_colours(views, geometry, seeds), 0.8), torch.from_numpy(seeds.label)
