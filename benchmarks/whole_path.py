"""From photographs to a friction angle: each stage against its aim, and the table in docs/measurements.md.

``splatsoil benchmark whole-path --page docs/measurements.md`` takes the best part of an hour on two cores: the example
sets are reconstructed, drawn from their true particles, simulated from them with one piece of the numerics changed at a
time, and fitted as a user does. Parts are kept in the folder as they end, fits with all their evaluations, and a second
call goes on from there; a part that is asked for by name is measured again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from splatsoil.benchmarks import numerics
from splatsoil.benchmarks._common import at_least, here
from splatsoil.benchmarks._speed import machine
from splatsoil.benchmarks._speed.clock import repeated
from splatsoil.benchmarks._speed.page import between
from splatsoil.benchmarks._speed.scenes import plough
from splatsoil.benchmarks.landscape import floor
from splatsoil.benchmarks.numerics import Truth
from splatsoil.benchmarks.reconstruction import score

from splatsoil.commands._output import only_json, print_json
from splatsoil.comparison import Comparator
from splatsoil.errors import RunError, SplatsoilError
from splatsoil.files import check_folder, plain, read_json, write_json, write_text
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction, reconstruct

FORMAT = "splatsoil-whole-path/1"
BEGIN = "<!-- whole path: written by `splatsoil benchmark whole-path`, what stands here is overwritten -->"
END = "<!-- whole path: end -->"
AWAY = 5.0
"""Degrees by which the simulations beside the renderer's floor are wrong."""
FIT_SEEDS = (0, 1, 2)
EFFECT = "cohesion"
"""What the damp set has and the base model hasn't."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: was measured.
        measured: with units.
        aim: in words.
        met: whether it was reached; None: there is nothing to reach.
    """

    what: str
    measured: str
    aim: str = ""
    met: bool | None = None

    def line(self) -> str:
        """In Markdown; what misses its aim is bold."""
        measured = self.measured.replace("-", "−")
        return f"| {self.what} | {f'**{measured}**' if self.met is False else measured} | {self.aim} |"


@dataclass(frozen=True)
class Task:
    """What parts are made with.

    Attributes:
        dry: a measurement set with true particles that the base model can explain.
        damp: one whose soil is cohesive.
        preset: of reconstruction and solver.
        seeds: of the particles, for heights and shifts.
        device: where to compute.
        out: folder for parts and runs.
    """

    dry: Path
    damp: Path
    preset: str
    seeds: int
    device: str
    out: Path


def parts(task: Task) -> dict[str, Callable[[], list[Row]]]:
    """All parts by name, in the table's order."""
    return {
        "reconstruction": lambda: reconstruction(task),
        "renderer": lambda: renderer(task),
        "solver": lambda: solver(task),
        "simulation": lambda: simulation(task),
        "angle": lambda: angle(task),
        "missing-effect": lambda: missing_effect(task),
    }


def reconstruction(task: Task) -> list[Row]:
    """Time, likeness to photographs that were set aside, and the surface against the true one."""
    measurement = Measurement.load(task.dry)
    found = score(task.dry, _reconstructed(task.dry, task.preset, task.device), measurement)
    assert found.rmse is not None and found.bias is not None
    name, rmse, bias = measurement.name, 1e3 * found.rmse, 1e3 * found.bias
    return [
        Row(
            f"reconstruction of `{name}`; photographs set aside",
            f"{found.seconds:.0f} s; {found.psnr:.1f} dB",
            "180 s; 30 dB",
            found.seconds <= 180.0 and found.psnr >= 30.0,
        ),
        Row(
            "its surface against the truth inside the bin: root mean square, mean",
            f"{rmse:.1f} mm, {bias:+.1f} mm",
            "4 mm, 1 mm",
            rmse <= 4.0 and abs(bias) <= 1.0,
        ),
    ]


def renderer(task: Task) -> list[Row]:
    """The error of true particles drawn through the whole scene path, beside that of wrong simulations."""
    truth = Truth.load(task.dry)
    made = _reconstructed(task.dry, task.preset, task.device)
    frames, least = floor(truth, made, task.device)
    model = Model(truth.measurement, made, preset=task.preset, device=task.device)
    comparator = Comparator(truth.measurement, surface=made.surface, frames=frames)
    off = []
    for by in (-AWAY, AWAY):
        images = model.predict({"friction_angle": truth.values["friction_angle"] + by}, 0).images
        off.append(comparator.compare(images))
    shown = ", ".join(map(str, frames[1:]))
    halves = [least.loss / wrong.loss for wrong in off]
    return [
        Row(
            f"true particles drawn, frames {shown}, against simulations {AWAY:g}° too weak and too strong: loss",
            f"{least.loss:.3f} against {off[0].loss:.3f} and {off[1].loss:.3f}",
            "less than half",
            max(halves) < 0.5,
        ),
        Row(
            "the same, raw colour error",
            f"{1e5 * least.rgb:.0f} against {1e5 * off[0].rgb:.0f} and {1e5 * off[1].rgb:.0f} · 10⁻⁵",
        ),
    ]


