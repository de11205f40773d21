"""How fast? Solver, rasteriser, reconstruction and whole inversion beside others of their kind: docs/performance.md."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatsoil.benchmarks._common import at_least, here
from splatsoil.benchmarks._speed import (
    against_newton,
    against_taichi,
    kernels,
    machine,
    mpm,
    page,
    pictures,
    run_to_run,
    whole,
)
from splatsoil.benchmarks._speed.rows import Group, missing, text
from splatsoil.benchmarks._speed.scenes import paper_scene, plough

from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import RunError, SplatsoilError
from splatsoil.files import check_folder, plain, read_json, write_json, write_text
from splatsoil.mpm import PRESETS
from splatsoil.quiet import hush

FORMAT = "splatsoil-speed/1"


@dataclass(frozen=True)
class Task:
    """What parts are made with.

    Attributes:
        folder: of the measurement set.
        preset: of solver and reconstruction.
        device: where to compute.
        repeats: of what takes seconds; what takes milliseconds is repeated more often.
        work: folder for run folders, empty at the start.
    """

    folder: Path
    preset: str
    device: str
    repeats: int
    work: Path


def cpu_parts(task: Task) -> dict[str, Callable[[], Group]]:
    """Parts that a machine without a GPU can measure, by name, in the page's order."""
    folder, preset, repeats = task.folder, task.preset, task.repeats
    return {
        "solver": lambda: mpm.cpu(plough(folder, preset), repeats),
        "taichi": lambda: against_taichi.compare(plough(folder, preset), repeats),
        "newton": lambda: against_newton.compare(plough(folder, preset), repeats),
        "rasteriser": lambda: pictures.rasteriser(repeats),
        "reconstruction": lambda: pictures.training(folder, preset, "cpu"),
        "kernels": lambda: kernels.profile(plough(folder, preset), "cpu"),
    }


def gpu_parts(task: Task) -> dict[str, Callable[[], Group]]:
    """Parts that are measured on a GPU."""
    folder, preset, device, repeats = task.folder, task.preset, task.device, task.repeats
    return {
        "solver": lambda: mpm.gpu(plough(folder, preset), device, repeats),
        "large": lambda: mpm.large(plough(folder, preset), device, repeats),
        "kernels": lambda: kernels.profile(paper_scene(), device),
        "kernels-large": lambda: kernels.profile(plough(folder, preset).refined(1_000_000), device),
        "reconstruction": lambda: pictures.training(folder, preset, device),
        "inversion": lambda: whole.inversion(folder, preset, device, task.work),
        "diagnosis": lambda: whole.diagnosis(folder, preset, device, task.work),
        "gsplat": lambda: pictures.against_gsplat(device, repeats),
        "run-to-run": lambda: run_to_run.compare(folder, preset, device, repeats),
    }


def parts(task: Task) -> dict[str, Callable[[], Group]]:
    """All parts for the task's device."""
    return cpu_parts(task) if task.device == "cpu" else gpu_parts(task)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the parts that are asked for, print their table, and write it into its section of the page.

    Returns:
        0; 1 where a part broke down in a way that isn't the machine's fault.
    """
    parser = argparse.ArgumentParser(prog="splatsoil benchmark speed", description=__doc__)
    parser.add_argument(
        "--set", type=Path, default=Path("examples/plow-dry"), help="measurement set with true particles"
    )
    parser.add_argument("--device", type=here, default="cpu", help="cpu or cuda:0; they have parts of their own")
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure; all of the device by default")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS), help="of solver and reconstruction")
    parser.add_argument("--repeats", type=at_least(1), default=3, help="of what takes seconds")
    parser.add_argument("--out", type=Path, default=Path("runs/speed"), help="results, one file a part")
    parser.add_argument("--page", type=Path, help="write the device's section of this page (.md)")
    parser.add_argument("--render", action="store_true", help="measure nothing: write the page from --out")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    options = parser.parse_args(arguments)
    hush()
    try:
        with tempfile.TemporaryDirectory() as work, only_json() if options.json else nullcontext():
            task = Task(options.set, options.preset, options.device, options.repeats, Path(work))
            return _run(parser, options, task)
    except SplatsoilError as error:
        parser.error(" ".join(str(error).split()))


def _run(parser: argparse.ArgumentParser, options: argparse.Namespace, task: Task) -> int:
    todo = parts(task)
    unknown = sorted(set(options.only or ()) - set(todo))
    if unknown:
        parser.error(f"part {unknown[0]!r} is not among {', '.join(todo)}, those of {task.device}")
    if options.page:
        page.current(options.page)
        check_folder(options.page.parent)
    kind = task.device.split(":")[0]
    out = options.out / kind
    check_folder(out)
    # a set that can't be read fails here, not in every part
    scene = plough(task.folder, task.preset)
    here = machine.describe(task.device)
    wanted = [] if options.render else [name for name in todo if not options.only or name in options.only]
    broken = False
    for name in wanted:
        began = time.monotonic()
        group, fault = measured(name, todo[name])
        broken |= fault
        seconds = time.monotonic() - began
        entry = {
            "format": FORMAT,
            "machine": here,
            "measurement": {"name": scene.measurement.name, "hash": scene.measurement.hash},
            "preset": task.preset,
            "repeats": task.repeats,
            "seconds": seconds,
            "group": group.data(),
        }
        write_json(out / f"{name}.json", entry)
        print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
        if not options.json:
            print(f"\n{text([group])}", flush=True)
        # after every part, so that a run that is cut short leaves what it has
        if options.page:
            write_page(options.page, task.device, out, list(todo), here)
    if options.page and not wanted:
        write_page(options.page, task.device, out, list(todo), here)
    if options.json:
        found = {name: read_json(out / f"{name}.json") for name in wanted}
        print_json({"ok": not broken, "machine": here, "parts": plain(found)})
    return int(broken)


def measured(name: str, part: Callable[[], Group]) -> tuple[Group, bool]:
    """A part's rows; one that can't be measured here becomes a row that says why, and whether it's a fault to mend."""
    try:
        return part(), False
    except SplatsoilError as error:
        return Group(name, (missing(name, " ".join(str(error).split())),)), False
    except Exception as error:  # the other parts must not suffer
        traceback.print_exc(file=sys.stderr)
        why = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return Group(name, (missing(name, why),)), True


def write_page(file: Path, device: str, out: Path, names: Sequence[str], here: Mapping[str, str]) -> None:
    """The device's section, from all parts on disk that this code measured on this machine.

    Raises:
        RunError: there is none.
    """
    groups, seconds = [], 0.0
    latest: dict[str, Any] = {"made": ""}
    for name in names:
        stored = read_json(out / f"{name}.json") if (out / f"{name}.json").is_file() else {}
        if stored.get("format") == FORMAT and machine.same(stored["machine"], here):
            groups.append(Group.restored(stored["group"]))
            seconds += stored["seconds"]
            latest = max(latest, stored["machine"], key=lambda told: str(told["made"]))
    if not groups:
        raise RunError(f"{out}: holds nothing that this code measured on this machine; leave --render out")
    kind = device.split(":")[0]
    command = f"splatsoil benchmark speed{'' if kind == 'cpu' else f' --device {device}'} --page {file}"
    write_text(file, page.replaced(page.current(file), kind, page.section(groups, latest, command, seconds)))


if __name__ == "__main__":
    raise SystemExit(main())
