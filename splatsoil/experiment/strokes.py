"""Other strokes of the same tool in the same bed, and what the same instruments would see of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.experiment.forces import SCALE
from splatsoil.experiment.plow import PlowExperiment, side_by_side
from splatsoil.experiment.scene_parts import heading_of
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.model import Model
from splatsoil.soil.effect import Effect

FloatArray = npt.NDArray[np.float64]

MEASURED = "as measured"
"""Name of the stroke that was made, repeated in a bed that is prepared anew."""
LEAN = 20.0
"""Degrees by which the tool leans otherwise."""
UNDER = 0.2
"""Of the soil's depth, what is left beneath the tool: beyond, the floor is measured and not the soil."""

MORE, WORTHWHILE = 1.5, 1.2
"""Depth over the measured one that is wanted, and from which it is worth a stroke of its own."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """A motion of the tool that could be made next.

    Attributes:
        name: for people.
        measurement: the set as it would be with this motion; its pictures are those of the stroke that was made.
        start: frame of this motion at which the stroke begins; what was before has been made already.
    """

    name: str
    measurement: Measurement
    start: int = 0

    def prepared(self, measured: PlowExperiment) -> Measurement:
        """The set to simulate: pictures numbered as the stroke's are, a force of any size where one is measured."""
        given, first = measured.base.measurement, self.start
        # What is still stays before the stroke.
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
        """The stroke from its own frame 0 on, one row for each frame of a rate in 1/s."""
        motion, rate = self.measurement.tool.motion, self.measurement.frame_rate
        begin, end = self.start / rate, float(motion.times[-1])
        frames = np.arange(int(np.ceil((end - begin) * frame_rate - 1e-6)) + 1)
        times = frames / frame_rate
        rotations, positions = zip(*(motion.pose(float(begin + t)) for t in times), strict=True)
        quaternions = Rotation.from_matrix(np.stack(rotations)).as_quat(canonical=True)
        return ToolMotion(frames, times, np.stack(positions), np.roll(quaternions, 1, axis=1))


def strokes(measurement: Measurement, surface: float) -> list[Stroke]:
    """The measured stroke again, deeper, shallower, faster, slower, with the tool leaning to either side, and a second
    one beside the first, in the soil that the first has left.

    Left out are those that the measured stroke's bed or tool does not allow: the tool stays between the walls, a fifth
    of the soil's depth remains beneath it, and it is not pushed deeper than its own height.

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
        # The pictures are as many, at the same places of the tool.
        quick = _with(measurement, replace(motion, times=motion.times / factor))
        return replace(quick, frame_rate=measurement.frame_rate * factor)

    def leaning(angle: float) -> Measurement:
        heading = heading_of(measurement)
        bent = Rotation.from_rotvec(np.radians(angle) * np.array([-heading[1], heading[0], 0.0])) * turn
        positions = motion.positions.copy()
        positions[:, 2] += lowest - _lowest(measurement, bent)
        return _with(measurement, replace(motion, positions=positions, quaternions=np.roll(bent.as_quat(), 1, axis=1)))

    bottom, top = _room(measurement)[4:]
    factor = min(MORE, min(surface - _floor(measurement, surface), top - bottom) / max(surface - bottom, 1e-9))
    deepest = [Stroke(f"deeper by {100.0 * (factor - 1.0):.0f} %", deeper(factor))] if factor >= WORTHWHILE else []
    out = [
        Stroke(MEASURED, measurement),
        *deepest,
        Stroke("half as deep", deeper(0.5)),
        Stroke("twice as fast", faster(2.0)),
        Stroke("half as fast", faster(0.5)),
    ]
    if heading_of(measurement).any():
        out += [
            Stroke("upper edge ahead", leaning(LEAN)),
            Stroke("lower edge ahead", leaning(-LEAN)),
        ]
        # What a wall doesn't allow on one side it may on the other.
        out += [s for s in _beside(measurement) if _possible(s, measurement, surface)][:1]
    return [stroke for stroke in out if _possible(stroke, measurement, surface)]


class StrokeExperiment(PlowExperiment):
    """What the cameras, and the force sensor where there is one, would see of a stroke that has not been made.

    Cameras, and heights, have the noise that still frames show; forces are in % of the measured stroke's largest.
    Pictures are held against the photograph at rest, which cancels; heights are seen where they were measured.
    Nothing is observed until :meth:`expect` says what to expect.

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
        # One level for each camera, less by the frames that make a row.
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
        """Take features (t, s) for what will be observed: the force's noise depends on its size."""
        self.observed = table
        if self.forces is not None:
            forces = SCALE * np.sinh(table[:, len(self._sites) :] / SCALE)
            self.forces = replace(self.forces, observed=forces)
            self.sensor = side_by_side(self._placed_noise, self.forces.noise)


