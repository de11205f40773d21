"""A measurement set, or parts of one, out of what others recorded: all of it or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.importing.clock import LOOKED_AT, WIDTH, ClockOffset, Footage, clock_offset, moving
from splatsoil.importing.options import ImportOptions
from splatsoil.importing.robot import Grid, metres, read_force, read_motion, read_rigid, resampled
from splatsoil.importing.similarity import (
    by_known_points,
    by_scale,
    distance_scale,
    moved,
    read_marked,
    read_points,
)
from splatsoil.importing.source import Source, find_image, read_source
from splatsoil.importing.tags import TagMotion, ToolTags, find_tool_tags, read_tool_tags, tag_scale
from splatsoil.importing.video import Video
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.fields import Fields
from splatsoil.measurement.frames import read_transforms, undistorted
from splatsoil.measurement.measurement import EXPERIMENT, FORMAT, FRAME_RATES, Measurement
from splatsoil.measurement.motion import MOTION_COLUMNS, ToolMotion
from splatsoil.measurement.tool import FORCE_COLUMNS, read_mesh
from splatsoil.measurement.writer import Picture, whole_folder, write_frames, write_json, write_table

PRE_ROLL = 8
"""Frames before anything moves that are kept of a video, at most: they measure the noise."""


@dataclass(frozen=True)
class Imported:
    """What was made.

    Attributes:
        kind: of the source.
        views: photographs.
        similarity: (4, 4) from the source's world to the set's.
        marks: root mean square of the marked points' distance from their pixels, px.
        points: the same of the known points, m; None without any.
        frames: of the video, by camera.
        clock: of the video, if it was estimated from the images.
        tags: the tool's motion by its tags, where that is the one.
        missing: parts that a set needs and this lacks.
    """

    kind: str
    views: int
    similarity: FloatArray
    marks: float
    points: float | None
    frames: dict[str, int]
    clock: ClockOffset | None
    tags: TagMotion | None
    missing: tuple[str, ...]

    @property
    def scale(self) -> float:
        """Metres for each unit of the source's world."""
        return float(np.cbrt(np.linalg.det(self.similarity[:3, :3])))


Report = Callable[[str, float], None]


def import_set(options: ImportOptions, report: Report) -> Imported:
    """Write the new folder: views, and whatever else of a set is given; with an experiment.json, a whole set, checked.

    ``report`` is called with what is being done, and the share of it that is done.

    Raises:
        MeasurementError: something is missing or faulty; nothing is written.
        ParameterError: a package is missing, or an option makes no sense.
    """
    if options.video_every < 1:
        raise ParameterError(f"--video-every: must be 1 or more, not {options.video_every}")
    if not np.isfinite(options.clock_offset or 0.0):
        raise ParameterError(f"--clock-offset: must be a number of seconds, not {options.clock_offset}")
    with whole_folder(options.out) as root:
        return _filled(root, options, report)


