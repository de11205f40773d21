"""Other strokes of the same tool in the same bed, simulated coarsely: which would tell two effects apart?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.measurement import Measurement, ToolMotion

if TYPE_CHECKING:
    from splatsoil.model import Model
    from splatsoil.soil.effect import Effect

FloatArray = npt.NDArray[np.float64]
Predict = Callable[[Mapping[str, float], tuple[str, ...]], FloatArray]

MEASURED = "as measured"
"""Name of the stroke that was made."""
PRESET = "tiny"
"""Patterns are compared, not fitted: the coarsest will do."""
LEAN = 20.0
"""Degrees by which the tool leans otherwise."""
MOMENTS = 6
"""Frames that are looked at."""
CHANCE = 2.0e-3
"""Of a square's height between seeds of the particles, m."""
PATCH = 2.0
"""Edge of the squares whose height is told, in cells: finer shapes are chance."""


@runtime_checkable
class Stroked(Protocol):
    """An experiment that can be thought of with another stroke."""

    def strokes(self) -> Mapping[str, Predict]:
        """Predictions (n,) in units of noise, by stroke, :data:`MEASURED` too; they take parameters and effects."""


def plow_strokes(model: Model, own: Mapping[str | Effect, Effect] | None = None) -> dict[str, Predict]:
    """The measured stroke deeper, shallower, slower, faster, and with the tool leaning, where the bed allows it.

    Args:
        model: of the measured stroke.
        own: effects that the library doesn't have, by name.
    """
    surface = float(np.nanmean(model.reconstruction.surface.height))
    return {
        name: partial(_heights, model, own or {}, measurement)
        for name, measurement in motions(model.measurement, surface).items()
    }


def motions(measurement: Measurement, surface: float) -> dict[str, Measurement]:
    """The set with other strokes, derived from the measured one; ``surface`` is the mean height of the bed in m."""
    motion, mesh = measurement.tool.motion, measurement.tool.mesh
    turn = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1))
    corners = np.asarray(mesh.vertices, dtype=np.float64)
    lowest = np.array([float((corners @ r.as_matrix().T)[:, 2].min()) for r in turn])
    low = motion.positions[:, 2] + lowest

    def along(other: ToolMotion) -> Measurement:
        return replace(measurement, tool=replace(measurement.tool, motion=other))

    def deeper(factor: float) -> Measurement:
        shift = np.where(low < surface, (factor - 1.0) * (low - surface), 0.0)
        return along(replace(motion, positions=motion.positions + shift[:, None] * np.array([0.0, 0.0, 1.0])))

    def faster(factor: float) -> Measurement:
        quick = along(replace(motion, times=motion.times / factor))
        return replace(quick, frame_rate=measurement.frame_rate * factor)

    def leaning(angle: float) -> Measurement:
        way = motion.positions[:, :2] - motion.positions[0, :2]
        level = way[int(np.argmax(np.linalg.norm(way, axis=1)))]
        size = float(np.linalg.norm(level))
        axis = np.array([-level[1], level[0], 0.0]) / size if size > 0.0 else np.array([0.0, 1.0, 0.0])
        bent = Rotation.from_rotvec(np.radians(angle) * axis) * turn
        new = np.array([float((corners @ r.as_matrix().T)[:, 2].min()) for r in bent])
        positions = motion.positions.copy()
        positions[:, 2] += lowest - new
        return along(replace(motion, positions=positions, quaternions=np.roll(bent.as_quat(), 1, axis=1)))

    out = {MEASURED: measurement, "half as deep": deeper(0.5)}
    floor = float(measurement.bed.lower[2])
    if surface + 1.5 * (float(low.min()) - surface) > floor + 0.2 * (surface - floor):
        out["deeper by half"] = deeper(1.5)
    out["half as fast"], out["twice as fast"] = faster(0.5), faster(2.0)
    out["with the tool's edge ahead"], out["with the tool's edge behind"] = leaning(-LEAN), leaning(LEAN)
    return out


def _heights(
    model: Model,
    own: Mapping[str | Effect, Effect],
    measurement: Measurement,
    values: Mapping[str, float],
    effects: tuple[str, ...],
) -> FloatArray:
    """(n,) changes of the surface's height over its chance, square by square, at some frames."""
    from splatsoil.model import Model
    from splatsoil.mpm import simulate

    on: tuple[str | Effect, ...] = (*model.effects, *(own.get(name, name) for name in effects))
    frames = np.unique(np.linspace(0, model.frames[-1], MOMENTS + 1).astype(int))
    coarse = Model(measurement, model.reconstruction, effects=on, preset=PRESET, device=model.device, frames=[0])
    run = simulate(
        measurement,
        coarse.particles(0),
        values,
        law=coarse.law,
        resolution=coarse.resolution,
        frames=frames,
        device=model.device,
    )[0]
    bed, edge = measurement.bed, PATCH * coarse.resolution.cell
    cells = np.maximum(((bed.upper - bed.lower)[:2] / edge).astype(int), 1)
    tables = []
    for positions in run.positions:
        place = np.clip(((positions[:, :2] - bed.lower[:2]) / edge).astype(int), 0, cells - 1)
        top = np.full(cells[0] * cells[1], bed.lower[2])
        np.maximum.at(top, place[:, 0] * cells[1] + place[:, 1], positions[:, 2].astype(np.float64))
        tables.append(top)
    return np.concatenate([table - tables[0] for table in tables[1:]]) / CHANCE
