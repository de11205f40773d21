"""Heights of the soil's surface, frame by frame: grids of a scanner, and what depth maps of a camera show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement.fields import Fields
from splatsoil.measurement.frames import Frame
from splatsoil.measurement.images import read_numbers

FIELDS = ("corner", "cell", "noise", "frames")
FRAME_FIELDS = ("file_path", "frame")
_NO_DATA = 42113
"""TIFF tag in which GDAL keeps the number that stands for an unknown height."""


@dataclass(frozen=True, eq=False)
class HeightMaps:
    """Grids of heights, one a frame.

    Attributes:
        corner: (2,) lowest x and y of the grid, m: a corner of its first cell.
        cell: side of a cell, m.
        grids: (ny, nx) heights in m by frame number, negative before anything moves; NaN where unseen, rows along y.
        noise: standard deviation of a height, m; None if unknown.
        paths: the files they are from: the list of them, then each grid's.
    """

    corner: FloatArray
    cell: float
    grids: Mapping[int, FloatArray]
    noise: float | None = None
    paths: tuple[Path, ...] = ()

    @classmethod
    def read(cls, file: Path, root: Path) -> HeightMaps:
        """Read a ``heights.json`` and all grids that it names.

        Args:
            file: the list; grids are relative to its folder.
            root: the measurement set's folder, which no path may leave.

        Raises:
            MeasurementError: naming file and field.
        """
        fields = Fields.read(file)
        fields.check_names(FIELDS)
        corner = fields.vector("corner", 2)
        cell = fields.number("cell", 1e-5, 10.0, hint="it is the side of a cell in metres")
        noise = fields.number("noise", 1e-6, 1.0, hint="it is in metres") if fields.has("noise") else None
        grids: dict[int, FloatArray] = {}
        paths: dict[int, Path] = {}
        for item in fields.children("frames"):
            item.check_names(FRAME_FIELDS)
            number, path = item.integer("frame", -(10**9), 10**9), item.path("file_path", root, file.parent)
            if number in grids:
                item.fail("frame", f"frame {number} is given twice")
            grids[number] = grid = read_heights(path, item.path_of("file_path"))
            first = next(iter(grids.values()))
            if grid.shape != first.shape:
                raise MeasurementError(
                    f"the grid has {grid.shape[0]} x {grid.shape[1]} cells where that of frames[0] has"
                    f" {first.shape[0]} x {first.shape[1]}",
                    file=path,
                    field=item.path_of("file_path"),
                )
            paths[number] = path
        order = sorted(grids)
        return cls(corner, cell, {n: grids[n] for n in order}, noise, (file, *(paths[n] for n in order)))

    def check(self, lower: FloatArray, upper: FloatArray, slack: float) -> None:
        """Raise MeasurementError unless each grid shows the box from ``lower`` to ``upper`` (3,), in its unit.

        Half of the heights lie in the box, which may be off by ``slack``, a share of it; none is far below. What is
        higher than the box is the tool, or what carries it.
        """
        depth = float(upper[2] - lower[2])
        if self.noise is not None and self.noise > depth:
            raise MeasurementError(
                f"{self.noise:g} m is more than the bed's depth; it is a height's standard deviation in metres",
                file=self.paths[0],
                field="noise",
            )
        for number, path in zip(self.grids, self.paths[1:], strict=True):
            points = self.points(number)
            points = points[np.all((points[:, :2] > lower[:2]) & (points[:, :2] < upper[:2]), axis=1)]
            if not len(points):
                raise MeasurementError(
                    "no known height lies over the soil's box; are corner and cell in metres, in the world of the bed?",
                    file=path,
                )
            z, reaches = points[:, 2], f"the bed reaches from {lower[2]:g} to {upper[2]:g} m"
            off = z < lower[2] - depth
            if 0 < off.sum() < len(z):
                raise MeasurementError(
                    f"{off.sum()} heights are as {z[off][0]:g} m, where {reaches}; an unknown height is NaN", file=path
                )
            typical = float(np.median(z))
            if not lower[2] - slack * depth < typical < upper[2] + slack * depth:
                raise MeasurementError(
                    f"half of the heights are beyond {typical:g} m, where {reaches}; heights are in metres, upwards, in"
                    " the world of the bed",
                    file=path,
                )

    def points(self, frame: int) -> FloatArray:
        """(n, 3) centres of the cells whose heights are known at a frame, m."""
        rows, columns = np.nonzero(np.isfinite(self.grids[frame]))
        place = self.corner + self.cell * (np.stack([columns, rows], axis=1) + 0.5)
        return np.column_stack([place, self.grids[frame][rows, columns]])


def read_heights(path: Path, field: str | None = None) -> FloatArray:
    """A grid of heights (ny, nx) in m, rows along y, NaN where unknown.

    A ``.npy`` has its first row at the lowest y; a TIFF, as a map has it, at the highest.

    Raises:
        MeasurementError: it can't be read, has no floating-point numbers, or none that is known.
    """
    values = read_numbers(path, field)
    if values.dtype.kind != "f" or values.ndim != 2:
        raise MeasurementError(
            "a grid of heights is a table of floating-point metres with rows and columns", file=path, field=field
        )
    grid = values.astype(np.float64)
    if path.suffix.lower() != ".npy":
        grid = np.where(grid == _no_data(path), np.nan, grid)[::-1]
    grid = np.where(np.isfinite(grid), grid, np.nan)
    if not np.isfinite(grid).any():
        raise MeasurementError("no height is known: all are NaN", file=path, field=field)
    return grid


def depth_points(frame: Frame, step: int = 1) -> FloatArray:
    """(n, 3) points in m that every ``step``-th pixel of a frame's depth map shows, where its mask allows it; none
    without a map."""
    depth, mask = frame.depth(), frame.mask()
    if depth is None:
        return np.zeros((0, 3))
    known = depth > 0.0 if mask is None else (depth > 0.0) & mask
    rows, columns = (index[::step] for index in np.nonzero(known))
    origins, rays = frame.camera.rays(np.stack([columns, rows], axis=1) + 0.5)
    along = rays @ -frame.camera.camera_to_world[:3, 2]
    points = origins + rays * (depth[rows, columns] / along)[:, None]
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _no_data(path: Path) -> float:
    with Image.open(path) as image:
        try:
            return float(str(image.getexif().get(_NO_DATA, "nan")).strip("\0 "))
        except ValueError:
            return float("nan")
