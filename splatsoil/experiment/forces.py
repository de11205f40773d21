"""Features of the measured force on the tool.

In pictures friction and cohesion are correlated: one compensates for the other. The tool force differs by a factor of
three to four between such pairs (docs/numerics.md), so a force known to 15 % separates them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.scene_parts import heading_of, stages_of
from splatsoil.measurement import Measurement

ALONG, UP = "force along", "force up"
"""Components: against the direction of pushing, and upwards."""
REGION, UNIT = "tool", "N"
STAGE, PAUSE = "pushing", "pause"
"""The stage whose largest force is the unit, and the stage in which the tool stands still."""
MIN_FORCE, MIN_ROWS = 0.25, 2
"""Minimum number of rows in which the pushing force exceeds this share of the largest force."""
SENSOR = 1.0
"""Standard deviation of the measurement, % of the largest force."""
SCALE = 10.0
"""Scale of the inverse hyperbolic sine (Burbidge, Magee & Robb 1988, J. Am. Stat. Assoc. 83:123), % of the largest
force: smaller forces are compared by difference, larger ones by ratio, because simulated forces err in proportion."""


@dataclass(frozen=True)
class ToolForces:
    """Forces as features.

    Attributes:
        channels: (c,) names of the components.
        observed: (t, c) measured means over each row's frames, in % of the largest.
        stages: (t,) stage of each row.
        measured: (t, c) whether there is a measurement.
        largest: largest force, N.
        axes: (c, 3) directions of the components.
        weights: (t, f) of frames 1, 2, …, f in each row's mean.
    """

    channels: tuple[str, ...]
    observed: FloatArray
    stages: tuple[str, ...]
    measured: BoolArray
    largest: float
    axes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, measurement: Measurement, rows: Sequence[Sequence[int]]) -> ToolForces | None:
        """Forces of a set in rows of compared frames; None where too little was measured.

        A row's force is the mean over the frames of its stage that are nearest to its compared frames.
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
        if (moving & (size > MIN_FORCE * largest)).sum() < MIN_ROWS:
            return None
        there = np.repeat((weights.sum(axis=1) > 0.0)[:, None], len(axes), axis=1)
        return cls((ALONG, UP), 100.0 * table / largest, stages, there, largest, axes, weights)

    def predicted(self, force: FloatArray) -> FloatArray:
        """(t, c) features of a simulation's force (f', 3) in frames 1, 2, …; f' at least f."""
        return 100.0 * (self.weights @ force[: self.weights.shape[1]] @ self.axes.T) / self.largest

    @property
    def features(self) -> FloatArray:
        """(t, c) measured features."""
        return compressed(self.observed)

    @property
    def noise(self) -> FloatArray:
        """(t, c) standard deviation of the features."""
        return np.hypot(SENSOR / np.sqrt(1.0 + (self.observed / SCALE) ** 2), _standing(self.features, self.stages))

    def newtons(self, features: FloatArray) -> FloatArray:
        """Forces in N from features: the inverse of `compressed`."""
        return np.asarray(0.01 * self.largest * SCALE * np.sinh(features / SCALE))


def force_record(measurement: Measurement, frames: Sequence[int], force: FloatArray) -> dict[str, Any] | None:
    """Measured and predicted force around each compared frame, in N, as plain data.

    Args:
        measurement: with the measured force.
        frames: compared ones.
        force: (f, 3) predicted force on the tool in frames 1, 2, …, in N.

    Returns:
        ``unit``, ``frames`` and, for each of ``channels``, its name and what was ``measured`` and ``predicted``; null
        in frames without a measurement. None where too little was measured.
    """
    forces = ToolForces.of(measurement, [[frame] for frame in frames])
    if forces is None:
        return None
    predicted = 0.01 * forces.largest * forces.predicted(force)
    measured = 0.01 * forces.largest * forces.observed

    def column(table: FloatArray, number: int) -> list[float | None]:
        there = forces.measured[:, number]
        return [round(float(v), 4) if known else None for v, known in zip(table[:, number], there, strict=True)]

    return {
        "unit": UNIT,
        "frames": list(frames),
        "channels": [
            {"channel": name, "measured": column(measured, i), "predicted": column(predicted, i)}
            for i, name in enumerate(forces.channels)
        ],
    }


def compressed(forces: FloatArray) -> FloatArray:
    """Inverse hyperbolic sine of forces in % of the largest, see `SCALE`."""
    return np.asarray(SCALE * np.arcsinh(forces / SCALE))


def _standing(features: FloatArray, stages: Sequence[str]) -> FloatArray:
    """(t, c) standard deviation of the force on a tool at rest. How it stops within a frame is not recorded, so the
    force is uniform between zero and its last value."""
    out = np.zeros(features.shape)
    last = np.zeros(features.shape[1])
    for row, stage in enumerate(stages):
        if stage == PAUSE:
            out[row] = np.abs(last) / np.sqrt(12.0)
        else:
            last = features[row]
    return out