def _filled(root: Path, options: ImportOptions, report: Report) -> Imported:
    report("posing the photographs" if options.sfm else "reading the views", 0.0)
    found = read_source(options.source, options.images, sfm=options.sfm)
    stills = {name: find_image(found.frames, image) for name, (_, image) in options.cameras.items()}
    aside = {still.path for still in stills.values()}
    photographs = [frame for frame in found.frames if frame.path not in aside]
    if not photographs:
        raise MeasurementError(
            "no view is left: all photographs give the video's cameras their poses", file=options.source
        )
    _scale_option(options)  # before videos are read
    videos = {name: _opened(path, image, stills[name].camera) for name, (path, image) in options.cameras.items()}
    tool_tags = None
    if options.motion_tags is not None:
        if options.motion is not None or not videos:
            raise MeasurementError(f"--motion-tags: {'leave --motion out' if videos else 'needs --video'}")
        report("finding the tool's tags", 0.05)
        posed = {name: (video, stills[name].camera) for name, video in videos.items()}
        tool_tags = find_tool_tags(photographs, posed, read_tool_tags(options.motion_tags))
    similarity, marks, left = _similarity(found, options, tool_tags)
    views = [moved(frame, similarity) for frame in photographs]
    cameras = {name: moved(still, similarity).camera for name, still in stills.items()}
    mesh = None if options.tool is None else _mesh(*options.tool)
    to_world, to_flange = read_rigid(options.robot_to_world), read_rigid(options.mesh_to_flange)
    motion = None if options.motion is None else read_motion(*options.motion, to_world, to_flange)
    tags = None
    if tool_tags is not None:
        tags = tool_tags.motion(similarity)
        # What follows is on the clock of the force, as a robot's motion is.
        motion = replace(tags.motion, times=tags.motion.times + (options.clock_offset or 0.0))
    experiment = Fields({}, options.out) if options.experiment is None else Fields.read(options.experiment)
    rate = _rate(videos, experiment, motion)

    clock, offset = None, options.clock_offset or 0.0
    if options.needs_clock and motion is not None:
        if mesh is None:
            raise MeasurementError(
                "the clock's offset is estimated with the tool's mesh; give --tool or --clock-offset"
            )
        report("finding the clock's offset", 0.1)
        clock = clock_offset([_footage(video, cameras[name]) for name, video in videos.items()], mesh, motion)
        offset = clock.seconds
    # The video's frame that is the last one before the tool moves is number 0.
    zero = 0 if motion is None or not videos else int(np.floor((moving(motion)[0] - offset) * rate + 1e-6))
    grid = Grid(rate, zero / rate + offset)

    write_frames(root / "views", views, video=False)
    last = None
    if mesh is not None:
        mesh.export(root / "tool.stl")
    if motion is not None:
        steps = resampled(motion, grid)
        write_table(root / "tool_motion.csv", MOTION_COLUMNS, steps.table)
        last = int(steps.frames[-1])
    if options.force is not None:
        write_table(root / "tool_force.csv", FORCE_COLUMNS, read_force(options.force, to_world, grid))
    wanted = {name: _wanted(video, zero, last, options.video_every) for name, video in videos.items()}

    def filmed() -> Iterator[Picture]:
        for k, (name, video) in enumerate(videos.items()):
            report(f"video {name}", 0.4 + 0.5 * k / len(videos))
            camera = replace(cameras[name], name=name)
            for number, image in video.pictures(wanted[name]):
                yield Picture(camera, image, number - zero, (number - zero) / video.rate)

    if videos:
        write_frames(root / "video", filmed(), video=True)
    report("checking", 0.9)
    missing = _finish(root, experiment.data, rate)
    frames = {name: len(numbers) for name, numbers in wanted.items()}
    return Imported(found.kind, len(views), similarity, marks, left, frames, clock, tags, missing)


def _scale_option(options: ImportOptions) -> str:
    """The option that determines the scale: --motion-tags if there is no other."""
    names = ("scale", "distance", "tags", "known")
    given = [f"--{name}" for name in names if getattr(options, name) is not None]
    if not given and options.motion_tags is not None:
        given = ["--motion-tags"]
    if len(given) != 1:
        what = f"{' and '.join(given)} contradict each other" if given else "no scale is given"
        raise MeasurementError(f"{what}; give one of --scale, --distance, --tags, --known and --motion-tags")
    return given[0]


def _similarity(
    source: Source, options: ImportOptions, tool_tags: ToolTags | None
) -> tuple[FloatArray, float, float | None]:
    """From the source's world to the set's; errors of marks in px, of known points in m."""
    way = _scale_option(options)
    if way in ("--distance", "--known") and options.points is None:
        raise MeasurementError(f"{way}: needs --points, the places of these points in the source")
    marked = None if options.points is None else read_marked(options.points, source.frames)
    if options.known is not None:
        if options.up is not None:
            raise MeasurementError("--up: the known points determine it; leave it out")
        assert marked is not None
        similarity, left = by_known_points(marked.places, read_points(options.known))
        return similarity, marked.error, left
    if options.up is None and not source.has_up:
        raise MeasurementError(f"{source.kind} does not define which way is up; give --up or --known")
    error = 0.0 if marked is None else marked.error
    if options.tags is not None:
        scale, error = tag_scale(source.frames, options.tags)
    elif options.distance is not None:
        assert marked is not None
        scale = distance_scale(marked.places, *options.distance)
    elif options.scale is not None:
        scale = options.scale
    else:
        assert tool_tags is not None
        scale, error = tool_tags.scale()
    return by_scale(scale, options.up or (0.0, 0.0, 1.0)), error, None


