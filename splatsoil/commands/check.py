"""``splatsoil check``: contents and errors of a measurement set."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil.commands import _laboratory
from splatsoil.commands._options import SET
from splatsoil.commands._output import print_result, print_table, print_text
from splatsoil.errors import ParameterError
from splatsoil.files import plain
from splatsoil.options import JSON, argument, option

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement

INTERRUPTED = "nothing was written; start again with"


@dataclass(frozen=True)
class Config:
    """List the contents of a measurement set, and its errors. Writes nothing but --pictures."""

    set: Path = argument(SET)
    pictures: Path | None = option(
        None, "New folder of the photographs with bed, tool and motion drawn over them.", metavar="FOLDER"
    )
    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Print the contents; MeasurementError for a violation of the format."""
    from splatsoil.measurement import Measurement, remarks

    if _laboratory.is_test(config.set):
        return _laboratory.check(config)
    measurement = Measurement.load(config.set)
    found = remarks(measurement)
    if config.pictures is not None:
        _draw(measurement, config.pictures)

    def show() -> None:
        print_table(f"{measurement.name} ({measurement.folder})", (), _rows(measurement))
        print_text(*(f"remark {remark.about}: {remark.text}" for remark in found), style="yellow")

    data = {**_as_json(measurement), "remarks": [asdict(remark) for remark in found]}
    last = "The set can be used as it is." if found else "The set is complete and consistent."
    return print_result(config, data, show, last=last)


def _draw(measurement: Measurement, folder: Path) -> None:
    """Write the photographs with the set's geometry drawn over them."""
    from splatsoil.measurement.writer import whole_folder
    from splatsoil.report.overlay import overlays

    if not measurement.views and not measurement.video:
        raise ParameterError(f"--pictures: {measurement.name} has no photographs")
    with whole_folder(folder) as root:
        for name, picture in overlays(measurement):
            picture.save(root / f"{name}.jpg", quality=90)


def _as_json(measurement: Measurement) -> dict[str, Any]:
    tool, motion = measurement.tool, measurement.tool.motion
    data: dict[str, Any] = plain(
        {
            "set": measurement.folder,
            **{key: getattr(measurement, key) for key in ("name", "hash", "gravity", "frame_rate")},
            "bed": {
                key: getattr(measurement.bed, key)
                for key in ("lower", "upper", "density", "wall_friction", "floor_friction")
            },
            "tool": {
                "extents": tool.mesh.extents,
                "volume": float(tool.mesh.volume),
                "friction": tool.friction,
                "rows": len(motion.times),
                "seconds": motion.times[-1] - motion.times[0],
                "force_rows": 0 if tool.force is None else len(tool.force),
            },
            "views": len(measurement.views),
            "video": {
                "cameras": list(measurement.cameras),
                "frames": measurement.frames,
                "pre_roll": sorted({f.frame for f in measurement.pre_roll if f.frame is not None}),
            },
            "heights": measurement.height_frames,
        }
    )
    return data


def _rows(measurement: Measurement) -> list[tuple[str, str]]:
    bed, tool, motion = measurement.bed, measurement.tool, measurement.tool.motion
    bent = any(f.camera.has_distortion for f in measurement.views)
    lens = "with lens distortion" if bent else "no lens distortion"
    sizes = sorted({(f.camera.width, f.camera.height) for f in measurement.views})
    pixels = ", ".join(f"{width} x {height}" for width, height in sizes)
    bed_size, tool_size = (" x ".join(f"{v:g}" for v in size.round(4)) for size in (bed.extents, tool.mesh.extents))
    pre_roll = {f.frame for f in measurement.pre_roll}
    frames = measurement.frames
    numbers = f"numbers {frames[0]} to {frames[-1]}" if frames else "none"
    cameras = ", ".join(measurement.cameras)
    source = "depth maps" if measurement.heights is None else "grids"
    way = sum(math.dist(a, b) for a, b in pairwise(motion.positions))
    return [
        ("bed", f"{bed_size} m, {bed.density:g} kg/m³, friction {bed.floor_friction:g} on the floor"),
        ("gravity", ", ".join(f"{g:g}" for g in measurement.gravity) + " m/s²"),
        ("views", f"{len(measurement.views)} of {pixels} pixels, {lens}" if measurement.views else "none"),
        ("video", f"cameras {cameras}; {len(frames)} frames each at most, {numbers}" if cameras else "none"),
        ("heights", f"{source} of {len(measurement.height_frames)} frames" if measurement.height_frames else "none"),
        ("pre-roll", f"{len(pre_roll)} frames" if pre_roll else "none"),
        ("tool", f"{tool_size} m, {len(tool.mesh.faces)} triangles, friction {tool.friction:g}"),
        ("motion", f"{len(motion.times)} rows, {motion.times[-1] - motion.times[0]:g} s, {way:.3g} m of way"),
        ("force", "not measured" if tool.force is None else f"{len(tool.force)} rows"),
        ("hash", measurement.hash[:16]),
    ]
