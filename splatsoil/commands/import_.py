"""``splatsoil import``: a measurement set out of posed photographs, a robot's record and video files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_result, stages
from splatsoil.files import plain
from splatsoil.importing.options import ImportOptions
from splatsoil.options import JSON, option
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from splatsoil.importing.build import Imported

INTERRUPTED = "nothing was written; start again with"


@dataclass(frozen=True)
class Config(ImportOptions):
    """A set from nerfstudio, instant-ngp, Blender or COLMAP."""

    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Import; MeasurementError for missing or faulty input."""
    from splatsoil.importing.build import import_set

    if config.needs_clock:
        hush()
    with stages(quiet=config.json) as begin:
        made = import_set(config, begin("import"))
    return print_result(config, _as_json(config, made), lambda: _show(config, made))


def _as_json(config: Config, made: Imported) -> dict[str, Any]:
    clock = None if made.clock is None else {"seconds": made.clock.seconds, "by_camera": made.clock.by_camera}
    tags = None if made.tags is None else {"frames": len(made.tags.motion.frames), "error_px": made.tags.error}
    return plain(
        {
            "set": config.out,
            "source": made.kind,
            "views": made.views,
            "scale": made.scale,
            "similarity": made.similarity,
            "marks_px": made.marks,
            "known_points_m": made.points,
            "video": made.frames,
            "clock_offset": clock,
            "tool_tags": tags,
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
    if made.tags is not None:
        print(f"the tool's tags: {len(made.tags.motion.frames)} frames, {made.tags.error:.2g} px off")
    if made.missing:
        print(f"{config.out} is no whole set yet: it lacks {', '.join(made.missing)} and experiment.json")
    else:
        print(command_line("check", config.out))
