"""Other strokes of the same tool in the same bed, and experiments with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.experiment.forces import SCALE
from splatsoil.experiment.plow import PlowExperiment, side_by_side
from splatsoil.experiment.scene_parts import heading_of
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.model import Model
from splatsoil.soil.effect import Effect

MEASURED = "as measured"
"""Name of the measured stroke, repeated in a new bed."""
INCLINATION = 20.0
"""Change of the tool's inclination, degrees."""
MIN_CLEARANCE = 0.2
"""Soil below the tool, as a share of the soil's depth: the floor must not matter."""
MAX_DEPTH, MIN_DEPTH = 1.5, 1.2
"""Depth of the deeper stroke over the measured one: at most, and at least to be of use."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """A proposed motion of the tool.

    Attributes:
        name: for the reader.
        measurement: the set with this motion and the pictures of the measured stroke.
        start: frame at which the proposed stroke begins, after the measured one.
    """

    name: str
    measurement: Measurement
    start: int = 0

    def prepared(self, measured: PlowExperiment) -> Measurement:
        """The set to simulate: pictures numbered from the stroke's start; a placeholder for a measured force."""
        given, first = measured.base.measurement, self.start
        # Frames before the tool moves stay before the stroke.
        video = tuple(
            replace(f, frame=f.frame + first) if f.frame is not None and f.frame >= 0 else f for f in given.video
        )
        force = None
        if measured.forces is not None:
            frames = np.arange(first + 1.0, first + given.frames[-1] + 1.0)
            against = -measured.forces.largest * np.append(heading_of(given), 0.0)
            times = frames / self.measurement.frame_rate
            force = np.column_stack([frames, times, np.tile(against, (len(frames), 1))])
        heights = given.heights
        if heights is not None:
            grids = {n + first if n >= 0 else n: grid for n, grid in heights.grids.items()}
            heights = replace(heights, grids=grids)
        tool = replace(self.measurement.tool, force=force)
        return replace(self.measurement, video=video, heights=heights, tool=tool)

    def motion(self, frame_rate: float) -> ToolMotion:
        """The stroke from its start, one row for each frame at a rate in 1/s."""
        motion, rate = self.measurement.tool.motion, self.measurement.frame_rate
        begin, end = self.start / rate, float(motion.times[-1])
        frames = np.arange(int(np.ceil((end - begin) * frame_rate - 1e-6)) + 1)
        times = frames / frame_rate
        rotations, positions = zip(*(motion.pose(float(begin + t)) for t in times), strict=True)
        quaternions = Rotation.from_matrix(np.stack(rotations)).as_quat(canonical=True)
        return ToolMotion(frames, times, np.stack(positions), np.roll(quaternions, 1, axis=1))


def strokes(measurement: Measurement, surface: float) -> list[Stroke]:
    """The measured stroke again, deeper, shallower, faster, slower, with an inclined tool, and a second one next to the
    first.

    Omitted are strokes that bed or tool do not allow: the tool stays between the walls, a fifth of the soil's depth
    remains below it, and it does not go deeper than its own height.

    Args:
        measurement: a set.
        surface: mean height of the undisturbed soil, m.
    """
    motion = measurement.tool.motion
    turn = Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1))
    lowest = _lowest(measurement, turn)
    low = motion.positions[:, 2] + lowest

    def deeper(factor: float) -> Measurement:
        shift = np.where(low < surface, (factor - 1.0) * (low - surface), 0.0)
        return _with(measurement, replace(motion, positions=motion.positions + shift[:, None] * [0.0, 0.0, 1.0]))

    def faster(factor: float) -> Measurement:
        # As many pictures, at the same positions of the tool.
        quick = _with(measurement, replace(motion, times=motion.times / factor))
        return replace(quick, frame_rate=measurement.frame_rate * factor)

    def leaning(angle: float) -> Measurement:
        heading = heading_of(measurement)
        bent = Rotation.from_rotvec(np.radians(angle) * np.array([-heading[1], heading[0], 0.0])) * turn
        positions = motion.positions.copy()
        positions[:, 2] += lowest - _lowest(measurement, bent)
        return _with(measurement, replace(motion, positions=positions, quaternions=np.roll(bent.as_quat(), 1, axis=1)))

    bottom, top = _room(measurement)[4:]
    factor = min(MAX_DEPTH, min(surface - _floor(measurement, surface), top - bottom) / max(surface - bottom, 1e-9))
    deepest = [Stroke(f"deeper by {100.0 * (factor - 1.0):.0f} %", deeper(factor))] if factor >= MIN_DEPTH else []
    out = [
        Stroke(MEASURED, measurement),
        *deepest,
        Stroke("half as deep", deeper(0.5)),
        Stroke("twice as fast", faster(2.0)),
        Stroke("half as fast", faster(0.5)),
    ]
    if heading_of(measurement).any():
        out += [
            Stroke("upper edge ahead", leaning(INCLINATION)),
            Stroke("lower edge ahead", leaning(-INCLINATION)),
        ]
        # The first side that the walls allow.
        out += [s for s in _second(measurement) if _possible(s, measurement, surface)][:1]
    return [stroke for stroke in out if _possible(stroke, measurement, surface)]


