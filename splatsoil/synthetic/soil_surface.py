"""The soil's surface mesh from particles, for the path tracer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from splatsoil.arrays import FloatArray
from splatsoil.errors import SimulationError
from splatsoil.measurement import Bed
from splatsoil.synthetic.stage import Body

LEVEL = 0.5
"""The surface is where the blurred filling falls to this share of the bulk's: half, so that level soil ends where its
volume does. At 0.45 it would stand an eighth of a spacing higher, and there would seem to be more soil."""
BLUR = 1.0
"""Standard deviation of the blur, in particle spacings."""
CELLS = 2
"""Cells along a particle's spacing."""
NEIGHBOURS = 6
COLOUR_REACH = 0.5
"""Width of the weights by which particles lend their colour to the surface, in particle spacings."""


def soil_surface(
    particles: npt.NDArray[np.floating], colours: FloatArray, spacing: float, bed: Bed, *, sides: bool = False
) -> Body:
    """The soil's surface with the albedo of the particles beneath it.

    Particles are counted on a grid, the counts blurred by one particle spacing and cut at half of the bulk. The bed's
    walls and floor mirror the soil, so that its surface meets them as it would go on.

    Args:
        particles: (n, 3) positions in m.
        colours: (n, 3) albedo, linear.
        spacing: edge of the cube of soil that a particle stands for, m.
        bed: its box.
        sides: whether the soil's sides are seen, as behind glass; otherwise walls are taken to hide them.

    Raises:
        SimulationError: nothing is left of the soil, or its surface is nowhere.
    """
    points = np.asarray(particles, dtype=np.float64)
    plan = np.maximum(np.round(bed.extents[:2] / spacing * CELLS).astype(int), 1)
    cell = np.array([*(bed.extents[:2] / plan), spacing / CELLS])
    top = float(points[:, 2].max()) + (3.0 + BLUR) * spacing
    shape = (int(plan[0]), int(plan[1]), int(np.ceil((top - bed.lower[2]) / cell[2])))
    filling = _counts(points, bed.lower, cell, shape) * spacing**3 / float(np.prod(cell))
    filling = gaussian_filter(filling, BLUR * spacing / cell, mode=("reflect", "reflect", "nearest"), truncate=4.0)
    # One cell more below and to the sides: there the surface ends, or goes on into the walls and leaves no gap.
    filling = np.pad(filling, ((0, 0), (0, 0), (1, 0)), mode="edge")
    around = ((1, 1), (1, 1), (0, 0))
    filling = np.pad(filling, around) if sides else np.pad(filling, around, mode="edge")
    if not filling.min() < LEVEL < filling.max():
        raise SimulationError("the particles have no surface: there is no soil, or no space over it")
    vertices, faces, normals, _ = marching_cubes(filling, LEVEL, spacing=tuple(cell), gradient_direction="descent")
    vertices = vertices + bed.lower - 0.5 * cell
    distance, nearest = cKDTree(points).query(vertices, k=min(NEIGHBOURS, len(points)))
    distance, nearest = distance.reshape(len(vertices), -1), nearest.reshape(len(vertices), -1)
    relative = (distance**2 - distance[:, :1] ** 2) / (COLOUR_REACH * spacing) ** 2
    weight = np.exp(-0.5 * relative)
    weight /= weight.sum(axis=1, keepdims=True)
    return Body(
        points=vertices,
        faces=faces[:, ::-1].astype(np.int64),  # marching_cubes winds them the other way round than its normals
        normals=normals.astype(np.float64),
        colours=np.einsum("nk,nkc->nc", weight, colours[nearest]),
    )


def _counts(points: FloatArray, lower: FloatArray, cell: FloatArray, shape: tuple[int, int, int]) -> FloatArray:
    """Particles in each cell, each shared by the eight cells around it; what falls outside counts in the last cell."""
    place = (points - lower) / cell - 0.5
    base = np.floor(place).astype(int)
    share = place - base
    out = np.zeros(int(np.prod(shape)))
    most = np.array(shape) - 1
    for corner in np.ndindex(2, 2, 2):
        index = np.clip(base + corner, 0, most)
        weight = np.prod(np.where(np.array(corner) == 1, share, 1.0 - share), axis=1)
        out += np.bincount(np.ravel_multi_index(tuple(index.T), shape), weight, minlength=len(out))
    return out.reshape(shape)
