"""The force on the tool, where it was measured: instruments beside the cameras.

Pictures leave a valley in which friction and cohesion make up for each other. The force that moves the tool differs
along it by a factor of four (docs/numerics.md), so even a force that is believed to 15 % ends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.scene_parts import heading_of, stages_of
from splatsoil.measurement import Measurement

FloatArray = npt.NDArray[np.float64]

ALONG, UP = "force along", "force up"
"""Instruments: against the way the tool is pushed, and upwards."""
REGION, UNIT = "tool", "% of the largest force"
MOVING = ("lowering", "pushing")
"""Stages in which the force is believed: at rest, contact by penalties lets go of what real soil holds."""
LEAST = 0.25
"""Share of the largest force below which it isn't looked at: where soil is first touched is a matter of cells."""
FEWEST = 2
"""Rows of forces that are worth having."""
SENSOR = 1.0
"""Standard deviation of what is measured, in the features' unit."""
ERROR = 0.15
"""Standard deviation of all simulated forces over their size, together: ours are 0 to 30 % off Reece's equation
(docs/validation.md), and 0 to 25 % off another solver's, which hang on its own numerics (docs/numerics.md)."""
OWN = 0.1
"""Likewise of one instrument's through one stage, beside that: ours upwards are 8 to 17 % too small."""
SHAPE = 0.05
"""Likewise of one row's: forces shake, and grow otherwise along the way."""


@dataclass(frozen=True)
class ToolForces:
    """Forces as features.

    Attributes:
        channels: (c,) the instruments; upwards alone where the tool isn't pushed.
        observed: (t, c) measured means over each row's frames, in % of the largest.
        seen: (t, c) rows in which they count.
        largest: what that is, N.
        axes: (c, 3) the instruments' directions.
        weights: (t, f) of frames 1, 2, …, f in each row.
        stages: (t,) of the rows.
    """

    channels: tuple[str, ...]
    observed: FloatArray
    seen: npt.NDArray[np.bool_]
    largest: float
    axes: FloatArray
    weights: FloatArray
    stages: tuple[str, ...]

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
        close = apart.min(axis=1) <= 0.5 * float(np.median(np.diff(compared)))
        weights = np.zeros((len(rows), int(compared.max())))
        for number, row, stage, near in zip(numbers, nearest, own, close, strict=True):
            weights[row, number - 1] = float(near and stage == stages[row])
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
        measured = np.zeros((weights.shape[1], 3))
        measured[numbers - 1] = force[:, 2:]
        heading = heading_of(measurement)
        up = np.array([0.0, 0.0, 1.0])
        axes = np.stack([np.append(-heading, 0.0), up] if heading.any() else [up])
        table = weights @ measured @ axes.T
        size = np.linalg.norm(table, axis=1)
        moving = np.isin(stages, MOVING) & (weights.sum(axis=1) > 0.0)
        largest = float(size[moving].max(initial=0.0))
        rows_seen = moving & (size > LEAST * largest)
        if rows_seen.sum() < FEWEST:
            return None
        seen = np.repeat(rows_seen[:, None], len(axes), axis=1)
        channels = (ALONG, UP)[-len(axes) :]
        return cls(channels, 100.0 * table / largest, seen, largest, axes, weights, stages)

    def predicted(self, force: FloatArray) -> FloatArray:
        """(t, c) features of a simulation's force (f', 3) in frames 1, 2, …; f' at least f."""
        return 100.0 * (self.weights @ force[: self.weights.shape[1]] @ self.axes.T) / self.largest

    @property
    def sensor(self) -> FloatArray:
        """(t, c) standard deviation of a row by itself: the instrument's, and what no stage has in common."""
        return np.hypot(SENSOR, SHAPE * self._size)

    @property
    def errors(self) -> FloatArray:
        """(k, t, c) what the model may get wrong of all forces, and of each instrument's through a whole stage; one
        standard deviation each.

        All forces go with their own sign, an instrument's error with the size of the whole: a force that happens to
        have no part upwards needn't have none in another solver.
        """
        out = [ERROR * self.observed]
        for stage in dict.fromkeys(self.stages):
            mine = np.array([s == stage for s in self.stages])
            for c in range(len(self.channels)):
                table = np.zeros(self.observed.shape)
                table[mine, c] = OWN * self._size[mine, 0]
                if np.any(table[self.seen]):
                    out.append(table)
        return np.stack(out)

    @property
    def _size(self) -> FloatArray:
        """(t, 1) of the measured force, in the features' unit."""
        return np.linalg.norm(self.observed, axis=1, keepdims=True)