class StrokeExperiment(PlowExperiment):
    """An experiment with a proposed stroke: the same cameras, heights and force sensor.

    Noise is that of the measured stroke. Forces are in % of its largest. Pictures are compared with the photograph at
    rest, which cancels. :meth:`expect` sets the expected observation.

    Args:
        model: of :meth:`Stroke.prepared`.
        measured: the experiment of the measured stroke.
        candidates: effects that are off; all of the library by default.
    """

    def __init__(
        self, model: Model, measured: PlowExperiment, candidates: Iterable[str | Effect] | None = None
    ) -> None:
        super().__init__(model, [p.name for p in measured.parameters], candidates=candidates)
        if self.forces is not None and measured.forces is not None:
            self.forces = replace(self.forces, largest=measured.forces.largest)
        # Noise of one frame of each camera; a row averages frames.
        level = {
            site.channel: std * np.sqrt(len(measured._bins[0]))
            for site, std in zip(measured.layout.sites, measured.sensor[0], strict=True)
        }
        frames = np.array([[len(group)] for group in self._bins], dtype=np.float64)
        self._placed_noise = np.array([level[site.channel] for site in self._sites]) / np.sqrt(frames)
        self.sensor = side_by_side(self._placed_noise, None if self.forces is None else self.forces.noise)
        seen = self.comparator.observed
        self.comparator = self.comparator.against({(c, f): seen[c, self.comparator.reference] for c, f in seen})

    def expect(self, table: FloatArray) -> None:
        """Take features (t, s) for those that will be observed: the noise of a force depends on its size."""
        self.observed = table
        if self.forces is not None:
            forces = SCALE * np.sinh(table[:, len(self._sites) :] / SCALE)
            self.forces = replace(self.forces, observed=forces)
            self.sensor = side_by_side(self._placed_noise, self.forces.noise)


def _with(measurement: Measurement, motion: ToolMotion) -> Measurement:
    return replace(measurement, tool=replace(measurement.tool, motion=motion))


def _lowest(measurement: Measurement, turn: Rotation) -> FloatArray:
    """(n,) height of the tool's lowest point above its origin, m, for rotations (n,)."""
    corners = np.asarray(measurement.tool.mesh.vertices, dtype=np.float64)
    return np.asarray((turn.as_matrix()[:, 2] @ corners.T).min(axis=1))


def _second(measurement: Measurement) -> list[Stroke]:
    """The measured stroke, followed by the same one tool width to its left, or to its right."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    heading = heading_of(measurement)
    left = np.array([-heading[1], heading[0], 0.0])
    out = []
    for name, side in (("a second one on the left", left), ("a second one on the right", -left)):
        across = _corners(measurement, 0) @ side
        start = motion.positions[0] + float(np.ptp(across)) * side
        # Out of the soil, across, and down again, not faster than the stroke.
        above = np.array([*motion.positions[-1, :2], max(motion.positions[:, 2].max(), motion.positions[-1, 2])])
        over = np.array([*start[:2], above[2]])
        way = np.stack([motion.positions[-1], above, over, start])
        speed = float((np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)).max())
        legs = np.maximum(np.ceil(np.linalg.norm(np.diff(way, axis=0), axis=1) / speed * rate - 1e-9), 1.0).astype(int)
        last = int(motion.frames[-1])
        stops = last + np.cumsum(legs)
        frames = np.concatenate([motion.frames, stops, stops[-1] - motion.frames[0] + motion.frames[1:]])
        positions = np.concatenate([motion.positions, way[1:], motion.positions[1:] + (start - motion.positions[0])])
        quaternions = np.concatenate(
            [
                motion.quaternions,
                np.tile(motion.quaternions[-1], (2, 1)),
                motion.quaternions[:1],
                motion.quaternions[1:],
            ]
        )
        both = ToolMotion(frames, frames / rate, positions, quaternions)
        out.append(Stroke(name, _with(measurement, both), int(stops[-1])))
    return out


def _corners(measurement: Measurement, row: int) -> FloatArray:
    """(n, 3) the tool's vertices at a row of its motion."""
    motion = measurement.tool.motion
    rotation, position = motion.pose(float(motion.times[row]))
    return np.asarray(measurement.tool.mesh.vertices @ rotation.T + position)


def _possible(stroke: Stroke, measured: Measurement, surface: float) -> bool:
    """Whether bed and tool allow a stroke; they allow the measured one."""
    walls = (*measured.bed.lower[:2], *-measured.bed.upper[:2])
    needed = np.minimum(_room(measured), [*walls, _floor(measured, surface), surface])
    return bool(np.all(_room(stroke.measurement) >= needed - 1e-9))


def _floor(measurement: Measurement, surface: float) -> float:
    """Least height of the tool, m."""
    return float(measurement.bed.lower[2] + MIN_CLEARANCE * (surface - measurement.bed.lower[2]))


def _room(measurement: Measurement) -> FloatArray:
    """(6,) minima of x, y, -x, -y of the tool below the top of the walls, and of the heights of its lowest and highest
    points, m."""
    out = np.full(6, np.inf)
    for row in range(len(measurement.tool.motion.times)):
        points = _corners(measurement, row)
        sunk = points[points[:, 2] < measurement.bed.upper[2], :2]
        if len(sunk):
            out[:4] = np.minimum(out[:4], [*sunk.min(axis=0), *(-sunk).min(axis=0)])
        out[4:] = np.minimum(out[4:], [points[:, 2].min(), points[:, 2].max()])
    return out
