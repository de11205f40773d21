"""Features of measured heights: the change of height of a square of the bed since the first frame.

Grids and depth maps are one instrument. Measured and predicted heights are averaged over the same cells of a square:
those that are visible and without the tool at both frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from splatsoil.arrays import BoolArray, FloatArray, Image
from splatsoil.comparison import GAIN, MARGIN, Comparator
from splatsoil.experiment.features import Site
from splatsoil.measurement import Measurement
from splatsoil.reconstruction.heights import Cells, seen_heights
from splatsoil.scene import Relief

CHANNEL, UNIT = "heights", "mm"
"""The instrument. Its noise in mm is similar to that of pictures in grey levels, so neither dominates the principal
components."""
MM = 1e3
PARTS = 8
"""Cells along a square's side."""
ENOUGH = 0.5
"""Share of a square's cells that must be known."""
UNKNOWN_NOISE, LEAST_NOISE = 1.0, 0.05
"""Standard deviation of a square's height, mm: default, and minimum."""


class Heights:
    """A set's heights as features.

    Args:
        measurement: has heights at the comparison's first frame.
        comparator: defines squares and frames.
        rows: indices of the compared frames of each row of features.

    Attributes:
        sites: (s,) the squares whose heights are known at the first frame.
        observed: (t, s) measured changes, mm; 0 where unknown.
        seen: (t, s) whether any frame of a row shows enough of a square.
        noise: (t, s) standard deviation of the changes, mm: from heights before the tool moves, or as the set states it
            (errors of a square's cells are then equal).
    """

    def __init__(self, measurement: Measurement, comparator: Comparator, rows: Sequence[Sequence[int]]) -> None:
        bed, size = measurement.bed, comparator.block
        self._squares = tuple(np.round(bed.extents[:2] / size).astype(int)[::-1].tolist())
        ny, nx = self._squares
        cells = Cells(bed.lower[:2], size / PARTS, (PARTS * ny, PARTS * nx))
        margin = min(MARGIN, 0.1 * float(bed.extents[:2].min()))
        there = measurement.height_frames

        def seen(frame: int) -> FloatArray:
            points = seen_heights(measurement, frame, cells)
            off = ~np.all(np.abs(points[:, :2] - 0.5 * (bed.lower + bed.upper)[:2]) < 0.5 * bed.extents[:2] - margin, 1)
            points[off] = np.nan
            return points

        still = np.stack([seen(f) for f in there if f <= comparator.reference])
        known = np.isfinite(still)
        self._reference, self._rows = comparator.reference, rows
        self._first = np.where(known, still, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        unknown = np.full_like(self._first, np.nan)
        self._later = {f: seen(f) if f in there else unknown for f in comparator.frames}
        count = self._counts(self._first[:, 2])
        self._kept = np.flatnonzero(count >= ENOUGH * count.max())
        enough = ENOUGH * count[self._kept]
        self._usable = np.stack([self._counts(p[:, 2] - self._first[:, 2])[self._kept] for p in self._later.values()])
        self._usable = (self._usable > enough).astype(np.float64)
        frames = np.stack([self._usable[list(row)].sum(axis=0) for row in rows])
        self.seen: BoolArray = frames > 0.0
        self._moved = np.stack([self._means(MM * (p - self._first)[:, 2]) for p in self._later.values()])
        self.observed = self._in_rows(self._moved)
        self._std = self._level(measurement, still[..., 2])
        self.noise = self._std / np.sqrt(np.maximum(frames, 1.0))
        self.sites = tuple(self._site(bed.lower[:2], size, k % nx, k // nx) for k in self._kept.tolist())

    @classmethod
    def of(cls, measurement: Measurement, comparator: Comparator, rows: Sequence[Sequence[int]]) -> Heights | None:
        """None if the set has no heights of the first frame or of any compared one."""
        there = set(measurement.height_frames)
        enough = comparator.reference in there and not there.isdisjoint(comparator.frames)
        return cls(measurement, comparator, rows) if enough else None

    def predicted(self, surfaces: Mapping[int, Relief]) -> FloatArray:
        """(t, s) changes in mm of surfaces by frame, the first one among them."""
        return self._in_rows(self._of(surfaces))

    def losses(self, surfaces: Mapping[int, Relief]) -> dict[int, float]:
        """Mean square residual of each compared frame over the mean square change; 0 is a perfect model, 1 one
        without motion."""
        moved, left = self._moved, self._moved - self._of(surfaces)
        unit = max(float(np.mean(moved[self._usable > 0.0] ** 2)), 1e-12)
        square = np.sum(self._usable * left**2, axis=1) / np.maximum(self._usable.sum(axis=1), 1.0)
        return {frame: float(v) / unit for frame, v in zip(self._later, square, strict=True)}

    @property
    def noise_loss(self) -> float:
        """Expected loss of a perfect model."""
        return self._std**2 / max(float(np.mean(self._moved[self._usable > 0.0] ** 2)), 1e-12)

    def pictures(self, surfaces: Mapping[int, Relief], frame: int) -> dict[str, Image]:
        """(h, w, 3) observed and predicted changes at a frame, from above with y upwards, and their difference, by
        these names: grey for no change or no data, brighter for higher. The difference is scaled by `GAIN`."""
        seen, first = self._later[frame], self._first
        largest = max(np.nanmax(np.abs((p - first)[:, 2]), initial=1e-9) for p in self._later.values())
        changes = (seen - first)[:, 2], _heights(surfaces[frame], seen) - _heights(surfaces[self._reference], first)
        observed, predicted = (np.clip(0.5 + 0.5 * np.nan_to_num(c) / largest, 0.0, 1.0) for c in changes)
        difference = np.clip(0.5 + GAIN * (observed - predicted), 0.0, 1.0)
        shape = tuple(PARTS * n for n in self._squares)
        named = {"observed": observed, "predicted": predicted, "difference": difference}
        return {
            name: np.repeat(values.reshape(shape)[::-1, :, None], 3, axis=2).astype(np.float32)
            for name, values in named.items()
        }

    def _of(self, surfaces: Mapping[int, Relief]) -> FloatArray:
        """(compared frames, s) changes of surfaces, mm."""
        first = _heights(surfaces[self._reference], self._first)
        return np.stack([self._means(MM * (_heights(surfaces[f], p) - first)) for f, p in self._later.items()])

    def _in_rows(self, changes: FloatArray) -> FloatArray:
        """(t, s) means of changes (compared frames, s) over the usable frames of each row; 0 where there are none."""
        total, count = (
            np.stack([v[list(row)].sum(axis=0) for row in self._rows]) for v in (self._usable * changes, self._usable)
        )
        return np.asarray(total / np.maximum(count, 1.0))

    def _site(self, lower: FloatArray, size: FloatArray, column: int, row: int) -> Site:
        ny, nx = self._squares
        x, y = (lower + size * (np.array([column, row]) + 0.5)).tolist()
        around = ((0, 1), (1, 1), (1, 0), (0, 0))
        return Site(CHANNEL, x, y, UNIT, outline=tuple(((column + i) / nx, 1.0 - (row + j) / ny) for i, j in around))

    def _level(self, measurement: Measurement, still: FloatArray) -> float:
        """Standard deviation of a square's change, mm, from heights (n, cells) before the tool moves."""
        if len(still) > 1:
            others = (still.sum(axis=0) - still) / (len(still) - 1)
            left = np.stack([self._means(MM * (s - o)) for s, o in zip(still, others, strict=True)])
            return max(float(np.sqrt(np.mean(left**2))), LEAST_NOISE)
        stated = None if measurement.heights is None else measurement.heights.noise
        return UNKNOWN_NOISE if stated is None else max(MM * stated, LEAST_NOISE)

    def _means(self, values: FloatArray) -> FloatArray:
        """(s,) means of values (cells,) over the known cells of a square; 0 for none."""
        total = self._in_squares(np.nan_to_num(values))[self._kept]
        return np.asarray(total / np.maximum(self._counts(values)[self._kept], 1.0))

    def _counts(self, values: FloatArray) -> FloatArray:
        """(squares,) known ones of values (cells,)."""
        return self._in_squares(np.isfinite(values).astype(np.float64))

    def _in_squares(self, values: FloatArray) -> FloatArray:
        """(squares,) sums of values (cells,)."""
        ny, nx = self._squares
        return np.asarray(values.reshape(ny, PARTS, nx, PARTS).sum(axis=(1, 3)).reshape(-1))


def _heights(surface: Relief, points: FloatArray) -> FloatArray:
    """(n,) heights of a surface at points (n, 3), m; NaN where these are."""
    place = torch.from_numpy(np.nan_to_num(points[:, :2]).astype(np.float32)).to(surface.device)
    height = surface.sample(surface.height, place).cpu().numpy().astype(np.float64)
    return np.where(np.isfinite(points[:, 2]), height, np.nan)
