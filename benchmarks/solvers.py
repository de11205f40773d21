"""How far do our solver's answers depend on its numbers, and how close is it to an independent solver?

The independent solver is Newton's implicit MPM (``newton`` on PyPI; extra ``independent``), run until it converges, on
scenes that are drawn by seed: flat, wavy and sloping beds of loose and dense sand, blades of two widths and rakes, a
drum that turns, friction angles from 22 to 48 degrees; or what measurement sets with true particles have of it. What it
simulates is kept, a file a scene, and a second call continues from there.

Our solver starts from particles that fill the same surface and runs at the true angle and at others. Compared are
heights in patches wider than seed-to-seed scatter, the angle whose heights lie nearest, soil cut and heaped up, and
forces by stage, each as the mean over the stage's frames. ``--cells`` and ``--changes`` compare our solver with itself,
on finer cells and with one of its numbers changed at a time; neither needs the other solver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._common import Clock, FloatArray, at_least, markdown, parser_of, stamp, tell
from splatsoil.benchmarks._hidden import NOTHING, Hidden
from splatsoil.benchmarks._newton import Numerics, plough
from splatsoil.benchmarks._scenes import Scene, scenes
from splatsoil.benchmarks._truth import (
    PATCH,
    Truth,
    cut_and_heaped,
    in_patches,
    read_particles,
    stage_forces,
    volume_range,
)

from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.files import plain, read_json, write_json
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.quiet import hush
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import FRICTION_ANGLE
from splatsoil.synthetic.world import save_particles

FRAMES = (50, 100, 150, 199)
"""At which drawn scenes are compared; sets at those of their true particles."""
OFFSETS = (-6.0, -3.0, 3.0, 6.0)
"""Of the angles of our runs from the true one, degrees."""


def ploughed(cases: Mapping[str, Scene], out: Path, device: str, side_by_side: int, say: Clock) -> dict[str, Truth]:
    """Scenes by their names with the independent solver's particles and force; those that the folder does not have are
    simulated, so many at a time.

    Raises:
        ParameterError: the folder has another scene of a name, or one of other numerics.
    """
    numerics, truths = Numerics(), {}
    about = {name: plain({"scene": asdict(scene), "numerics": asdict(numerics)}) for name, scene in cases.items()}
    missing = [name for name in cases if not (out / f"{name}.json").is_file()]
    for group in (missing[k : k + side_by_side] for k in range(0, len(missing), side_by_side)):
        say(f"{', '.join(group)}: begun")
        soils = [Hidden(NOTHING, 0, cases[name]).soil(cases[name].setup(), numerics.spacing) for name in group]
        for name, run in zip(group, plough(soils, numerics, FRAMES, device), strict=True):
            out.mkdir(parents=True, exist_ok=True)
            save_particles(out / f"{name}.npz", run, run.frames)
            write_json(out / f"{name}.json", {**about[name], "force": run.force})
    for name, scene in cases.items():
        kept = read_json(out / f"{name}.json")
        force = np.array(kept.pop("force"))
        if kept != about[name]:
            raise ParameterError(f"{out / name}: is another scene or of other numerics; choose another --out")
        particles, spacing = read_particles(out / f"{name}.npz")
        values = {"friction_angle": scene.angle}
        truths[name] = Truth(scene.setup().experiment(), particles, spacing**3, values, (), force)
    return truths


def of_set(folder: Path) -> Truth:
    """A measurement set with true particles; MeasurementError where it lacks them, or the force."""
    truth = Truth.load(folder)
    if truth.force is None:
        raise MeasurementError("the benchmark needs the true force", file=folder)
    return truth


@dataclass(frozen=True)
class Scan:
    """Our solver over friction angles.

    Attributes:
        truth: where particles begin, and the frames at which heights are taken.
        angles: (n,) in degrees, increasing.
        begun: (ny, nx) heights at frame 0 in m, averaged over seeds as all that follows.
        heights: (n, frames, ny, nx) in m.
        force: (n, f, 3) of the soil on the tool at frames 1, 2, …, f, N.
    """

    truth: Truth
    angles: FloatArray
    begun: FloatArray
    heights: FloatArray
    force: FloatArray

    @classmethod
    def simulated(
        cls, truth: Truth, seeds: Sequence[int], device: str, resolution: Resolution, offsets: Sequence[float] = ()
    ) -> Scan:
        """The true angle and others by offsets in degrees, for all seeds of the particles; on a GPU as one batch."""
        volume, true = resolution.spacing**3, truth.values["friction_angle"]
        low, high = FRICTION_ANGLE.limits or (FRICTION_ANGLE.lower, FRICTION_ANGLE.upper)
        angles = sorted({true + o for o in (*offsets, 0.0) if low <= true + o <= high})
        batch = [{**truth.values, "friction_angle": angle} for angle in angles]
        given: dict[str, Any] = {"law": Law(find_effects(truth.effects)), "resolution": resolution}
        begun, heights, forces = [], [], []
        for seed in seeds:
            x = truth.start(resolution.spacing, seed)
            runs = [
                run
                for group in ([[values] for values in batch] if device == "cpu" else [batch])
                for run in simulate(truth.measurement, x, group, **given, frames=truth.frames, device=device)
            ]
            begun.append(truth.heights(x, volume))
            heights.append([[truth.heights(p, volume) for p in run.positions] for run in runs])
            forces.append([run.force for run in runs])
        return cls(truth, np.array(angles), *(np.mean(found, axis=0) for found in (begun, heights, forces)))

    @property
    def at(self) -> int:
        """Index of the true angle."""
        return int(np.argmin(np.abs(self.angles - self.truth.values["friction_angle"])))

    @property
    def push(self) -> float:
        """Mean force along the tool's way while it is pushed at the true angle, N."""
        return abs(stage_forces(self.truth.measurement, self.force[self.at])["pushing"][0])

    def best(self, other: FloatArray) -> tuple[float, float]:
        """Angle whose heights lie nearest to ``other`` (frames, ny, nx) in patches, by a cubic spline through mean
        squares, and the difference in m that remains there."""
        smooth = gaussian_filter(self.heights - other, (0, 0, PATCH, PATCH))
        fine = np.linspace(self.angles[0], self.angles[-1], 2001)
        loss = CubicSpline(self.angles, np.mean(smooth**2, axis=(1, 2, 3)))(fine)
        return float(fine[np.argmin(loss)]), float(np.sqrt(max(loss.min(), 0.0)))


