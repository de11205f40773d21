"""A measurement set: a folder of photographs, video frames, tool mesh and motion. Read-only."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.files import check_paths
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.fields import Fields, inside
from splatsoil.measurement.frames import Frame, read_transforms
from splatsoil.measurement.heights import HeightMaps, depth_points
from splatsoil.measurement.motion import ToolMotion
from splatsoil.measurement.tool import DEFAULT_FRICTION, Tool, read_force, read_mesh

FORMAT = "splatsoil-measurement/1"
EXPERIMENT = "experiment.json"
MAKING = "; splatsoil import makes one of photographs and videos"
FIELDS = ("format", "name", "up", "gravity", "frame_rate", "bed", "tool", "views", "video", "heights")
BED_FIELDS = ("lower", "upper", "density", "container", "wall_friction", "floor_friction")
BIN, TRANSPARENT, OPEN, HEAP = "bin", "transparent", "open", "heap"
CONTAINERS = (BIN, TRANSPARENT, OPEN, HEAP)
TOOL_FIELDS = ("mesh", "motion", "force", "friction")
FRAME_RATES = (1e-3, 1e6)

# What a laboratory or a field could hold; beyond it a unit is wrong (millimetres, g/cm³).
_SMALLEST_BED, _LARGEST_BED = 0.01, 50.0
_FARTHEST_BED = 1000.0  # from the origin: positions are single precision in places
_DENSITIES = (100.0, 20_000.0)
_GRAVITIES = (1e-3, 300.0)
_FAR_CAMERA = 100.0  # in diagonals of the bed
_DEPTHS = 10_000  # pixels of a depth map that are asked whether they show the bed
_AROUND = 0.2  # of the bed's narrower side: how much beyond it is simulated where nothing stands at its sides
_SLACK = 0.1  # of the bed: what its floor and walls, which the tool can't pass, may be off by
_SMALL_TOOL = 1e5  # cubes of the tool's width in the bed; cells are a fraction of it, and no memory holds as many
_FASTEST_TOOL = 100.0  # m/s, the speed of sound in loose soil: nothing is pushed through it faster


@dataclass(frozen=True, eq=False)
class Bed:
    """The box of soil.

    Attributes:
        lower: (3,) lowest corner in metres; its z is the floor.
        upper: (3,) highest corner in metres; its z is the top of the space the soil may use, not the soil's surface.
        density: bulk density in kg/m³.
        wall_friction: Coulomb coefficient at the box's sides.
        floor_friction: Coulomb coefficient at its floor.
        container: what holds the soil, one of ``CONTAINERS``: a bin of opaque walls, transparent walls, nothing because
            soil goes on beyond the box (``open``), or nothing because it lies on a floor as a heap. None if it is not
            said: a bin, unless photographs show soil at its sides.
    """

    lower: FloatArray
    upper: FloatArray
    density: float
    wall_friction: float = 0.0
    floor_friction: float = 0.6
    container: str | None = None

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            corner = np.array(getattr(self, name), dtype=np.float64).reshape(3)
            corner.setflags(write=False)
            object.__setattr__(self, name, corner)

    @property
    def extents(self) -> FloatArray:
        """Lengths (3,) of the box's edges in metres."""
        return self.upper - self.lower

    @property
    def domain(self) -> Bed:
        """What of the world is simulated: the box, or where nothing stands at its sides, more around it for soil to go
        on or to run out to."""
        if self.container not in (OPEN, HEAP):
            return self
        margin = _AROUND * float(self.extents[:2].min()) * np.array([1.0, 1.0, 0.0])
        return replace(self, lower=self.lower - margin, upper=self.upper + margin)

    @property
    def corners(self) -> FloatArray:
        """The box's corners (8, 3) in metres."""
        pick = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
        return np.where(pick == 1, self.upper, self.lower)

    def beyond(self, points: FloatArray) -> FloatArray:
        """How far points (..., 2 or more) lie outside of the box's sides in plan, metres (...); negative inside."""
        xy = points[..., :2]
        return np.maximum(self.lower[:2] - xy, xy - self.upper[:2]).max(axis=-1)


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement set, checked.

    Attributes:
        folder: where it lies, an absolute path; nothing in it is ever modified.
        name: what it calls itself.
        gravity: (3,) m/s².
        frame_rate: frames a second of the tool motion's and the video's numbering.
        bed: the box of soil.
        tool: the tool and its motion.
        views: photographs before anything moves, by their names.
        video: the fixed cameras' frames, pre-roll included, by number and camera.
        assumed: fields that ``experiment.json`` leaves out, and the values taken for them.
        sources: the set's own files; ``experiment.json`` stands for a list of pictures that isn't there.
        heights: grids of heights; None if there are none.
    """

    folder: Path
    name: str
    gravity: FloatArray
    frame_rate: float
    bed: Bed
    tool: Tool
    views: tuple[Frame, ...]
    video: tuple[Frame, ...]
    assumed: dict[str, float] = field(default_factory=dict)
    sources: tuple[Path, ...] = ()
    heights: HeightMaps | None = None

    @classmethod
    def load(cls, folder: str | Path) -> Measurement:
        """Read a set and check all of it, every image included.

        Raises:
            MeasurementError: at the first thing that is wrong, naming the file and the field.
        """
        root = Path(folder).absolute()  # images are read later, perhaps from another working folder
        file = root / EXPERIMENT
        check_paths([root])
        if not root.is_dir():
            fault = "not a folder" if root.exists() else "no such folder"
            raise MeasurementError(f"{fault}; give the folder of a measurement set{MAKING}", file=root)
        if not file.is_file():
            raise MeasurementError(f"no {EXPERIMENT} in this folder; it is no measurement set{MAKING}", file=file)
        fields = Fields.read(inside(EXPERIMENT, root, root, file, ""))
        fields.check_names(FIELDS)
        tag = fields.text("format")
        if tag != FORMAT:
            fields.fail("format", f"{tag!r} is not {FORMAT!r}; this is another format or another version of it")
        if fields.has("up") and fields.text("up") != "z":
            fields.fail("up", "only 'z' is known; turn the world so that z is up")
        assumed: dict[str, float] = {}
        bed = _read_bed(fields.child("bed"), assumed)
        tool_fields = fields.child("tool")
        tool = _read_tool(tool_fields, root, assumed)
        heights = HeightMaps.read(fields.path("heights", root, root), root) if fields.has("heights") else None
        # Heights stand in for a video, and their first grid for views where no pictures are to be drawn.
        absent = {key for key in ("views", "video") if heights and not (fields.has(key) or fields.has("video"))}
        transforms = {key: file if key in absent else fields.path(key, root, root) for key in ("views", "video")}
        views, video = (
            () if key in absent else read_transforms(transforms[key], root, video=key == "video")
            for key in ("views", "video")
        )
        measurement = cls(
            folder=root,
            name=fields.name("name", root.resolve().name),
            gravity=_read_gravity(fields),
            frame_rate=fields.number("frame_rate", *FRAME_RATES, hint="it is in frames a second"),
            bed=bed,
            tool=tool,
            views=views,
            video=video,
            assumed=assumed,
            sources=(file, *transforms.values(), tool_fields.path("motion", root, root)),
            heights=heights,
        )
        _check_clocks(measurement)
        _check_tool(measurement)
        _check_force(measurement)
        _check_views(measurement)
        _check_cameras(measurement)
        _check_heights(measurement)
        # Sums are taken in the frames' order: it must not be that in which a file happens to list them.
        return replace(
            measurement,
            views=tuple(sorted(measurement.views, key=lambda f: f.path.relative_to(root).as_posix())),
            video=tuple(sorted(measurement.video, key=lambda f: (f.frame, f.camera_name))),
        )

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) over names and contents of the set's files; ``truth*`` and strangers don't count."""
        digest = hashlib.sha256()
        for path in sorted(set(self._files()), key=lambda p: p.relative_to(self.folder).as_posix()):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(self.folder).as_posix()}\0{len(content)}\0".encode())
            digest.update(content)
        return digest.hexdigest()

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """The video's cameras by name."""
        out: dict[str, Camera] = {}
        for frame in self.video:
            out.setdefault(frame.camera_name, frame.camera)
        return out

    @cached_property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers of the video, or without one of the heights, from 0 on, sorted."""
        numbers = {f.frame for f in self.video} if self.video else set(self.height_frames)
        return tuple(sorted(n for n in numbers if n is not None and n >= 0))

    @cached_property
    def height_frames(self) -> tuple[int, ...]:
        """Frame numbers, sorted, at which grids of heights, or else depth maps of the fixed cameras, show the soil."""
        if self.heights is not None:
            return tuple(self.heights.grids)
        return tuple(sorted({f.frame for f in self.video if f.frame is not None and f.depth_path is not None}))

    def surface_points(self, frame: int) -> FloatArray:
        """(n, 3) points in m that these show at a frame of ``height_frames``: soil, tool and all."""
        if self.heights is not None:
            return self.heights.points(frame)
        return np.concatenate([depth_points(f) for f in self.video if f.frame == frame])

    @cached_property
    def pre_roll(self) -> tuple[Frame, ...]:
        """Video frames with negative numbers, in which nothing moves."""
        return tuple(f for f in self.video if f.frame is not None and f.frame < 0)

    def video_frame(self, camera: str, frame: int) -> Frame:
        """The video frame of a camera; MeasurementError when there is none."""
        for candidate in self.video:
            if candidate.camera_name == camera and candidate.frame == frame:
                return candidate
        known = f"cameras are {', '.join(self.cameras)}, frames {self.frames[:3]} … {self.frames[-1:]}"
        raise MeasurementError(f"no frame {frame} of camera {camera!r}; {known}", file=self.folder)

    def _files(self) -> Iterator[Path]:
        yield from self.sources
        yield from (p for p in (self.tool.mesh_path, self.tool.force_path) if p is not None)
        yield from () if self.heights is None else self.heights.paths
        for frame in (*self.views, *self.video):
            yield from (p for p in (frame.path, frame.mask_path, frame.depth_path) if p is not None)


def _read_bed(fields: Fields, assumed: dict[str, float]) -> Bed:
    fields.check_names(BED_FIELDS)
    lower, upper = fields.vector("lower", 3), fields.vector("upper", 3)
    for axis, (low, high) in enumerate(zip(lower, upper, strict=True)):
        size = high - low
        if size <= 0.0:
            fields.fail(f"upper[{axis}]", f"{high:g} is not above lower[{axis}] = {low:g}")
        if not _SMALLEST_BED <= size <= _LARGEST_BED:
            fields.fail(
                f"upper[{axis}]",
                f"the bed is {size:g} m along {'xyz'[axis]}, outside [{_SMALLEST_BED:g}, {_LARGEST_BED:g}] m; "
                "lengths are in metres",
            )
        if max(abs(low), abs(high)) > _FARTHEST_BED:
            fields.fail(f"upper[{axis}]", f"the bed lies {abs(high):g} m from the origin; move the origin to it")
    return Bed(
        lower,
        upper,
        density=fields.number("density", *_DENSITIES, hint="it is the bulk density in kg/m³"),
        wall_friction=_read_friction(fields, "wall_friction", 0.0, assumed),
        floor_friction=_read_friction(fields, "floor_friction", 0.6, assumed),
        container=_read_container(fields),
    )


def _read_container(fields: Fields) -> str | None:
    if not fields.has("container"):
        return None
    container = fields.text("container")
    if container not in CONTAINERS:
        fields.fail("container", f"{container[:40]!r} is unknown; known are {', '.join(CONTAINERS)}")
    return container


def _read_friction(fields: Fields, key: str, default: float, assumed: dict[str, float]) -> float:
    if not fields.has(key):
        assumed[fields.path_of(key)] = default
    return fields.number(key, 0.0, 10.0, default=default, hint="it is a coefficient of friction, not an angle")


def _read_gravity(fields: Fields) -> FloatArray:
    gravity = fields.vector("gravity", 3)
    size = float(np.linalg.norm(gravity))
    if not _GRAVITIES[0] <= size <= _GRAVITIES[1]:
        fields.fail(
            "gravity", f"{size:g} m/s² is no gravity that soil is known to stand in; on Earth it is 0, 0, -9.81"
        )
    if gravity[2] > -0.5 * size:
        fields.fail("gravity", "it does not point down; z is up, so that its third number is the large, negative one")
    return gravity


def _read_tool(fields: Fields, root: Path, assumed: dict[str, float]) -> Tool:
    fields.check_names(TOOL_FIELDS)
    if fields.has("give"):
        fields.fail("give", "soil does not give way to the tool; remove this field")
    mesh_path = fields.path("mesh", root, root)
    motion_path = fields.path("motion", root, root)
    force_path = fields.path("force", root, root) if fields.has("force") else None
    return Tool(
        mesh=read_mesh(mesh_path),
        motion=ToolMotion.read(motion_path),
        friction=_read_friction(fields, "friction", DEFAULT_FRICTION, assumed),
        force=None if force_path is None else read_force(force_path),
        mesh_path=mesh_path,
        force_path=force_path,
    )


def _check_clocks(measurement: Measurement) -> None:
    """Whether times are frame numbers by the frame rate, as all that moves is taken to be, within a frame."""
    rate, motion = measurement.frame_rate, measurement.tool.motion
    experiment, _, video, table = measurement.sources
    off: list[tuple[Path, str, str]] = []
    clocks = (
        (table, [(f"time, frame {n}", int(n), float(t)) for n, t in zip(motion.frames, motion.times, strict=True)]),
        (video, [(f"frames[{i}].time", f.frame or 0, f.time or 0.0) for i, f in enumerate(measurement.video)]),
    )
    for file, rows in clocks:
        if not rows:
            continue
        field, number, time = max(rows, key=lambda row: abs(row[2] - row[1] / rate))
        if abs(time - number / rate) > 1.001 / rate:
            there = f"frame {number} is at {time:.10g} s in {file.name}"
            off.append((file, field, f"{there}, where {rate:g} frames a second put it at {number / rate:g} s"))
    if off:
        # What both contradict is itself at fault.
        file, field = off[0][:2] if len(off) == 1 else (experiment, "frame_rate")
        raise MeasurementError(f"{off[0][2]}; times are in seconds, 0 at frame 0", file=file, field=field)


def _check_tool(measurement: Measurement) -> None:
    """The tool's size, path and speed against the bed's and the soil's."""
    bed, tool, motion = measurement.bed, measurement.tool, measurement.sources[3]
    width = float(np.sort(tool.mesh.extents)[1])
    if float(np.prod(bed.extents)) > _SMALL_TOOL * width**3:
        raise MeasurementError(
            f"the tool is {width:g} m wide, too small a part of the bed for cells that show it; meshes are in metres",
            file=tool.mesh_path,
            field="vertices",
        )
    if not tool.touches(bed.lower, bed.upper).any():
        raise MeasurementError(
            "the tool never touches the soil's box: it is outside of the bed for the whole run; "
            "are motion and bed in the same world, in metres?",
            file=motion,
            field="x,y,z",
        )
    for number, time in zip(tool.motion.frames, tool.motion.times, strict=True):
        passes = _passes(tool, float(time), bed)
        if passes:
            size = float(np.max(tool.mesh.extents))
            large = size > bed.extents[2]
            raise MeasurementError(
                f"the tool, {size:g} m long, passes the bed's {passes} in frame {number}; meshes and motions are in"
                " metres",
                file=tool.mesh_path if large else motion,
                field="vertices" if large else "x,y,z",
            )
    if not (np.ptp(tool.motion.positions, axis=0).any() or np.ptp(tool.motion.quaternions, axis=0).any()):
        raise MeasurementError("the tool never moves, so that nothing can be fitted", file=motion, field="x,y,z")
    ways = np.linalg.norm(np.diff(tool.motion.positions, axis=0), axis=1)
    fastest = float((ways / np.diff(tool.motion.times)).max())
    if fastest > _FASTEST_TOOL:
        raise MeasurementError(
            f"the tool moves at {fastest:g} m/s, faster than sound in soil; times are in seconds, positions in metres",
            file=motion,
            field="time",
        )