def _mesh(file: Path, unit: str) -> Any:
    mesh = read_mesh(file)
    told = mesh.units is not None
    if told and unit != "m":
        raise MeasurementError(f"the file has its own unit and was read in metres; give m, not {unit}", file=file)
    return mesh if told else mesh.apply_scale(metres(unit, file))


def _opened(path: Path, image: str, camera: Camera) -> Video:
    video = Video.open(path)
    if video.size != (camera.width, camera.height):
        raise MeasurementError(
            f"its frames have {video.size[0]} x {video.size[1]} pixels, {image} has {camera.width} x {camera.height}",
            file=path,
        )
    return video


def _rate(videos: dict[str, Video], experiment: Fields, motion: ToolMotion | None) -> float:
    """The set's frames a second: the videos', or the experiment's."""
    rates = {video.rate for video in videos.values()}
    if experiment.has("frame_rate"):
        rates.add(experiment.number("frame_rate", *FRAME_RATES, hint="it is in frames a second"))
    if len(rates) > 1 and max(rates) > 1.001 * min(rates):
        raise MeasurementError(
            f"videos and experiment.json have different frame rates: {', '.join(f'{r:g}' for r in sorted(rates))}"
        )
    if not rates and motion is not None:
        raise MeasurementError("a motion needs frames: give --video, or --experiment with a frame_rate")
    return next((video.rate for video in videos.values()), max(rates, default=1.0))


def _footage(video: Video, camera: Camera) -> Footage:
    """Pictures over all of a video, small ones."""
    factor = 1.0
    while factor * camera.width > WIDTH:
        factor *= 0.5
    small = camera.scaled(factor)
    numbers = {video.numbers[k] for k in np.linspace(0, len(video.numbers) - 1, LOOKED_AT).astype(int)}
    times, pictures = [], []
    for number, picture in video.pictures(numbers):
        image = np.asarray(Image.fromarray(picture).resize((small.width, small.height), Image.Resampling.BOX))
        if small.has_distortion:
            image = np.rint(undistorted(image.astype(np.float32), small)).astype(np.uint8)
        times.append(number / video.rate)
        pictures.append(image)
    return Footage(small.undistorted(), np.array(times), np.stack(pictures))


def _wanted(video: Video, zero: int, last: int | None, every: int) -> set[int]:
    """Frames of a video: every so many from ``zero`` on until the tool rests, and those just before."""
    end = video.numbers[-1] + 1 if last is None else zero + last + 1
    wanted = {*range(max(zero, zero % every), end, every), *range(zero - PRE_ROLL, zero)} & {*video.numbers}
    if not wanted:
        raise MeasurementError("the video ends before the tool moves, or begins after; is the clock's offset right?")
    return wanted


def _finish(root: Path, experiment: dict[str, Any], rate: float) -> tuple[str, ...]:
    """Write experiment.json and check the set, or what there is of it; returns the parts that it lacks."""
    there = {name: name for name in ("tool.stl", "tool_motion.csv", "tool_force.csv") if (root / name).is_file()}
    tool = dict(experiment["tool"]) if isinstance(experiment.get("tool"), dict) else {}
    keys = {"mesh": "tool.stl", "motion": "tool_motion.csv", "force": "tool_force.csv"}
    tool = {k: v for k, v in tool.items() if k not in keys} | {k: v for k, v in keys.items() if v in there}
    parts = {kind: f"{kind}/transforms.json" for kind in ("views", "video") if (root / kind).is_dir()}
    # What a file names that is not imported isn't in the new folder.
    notes = {key: value for key, value in experiment.items() if key not in ("views", "video")}
    whole = {"format": FORMAT, **notes, "tool": tool, "frame_rate": rate, **parts}
    missing = [name for name, key in (("bed", "bed"), ("gravity", "gravity"), ("video", "video")) if key not in whole]
    missing += [f"tool.{key}" for key in ("mesh", "motion") if key not in tool]
    if missing:
        read_transforms(root / "views" / "transforms.json", root, video=False)
    else:
        write_json(root / EXPERIMENT, whole)
        Measurement.load(root)
    return tuple(missing)