Scanner = Callable[..., Scan]
"""Makes scans of one truth, of a resolution and offsets; see :meth:`Scan.simulated`."""


def compare_stages(truth: Truth, ours: FloatArray, other: FloatArray) -> dict[str, dict[str, Any]]:
    """By stage: both mean forces along the way and upwards in N, and how far they are apart over the other's size."""
    last = min(len(ours), len(other))
    own, reference = (stage_forces(truth.measurement, force[:last]) for force in (ours, other))
    return {
        name: {"ours": own[name], "other": there, "off": float(np.hypot(*np.subtract(own[name], there)) / size)}
        for name, there in reference.items()
        if (size := float(np.hypot(*there))) > 0.0
    }


def agreement(found: Scan) -> dict[str, Any]:
    """A scan beside the independent solver's particles and force, JSON-able."""
    truth, at, theirs = found.truth, found.at, found.truth.surfaces()
    first, (best, left) = truth.heights(truth.particles[0], truth.volume), found.best(theirs)
    assert truth.force is not None
    return {
        "angle": truth.values["friction_angle"],
        "angles": found.angles,
        "best_angle": best,
        "heights_mm": 1e3 * in_patches(found.heights[at] - theirs),
        "heights_mm_at_best": 1e3 * left,
        "cut_and_heaped_cm3": cut_and_heaped(found.begun, found.heights[at][-1]),
        "their_cut_and_heaped_cm3": cut_and_heaped(first, theirs[-1]),
        "stages": compare_stages(truth, found.force[at], truth.force),
    }


