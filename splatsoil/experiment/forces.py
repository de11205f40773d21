"""The force on the tool, where it was measured: instruments beside the cameras.

Pictures leave a valley in which friction and cohesion make up for each other. The force that moves the tool differs
along it by a factor of three to four (docs/numerics.md), so even a force that is believed to 15 % shortens it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.scene_parts import heading_of, stages_of
from splatsoil.measurement import Measurement

FloatArray = npt.NDArray[np.float64]

ALONG, UP = "force along", "force up"
"""Instruments: against the way the tool is pushed, and upwards."""
REGION, UNIT = "tool", "% of the largest force, asinh"
STAGE = "pushing"
"""In which the force is believed: that of lowering depends on the cell, and that of standing on how the last moment of
the motion is resolved, which measured poses leave open (docs/numerics.md)."""
LEAST = 0.25
"""Share of the largest force below which it isn't looked at: where soil is first touched is a matter of cells."""
FEWEST = 2
"""Rows of forces that are worth having."""
SENSOR = 1.0
"""Standard deviation of what is measured, % of the largest force."""
SCALE = 10.0
"""% of the largest force up to which a comparison of models takes forces as they are; beyond, relative differences
count (inverse hyperbolic sine: Burbidge, Magee & Robb 1988, J. Am. Stat. Assoc. 83:123), because forces grow tenfold
from weak to strong soil and simulated ones err in proportion."""
ERROR = 0.1
"""Standard deviation of all simulated forces over their size, together: with cells of 20 mm ours are 12 to 16 % above a
converged solver's, of 13.3 mm 4 to 6 % (docs/numerics.md), and 4 to 28 % off Reece's equation (docs/validation.md)."""
OWN = 0.1
"""Likewise of one instrument's, beside that."""
GROWTH = 0.1
"""Likewise of the last row's, and of the first row's the other way: as soil gathers before the tool."""
SHAPE = 0.05
"""Likewise of one row's: forces shake."""


@dataclass(frozen=True)
class ToolForces:
    """Forces as features.

    Attributes:
        channels: (c,) the instruments.
        observed: (t, c) measured means over each row's frames, in % of the largest.
        seen: (t, c) rows in which they count for a fit's loss.
        measured: (t, c) rows in which there are any.
        largest: what that is, N.
        axes: (c, 3) the instruments' directions.
        weights: (t, f) of frames 1, 2, …, f in each row.
        frames: (t,) the last of each row.
    """

    channels: tuple[str, ...]
    observed: FloatArray
    seen: npt.NDArray[np.bool_]
    measured: npt.NDArray[np.bool_]
    largest: float
    axes: FloatArray
    weights: FloatArray
    frames: tuple[int, ...]

    @classmethod
    def of(cls, measurement: Measurement, rows: Sequence[Sequence[int]]) -> ToolForces | None:
        """What a set's forces say in rows of compared frames; None where too little was measured.

        A row's force is the mean over the frames of its stage that are nearer to its compared frames than to others: a
        frame's own force shakes, and pictures between the compared ones say little.
        """
        force = measurement.tool.force
        compared = np.array([frame for row in rows for frame in row])
        if force is None or len(compared) < 2:
            return None
        row_of = np.array([i for i, row in enumerate(rows) for _ in row])
        numbers = force[:, 0].astype(int)
        force = force[(numbers >= 1) & (numbers <= compared.max())]
        if not len(force):
            return None
        numbers = force[:, 0].astype(int)
        apart = np.abs(numbers[:, None] - compared[None])
        nearest = row_of[apart.argmin(axis=1)]
        stages = stages_of(measurement, [float(row[-1]) for row in rows])
        own = stages_of(measurement, numbers.astype(float))
        weights = np.zeros((len(rows), int(compared.max())))
        for number, row, stage in zip(numbers, nearest, own, strict=True):
            weights[row, number - 1] = float(stage == stages[row])
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
        by_frame = np.zeros((weights.shape[1], 3))
        by_frame[numbers - 1] = force[:, 2:]
        axes = np.stack([np.append(-heading_of(measurement), 0.0), [0.0, 0.0, 1.0]])
        table = weights @ by_frame @ axes.T
        size = np.linalg.norm(table, axis=1)
        moving = (np.array(stages) == STAGE) & (weights.sum(axis=1) > 0.0)
        largest = float(size[moving].max(initial=0.0))
        rows_seen = moving & (size > LEAST * largest)
        if rows_seen.sum() < FEWEST:
            return None
        seen = np.repeat(rows_seen[:, None], len(axes), axis=1)
        there = np.repeat((weights.sum(axis=1) > 0.0)[:, None], len(axes), axis=1)
        last = tuple(row[-1] for row in rows)
        return cls((ALONG, UP), 100.0 * table / largest, seen, there, largest, axes, weights, last)

    def predicted(self, force: FloatArray) -> FloatArray:
        """(t, c) features of a simulation's force (f', 3) in frames 1, 2, …; f' at least f."""
        return 100.0 * (self.weights @ force[: self.weights.shape[1]] @ self.axes.T) / self.largest

    @property
    def features(self) -> FloatArray:
        """(t, c) what was measured, as a comparison of models takes it."""
        return compressed(self.observed)

    @property
    def noise(self) -> FloatArray:
        """(t, c) standard deviation of the instrument in these."""
        return SENSOR / np.sqrt(1.0 + (self.observed / SCALE) ** 2)

    def residuals(self, force: FloatArray) -> dict[str, float]:
        """Observed minus predicted features that count, by name, for a simulation's force (f', 3)."""
        off = (self.observed - self.predicted(force))[self.seen]
        return dict(zip(self.names, map(float, off), strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the features that count."""
        return tuple(f"{self.channels[c]}, frame {self.frames[t]}" for t, c in zip(*np.nonzero(self.seen), strict=True))

    def independent(self, residuals: Mapping[str, float]) -> FloatArray:
        """(k,) combinations of named residuals whose known errors are independent, of variance 1."""
        return np.linalg.solve(self._factor, np.array([residuals[name] for name in self.names]))

    @cached_property
    def _factor(self) -> FloatArray:
        """Cholesky factor of the known errors' covariance."""
        columns = self.errors[:, self.seen]
        return np.asarray(np.linalg.cholesky(columns.T @ columns + np.diag(self.sensor[self.seen] ** 2)))

    @property
    def sensor(self) -> FloatArray:
        """(t, c) standard deviation of a row by itself: the instrument's, and what no stage has in common."""
        return np.broadcast_to(np.hypot(SENSOR, SHAPE * self._size), self.observed.shape)

    @property
    def errors(self) -> FloatArray:
        """(k, t, c) what the model may get wrong of all forces, of how they grow along the way, and of each
        instrument's; one standard deviation each.

        All forces go with their own sign, an instrument's error with the size of the whole: a force that happens to
        have no part upwards needn't have none in another solver.
        """
        rows = np.flatnonzero(self.seen[:, 0])
        way = np.interp(np.arange(len(self.seen)), rows, np.linspace(-1.0, 1.0, len(rows)))
        together = np.stack([ERROR * self.observed, GROWTH * way[:, None] * self.observed])
        own = OWN * self._size[..., None] * np.eye(len(self.channels))
        return np.concatenate([together, own.transpose(1, 0, 2)])

    @property
    def _size(self) -> FloatArray:
        """(t, 1) of the measured force, in the features' unit."""
        return np.linalg.norm(self.observed, axis=1, keepdims=True)


def compressed(forces: FloatArray) -> FloatArray:
    """Forces in % of the largest, relative beyond `SCALE`."""
    return np.asarray(SCALE * np.arcsinh(forces / SCALE))
