"""Setups of synthetic experiments: bed, surface, tool, motion and cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.measurement import BIN, HEAP, TRANSPARENT, Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.reconstruction.height_field import HeightField

PRE_ROLL = (-4, -3, -2, -1)
VIDEO_EVERY = 10
VIEWS = 40
FRAME_RATE = 50.0
GRAVITY = (0.0, 0.0, -9.81)
STAGES = (25, 75, 25, 75)
"""Frames of a tool's way down, forward, at rest and back."""

SURFACE_CELL = 0.005
"""Of surfaces, m."""
RELIEF = 0.09
"""Standard deviation of a wavy surface, as a share of the soil's depth."""
STEEPEST = 12.0
"""Slope of a wavy surface in degrees: well below any friction angle, so that it rests."""
WAVELENGTHS = (0.4, 1.6)
"""Of a wavy surface, as shares of the bed's narrower side."""
DEPTH_SHARE = 0.45
"""Mean depth of the soil in the bed's box, where nothing else is said."""
FOOT, FLANK = 0.05, 25.0
"""Of a heap: what its foot keeps off the bed's sides, of the narrower one, and its slopes in degrees."""
CLEARANCE = 0.004
"""Between the soil and the tool before it moves, m."""
RIM = 0.006
"""How far a bin's walls stand over the soil along them, m."""


@dataclass(frozen=True, eq=False)
class Setup:
    """An experiment before it is run.

    Attributes:
        bed: the box of soil.
        surface: the soil's surface before anything moves.
        tool: mesh, motion and friction.
        views: cameras of the photographs.
        video: fixed cameras by name.
        frames: video frames, from 0 on.
        pre_roll: video frames before that, negative.
        gravity: (3,) m/s².
        frame_rate: frames a second.
        rim: how far a bin's walls stand over the soil along them, m.
    """

    bed: Bed
    surface: HeightField
    tool: Tool
    views: tuple[Camera, ...]
    video: Mapping[str, Camera]
    frames: tuple[int, ...]
    pre_roll: tuple[int, ...] = PRE_ROLL
    gravity: FloatArray = field(default_factory=lambda: np.array(GRAVITY))
    frame_rate: float = FRAME_RATE
    rim: float = RIM

    def experiment(self) -> Measurement:
        """The experiment as the solver takes it; the pictures of its video are yet to be taken.

        The tool is the one that the set will hold, in STL's single precision: of a bed of 12.5 cells a rounded width
        makes 12 or 13, and a model of the set must have as many.
        """
        mesh = self.tool.mesh.copy()
        mesh.vertices = mesh.vertices.astype(np.float32)
        return Measurement(
            folder=Path(),
            name="synthetic",
            gravity=self.gravity,
            frame_rate=self.frame_rate,
            bed=self.bed,
            tool=replace(self.tool, mesh=mesh),
            views=(),
            video=tuple(
                Frame(camera, Path(), name, frame, frame / self.frame_rate)
                for frame in self.frames
                for name, camera in self.video.items()
            ),
        )

    def resized(self, factor: float) -> Setup:
        """The same with pictures larger or smaller by ``factor``.

        Raises:
            ParameterError: the factor leaves no picture, or one that image libraries refuse to read.
        """
        cameras = (*self.views, *self.video.values())
        if factor * factor * max(c.width * c.height for c in cameras) > (Image.MAX_IMAGE_PIXELS or math.inf):
            raise ParameterError(f"pictures {factor:g} times as large cannot be read again; give a smaller factor")
        if not (math.isfinite(factor) and factor > 0.0 and min(min(c.width, c.height) for c in cameras) * factor >= 8):
            raise ParameterError(f"pictures {factor:g} times as large are too small; give a larger factor")
        return replace(
            self,
            views=tuple(c.scaled(factor) for c in self.views),
            video={name: c.scaled(factor) for name, c in self.video.items()},
        )


def plow(seed: int = 0, *, views: int = VIEWS, depth: float | None = None, container: str = BIN) -> Setup:
    """A plate of 12 x 12 cm, tilted by 20°, lowered into a bed of 0.8 x 0.5 m, pushed, paused and drawn back.

    Args:
        seed: of the surface.
        views: how many.
        depth: mean depth of the soil in m, of a heap its highest.
        container: what holds the soil, see `measurement.Bed`.
    """
    bed = Bed(np.zeros(3), np.array([0.8, 0.5, 0.27]), 1600.0, 0.0, floor_friction=0.6, container=container)
    motion = staged_motion((0.2, 0.25, 0.21), tilt=20.0, down=0.2, push=0.2, stages=STAGES)
    tool = Tool(plate(), motion, friction=0.3)
    target = (0.4, 0.25, 0.08)
    focal = 343.12

    def camera(eye: npt.ArrayLike, aim: npt.ArrayLike, name: str = "") -> Camera:
        return Camera(320, 240, focal, focal, 160.0, 120.0, look_at(eye, aim), name=name)

    return Setup(
        bed=bed,
        surface=wavy_surface(bed, 0.12 if depth is None else depth, seed, tool),
        tool=tool,
        views=tuple(camera(eye, target) for eye in spiral(target, 0.95, views)),
        video={
            "left": camera((-0.1, -0.37, 0.6), (0.43, 0.25, 0.08), "left"),
            "right": camera((0.95, 0.85, 0.58), target, "right"),
        },
        frames=video_frames(199),
    )