def solver(task: Task) -> list[Row]:
    """Heights and best angle against an independent solver, and how far numerics shift the angle."""
    arguments = [([folder], task.preset, task.seeds, task.device) for folder in (task.dry, task.damp)]
    with ProcessPoolExecutor(2, get_context("spawn"), hush) as pool:
        jobs = [pool.submit(numerics.run, *each) for each in arguments]
        found = {name: entry for job in jobs for name, entry in job.result()["sets"].items()}
    return of_solver(found, task.preset)


def of_solver(found: Mapping[str, Any], preset: str) -> list[Row]:
    """Rows of what `splatsoil.benchmarks.numerics` found, by set."""
    rows = []
    for name, entry in found.items():
        errors, true = entry["rmse_mm"].values(), entry["true_angle"]
        gain = 100.0 * entry["volume"][1]
        rows.append(
            Row(
                f"from the true particles of `{name}`: heights; best angle of a scan (true {true:g}°); volume gained",
                f"{min(errors):.1f} to {max(errors):.1f} mm; {entry['best_angle']:.1f}°; {gain:+.2f} %",
                "4 mm; within 2°; 0.5 %",
                max(errors) <= 4.0 and abs(entry["best_angle"] - true) <= 2.0 and gain <= 0.5,
            )
        )
    for name, entry in found.items():
        shifts = entry["shifts"]
        rows.append(
            Row(
                f"shift of the angle by {', '.join(shifts)} (`{name}`, preset `{preset}`)",
                ", ".join(f"{by:+.1f}°" for by in shifts.values()),
                "1° each",
                all(abs(by) <= 1.0 for by in shifts.values()),
            )
        )
    return rows


def simulation(task: Task) -> list[Row]:
    """Seconds of one run."""
    scene = plough(task.dry, task.preset)
    took = repeated(lambda: scene.run(task.device), 2, task.device)
    where = "one core" if task.device == "cpu" else task.device
    return [Row(f"one simulation, {where}", f"{took.median:.1f} s", "20 s", took.median <= 20.0)]


def angle(task: Task) -> list[Row]:
    """The commands that a user gives, for three seeds."""
    true = Truth.load(task.dry).values["friction_angle"]
    # only a run that hasn't begun can be timed
    fresh = not (task.out / "runs" / f"{task.dry.name}-0").exists()
    options = ("run", "--stop-at-floor", "--seed")
    runs = [_fitted(task, task.dry, f"{task.dry.name}-{seed}", *options, str(seed)) for seed in FIT_SEEDS]
    seconds, memory = runs[0].seconds, runs[0].memory
    angles = [run.fit["parameters"]["friction_angle"] for run in runs]
    stds = sorted(found["std"] for found in angles)
    estimates = ", ".join(f"{found['estimate']:.1f}" for found in angles)
    rows = [
        Row(
            f"friction angle of `{task.dry.name}` from photographs and force (true {true:g}°), seeds "
            f"{', '.join(map(str, FIT_SEEDS))}",
            f"{estimates} ± {stds[0]:.1f} to {stds[-1]:.1f}°",
            "within 2°",
            all(abs(found["estimate"] - true) <= 2.0 for found in angles),
        )
    ]
    if fresh:
        rows.append(
            Row(
                "all of it by `splatsoil run`, as `make demo` does after the set-up; its largest process",
                f"{seconds / 60.0:.1f} min; {memory / 2**30:.1f} GiB",
                "8 min; 2 GiB",
                seconds <= 480.0 and memory <= 2**31,
            )
        )
    return rows


def missing_effect(task: Task) -> list[Row]:
    """The damp set under the base model and with what it lacks, beside the renderer's floor."""
    name = task.damp.name
    base = _fitted(task, task.damp, f"{name}-base", "fit").fit["loss"]
    added = _fitted(task, task.damp, f"{name}-{EFFECT}", "fit", "--with", EFFECT).fit["loss"]
    truth = Truth.load(task.damp)
    least = floor(truth, _reconstructed(task.damp, task.preset, task.device), task.device)[1].loss
    return [
        Row(
            f"loss of `{name}`: base model, with {EFFECT}, true particles drawn",
            f"{base:.3f}, {added:.3f}, {least:.3f}",
            f"falls with {EFFECT}, towards the last",
            added < base and base > 1.5 * least,
        )
    ]