def changed(base: Resolution) -> dict[str, Resolution]:
    """The solver with one of its numbers changed."""
    return {
        "half the particles' step": replace(base, steps=2 * base.steps),
        "half the grid's substep": replace(base, courant=base.courant / 2.0),
        "Young's modulus × 3": replace(base, bulk=3.0 * base.bulk, shear=3.0 * base.shear),
        "27 instead of 8 particles a cell": replace(base, spacing=base.spacing / 1.5),
        "hourglass modes damped twice as fast": replace(base, relaxation=2.0 * base.relaxation),
        "hourglass modes damped half as fast": replace(base, relaxation=0.5 * base.relaxation),
        "faces of thin plates without skin": replace(base, skin=0.0),
    }


def sensitivity(scan: Scanner, base: Resolution, found: Scan) -> list[dict[str, Any]]:
    """By how much each of the solver's numbers shifts the angle that the scan reads, in degrees, and the push force."""
    angle, _ = found.best(found.heights[found.at])
    others = {name: scan(resolution) for name, resolution in changed(base).items()}
    return [
        {"change": name, "angle": found.best(o.heights[0])[0] - angle, "force": o.push / found.push - 1.0}
        for name, o in others.items()
    ]


def convergence(scan: Scanner, truth: Truth, preset: str, cells: Sequence[float]) -> list[dict[str, float]]:
    """One row for each number of cells across the tool, the coarsest first, compared with the finest one's heights."""
    rows = []
    across = [replace(PRESETS[preset], cells_across_tool=c) for c in sorted(cells)]
    *grids, last = (Resolution.derive(truth.measurement, p) for p in across)
    finest = scan(last)
    for grid, found in [*((grid, scan(grid, OFFSETS)) for grid in grids), (last, finest)]:
        heights = found.heights[found.at]
        low, high = volume_range(found.begun, heights)
        rows.append({"cell_mm": 1e3 * grid.cell, "force": found.push, "lost": low, "gained": high})
        if found is not finest:
            rows[-1]["heights_mm"] = 1e3 * in_patches(heights - finest.heights[0])
            rows[-1]["angle_off"] = found.best(finest.heights[0])[0] - truth.values["friction_angle"]
    return rows


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    cases, preset = result["cases"], result["preset"]
    text = [f"Preset `{preset}`, {result['seeds']} particle seeds, {result['made_by']['device']}."]
    text += _agreement({name: case["agreement"] for name, case in cases.items()})
    for name, case in cases.items():
        if case.get("convergence"):
            head = [f"{name}: cell, mm", "angle off", "heights off, mm", "push force, N", "volume"]
            text.append(markdown(head, [_convergence(row) for row in case["convergence"]]))
        if case.get("changes"):
            head = [f"{name}: change", "shift of the angle", "of the push force"]
            shifts = [(r["change"], f"{r['angle']:+.1f}°", f"{100 * r['force']:+.0f} %") for r in case["changes"]]
            text.append(markdown(head, shifts))
    return "\n\n".join(text)


def _convergence(row: Mapping[str, float]) -> list[str]:
    off = [f"{row['angle_off']:+.1f}°", f"{row['heights_mm']:.1f}"] if "angle_off" in row else ["–", "–"]
    volume = f"{100 * row['lost']:+.2f} to {100 * row['gained']:+.2f} %"
    return [f"{row['cell_mm']:.1f}", *off, f"{row['force']:.0f}", volume]