def paper(*, views: int = VIEWS) -> Setup:
    """The scene of Hsiao and Kumar, turned so that z is up; its surface is a formula.

    Their x stays, their y (up) is our z, their z is our 1 - y. The plate's thickness and the frictions of tool and
    floor are not published; 1 cm and the frictions of ``plow`` are taken.
    """
    # Their cameras stand so low that walls would hide the furrow.
    bed = Bed(np.zeros(3), np.ones(3), 1000.0, wall_friction=0.0, floor_friction=0.6, container=TRANSPARENT)
    field = HeightField.over(bed.lower, bed.upper, SURFACE_CELL)
    x, z = field.points[..., 0], 1.0 - field.points[..., 1]
    waves = np.sin(math.pi * x) + 0.5 * np.sin(1.5 * math.pi * z) + 0.05 * np.sin(4.0 * math.pi * x)
    motion = staged_motion((0.1, 0.5, 0.4), tilt=30.0, down=0.1, push=0.3, stages=STAGES)
    target = (0.5, 0.5, 0.25)
    focal = 640.0 / math.tan(math.radians(0.5 * 61.93))

    def camera(eye: npt.ArrayLike, name: str = "") -> Camera:
        return Camera(1280, 720, focal, focal, 640.0, 360.0, look_at(eye, target), name=name)

    return Setup(
        bed=bed,
        surface=replace(field, height=0.22 + 0.1 * waves),
        tool=Tool(trimesh.creation.box((0.01, 0.1, 0.1)), motion, friction=0.3),
        views=tuple(camera(eye) for eye in spiral(target, 1.8, views)),
        video={"left": camera((-0.5, -0.5, 0.5), "left"), "right": camera((-0.5, 1.5, 0.5), "right")},
        frames=video_frames(199),
    )


def like(measurement: Measurement, seed: int = 0, *, views: int | None = None, depth: float | None = None) -> Setup:
    """Bed, tool, motion and cameras of an existing set, with another soil surface.

    Args:
        measurement: the set.
        seed: of the surface.
        views: how many of its views to take, evenly; all by default.
        depth: mean depth of the soil in m; by default 0.45 of the bed's box, or what leaves the tool above it.

    Raises:
        ParameterError: the tool starts too low for any soil, or there are no frames from 0 on.
    """
    if not measurement.frames:
        raise ParameterError(f"{measurement.folder}: its video has no frames from 0 on; there is nothing to simulate")
    bed, tool = measurement.bed, replace(measurement.tool, force=None, force_path=None, mesh_path=None)
    if depth is None:
        start = float(tool.bounds(0.0)[0][2] - bed.lower[2])
        inside = bool(tool.touches(bed.lower, np.array([*bed.upper[:2], np.inf]))[0])
        depth = DEPTH_SHARE * float(bed.extents[2])
        depth = min(depth, start / (1.0 + 2.0 * RELIEF)) if inside else depth
        if depth <= 0.0:
            raise ParameterError("the tool starts on or below the bed's floor; no soil can lie under it")
    cameras = tuple(frame.camera for frame in measurement.views)
    if views is not None and views < len(cameras):
        cameras = tuple(cameras[round(i)] for i in np.linspace(0, len(cameras) - 1, views))
    return Setup(
        bed=bed,
        surface=wavy_surface(bed, depth, seed, tool),
        tool=tool,
        gravity=measurement.gravity,
        frame_rate=measurement.frame_rate,
        views=cameras,
        video={name: replace(camera, name=name) for name, camera in measurement.cameras.items()},
        frames=measurement.frames,
        pre_roll=tuple(sorted({f.frame for f in measurement.pre_roll if f.frame is not None})),
    )


def plate(width: float = 0.12) -> trimesh.Trimesh:
    """12 mm thick along x, ``width`` m wide along y, 12 cm high."""
    return trimesh.creation.box((0.012, width, 0.12))


def drum(width: float = 0.12, radius: float = 0.06) -> trimesh.Trimesh:
    """A wheel-like cylinder about y, lengths in m."""
    return trimesh.creation.cylinder(radius, width, sections=48).apply_transform(
        trimesh.transformations.rotation_matrix(0.5 * math.pi, (1.0, 0.0, 0.0))
    )


def staged_motion(
    start: Sequence[float],
    *,
    tilt: float,
    down: float,
    push: float,
    stages: Sequence[int],
    rate: float = FRAME_RATE,
    roll: float = 0.0,
) -> ToolMotion:
    """Down, along +x, a pause, back.

    Args:
        start: (3,) m.
        tilt: about y, degrees.
        down, push: speeds in m/s.
        stages: frames of each.
        rate: frames a second.
        roll: turn about y in radians a metre along +x: 1 / radius for a wheel that doesn't slip.
    """
    velocities = np.array([[0.0, 0.0, -down], [push, 0.0, 0.0], [0.0, 0.0, 0.0], [-push, 0.0, 0.0]])
    steps = np.repeat(velocities, stages, axis=0) / rate
    positions = np.concatenate([[start], np.asarray(start) + np.cumsum(steps, axis=0)])
    half = 0.5 * (math.radians(tilt) + roll * (positions[:, 0] - positions[0, 0]))
    frames, none = np.arange(len(positions)), np.zeros(len(positions))
    return ToolMotion(frames, frames / rate, positions, np.stack([np.cos(half), none, np.sin(half), none], axis=1))