# A process is said to be as large as the one that it began as a copy of, so a small one begins the command.
_COUNTED = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""


@cache
def _reconstructed(folder: Path, preset: str, device: str) -> Reconstruction:
    return reconstruct(Measurement.load(folder), preset=preset, device=device)


@dataclass(frozen=True)
class Run:
    """What a command left.

    Attributes:
        fit: its ``fit.json``.
        seconds: of the whole command.
        memory: of its largest process, bytes.
    """

    fit: Mapping[str, Any]
    seconds: float
    memory: int


def _fitted(task: Task, folder: Path, name: str, command: str, *options: str) -> Run:
    """A command in a process of its own; evaluations of a run that began before aren't repeated.

    Raises:
        RunError: the command failed.
    """
    run = task.out / "runs" / name
    words = [command, str(folder), "--run", str(run), "--preset", task.preset, "--device", task.device, *options]
    began = time.monotonic()
    counted = [sys.executable, "-c", _COUNTED, sys.executable, "-m", "splatsoil", *words]
    done = subprocess.run(counted, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"splatsoil {' '.join(words)}: {' '.join(done.stderr.split())[-300:]}")
    # Linux counts in KiB, macOS in bytes
    memory = int(done.stdout) * (1 if sys.platform == "darwin" else 1024)
    return Run(read_json(run / "fit.json"), time.monotonic() - began, memory)


def table(rows: Sequence[Row]) -> str:
    """Markdown."""
    return "\n".join(["| | measured | aim |", "|---|---|---|", *(row.line() for row in rows)])


def written(page: str, rows: Sequence[Row], made: Mapping[str, str]) -> str:
    """A page with the table between its two lines.

    Raises:
        RunError: the page has no such lines.
    """
    told = f"On {str(made['made'])[:10]}: {machine.sentence(dict(made))}"
    return between(page, BEGIN, END, f"{table(rows)}\n\n{told}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the parts that are asked for, print the table, and write it into a page."""
    parser = argparse.ArgumentParser(prog="splatsoil benchmark whole-path", description=__doc__)
    parser.add_argument("--dry", type=Path, default=Path("examples/plow-dry"), help="set that the base model explains")
    parser.add_argument("--damp", type=Path, default=Path("examples/plow-damp"), help="set with cohesive soil")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS))
    parser.add_argument("--seeds", type=at_least(1), default=2, help="of the particles, for heights and shifts")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure, again if need be; all by default")
    parser.add_argument("--out", type=Path, default=Path("runs/whole-path"))
    parser.add_argument("--page", type=Path, help="write the table into this page")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options = parser.parse_args(arguments)
    hush()
    task = Task(options.dry, options.damp, options.preset, options.seeds, options.device, options.out)
    known = parts(task)
    unknown = sorted(set(options.only or ()) - set(known))
    if unknown:
        parser.error(f"part {unknown[0]!r} is not among {', '.join(known)}")
    try:
        with only_json() if options.json else nullcontext():
            return _run(options, task)
    except SplatsoilError as error:
        parser.error(" ".join(str(error).split()))


def _run(options: argparse.Namespace, task: Task) -> int:
    check_folder(task.out)
    here = machine.describe(task.device)
    if options.page:
        written(_page(options.page), (), here)  # a page without a place for the table fails now, not at the end
    todo = parts(task)
    kept = _kept(task, here, todo)
    for name in options.only or [name for name in todo if name not in kept]:
        began = time.monotonic()
        rows = todo[name]()
        entry = {"format": FORMAT, "machine": here, "preset": task.preset, "seeds": task.seeds}
        seconds = time.monotonic() - began
        write_json(task.out / f"{name}.json", {**entry, "seconds": seconds, "rows": [asdict(row) for row in rows]})
        print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
    rows = [row for found in _kept(task, here, todo).values() for row in found]
    if options.page:
        write_text(options.page, written(_page(options.page), rows, here))
    if options.json:
        print_json({"ok": True, "machine": here, "rows": plain([asdict(row) for row in rows])})
    else:
        print(table(rows))
    return 0


def _page(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{file}: cannot be read as text ({error})") from error


def _kept(task: Task, here: Mapping[str, str], names: Iterable[str]) -> dict[str, list[Row]]:
    """Rows by part of what this code measured on this machine, with these options."""
    found = {}
    for name in names:
        file = task.out / f"{name}.json"
        stored = read_json(file) if file.is_file() else {}
        same = stored.get("format") == FORMAT and machine.same(stored["machine"], here)
        if same and (stored["preset"], stored["seeds"]) == (task.preset, task.seeds):
            found[name] = [Row(**row) for row in stored["rows"]]
    return found


if __name__ == "__main__":
    raise SystemExit(main())