def _with(measurement: Measurement, motion: ToolMotion) -> Measurement:
    return replace(measurement, tool=replace(measurement.tool, motion=motion))


def _lowest(measurement: Measurement, turn: Rotation) -> FloatArray:
    """(n,) height of the tool's lowest point over its origin, m, for turns (n,)."""
    corners = np.asarray(measurement.tool.mesh.vertices, dtype=np.float64)
    return np.asarray((turn.as_matrix()[:, 2] @ corners.T).min(axis=1))


def _beside(measurement: Measurement) -> list[Stroke]:
    """The measured stroke and after it the same a tool's width to its left, or to its right where there is no room."""
    motion, rate = measurement.tool.motion, measurement.frame_rate
    heading = heading_of(measurement)
    left = np.array([-heading[1], heading[0], 0.0])
    out = []
    for name, side in (("a second one on the left", left), ("a second one on the right", -left)):
        across = _corners(measurement, 0) @ side
        aside = motion.positions[0] + float(np.ptp(across)) * side
        # Out of the soil, across, then as before: never faster than the stroke itself.
        above = np.array([*motion.positions[-1, :2], max(motion.positions[:, 2].max(), motion.positions[-1, 2])])
        over = np.array([*aside[:2], above[2]])
        way = np.stack([motion.positions[-1], above, over, aside])
        speed = float((np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / np.diff(motion.times)).max())
        legs = np.maximum(np.ceil(np.linalg.norm(np.diff(way, axis=0), axis=1) / speed * rate - 1e-9), 1.0).astype(int)
        last = int(motion.frames[-1])
        stops = last + np.cumsum(legs)
        frames = np.concatenate([motion.frames, stops, stops[-1] - motion.frames[0] + motion.frames[1:]])
        positions = np.concatenate([motion.positions, way[1:], motion.positions[1:] + (aside - motion.positions[0])])
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
    """Whether the bed and the tool allow a stroke: what the measured one does, they do."""
    walls = (*measured.bed.lower[:2], *-measured.bed.upper[:2])
    wanted = np.minimum(_room(measured), [*walls, _floor(measured, surface), surface])
    return bool(np.all(_room(stroke.measurement) >= wanted - 1e-9))


def _floor(measurement: Measurement, surface: float) -> float:
    """Least height of the tool, m."""
    return float(measurement.bed.lower[2] + UNDER * (surface - measurement.bed.lower[2]))


def _room(measurement: Measurement) -> FloatArray:
    """(6,) least x, y, -x, -y of the tool where it is lower than the bed's walls, and least heights of its lowest and
    highest points, m."""
    out = np.full(6, np.inf)
    for row in range(len(measurement.tool.motion.times)):
        points = _corners(measurement, row)
        sunk = points[points[:, 2] < measurement.bed.upper[2], :2]
        if len(sunk):
            out[:4] = np.minimum(out[:4], [*sunk.min(axis=0), *(-sunk).min(axis=0)])
        out[4:] = np.minimum(out[4:], [points[:, 2].min(), points[:, 2].max()])
    return out