def _check_force(measurement: Measurement) -> None:
    """Whether the force is one that soil has: it is passive, and takes energy from the tool.

    Of a tool that turns the torque's part isn't known.
    """
    tool, motion = measurement.tool, measurement.tool.motion
    if tool.force is None or np.ptp(motion.quaternions, axis=0).max() > 1e-6:
        return
    ends = tool.force[:, :1] - [0.0, 1.0]
    way = np.stack([np.interp(ends, motion.frames, axis) for axis in motion.positions.T], axis=-1)
    work = np.sum((way[:, 0] - way[:, 1]) * tool.force[:, 2:], axis=1)
    # Noise by itself does and takes alike.
    if work.sum() > 0.5 * np.abs(work).sum():
        raise MeasurementError(
            f"the force does {work.sum():.3g} J of work on the tool, where soil resists; it is the soil's on the tool,"
            " in world axes",
            file=tool.force_path,
            field="fx,fy,fz",
        )


def _passes(tool: Tool, time: float, bed: Bed) -> str:
    """Whether the tool is under the bed's floor at ``time``, or beyond two opposite walls at once; empty if neither.

    One wall it may come in through: not every bed has them.
    """
    rotation, position = tool.motion.pose(time)
    points = tool.mesh.vertices @ rotation.T + position
    slack = _SLACK * bed.extents
    under = _level(points, tool.mesh.edges_unique, float(bed.lower[2] - slack[2]))
    if len(under) and np.all(under.min(axis=0) < bed.upper[:2]) and np.all(under.max(axis=0) > bed.lower[:2]):
        return "floor"
    inside = points[(points[:, 2] > bed.lower[2]) & (points[:, 2] < bed.upper[2]), :2]
    ends = [_level(points, tool.mesh.edges_unique, float(z)) for z in (bed.lower[2], bed.upper[2])]
    within = np.concatenate([inside, *ends])
    if len(within) == 0:
        return ""
    low, high = within.min(axis=0), within.max(axis=0)
    over = (low < (bed.lower - slack)[:2]) & (high > (bed.upper + slack)[:2])
    return "walls" if over.any() and np.all(low < bed.upper[:2]) and np.all(high > bed.lower[:2]) else ""


