"""``splatsoil import``: a measurement set out of posed photographs, a robot's record and video files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json
from splatsoil.errors import ParameterError

if TYPE_CHECKING:
    from splatsoil.measurement.importing import Imported

Unit = Literal["m", "cm", "mm", "in"]


def _option(metavar: str) -> Any:
    """How help shows an option that is off by default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


@dataclass(frozen=True)
class Config:
    """A set from nerfstudio, instant-ngp, Blender or COLMAP."""

    source: Annotated[Positional[Path], tyro.conf.arg(metavar="SOURCE", help_behavior_hint="")]
    """transforms.json, or the folder of it or of a COLMAP model."""
    out: Annotated[Positional[Path], tyro.conf.arg(metavar="OUT", help_behavior_hint="")]
    """Folder of the new set, or of parts of one; new or empty."""
    images: Annotated[Path | None, _option("FOLDER")] = None
    """Photographs of a COLMAP model."""
    scale: Annotated[float | None, _option("METRES")] = None
    """Length of SOURCE's unit."""
    distance: Annotated[tuple[str, str, float] | None, _option("A B METRES")] = None
    """Between two of --points, for the scale."""
    tags: Annotated[float | None, _option("METRES")] = None
    """Edge of AprilTags (36h11) in photographs, for the scale."""
    known: Annotated[Path | None, _option("CSV")] = None
    """point,x,y,z in the set's world: scale, turn, origin."""
    points: Annotated[Path | None, _option("CSV")] = None
    """point,image,u,v or point,x,y,z in SOURCE's world."""
    up: Annotated[tuple[float, float, float] | None, _option("X Y Z")] = None
    """What is up in SOURCE's world; z but for COLMAP."""
    tool: Annotated[tuple[Path, Unit] | None, _option("MESH UNIT")] = None
    """The tool; m, cm, mm or in."""
    motion: Annotated[tuple[Path, Unit] | None, _option("CSV UNIT")] = None
    """Flange in the robot's frame: time,x,y,z,qw,qx,qy,qz."""
    force: Annotated[Path | None, _option("CSV")] = None
    """On the tool, robot's axes: time,fx,fy,fz (N)."""
    robot_to_world: Annotated[Path | None, _option("FILE")] = None
    """4 x 4 (m), from hand-eye calibration."""
    mesh_to_flange: Annotated[Path | None, _option("FILE")] = None
    """4 x 4 (m), how the mesh is mounted."""
    video: Annotated[tuple[str, ...], _option("FILE=IMAGE …")] = ()
    """Video, and its camera's photograph in SOURCE."""
    video_every: Annotated[int, _option("N")] = 1
    """Keep every N-th frame; 1 if not given."""
    clock_offset: Annotated[float | None, _option("SECONDS")] = None
    """Robot's time minus video's; estimated if not given."""
    experiment: Annotated[Path | None, _option("JSON")] = None
    """experiment.json with the rest: bed, gravity …"""
    json: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = False
    """Print one JSON object."""


def run(config: Config) -> int:
    """Import; MeasurementError for whatever is missing or faulty, with nothing written."""
    from splatsoil.commands._progress import stages
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


def interrupted(config: Config) -> str:
    """A set is written when it is complete."""
    options = []
    for field in dataclasses.fields(config)[2:]:
        options.append((f"--{field.name.replace('_', '-')}", getattr(config, field.name), field.default))
    again = command_line("import", (config.source, config.out), options)
    return f"nothing was written; start again with: {again}"


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
        print(command_line("check", (config.out,)))
