"""``splatsoil import``: a measurement set out of posed photographs, a robot's record and video files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatsoil.commands._options import JSON, argument, command_line, option
from splatsoil.commands._output import print_json, stages
from splatsoil.errors import ParameterError

if TYPE_CHECKING:
    from splatsoil.measurement.importing import Imported

INTERRUPTED = "nothing was written; start again with"
Unit = Literal["m", "cm", "mm", "in"]


@dataclass(frozen=True)
class Config:
    """A set from nerfstudio, instant-ngp, Blender or COLMAP."""

    source: Path = argument("transforms.json, or the folder of it or of a COLMAP model.")
    out: Path = argument("Folder of the new set, or of parts of one; new or empty.")
    images: Path | None = option(None, "Photographs of a COLMAP model.", metavar="FOLDER")
    scale: float | None = option(None, "Length of SOURCE's unit.", metavar="METRES")
    distance: tuple[str, str, float] | None = option(
        None, "Between two of --points, for the scale.", metavar="A B METRES"
    )
    tags: float | None = option(None, "Edge of AprilTags (36h11) in photographs, for the scale.", metavar="METRES")
    known: Path | None = option(
        None, "point,x,y,z in the set's world: scale, turn, origin.", metavar="CSV", expert=True
    )
    points: Path | None = option(None, "point,image,u,v or point,x,y,z in SOURCE's world.", metavar="CSV", expert=True)
    up: tuple[float, float, float] | None = option(
        None, "What is up in SOURCE's world; z but for COLMAP.", metavar="X Y Z"
    )
    tool: tuple[Path, Unit] | None = option(None, "The tool; m, cm, mm or in.", metavar="MESH UNIT")
    motion: tuple[Path, Unit] | None = option(
        None, "Flange in the robot's frame: time,x,y,z,qw,qx,qy,qz.", metavar="CSV UNIT"
    )
    force: Path | None = option(None, "On the tool, robot's axes: time,fx,fy,fz (N).", metavar="CSV")
    robot_to_world: Path | None = option(None, "4 x 4 (m), from hand-eye calibration.", metavar="FILE", expert=True)
    mesh_to_flange: Path | None = option(None, "4 x 4 (m), how the mesh is mounted.", metavar="FILE", expert=True)
    video: tuple[str, ...] = option((), "Video, and its camera's photograph in SOURCE.", metavar="FILE=IMAGE")
    video_every: int = option(1, "Keep every N-th frame.", expert=True)
    clock_offset: float | None = option(None, "Robot's time minus video's; estimated if not given.", metavar="SECONDS")
    experiment: Path | None = option(None, "experiment.json with the rest: bed, gravity …", metavar="JSON")
    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Import; MeasurementError for whatever is missing or faulty, with nothing written."""
    from splatsoil.measurement.importing import Alignment, Parts, import_set, names_of
    from splatsoil.quiet import hush

    if config.video_every < 1:
        raise ParameterError(f"--video-every: must be 1 or more, not {config.video_every}")
    videos = names_of(config.video)
    if videos and config.motion is not None and config.clock_offset is None:
        hush()
    alignment = Alignment(config.scale, config.distance, config.tags, config.known, config.points, config.up)
    parts = Parts(
        tool=config.tool,
        motion=config.motion,
        force=config.force,
        robot_to_world=config.robot_to_world,
        mesh_to_flange=config.mesh_to_flange,
        video=videos,
        every=config.video_every,
        clock_offset=config.clock_offset,
        experiment=config.experiment,
    )
    with stages(quiet=config.json) as begin:
        made = import_set(config.source, config.out, alignment, parts, images=config.images, report=begin("import"))
    if config.json:
        print_json({"ok": True, **_as_json(config, made)})
    else:
        _show(config, made)
    return 0


def _as_json(config: Config, made: Imported) -> dict[str, Any]:
    from splatsoil.files import plain

    clock = None if made.clock is None else {"seconds": made.clock.seconds, "by_camera": made.clock.by_camera}
    return plain(
        {
            "out": config.out,
            "source": made.kind,
            "views": made.views,
            "scale": made.scale,
            "similarity": made.similarity,
            "marks_px": made.marks,
            "known_points_m": made.points,
            "video": made.frames,
            "clock_offset": clock,
            "missing": made.missing,
        }
    )


def _show(config: Config, made: Imported) -> None:
    print(f"{made.views} views of {made.kind}, {made.scale:.6g} m a unit")
    if config.points is not None or config.tags is not None:
        known = "" if made.points is None else f"; known points {1e3 * made.points:.2g} mm off (root mean square)"
        print(f"marked points {made.marks:.2g} px off{known}")
    for name, count in made.frames.items():
        print(f"video {name}: {count} frames")
    if made.clock is not None:
        alone = ", ".join(f"{seconds:.4f}" for seconds in made.clock.by_camera)
        print(f"clock offset {made.clock.seconds:.4f} s (by camera: {alone})")
    if made.missing:
        print(f"{config.out} is no whole set yet: it lacks {', '.join(made.missing)} and experiment.json")
    else:
        print(command_line("check", config.out))