def _agreement(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """All cases, and what they come to."""
    stages = list(dict.fromkeys(s for row in rows.values() for s in row["stages"]))
    head = "case", "true φ", "best φ", "heights at the truth, mm", "at the best φ, mm", "cut, cm³", "heaped, cm³"
    lines = []
    for name, row in rows.items():
        end = " (end of the scan)" if row["best_angle"] in (row["angles"][0], row["angles"][-1]) else ""
        cells = [name, f"{row['angle']:.1f}°", f"{row['best_angle']:.1f}°{end}"]
        cells += [f"{row['heights_mm']:.2f}", f"{row['heights_mm_at_best']:.2f}"]
        soil = zip(row["cut_and_heaped_cm3"], row["their_cut_and_heaped_cm3"], strict=True)
        cells += [f"{own:.0f} / {other:.0f}" for own, other in soil]
        for stage in (row["stages"].get(s) for s in stages):
            pairs = zip(stage["ours"], stage["other"], strict=True) if stage else ()
            cells.append(", ".join(f"{own:.0f} / {other:.0f}" for own, other in pairs) or "–")
        lines.append(cells)
    apart = {"heights at the truth, mm": [row["heights_mm"] for row in rows.values()]}
    apart["best angle less the true one, degrees"] = [row["best_angle"] - row["angle"] for row in rows.values()]
    for s in stages:
        off = [100.0 * row["stages"][s]["off"] for row in rows.values() if s in row["stages"]]
        apart[f"force, {s}, difference in %"] = off
    means = [
        f"- {what}: mean {np.mean(off):+.2f}, root mean square {np.sqrt(np.mean(np.square(off))):.2f}, "
        f"{np.max(np.abs(off)):.2f} at most"
        for what, off in apart.items()
    ]
    words = "Ours / Newton's; forces along the way, upwards in N."
    return [words, markdown([*head, *stages], lines), "\n".join(means)]


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = parser_of(__doc__, "runs/solvers")
    parser.add_argument("--count", type=at_least(0), help="scenes that are drawn; 6, or with --sets none")
    parser.add_argument("--seed", type=int, default=1, help="of the scenes")
    parser.add_argument("--sets", type=Path, nargs="+", default=[], metavar="DIR", help="measurement sets with truths")
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS), help="of our solver")
    parser.add_argument("--cells", nargs="+", type=float, default=[], help="across the tool: ours on these grids")
    parser.add_argument("--changes", action="store_true", help="change each number of our solver")
    parser.add_argument("--seeds", type=at_least(1), default=2, help="particle seeds that ours are averaged over")
    parser.add_argument("--side-by-side", type=at_least(1), default=4, help="scenes that Newton ploughs at a time")
    options = parser.parse_args(arguments)
    count = options.count if options.count is not None else 0 if options.sets else 6
    drawn = {f"scene-{options.seed}-{k}": scene for k, scene in enumerate(islice(scenes(options.seed), count))}
    truths = {truth.measurement.name: truth for truth in map(of_set, options.sets)}
    if not drawn and not truths:
        raise ParameterError("there is nothing to compare: give --count or --sets")
    hush()
    say, preset = Clock(), options.preset
    truths |= ploughed(drawn, options.out, options.device, options.side_by_side, say)
    result: dict[str, Any] = {"made_by": stamp(options.device), "seeds": options.seeds, "preset": preset, "cases": {}}
    for name, truth in truths.items():
        scan = partial(Scan.simulated, truth, range(options.seeds), options.device)
        base = Resolution.derive(truth.measurement, preset)
        scanned = scan(base, OFFSETS)
        found: dict[str, Any] = {"agreement": agreement(scanned)}
        if name in drawn:
            found["scene"] = asdict(drawn[name])
        if options.changes:
            found["changes"] = sensitivity(scan, base, scanned)
        if options.cells:
            found["convergence"] = convergence(scan, truth, preset, options.cells)
        result["cases"][name] = found
        write_json(options.out / "result.json", result)
        say(f"{name}: compared")
    tell(options, result, table(result))
    return 0