def _level(points: FloatArray, edges: npt.NDArray[np.int64], z: float) -> FloatArray:
    """Where edges between points (n, 3) cross a level: (m, 2) x and y."""
    start, end = points[edges[:, 0]], points[edges[:, 1]]
    crosses = (start[:, 2] < z) != (end[:, 2] < z)
    start, end = start[crosses], end[crosses]
    share = (z - start[:, 2]) / (end[:, 2] - start[:, 2])
    return (start + share[:, None] * (end - start))[:, :2]


def _check_views(measurement: Measurement) -> None:
    """Whether views were taken before the tool moved, so far as the video shows them, too."""
    later = {frame.path.resolve(): frame.frame for frame in measurement.video if (frame.frame or 0) > 0}
    for i, view in enumerate(measurement.views):
        number = later.get(view.path.resolve())
        if number is not None:
            raise MeasurementError(
                f"it is frame {number} of the video; views are photographs before the tool moves",
                file=measurement.sources[1],
                field=f"frames[{i}].file_path",
            )


def _check_cameras(measurement: Measurement) -> None:
    """The cameras' places and directions against the bed."""
    bed = measurement.bed
    centre = 0.5 * (bed.lower + bed.upper)
    diagonal = float(np.linalg.norm(bed.extents))
    for file, frames in zip(measurement.sources[1:3], (measurement.views, measurement.video), strict=True):
        for i, frame in enumerate(frames):
            distance = float(np.linalg.norm(frame.camera.position - centre))
            if distance > _FAR_CAMERA * diagonal:
                raise MeasurementError(
                    f"the camera is {distance:g} m from a bed of {diagonal:.2g} m; positions are in metres",
                    file=file,
                    field=f"frames[{i}].transform_matrix",
                )
            if frame.depth_path is None or not sees(frame, bed):
                continue
            points = depth_points(frame, 1 + frame.camera.width * frame.camera.height // _DEPTHS)
            within = (points > bed.lower - _SLACK * bed.extents) & (points < bed.upper + _SLACK * bed.extents)
            if not within.all(axis=1).any():
                raise MeasurementError(
                    f"no depth is one of the bed, which is {distance:.2g} m away; depths are along the camera's axis,"
                    " whole numbers in millimetres, floating-point ones in metres",
                    file=frame.depth_path,
                    field=f"frames[{i}].depth_file_path",
                )
        if frames and not any(sees(frame, bed) for frame in frames):
            raise MeasurementError(
                "no camera looks at the soil's box; matrices are camera to world, cameras look down their -z axis, and"
                " masks are black where pixels are ignored",
                file=file,
                field="frames[0].transform_matrix",
            )


def _check_heights(measurement: Measurement) -> None:
    """Whether grids of heights show the bed, also before anything has moved."""
    heights, frames = measurement.heights, measurement.frames
    if heights is None:
        return
    heights.check(measurement.bed.lower, measurement.bed.upper, _SLACK)
    if frames and frames[0] not in heights.grids:
        raise MeasurementError(
            f"there is no grid of frame {frames[0]}, since which changes are compared", file=heights.paths[0]
        )


def sees(frame: Frame, bed: Bed) -> bool:
    """Whether any of a grid of points of the bed's box falls into the image, where its mask allows it."""
    camera, mask = frame.camera, frame.mask()
    steps = np.linspace(0.0, 1.0, 9)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    pixels, depth = camera.project(bed.lower + grid * bed.extents)
    with np.errstate(invalid="ignore"):
        within = (pixels >= 0.0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    column, row = pixels[within & (depth > 0.0)].astype(int).T
    return bool(column.size and (mask is None or mask[row, column].any()))
