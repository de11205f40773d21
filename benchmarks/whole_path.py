"""From photographs to a friction angle: each stage against its target, and the table in docs/measurements.md.

``splatsoil benchmark whole-path --page docs/measurements.md`` takes the best part of an hour on two cores: the example
sets are reconstructed, drawn from their true particles, and fitted as a user does. Parts are kept in the folder as they
end, fits with all their evaluations, and a second call continues from there.
"""

from __future__ import annotations

import subprocess
import sys
import time
from argparse import Namespace
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from splatsoil.benchmarks._common import sources
from splatsoil.benchmarks._parts import Row, Section, parts_parser, run_parts
from splatsoil.benchmarks._truth import Truth

from splatsoil.comparison import Comparator
from splatsoil.errors import RunError
from splatsoil.files import read_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS
from splatsoil.quiet import hush
from splatsoil.reconstruction import HeightField, Reconstruction, reconstruct
from splatsoil.scene import build_scene

AWAY = 5.0
"""Degrees by which the simulations beside the true particles are wrong."""
FIT_SEEDS = (0, 1, 2)
EFFECT = "cohesion"
"""What the damp set has and the base model has not."""
LEVEL = 0.45
"""Share of the bulk density at which the sets' pictures show the surface."""
FINENESS, PADDING = 4, 3
"""Grid cells per particle spacing, and spacings of empty space around the bed, so that the blur ends in nothing."""


def true_surface(truth: Truth, cells: HeightField) -> HeightField:
    """The surface of the true particles at frame 0 at the given cells, found without any part of the reconstruction.

    It is where a Gaussian blur of one spacing of the particles' volume falls to `LEVEL`, from above: so the sets'
    pictures were made, on a coarser grid. Other grids move it by up to 0.2 mm on average and 0.7 mm in a cell.
    """
    bed, spacing = truth.measurement.bed, truth.spacing
    step = spacing / FINENESS
    lower = bed.lower - PADDING * spacing
    shape = np.ceil((bed.upper + PADDING * spacing - lower) / step).astype(int)
    ranges = list(zip(lower, lower + shape * step, strict=True))
    bulk, _ = np.histogramdd(truth.particles[0], bins=shape.tolist(), range=ranges)
    bulk, level = gaussian_filter(bulk * FINENESS**3, FINENESS), np.arange(shape[2])
    y, x = ((a - lower[k]) / step - 0.5 for k, a in ((1, cells.y), (0, cells.x)))
    y, x, z = np.meshgrid(y, x, level, indexing="ij")
    columns = map_coordinates(bulk, [x, y, z], order=1)
    filled = columns >= LEVEL
    top = len(level) - 1 - np.argmax(filled[..., ::-1], axis=2)
    under = np.take_along_axis(columns, top[..., None], axis=2)[..., 0]
    over = np.take_along_axis(columns, np.minimum(top + 1, len(level) - 1)[..., None], axis=2)[..., 0]
    height = lower[2] + (top + 0.5 + (under - LEVEL) / np.maximum(under - over, 1e-12)) * step
    return HeightField(cells.x, cells.y, np.where(filled.any(axis=2), height, np.nan))


def reconstruction(task: Namespace) -> Section:
    """Time, likeness to photographs that were set aside, and the surface against the true one."""
    truth, made = Truth.load(task.dry), _reconstructed(task.dry, task.preset, task.device)
    exact = true_surface(truth, made.surface)
    rmse, bias = 1e3 * made.surface.rmse(exact), 1e3 * made.surface.bias(exact)
    name, good = truth.measurement.name, made.seconds <= 180.0 and made.psnr >= 30.0
    rows = (
        Row(f"{name}; photographs set aside", f"{made.seconds:.0f} s; {made.psnr:.1f} dB", "180 s; 30 dB", good),
        Row(
            "surface against the truth inside the bin: root mean square, mean",
            f"{rmse:.1f} mm, {bias:+.1f} mm",
            "4 mm, 1 mm",
            rmse <= 4.0 and abs(bias) <= 1.0,
        ),
    )
    return Section("Reconstruction", rows)


def renderer(task: Namespace) -> Section:
    """The error of true particles drawn through the whole scene path, beside that of wrong simulations."""
    truth, made = Truth.load(task.dry), _reconstructed(task.dry, task.preset, task.device)
    measurement, frames = truth.measurement, (0, *truth.frames)
    scene = build_scene(made, measurement, truth.particles[0], truth.spacing, device=task.device)
    motion, images = measurement.tool.motion, {}
    for frame in frames:
        posed = scene.pose(truth.particles[frame], None, motion.pose(frame / measurement.frame_rate))
        for name, camera in measurement.cameras.items():
            images[name, frame] = scene.picture(posed, camera.undistorted())
    comparator = Comparator(measurement, surface=made.surface, frames=frames, surroundings=made.standing)
    model, least = Model(measurement, made, preset=task.preset, device=task.device), comparator.compare(images)
    weak, strong = (
        comparator.compare(model.predict({"friction_angle": truth.values["friction_angle"] + by}, 0).images)
        for by in (-AWAY, AWAY)
    )
    rows = (
        Row(
            f"loss of the true particles; of simulations {AWAY:g}° too weak and too strong",
            f"{least.loss:.3f}; {weak.loss:.3f} and {strong.loss:.3f}",
            "less than half",
            least.loss < 0.5 * min(weak.loss, strong.loss),
        ),
        Row("raw colour error", f"{1e5 * least.rgb:.0f}; {1e5 * weak.rgb:.0f} and {1e5 * strong.rgb:.0f} · 10⁻⁵"),
    )
    return Section("Renderer", rows)


