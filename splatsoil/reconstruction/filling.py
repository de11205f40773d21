"""Particles between the floor and the surface, in columns of equal particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.measurement import Bed
from splatsoil.mpm.grid import nearest
from splatsoil.reconstruction.height_field import HeightField, centres

_SAMPLES = 4  # heights sampled along each side of a column


def fill(surface: HeightField, bed: Bed, spacing: float, seed: int = 0, jitter: float = 0.5) -> FloatArray:
    """Particles that fill the bed from its floor to the surface, each standing for `spacing`³ of soil.

    Where nothing stands at the bed's sides, its whole `Bed.domain` is filled, the surface's border carried on.

    The bed is cut into square columns about `spacing` wide. A column of height H holds the whole number of particles
    nearest to its volume, and the rounding errors are carried on from column to column, so that the sum is right to
    within one particle. They are spread evenly over H: the top layer lies half a particle below the surface everywhere,
    with no steps and no bias, at the price of a density that differs by up to half a particle per column.

    Args:
        surface: the soil's surface.
        bed: its box; columns stand on lower[2].
        spacing: edge of the cube that a particle stands for, metres.
        seed: of the jitter and of the rounding's start.
        jitter: 0 for a regular lattice, 1 for anywhere in the particle's own share of its column.

    Returns:
        (n, 3) float64 positions, metres, strictly inside the box's sides and floor and below the surface; column by
        column, from the floor up.

    Raises:
        ParameterError: spacing or jitter make no sense for this bed.
    """
    bed = bed.domain
    surface = surface.widened(bed.lower, bed.upper)
    size = bed.upper - bed.lower
    if not 0.0 < spacing <= 0.5 * float(size.min()):
        raise ParameterError(
            f"a particle spacing of {spacing:g} m does not fit a bed of {', '.join(f'{s:g}' for s in size)} m"
        )
    if not 0.0 <= jitter <= 1.0:
        raise ParameterError(f"jitter must lie between 0 and 1, not {jitter:g}")
    generator = np.random.default_rng(seed)
    counts_xy = [max(1, nearest(float(size[k]) / spacing)) for k in (0, 1)]
    widths = [float(size[k]) / counts_xy[k] for k in (0, 1)]
    depth = column_depths(surface, bed, counts_xy[0], counts_xy[1])
    share = depth * (widths[0] * widths[1] / spacing**3)
    count = _rounded(share, float(generator.random()))
    ny, nx = depth.shape
    column = np.repeat(np.arange(nx * ny), count.ravel())
    start = np.concatenate([[0], np.cumsum(count.ravel())[:-1]])
    level = np.arange(len(column)) - start[column]
    offset = 0.5 + 0.999 * jitter * (generator.random((len(column), 3)) - 0.5)
    row, place = np.divmod(column, nx)
    x = bed.lower[0] + (place + offset[:, 0]) * widths[0]
    y = bed.lower[1] + (row + offset[:, 1]) * widths[1]
    # A slope inside a column must not leave particles above it: stretch to the height over the particle, not to the
    # mean, and the columns' volumes stay the same because heights over particles average to the column's mean.
    top = np.maximum(surface.smooth(np.stack([x, y], axis=1)) - bed.lower[2], 0.0)
    z = bed.lower[2] + (level + offset[:, 2]) / count.ravel()[column] * top
    return np.stack([x, y, z], axis=1)


def column_depths(surface: HeightField, bed: Bed, nx: int, ny: int) -> FloatArray:
    """(ny, nx) mean depth of the soil over the floor in equal columns, metres."""
    fine = [centres(bed.lower[k], bed.upper[k], n * _SAMPLES) for k, n in enumerate((nx, ny))]
    depth = np.maximum(surface.smooth(np.stack(np.meshgrid(*fine), axis=-1)) - bed.lower[2], 0.0)
    return depth.reshape(ny, _SAMPLES, nx, _SAMPLES).mean(axis=(1, 3))


def volume(surface: HeightField, bed: Bed) -> float:
    """Volume of soil between the bed's floor and the surface, m³."""
    nx, ny = len(surface.x), len(surface.y)
    area = float(np.prod((bed.upper - bed.lower)[:2])) / (nx * ny)
    return float(column_depths(surface, bed, nx, ny).sum() * area)


def _rounded(share: FloatArray, start: float) -> NDArray[np.int64]:
    """Whole numbers whose running sum along a meandering path stays within one of the shares' sum."""
    path = share.copy()
    path[1::2] = path[1::2, ::-1]
    total = np.floor(np.cumsum(path.ravel()) + start).astype(np.int64)
    whole = np.diff(np.concatenate([[np.int64(np.floor(start))], total])).reshape(share.shape)
    whole[1::2] = whole[1::2, ::-1]
    return whole
