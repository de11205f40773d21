"""How far do our solver's answers depend on its numbers, and how close is it to an independent solver?

The independent solver is Newton's implicit MPM (``newton`` on PyPI; extra ``independent``), run until it converges, on
scenes that are drawn by seed: flat, wavy and sloping beds of loose and dense sand, blades of two widths and rakes, a
drum that turns, friction angles from 22 to 48 degrees; or on measurement sets with true particles. What it simulates is
kept, a file a scene, and a second call continues from there.

Our solver starts from particles that fill the same surface and runs at the true angle and at others. Compared are
heights in patches wider than seed-to-seed scatter, the angle whose heights lie nearest, soil cut and heaped up, and
forces by stage, each as the mean over the stage's frames. ``--cells`` and ``--changes`` compare our solver with itself,
on finer cells and with one of its numbers changed at a time; neither needs the other solver.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._common import Clock, at_least, parser_of, stamp, write_result
from splatsoil.benchmarks._newton import Numerics, World, plough
from splatsoil.benchmarks._scenes import Scene, pair, scenes
from splatsoil.benchmarks._truth import PATCH, FloatArray, Truth, cut_and_heaped, in_patches, stage_forces, volume_range

from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.files import plain
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.quiet import hush
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import FRICTION_ANGLE

FRAMES = (50, 100, 150, 199)
"""At which drawn scenes are compared; sets at those of their true particles."""
OFFSETS = (-6.0, -3.0, 0.0, 3.0, 6.0)
"""Of the angles of our runs from the true one, degrees."""


@dataclass(frozen=True)
class Case:
    """Soil that both solvers plough.

    Attributes:
        name: of its file.
        truth: bed, tool, motion and true parameters; its particles are used only if ``made``.
        numerics: of the independent solver.
        frames: at which solvers are compared, from 1 on.
        about: what its file must state, JSON-able.
        start: (n, 3) particles at frame 0 by their spacing, m.
        made: whether the truth comes with particles that these numerics made.
    """

    name: str
    truth: Truth
    numerics: Numerics
    frames: tuple[int, ...]
    about: Mapping[str, Any]
    start: Callable[[float], FloatArray]
    made: bool = False

    @classmethod
    def drawn(cls, name: str, scene: Scene, numerics: Numerics) -> Case:
        """Of a scene."""
        setup = scene.setup()
        return cls(
            name,
            Truth(setup.experiment(), {}, 0.0, {"friction_angle": scene.angle}, ()),
            numerics,
            FRAMES,
            {"scene": asdict(scene), "numerics": asdict(numerics)},
            lambda spacing: fill(setup.surface, setup.bed, spacing, seed=scene.seed),
        )

    @classmethod
    def of_set(cls, folder: Path, numerics: Numerics) -> Case:
        """Of a measurement set; made already if its particles are of these numerics, scaled to its tool's width.

        A tool's width is its second longest edge, as for our own solver.
        """
        truth = Truth.load(folder)
        name, extents = truth.measurement.name, truth.measurement.tool.mesh.extents
        numerics = numerics.across(float(np.sort(extents)[1]))
        try:
            made = Numerics.of(folder) == numerics and truth.force is not None
        except MeasurementError:
            made = False
        about = {"set": name, **truth.values, "numerics": asdict(numerics)}
        return cls(name, truth, numerics, truth.frames, about, lambda spacing: truth.start(spacing, 0), made)

    @property
    def angle(self) -> float:
        """True friction angle, degrees."""
        return self.truth.values["friction_angle"]

    def refined(self) -> Case:
        """The same with voxels of three quarters."""
        finer = self.numerics.refined()
        about = {**self.about, "numerics": asdict(finer)}
        return replace(self, name=f"{self.name}.fine", numerics=finer, about=about, made=False)

    def world(self) -> World:
        """As Newton takes it."""
        cohesion, spacing = self.truth.values.get("cohesion", 0.0), self.numerics.spacing
        return World(self.name, self.truth.measurement, self.angle, self.start(spacing), spacing, cohesion=cohesion)

    def kept(self, out: Path) -> Truth:
        """With the independent solver's particles and force; ParameterError where the file is of another case."""
        return self.truth if self.made else Truth.saved(out / f"{self.name}.npz", self.about, self.truth)