def wavy_surface(bed: Bed, depth: float, seed: int, tool: Tool) -> HeightField:
    """`waves`, of a heap cut down to one, that are clear of the tool where it starts.

    Raises:
        ParameterError: a depth that does not fit the bed, or soil that would reach the tool before it moves.
    """
    field = waves(bed, depth, seed)
    if bed.container == HEAP:
        field = heaped(field, bed)
    low, high = tool.bounds(0.0)
    reach = highest(field, low, high)
    if reach + CLEARANCE > low[2]:
        raise ParameterError(
            f"the soil would reach {reach:.3f} m where the tool starts at {low[2]:.3f} m; "
            f"give --depth less than {depth:.3f} m"
        )
    return field


def waves(bed: Bed, depth: float, seed: int) -> HeightField:
    """Waves drawn by seed around a mean ``depth`` in m over the bed's floor.

    Raises:
        ParameterError: a depth that does not fit the bed.
    """
    if not 0.0 < depth < bed.extents[2]:
        raise ParameterError(
            f"soil {depth:g} m deep does not fit a bed {bed.extents[2]:g} m high; give --depth a value below that"
        )
    generator = np.random.default_rng([seed, 0])
    width = float(bed.extents[:2].min())
    field = HeightField.over(bed.lower, bed.upper, min(SURFACE_CELL, 0.02 * width))
    place = field.points[..., :2]
    relief = np.zeros(field.height.shape)
    for _ in range(16):
        length = width * math.exp(generator.uniform(*np.log(WAVELENGTHS)))
        turn, phase = generator.uniform(0.0, 2.0 * math.pi, 2)
        along = place @ np.array([math.cos(turn), math.sin(turn)])
        relief += length * np.cos(2.0 * math.pi / length * along + phase)
    relief -= relief.mean()
    slope = np.hypot(*np.gradient(relief, *field.cell[::-1])).max()
    scale = min(RELIEF * depth / relief.std(), math.tan(math.radians(STEEPEST)) / slope)
    return replace(field, height=np.minimum(bed.lower[2] + depth + scale * relief, bed.upper[2]))


def heaped(surface: HeightField, bed: Bed) -> HeightField:
    """A surface cut down to a heap whose foot is clear of the bed's sides, with slopes at which soil rests."""
    place, foot = surface.points[..., :2], FOOT * float(bed.extents[:2].min())
    inside = np.minimum(place - bed.lower[:2], bed.upper[:2] - place).min(axis=-1) - foot
    slope = bed.lower[2] + math.tan(math.radians(FLANK)) * np.maximum(inside, 0.0)
    return replace(surface, height=np.minimum(surface.height, slope))


def plane(bed: Bed, depth: float, slope: float = 0.0, towards: float = 0.0) -> HeightField:
    """A level or sloping surface.

    Args:
        bed: its box.
        depth: of the soil in the bed's middle, m.
        slope: degrees.
        towards: where it rises, degrees from +x to +y.
    """
    field = HeightField.over(bed.lower, bed.upper, SURFACE_CELL)
    turn, middle = math.radians(towards), bed.lower[:2] + 0.5 * bed.extents[:2]
    along = (field.points[..., :2] - middle) @ np.array([math.cos(turn), math.sin(turn)])
    return replace(field, height=bed.lower[2] + depth + math.tan(math.radians(slope)) * along)


def highest(surface: HeightField, low: FloatArray, high: FloatArray) -> float:
    """Height in m of the surface's highest cell whose centre lies between two corners in plan; -inf where none does."""
    x, y = surface.points[..., 0], surface.points[..., 1]
    under = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    return float(surface.height[under].max(initial=-np.inf))


def spiral(target: Sequence[float], distance: float, count: int) -> list[FloatArray]:
    """Places (3,) around and above a target, from 29° to 79° high, turning by the golden angle."""
    golden = math.pi * (3.0 - math.sqrt(5.0))
    out = []
    for k in range(count):
        rise = math.radians(28.65 + 50.0 * k / max(count - 1, 1))
        flat = distance * math.cos(rise)
        offset = [flat * math.cos(k * golden), flat * math.sin(k * golden), distance * math.sin(rise)]
        out.append(np.asarray(target) + offset)
    return out


def video_frames(last: int) -> tuple[int, ...]:
    """Every tenth frame and the last."""
    return tuple(sorted({*range(0, last, VIDEO_EVERY), last}))


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike) -> FloatArray:
    """Camera to world (4, 4), OpenGL axes, with the world's z up in the picture; not for looking straight down."""
    back = np.subtract(eye, target)
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, np.asarray(eye, dtype=np.float64)], axis=1)
    return matrix