def dry(task: Namespace) -> Section:
    """The command that a user gives, for three seeds."""
    true = Truth.load(task.dry).values["friction_angle"]
    # only a run that has not begun can be timed
    fresh = not (task.out / "runs" / f"{task.dry.name}-0").exists()
    runs = [_run(task, task.dry, seed, "--no-effects") for seed in FIT_SEEDS]
    angles = [read_json(run / "fit.json")["parameters"]["friction_angle"] for run, _ in runs]
    stds, estimates = sorted(a["std"] for a in angles), ", ".join(f"{a['estimate']:.1f}" for a in angles)
    rows = [
        Row(
            f"{task.dry.name} (true {true:g}°), seeds {', '.join(map(str, FIT_SEEDS))}",
            f"{estimates} ± {stds[0]:.1f} to {stds[-1]:.1f}°",
            "within 2°",
            all(abs(found["estimate"] - true) <= 2.0 for found in angles),
        )
    ]
    if fresh:
        took = runs[0][1]
        what, met = "all of it by `splatsoil run`; its largest process", took.seconds <= 480.0 and took.memory <= 2**31
        rows.append(Row(what, f"{took.seconds / 60.0:.1f} min; {took.memory / 2**30:.1f} GiB", "8 min; 2 GiB", met))
    return Section("Friction angle from photographs and force", rows)


def damp(task: Namespace) -> Section:
    """The command adds what the damp set has and the base model lacks, and nothing else."""
    true, run = Truth.load(task.damp).values, _run(task, task.damp, 0)[0]
    added, estimates = read_json(run / "fit.json")["setup"]["effects"], read_json(run / "diagnosis.json")["estimates"]
    rows = [Row(f"{task.damp.name}: effects added", ", ".join(added), EFFECT, added == [EFFECT])]
    for name, unit, low, high in (("friction_angle", "°", -2.0, 2.0), (EFFECT, " Pa", -60.0, 75.0)):
        if name in estimates:
            found, least, most = estimates[name]["value"], true[name] + low, true[name] + high
            text = f"{found:.3g} ± {estimates[name]['std']:.2g}{unit}"
            rows.append(Row(name.replace("_", " "), text, f"{least:g} to {most:g}{unit}", least <= found <= most))
    return Section("A missing effect", rows)


@cache
def _reconstructed(folder: Path, preset: str, device: str) -> Reconstruction:
    return reconstruct(Measurement.load(folder), preset=preset, device=device)


@dataclass(frozen=True)
class Ran:
    """What a command took: seconds, and bytes of its largest process."""

    seconds: float
    memory: int


# A process is reported to be as large as the one that it began as a copy of, so a small one begins the command.
_COUNTED = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""


def _run(task: Namespace, folder: Path, seed: int, *options: str) -> tuple[Path, Ran]:
    """The folder of ``splatsoil run`` in a process of its own, and what it took; a run that began before goes on.

    Raises:
        RunError: it failed.
    """
    run, began = task.out / "runs" / f"{folder.name}-{seed}", time.monotonic()
    words = ["run", folder, "--run", run, "--preset", task.preset, "--device", task.device, "--seed", seed, *options]
    counted = [sys.executable, "-c", _COUNTED, sys.executable, "-m", "splatsoil", *map(str, words)]
    done = subprocess.run(counted, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"splatsoil {' '.join(map(str, words))}: {' '.join(done.stderr.split())[-300:]}")
    # Linux counts in KiB, macOS in bytes
    return run, Ran(time.monotonic() - began, int(done.stdout) * (1 if sys.platform == "darwin" else 1024))


PARTS = (reconstruction, renderer, dry, damp)
"""In the page's order."""


def main(arguments: list[str] | None = None) -> int:
    """Measure the parts that are asked for, print their tables, and write them into a page."""
    parser = parts_parser(__doc__, "runs/whole-path")
    parser.add_argument("--dry", type=Path, default=Path("examples/plow-dry"), help="set that the base model explains")
    parser.add_argument("--damp", type=Path, default=Path("examples/plow-damp"), help="set with cohesive soil")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS))
    options = parser.parse_args(arguments)
    hush()
    sets = {name: Measurement.load(folder).hash for name, folder in (("dry", options.dry), ("damp", options.damp))}
    key = {"code": sources("whole_path"), "preset": options.preset, **sets}
    parts = {part.__name__: partial(part, options) for part in PARTS}
    return run_parts(options, parts, lambda _: key, "whole path")