def plough_missing(
    cases: Sequence[Case], out: Path, device: str, side_by_side: int, say: Callable[[str], None]
) -> None:
    """Simulate the cases that the folder does not have by the independent solver, so many at a time."""
    alike: dict[Any, list[Case]] = {}
    for case in cases:
        if (out / f"{case.name}.npz").is_file():
            case.kept(out)  # another case of this name is refused now, not at the end
        elif not case.made:
            bed = case.truth.measurement.bed
            floor = (float(bed.lower[2]), bed.floor_friction)
            alike.setdefault((case.numerics, case.frames, case.truth.measurement.frame_rate, floor), []).append(case)
    for group in (g[k : k + side_by_side] for g in alike.values() for k in range(0, len(g), side_by_side)):
        worlds, names = [case.world() for case in group], ", ".join(case.name for case in group)
        say(f"{names}: {sum(len(w.particles) for w in worlds)} particles")
        runs = plough(worlds, group[0].numerics, group[0].frames, device)
        for case, world, run in zip(group, worlds, runs, strict=True):
            made = replace(case.truth, particles={0: world.particles, **run.particles}, volume=world.spacing**3)
            replace(made, force=run.force).save(out / f"{case.name}.npz", case.about)
        say(f"{names}: done")


@dataclass(frozen=True)
class Scan:
    """Our solver over friction angles.

    Attributes:
        angles: (n,) in degrees, increasing.
        begun: (ny, nx) heights at frame 0 in m, averaged over seeds as all that follows.
        heights: (n, frames, ny, nx) in m.
        force: (n, f, 3) of the soil on the tool at frames 1, 2, …, f, N.
        scatter: of the heights between seeds, m; None for one seed.
    """

    angles: FloatArray
    begun: FloatArray
    heights: FloatArray
    force: FloatArray
    scatter: float | None = None

    def at(self, angle: float) -> int:
        """Index of the angle nearest to one."""
        return int(np.argmin(np.abs(self.angles - angle)))

    def best(self, other: FloatArray) -> float:
        """Angle whose heights lie nearest to ``other`` (frames, ny, nx) in patches."""
        fine, loss = self._loss(other)
        return float(fine[np.argmin(loss)])

    def residual(self, other: FloatArray) -> float:
        """Difference in patches, m, that no angle takes away."""
        return float(np.sqrt(max(self._loss(other)[1].min(), 0.0)))

    def _loss(self, other: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean square difference by angle, interpolated by a cubic spline."""
        smooth = gaussian_filter(self.heights - other, (0, 0, PATCH, PATCH))
        fine = np.linspace(self.angles[0], self.angles[-1], 2001)
        return fine, CubicSpline(self.angles, np.mean(smooth**2, axis=(1, 2, 3)))(fine)


def scan(truth: Truth, resolution: Resolution, offsets: Sequence[float], seeds: Sequence[int], device: str) -> Scan:
    """Simulate the true angle and others by their offsets for all seeds, on a GPU as one batch.

    Args:
        truth: where particles begin, and the frames at which heights are taken.
        resolution: of our solver.
        offsets: degrees.
        seeds: of the particles.
        device: where to compute.
    """
    low, high = FRICTION_ANGLE.limits or (FRICTION_ANGLE.lower, FRICTION_ANGLE.upper)
    true = truth.values["friction_angle"]
    angles = sorted({true + o for o in (*offsets, 0.0) if low <= true + o <= high})
    batch = [{**truth.values, "friction_angle": a} for a in angles]
    law, volume = Law(find_effects(truth.effects)), resolution.spacing**3
    begun, heights, forces = [], [], []
    for seed in seeds:
        x = truth.start(resolution.spacing, seed)
        runs = [
            run
            for group in ([[values] for values in batch] if device == "cpu" else [batch])
            for run in simulate(
                truth.measurement, x, group, law=law, resolution=resolution, frames=truth.frames, device=device
            )
        ]
        begun.append(truth.heights(x, volume))
        heights.append([[truth.heights(p, volume) for p in run.positions] for run in runs])
        forces.append([run.force for run in runs])
    scatter = float(np.sqrt(np.var(heights, axis=0, ddof=1).mean())) if len(seeds) > 1 else None
    start, height, force = (np.mean(found, axis=0) for found in (begun, heights, forces))
    return Scan(np.array(angles), start, height, force, scatter)


def compare_stages(truth: Truth, ours: FloatArray, other: FloatArray) -> dict[str, dict[str, Any]]:
    """By stage: both mean forces along the way and upwards in N, and how far they are apart over the other's size."""
    last = min(len(ours), len(other))
    own, reference = (stage_forces(truth.measurement, force[:last]) for force in (ours, other))
    return {
        name: {"ours": own[name], "other": there, "off": float(np.hypot(*np.subtract(own[name], there)) / size)}
        for name, there in reference.items()
        if (size := float(np.hypot(*there))) > 0.0
    }


def agreement(truth: Truth, found: Scan) -> dict[str, Any]:
    """A scan beside the independent solver's particles and force, JSON-able."""
    at, theirs, several = found.at(truth.values["friction_angle"]), truth.surfaces(), len(found.angles) > 2
    first = truth.heights(truth.particles[0], truth.volume)
    assert truth.force is not None
    return {
        "angle": truth.values["friction_angle"],
        "angles": found.angles,
        "best_angle": found.best(theirs) if several else None,
        "heights_mm": 1e3 * in_patches(found.heights[at] - theirs),
        "heights_mm_at_best": 1e3 * found.residual(theirs) if several else None,
        "scatter_mm": None if found.scatter is None else 1e3 * found.scatter,
        "volume": volume_range(found.begun, found.heights[at]),
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


def sensitivity(truth: Truth, base: Resolution, found: Scan, seeds: Sequence[int], device: str) -> list[dict[str, Any]]:
    """By how much each of the solver's numbers shifts the angle that the scan reads, in degrees, and the push force."""
    at = found.at(truth.values["friction_angle"])
    angle, force = found.best(found.heights[at]), _push(truth, found.force[at])
    rows = []
    for name, resolution in changed(base).items():
        other = scan(truth, resolution, (), seeds, device)
        shifted = found.best(other.heights[0]) - angle
        rows.append({"change": name, "angle": shifted, "force": _push(truth, other.force[0]) / force - 1.0})
    return rows


def convergence(
    truth: Truth, preset: str, cells: Sequence[float], offsets: Sequence[float], seeds: Sequence[int], device: str
) -> list[dict[str, float]]:
    """One row for each number of cells across the tool, the coarsest first, compared with the finest one's heights."""
    true, rows = truth.values["friction_angle"], []
    grids = [Resolution.derive(truth.measurement, replace(PRESETS[preset], cells_across_tool=c)) for c in sorted(cells)]
    finest = scan(truth, grids[-1], (), seeds, device)
    for grid in grids:
        found = finest if grid is grids[-1] else scan(truth, grid, offsets, seeds, device)
        at = found.at(true)
        low, high = volume_range(found.begun, found.heights[at])
        rows.append({"cell_mm": 1e3 * grid.cell, "force": _push(truth, found.force[at]), "lost": low, "gained": high})
        if found is not finest:
            rows[-1]["heights_mm"] = 1e3 * in_patches(found.heights[at] - finest.heights[0])
            rows[-1]["angle_off"] = found.best(finest.heights[0]) - true
    return rows


def _push(truth: Truth, force: FloatArray) -> float:
    """Mean force along the tool's way while it is pushed, N."""
    return abs(stage_forces(truth.measurement, force)["pushing"][0])


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    cases = result["cases"]
    lines = [f"{result['seeds']} particle seeds, {result['made_by']['device']}."]
    for preset in result["presets"]:
        rows = {n: c["agreement"][preset] for n, c in cases.items() if preset in c.get("agreement", {})}
        if rows:
            lines += ["", *_agreement_table(preset, rows), "", *_summary(rows)]
    for name, case in cases.items():
        if case.get("convergence"):
            lines += [
                "",
                f"| {name}: cell, mm | angle off | heights off, mm | push force, N | volume |",
                "|---" * 5 + "|",
            ]
        for row in case.get("convergence", ()):
            off = f"{row['angle_off']:+.1f}° | {row['heights_mm']:.1f}" if "angle_off" in row else "– | –"
            volume = f"{100 * row['lost']:+.2f} to {100 * row['gained']:+.2f} %"
            lines.append(f"| {row['cell_mm']:.1f} | {off} | {row['force']:.0f} | {volume} |")
        if case.get("changes"):
            lines += ["", f"| {name}: change | shift of the angle | of the push force |", "|---" * 3 + "|"]
        for row in case.get("changes", ()):
            lines.append(f"| {row['change']} | {row['angle']:+.1f}° | {100 * row['force']:+.0f} % |")
    refined = {name: case["refined"] for name, case in cases.items() if "refined" in case}
    if refined:
        lines += ["", "| Newton on voxels of 3/4 | heights off, mm | force while pushed |", "|---" * 3 + "|"]
        lines += [f"| {n} | {f['heights_mm']:.2f} | {100 * f['pushing']:.1f} % |" for n, f in refined.items()]
    return "\n".join(lines)


def _agreement_table(preset: str, rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    stages = list(dict.fromkeys(s for row in rows.values() for s in row["stages"]))
    lines = [
        f"Preset `{preset}`: ours / Newton's; forces along the way, upwards in N.",
        "",
        "| case | true φ | best φ | heights at the truth, mm | at the best φ, mm | cut, cm³ | heaped, cm³ | "
        + " | ".join(stages)
        + " |",
        "|---" * (7 + len(stages)) + "|",
    ]
    for name, row in rows.items():
        best = "–" if row["best_angle"] is None else f"{row['best_angle']:.1f}°"
        best += " (end of the scan)" if row["best_angle"] in (row["angles"][0], row["angles"][-1]) else ""
        least = "–" if row["heights_mm_at_best"] is None else f"{row['heights_mm_at_best']:.2f}"
        cells = [name, f"{row['angle']:.1f}°", best, f"{row['heights_mm']:.2f}", least]
        soil = zip(row["cut_and_heaped_cm3"], row["their_cut_and_heaped_cm3"], strict=True)
        cells += [f"{own:.0f} / {other:.0f}" for own, other in soil]
        for stage in (row["stages"].get(s) for s in stages):
            pairs = zip(stage["ours"], stage["other"], strict=True) if stage else ()
            cells.append(", ".join(f"{own:.0f} / {other:.0f}" for own, other in pairs) or "–")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _summary(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What all cases come to."""

    def spread(what: str, values: Sequence[float], digits: int) -> str:
        rms, most = np.sqrt(np.mean(np.square(values))), np.max(np.abs(values))
        mean = np.mean(values)
        return f"- {what}: mean {mean:+.{digits}f}, root mean square {rms:.{digits}f}, {most:.{digits}f} at most"

    lines = [spread("heights at the truth, mm", [row["heights_mm"] for row in rows.values()], 2)]
    off = [row["best_angle"] - row["angle"] for row in rows.values() if row["best_angle"] is not None]
    lines += [spread("best angle less the true one, degrees", off, 2)] if off else []
    for name in dict.fromkeys(s for row in rows.values() for s in row["stages"]):
        apart = [100.0 * row["stages"][name]["off"] for row in rows.values() if name in row["stages"]]
        lines.append(spread(f"force, {name}, difference in %", apart, 0))
    return lines


def measure(case: Case, options: argparse.Namespace, say: Callable[[str], None]) -> dict[str, Any]:
    """All that the command line asks for of a case."""
    seeds, device, offsets = range(options.seeds), options.device, options.offsets
    truth, found = case.kept(options.out), dict[str, Any](case.about)
    found["agreement"] = {}
    for preset in options.presets:
        base = Resolution.derive(truth.measurement, preset)
        scanned = scan(truth, base, offsets, seeds, device)
        found["agreement"][preset] = agreement(truth, scanned)
        if options.changes and preset == options.presets[0]:
            found["changes"] = sensitivity(truth, base, scanned, seeds, device)
        say(f"{case.name}, {preset}: compared")
    if options.cells:
        found["convergence"] = convergence(truth, options.presets[0], options.cells, offsets, seeds, device)
    if (options.out / f"{case.name}.fine.npz").is_file():
        fine = case.refined().kept(options.out)
        assert truth.force is not None and fine.force is not None
        pushing = compare_stages(truth, truth.force, fine.force)["pushing"]["off"]
        found["refined"] = {"heights_mm": 1e3 * in_patches(truth.surfaces() - fine.surfaces()), "pushing": pushing}
    return found


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=at_least(0), help="scenes that are drawn; 6, or with --sets none")
    parser.add_argument("--seed", type=int, default=1, help="of the scenes")
    parser.add_argument("--pairs", action="store_true", help="also one scene with tool friction 0.3 and 0.9")
    parser.add_argument("--sets", type=Path, nargs="+", default=[], metavar="DIR", help="measurement sets with truths")
    parser.add_argument("--out", type=Path, default=Path("runs/solvers"), help="folder of scenes and results")
    parser.add_argument("--presets", nargs="+", default=["small"], choices=sorted(PRESETS), help="of our solver")
    parser.add_argument("--cells", nargs="+", type=float, default=[], help="across the tool: ours on these grids")
    parser.add_argument("--changes", action="store_true", help="change each number of our solver")
    parser.add_argument("--offsets", nargs="*", type=float, default=list(OFFSETS), help="of our angles, degrees")
    parser.add_argument("--seeds", type=at_least(1), default=2, help="particle seeds that ours are averaged over")
    parser.add_argument("--side-by-side", type=at_least(1), default=4, help="scenes that Newton ploughs at a time")
    parser.add_argument("--refine", action="store_true", help="Newton on finer voxels, too")
    parser.add_argument("--voxel", type=float, default=Numerics.voxel, help="edge of Newton's cells, m")
    parser.add_argument("--substeps", type=at_least(1), default=Numerics.substeps, help="of Newton in a frame")
    parser.add_argument("--iterations", type=at_least(1), default=Numerics.iterations, help="most in a substep")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    options = parser.parse_args(arguments)
    if not options.voxel > 0.0:
        raise ParameterError("--voxel must be positive")
    if (options.changes or options.cells) and len({0.0, *options.offsets}) < 3:
        raise ParameterError("--changes and --cells read angles off a scan: give two or more --offsets")
    count = options.count if options.count is not None else 0 if options.sets else 6
    numerics = Numerics(options.voxel, options.substeps, options.iterations)
    drawn = [(f"scene-{options.seed}-{k}", scene) for k, scene in enumerate(islice(scenes(options.seed), count))]
    if options.pairs:
        drawn += [(f"pair-{options.seed}-friction-{s.tool_friction:g}", s) for s in pair(options.seed)]
    cases = [Case.drawn(name, scene, numerics) for name, scene in drawn]
    cases += [Case.of_set(folder, numerics) for folder in options.sets]
    if not cases:
        raise ParameterError("there is nothing to compare: give --count or --sets")
    hush()
    say = Clock()
    finer = [case.refined() for case in cases] if options.refine else []
    plough_missing([*cases, *finer], options.out, options.device, options.side_by_side, say)
    result = {"made_by": stamp(options.device), "seeds": options.seeds, "presets": options.presets, "cases": {}}
    for case in cases:
        result["cases"][case.name] = measure(case, options, say)
        write_result(options.out, result, table(result), {})
    print(json.dumps(plain(result), indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
