"""``splatsoil check``: what a measurement set holds, and what is wrong with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement, Remark


@dataclass(frozen=True)
class Config:
    """List what a measurement set contains and what is wrong with it. Writes nothing."""

    set: Positional[Path]
    """Folder of the measurement set."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Print the table or the object; MeasurementError when the set breaks the format's rules."""
    from splatsoil.commands import _laboratory as laboratory
    from splatsoil.measurement import Measurement, remarks

    if laboratory.is_test(config.set):
        return laboratory.check(config.set, quiet=config.json)
    measurement = Measurement.load(config.set)
    said = remarks(measurement)
    if config.json:
        print_json(_as_json(measurement, said))
    else:
        _show(measurement, said)
    return 0


def interrupted(config: Config) -> str:
    """Checking keeps nothing."""
    return f"nothing was written; start again with: {command_line('check', (config.set,))}"


def _as_json(measurement: Measurement, said: tuple[Remark, ...]) -> dict[str, Any]:
    bed, tool = measurement.bed, measurement.tool
    return {
        "ok": True,
        "folder": str(measurement.folder),
        "name": measurement.name,
        "hash": measurement.hash,
        "gravity": measurement.gravity.tolist(),
        "frame_rate": measurement.frame_rate,
        "bed": {
            "lower": bed.lower.tolist(),
            "upper": bed.upper.tolist(),
            "density": bed.density,
            "wall_friction": bed.wall_friction,
            "floor_friction": bed.floor_friction,
        },
        "tool": {
            "extents": tool.mesh.extents.tolist(),
            "volume": float(tool.mesh.volume),
            "friction": tool.friction,
            "rows": len(tool.motion.times),
            "seconds": float(tool.motion.times[-1] - tool.motion.times[0]),
            "force_rows": 0 if tool.force is None else len(tool.force),
        },
        "views": len(measurement.views),
        "video": {
            "cameras": list(measurement.cameras),
            "frames": list(measurement.frames),
            "pre_roll": sorted({f.frame for f in measurement.pre_roll if f.frame is not None}),
        },
        "remarks": [{"about": remark.about, "text": remark.text} for remark in said],
    }


def _show(measurement: Measurement, said: tuple[Remark, ...]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(f"{measurement.name} ({measurement.folder})"), show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for key, value in _rows(measurement):
        table.add_row(key, escape(value))
    console = Console(highlight=False)
    console.print(table)
    for remark in said:
        console.print(f"[yellow]remark[/yellow] {remark.about}: {escape(remark.text)}")
    console.print("[green]The set is complete and consistent.[/green]" if not said else "The set can be used as it is.")


def _rows(measurement: Measurement) -> list[tuple[str, str]]:
    bed, tool, motion = measurement.bed, measurement.tool, measurement.tool.motion
    first = measurement.views[0].camera
    sizes = {(f.camera.width, f.camera.height) for f in measurement.views}
    pre_roll = {f.frame for f in measurement.pre_roll}
    frames = measurement.frames
    numbers = f"numbers {frames[0]} to {frames[-1]}" if frames else "none"
    way = sum(math.dist(a, b) for a, b in pairwise(motion.positions))
    return [
        ("bed", f"{_lengths(bed.extents)} m, {bed.density:g} kg/m³, friction {bed.floor_friction:g} on the floor"),
        ("gravity", ", ".join(f"{g:g}" for g in measurement.gravity) + " m/s²"),
        ("views", f"{len(measurement.views)} of {_sizes(sizes)} pixels, {_lens(first.has_distortion)}"),
        ("video", f"cameras {', '.join(measurement.cameras)}; {len(frames)} frames each at most, {numbers}"),
        ("pre-roll", f"{len(pre_roll)} frames" if pre_roll else "none"),
        ("tool", f"{_lengths(tool.mesh.extents)} m, {len(tool.mesh.faces)} triangles, friction {tool.friction:g}"),
        ("motion", f"{len(motion.times)} rows, {motion.times[-1] - motion.times[0]:g} s, {way:.3g} m of way"),
        ("force", "not measured" if tool.force is None else f"{len(tool.force)} rows"),
        ("hash", measurement.hash[:16]),
    ]


def _lengths(values: Any) -> str:
    return " x ".join(f"{v:g}" for v in values.round(4))


def _sizes(sizes: set[tuple[int, int]]) -> str:
    return ", ".join(f"{w} x {h}" for w, h in sorted(sizes))


def _lens(distorted: bool) -> str:
    return "with lens distortion" if distorted else "no lens distortion"
