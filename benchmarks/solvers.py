"""How close does our solver come to an independent one that has converged: heights, angle, force in every stage?

The independent solver is Newton's implicit MPM (``newton`` on PyPI; extra ``independent``), run until it converges, on
scenes that are drawn by seed: flat, wavy and sloping beds of loose and dense sand, blades of two widths and rakes, a
drum that turns, friction angles from 22 to 48 degrees. What it ploughs is kept, a file a world, and a second call goes
on from there; from these files our solver is judged with the package or without. Started from particles that fill the
same surface, it runs at the true angle and at others: heights are compared in patches larger than chance, the angle
whose heights lie nearest is told, soil cut and soil heaped up are told apart, and forces are compared by stage, each as
the mean over the stage's frames.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._common import at_least, here, stamp, write_result
from splatsoil.benchmarks._newton import Numerics, Run, World, load_newton, plough
from splatsoil.benchmarks._scenes import Scene, pair, scenes
from splatsoil.benchmarks.numerics import CELL, PATCH, FloatArray, Scan, Truth, pushing, volume_range

from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.experiment.scene_parts import heading_of, stages_of
from splatsoil.files import plain, read_npz, write_bytes
from splatsoil.measurement import Measurement
from splatsoil.mpm import Resolution, simulate
from splatsoil.quiet import hush
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import FRICTION_ANGLE

FRAMES = (50, 100, 150, 199)
"""At which drawn scenes are compared; sets at those of their true particles."""
SCALE = 1.25e-5
"""Step of kept positions, m."""
OFFSETS = (-6.0, -3.0, 0.0, 3.0, 6.0)
"""Of the angles of our runs from the true one, degrees."""
SETTLED = 2.0e-3
"""Change of a patch's height below which its soil counts as neither cut nor heaped, m: three times the scatter between
particle seeds, which would else fill a bed of 0.4 m² with a hundred cm³ of both."""
LEAST = 0.2
"""Of a stage's force that a component must have for its ratio to be told."""
HEIGHTS_CLOSE, FORCE_CLOSE = 1.0e-3, 0.05
"""By how much voxels of three quarters may move a world that counts as converged: m in patches, share of a force."""


@dataclass(frozen=True)
class Case:
    """A world that is asked for.

    Attributes:
        name: of its file.
        kind: worlds of one kind share a check by finer voxels.
        measurement: bed, tool and motion.
        numerics: by which the independent solver ploughs it.
        frames: at which it is compared, from 1 on.
        values: true parameters by name.
        effects: effects that are on, by name.
        about: what its file must tell to be this one, JSON-able.
        start: (n, 3) particles at frame 0 by their spacing, m.
        made: the world, where it comes with a measurement set that converged numerics made.
    """

    name: str
    kind: str
    measurement: Measurement
    numerics: Numerics
    frames: tuple[int, ...]
    values: Mapping[str, float]
    effects: tuple[str, ...]
    about: Mapping[str, Any]
    start: Callable[[float], FloatArray]
    made: Kept | None = None

    @classmethod
    def drawn(cls, name: str, scene: Scene, numerics: Numerics) -> Case:
        """Of a scene."""
        setup = scene.setup()
        return cls(
            name,
            f"{scene.tool} {scene.width:g} m, {scene.tilt:g}°, friction {scene.tool_friction:g}",
            setup.experiment(),
            numerics,
            FRAMES,
            {"friction_angle": scene.angle},
            (),
            asdict(scene),
            lambda spacing: fill(setup.surface, setup.bed, spacing, seed=scene.seed),
        )

    @classmethod
    def of_set(cls, folder: Path, numerics: Numerics) -> Case:
        """Of a measurement set with a truth; made already, where it was ploughed as these numerics are for its tool.

        A tool's width is its second longest edge, as for our own solver.
        """
        truth = Truth.load(folder)
        measurement, force = truth.measurement, truth.measurement.tool.force
        numerics = numerics.across(float(np.sort(measurement.tool.mesh.extents)[1]))
        try:
            same = Numerics.of(folder) == numerics and force is not None
        except MeasurementError:
            same = False
        # the table has a row for each frame from 1 on
        made = Kept(truth.particles, truth.volume ** (1.0 / 3.0), force[:, 2:]) if same and force is not None else None
        about = {"set": measurement.name, **truth.values}
        return cls(
            measurement.name,
            measurement.name,
            measurement,
            numerics,
            tuple(frame for frame in sorted(truth.particles) if frame > 0),
            truth.values,
            truth.effects,
            about,
            lambda spacing: truth.start(spacing, 0),
            made,
        )

    @property
    def angle(self) -> float:
        """True friction angle, degrees."""
        return self.values["friction_angle"]

    def finer(self) -> Case:
        """The same with voxels of three quarters."""
        return replace(self, numerics=self.numerics.refined())

    def world(self) -> World:
        """As Newton takes it."""
        cohesion, spacing = self.values.get("cohesion", 0.0), self.numerics.spacing
        return World(self.name, self.measurement, self.angle, self.start(spacing), spacing, cohesion=cohesion)

    def truth(self, kept: Kept) -> Truth:
        """As our benchmarks take it."""
        return Truth(self.measurement, kept.particles, kept.spacing**3, dict(self.values), self.effects)

    def heights(self, kept: Kept) -> FloatArray:
        """(frames, ny, nx) m, at the frames that are compared."""
        return surfaces(self.measurement, kept.particles, kept.spacing)


@dataclass(frozen=True)
class Kept:
    """A world that the independent solver made.

    Attributes:
        particles: (n, 3) in m by frame, from 0 on.
        spacing: edge of the cube of soil that a particle stands for, m.
        force: (f, 3) N, of the soil on the tool: mean over the time that leads to frames 1, 2, …, f.
    """

    particles: dict[int, FloatArray]
    spacing: float
    force: FloatArray

    def save(self, file: Path, about: Mapping[str, Any]) -> None:
        """Positions as ``fNNN`` (n, 3) uint16: times ``scale`` plus ``origin`` they are metres; with ``spacing``,
        ``force`` and, as JSON, what the world is."""
        origin = np.floor(100.0 * np.min([x.min(axis=0) for x in self.particles.values()], axis=0)) / 100.0
        reach = max(float((x - origin).max()) for x in self.particles.values())
        scale = SCALE * max(1.0, np.ceil(reach / (SCALE * np.iinfo(np.uint16).max)))
        stored = {f"f{f:03d}": np.round((x - origin) / scale).astype(np.uint16) for f, x in self.particles.items()}
        _archive(
            file,
            scale=scale,
            origin=origin,
            spacing=self.spacing,
            force=self.force.astype(np.float32),
            about=json.dumps(plain(about)),
            **stored,
        )

    @classmethod
    def load(cls, file: Path, about: Mapping[str, Any]) -> Kept:
        """What `save` wrote; ParameterError where the file holds another world."""
        check_about(file, about)
        return cls(*read_particles(file), read_npz(file, ["force"])["force"].astype(np.float64))


def read_particles(file: Path) -> tuple[dict[int, FloatArray], float]:
    """Positions (n, 3) in m by frame and the particles' spacing in m, as `Kept.save` and sets store them."""
    with np.load(file) as stored:
        scale, origin = float(stored["scale"]), stored["origin"]
        particles = {int(k[1:]): stored[k] * scale + origin for k in stored.files if k[1:].isdigit()}
        return particles, float(stored["spacing"])


def surfaces(measurement: Measurement, particles: dict[int, FloatArray], spacing: float) -> FloatArray:
    """Heights (frames, ny, nx) in m at the frames after 0, of particles (n, 3) by frame."""
    truth = Truth(measurement, particles, spacing**3, {}, ())
    return np.array([truth.heights(particles[f], truth.volume) for f in sorted(particles) if f > 0])


def _archive(file: Path, **arrays: Any) -> None:
    """Write arrays whole or not at all, compressed."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    write_bytes(file, stream.getvalue())


def check_about(file: Path, about: Mapping[str, Any]) -> dict[str, Any]:
    """What a file tells of its world, with what it took; ParameterError unless it is the one that is asked for."""
    told = json.loads(str(read_npz(file, ["about"])["about"]))
    if {key: told.get(key) for key in about} != json.loads(json.dumps(plain(about))):
        raise ParameterError(f"{file}: holds another scene or other numerics; choose another --out")
    return dict(told)


def plough_missing(
    cases: Sequence[Case],
    out: Path,
    device: str,
    side_by_side: int,
    say: Callable[[str], None],
    *,
    fine: bool = False,
) -> None:
    """Make the worlds that the folder doesn't have, so many at a time; of fine ones keep heights, not particles."""
    missing = []
    for case in cases:
        if place(out, case, fine).is_file():
            check_about(place(out, case, fine), told(case))
        elif fine or case.made is None:
            missing.append(case)
    for group in _groups(missing, side_by_side):
        began = time.perf_counter()
        worlds = [case.world() for case in group]
        names = ", ".join(case.name for case in group)
        say(f"{names}: {sum(len(w.particles) for w in worlds)} particles")

        def progress(frame: int, last: int, names: str = names) -> None:
            if frame in (1, 2, 5) or frame % 25 == 0:
                say(f"{names}: frame {frame} of {last}")

        runs = plough(worlds, group[0].numerics, group[0].frames, device, progress=progress)
        seconds = time.perf_counter() - began
        more = {"newton": load_newton().__version__, "device": device.split(":")[0], "seconds": seconds}
        for case, world, run in zip(group, worlds, runs, strict=True):
            _keep(place(out, case, fine), case, world, run, {**told(case), **more, "beside": len(group)}, fine)
        say(f"{names}: done in {seconds:.0f} s")


def _groups(cases: Sequence[Case], most: int) -> list[list[Case]]:
    """Those that can be ploughed side by side together, ``most`` at a time, in their order."""
    alike: dict[Any, list[Case]] = {}
    for case in cases:
        bed = case.measurement.bed
        floor = (float(bed.lower[2]), bed.floor_friction)
        alike.setdefault((case.numerics, case.frames, case.measurement.frame_rate, floor), []).append(case)
    return [group[k : k + most] for group in alike.values() for k in range(0, len(group), most)]


def told(case: Case) -> dict[str, Any]:
    """What a file tells of the world in it."""
    return {"scene": dict(case.about), "numerics": asdict(case.numerics)}


def place(out: Path, case: Case, fine: bool = False) -> Path:
    """A world's file."""
    return out / f"{case.name}{'.fine' if fine else ''}.npz"


def _keep(file: Path, case: Case, world: World, run: Run, about: Mapping[str, Any], fine: bool) -> None:
    kept = Kept({0: world.particles, **run.particles}, world.spacing, run.force)
    if not fine:
        kept.save(file, about)
        return
    _archive(
        file,
        heights=case.heights(kept).astype(np.float32),
        force=kept.force.astype(np.float32),
        about=json.dumps(plain(about)),
    )


def in_patches(difference: FloatArray) -> float:
    """Root mean square of a difference of heights (…, ny, nx), smoothed to patches larger than chance."""
    width = (0.0,) * (difference.ndim - 2) + (PATCH, PATCH)
    return float(np.sqrt(np.mean(gaussian_filter(difference, width) ** 2)))


def cut_and_heaped(before: FloatArray, after: FloatArray) -> FloatArray:
    """Soil that is missing and soil that was added, (frames, 2) in cm³.

    Args:
        before: heights (ny, nx) in m.
        after: heights (frames, ny, nx) in m.
    """
    change = gaussian_filter(after - before, (0.0, PATCH, PATCH))
    change = np.where(np.abs(change) > SETTLED, change, 0.0)
    parts = [np.clip(sign * change, 0.0, None).sum(axis=(1, 2)) for sign in (-1.0, 1.0)]
    return np.stack(parts, axis=1) * CELL**2 * 1.0e6


def stage_forces(measurement: Measurement, force: FloatArray) -> dict[str, tuple[float, float]]:
    """Mean force along the tool's way forward and upwards, N, over all frames of each stage, by the stages' names.

    Args:
        measurement: bed, tool and motion.
        force: (f, 3) N at frames 1, 2, …, f.
    """
    stages = np.array(stages_of(measurement, [float(frame) for frame in range(1, len(force) + 1)]))
    heading = heading_of(measurement)
    parts = np.stack([force[:, :2] @ heading, force[:, 2]], axis=1)
    return {
        str(name): (float(mean[0]), float(mean[1]))
        for name in dict.fromkeys(stages)
        for mean in [parts[stages == name].mean(axis=0)]
    }


def compare_forces(measurement: Measurement, ours: FloatArray, theirs: FloatArray) -> dict[str, dict[str, Any]]:
    """By stage: both means, their ratios and how far they are apart as a share of theirs.

    A ratio is None where the component is a small part of the stage's force.
    """
    last = min(len(ours), len(theirs))
    own, other = stage_forces(measurement, ours[:last]), stage_forces(measurement, theirs[:last])
    found = {}
    for name, there in other.items():
        size = float(np.hypot(*there))
        apart = float(np.hypot(*np.subtract(own[name], there)))
        found[name] = {
            "ours": own[name],
            "newton": there,
            "ratio": [a / b if abs(b) > LEAST * size else None for a, b in zip(own[name], there, strict=True)],
            "off": apart / size if size > 0.0 else None,
        }
    return found


def judge(
    case: Case, kept: Kept, preset: str, offsets: Sequence[float], seeds: Sequence[int], device: str
) -> dict[str, Any]:
    """Our solver beside a world, JSON-able."""
    began = time.perf_counter()
    truth = case.truth(kept)
    resolution = Resolution.derive(case.measurement, preset)
    low, high = FRICTION_ANGLE.limits or (FRICTION_ANGLE.lower, FRICTION_ANGLE.upper)
    angles = sorted({case.angle + o for o in (*offsets, 0.0) if low <= case.angle + o <= high})
    at = angles.index(case.angle)
    begun, heights, forces, volumes = [], [], [], []
    for seed in seeds:
        x = truth.start(resolution.spacing, seed)
        runs = _ours(case, x, angles, resolution, device)
        volume = resolution.spacing**3
        begun.append(truth.heights(x, volume))
        heights.append([[truth.heights(p, volume) for p in run.positions] for run in runs])
        forces.append([run.force for run in runs])
        volumes.append(volume_range(begun[-1], np.array(heights[-1][at])))
    every, force = np.array(heights), np.mean(forces, axis=0)
    mean, theirs = every.mean(axis=0), case.heights(kept)
    scatter = float(np.sqrt(every.var(axis=0, ddof=1).mean())) if len(seeds) > 1 else None
    pushes = np.array([pushing(case.measurement, of_angle) for of_angle in force])
    scanned = Scan(np.array(angles), mean, scatter or 0.0, volumes[0], pushes) if len(angles) > 2 else None
    first = truth.heights(kept.particles[0], truth.volume)
    return {
        "angle": case.angle,
        "angles": angles,
        "best_angle": scanned.best(theirs) if scanned else None,
        "best_angle_by_slopes": scanned.best(theirs, slopes=True) if scanned else None,
        "heights_mm": 1e3 * in_patches(mean[at] - theirs),
        "heights_mm_by_frame": {
            str(f): 1e3 * in_patches(a - b) for f, a, b in zip(case.frames, mean[at], theirs, strict=True)
        },
        "heights_mm_at_best": 1e3 * scanned.residual(theirs) if scanned else None,
        "chance_mm": None if scatter is None else 1e3 * scatter,
        "volume": np.mean(volumes, axis=0),
        "newton_volume": volume_range(first, theirs),
        "cut_and_heaped_cm3": cut_and_heaped(np.mean(begun, axis=0), mean[at]),
        "newton_cut_and_heaped_cm3": cut_and_heaped(first, theirs),
        "stages": compare_forces(case.measurement, force[at], kept.force),
        "resolution": asdict(resolution),
        "particles": len(x),
        "seconds": time.perf_counter() - began,
    }


def _ours(case: Case, x: FloatArray, angles: Sequence[float], resolution: Resolution, device: str) -> list[Any]:
    """Runs at all angles; on a GPU as one batch."""
    law = Law(find_effects(case.effects))
    batch = [{**case.values, "friction_angle": float(a)} for a in angles]
    groups = [[values] for values in batch] if device == "cpu" else [batch]
    return [
        run
        for group in groups
        for run in simulate(
            case.measurement, x, group, law=law, resolution=resolution, frames=case.frames, device=device
        )
    ]


def refinement(case: Case, kept: Kept, out: Path) -> dict[str, Any] | None:
    """What voxels of three quarters change in a world; None where that wasn't tried."""
    file = place(out, case, fine=True)
    if not file.is_file():
        return None
    check_about(file, told(case.finer()))
    fine = read_npz(file, ["heights", "force"])
    return moved(
        case.measurement, (case.heights(kept), kept.force), (fine["heights"], fine["force"].astype(np.float64))
    )


def moved(
    measurement: Measurement, coarse: tuple[FloatArray, FloatArray], fine: tuple[FloatArray, FloatArray]
) -> dict[str, Any]:
    """How far apart two runs' heights (frames, ny, nx) and forces (f, 3) are, and whether the first has converged."""
    height = in_patches(coarse[0] - fine[0])
    stages = compare_forces(measurement, coarse[1], fine[1])
    return {
        "heights_mm": 1e3 * height,
        "stages": {name: {"coarse": s["ours"], "fine": s["newton"], "off": s["off"]} for name, s in stages.items()},
        "converged": bool(height <= HEIGHTS_CLOSE and stages["pushing"]["off"] <= FORCE_CLOSE),
    }


def refinement_table(checked: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What `moved` said of worlds by name, as lines of Markdown."""
    lines = ["| world | voxels of 3/4: heights, mm | force while pushed | converged |", "|---|---|---|---|"]
    for name, found in checked.items():
        pushed = 100.0 * found["stages"]["pushing"]["off"]
        lines.append(
            f"| {name} | {found['heights_mm']:.2f} | {pushed:.1f} % | {'yes' if found['converged'] else 'no'} |"
        )
    return lines


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    lines = []
    names = list(result["worlds"])
    for preset in result["presets"]:
        rows = {n: w["presets"][preset] for n, w in result["worlds"].items() if preset in w["presets"]}
        if not rows:
            continue
        stages = list(dict.fromkeys(s for row in rows.values() for s in row["stages"]))
        lines += [
            f"Preset `{preset}`, {result['seeds']} particle seeds, {result['made_by']['device']}. Heights in patches, "
            "all frames that are kept; soil cut and heaped in the end, ours / Newton's; force, ours / Newton's in N: "
            "along the way, upwards (apart in all).",
            "",
            "| world | cell, mm | φ | best φ | heights at the truth, mm | at the best φ, mm | volume | cut, cm³ "
            "| heaped, cm³ | " + " | ".join(stages) + " | s |",
            "|---" * (10 + len(stages)) + "|",
        ]
        for name, row in rows.items():
            best = "–" if row["best_angle"] is None else f"{_at_end(row)}{row['best_angle']:.1f}°"
            left = "–" if row["heights_mm_at_best"] is None else f"{row['heights_mm_at_best']:.2f}"
            volume = f"{100 * row['volume'][0]:+.2f} to {100 * row['volume'][1]:+.2f} %"
            last = zip(row["cut_and_heaped_cm3"][-1], row["newton_cut_and_heaped_cm3"][-1], strict=True)
            cells = [f"{own:.0f} / {other:.0f}" for own, other in last]
            cells += [_forces(row["stages"][s]) if s in row["stages"] else "–" for s in stages]
            lines.append(
                f"| {name} | {1e3 * row['resolution']['cell']:.1f} | {row['angle']:.1f}° | {best} "
                f"| {row['heights_mm']:.2f} | {left} | {volume} | " + " | ".join(cells) + f" | {row['seconds']:.0f} |"
            )
        lines += ["", *_summary(rows, stages), ""]
    checked = {n: result["worlds"][n]["refinement"] for n in names if result["worlds"][n].get("refinement")}
    if checked:
        lines += refinement_table(checked)
    absent = [n for n in names if not result["worlds"][n]["presets"]]
    if absent:
        lines += ["", f"Not judged: {', '.join(absent)}."]
    return "\n".join(lines)


def _at_end(row: Mapping[str, Any]) -> str:
    """An estimate at the scan's end is only a bound."""
    low, high = row["angles"][0], row["angles"][-1]
    return "≤ " if row["best_angle"] <= low else "≥ " if row["best_angle"] >= high else ""


def _forces(stage: Mapping[str, Any]) -> str:
    pairs = ", ".join(f"{a:.0f} / {b:.0f}" for a, b in zip(stage["ours"], stage["newton"], strict=True))
    return pairs if stage["off"] is None else f"{pairs} ({100 * stage['off']:.0f} %)"


def _summary(rows: Mapping[str, Mapping[str, Any]], stages: Sequence[str]) -> list[str]:
    """What all worlds come to."""

    def spread(values: Sequence[float]) -> str:
        return f"{np.sqrt(np.mean(np.square(values))):.2f} root mean square, {np.max(np.abs(values)):.2f} at most"

    lines = [f"- heights at the truth, mm: {spread([row['heights_mm'] for row in rows.values()])}"]
    off = [row["best_angle"] - row["angle"] for row in rows.values() if row["best_angle"] is not None]
    if off:
        lines.append(f"- best angle less the true one, degrees: mean {np.mean(off):+.2f}, {spread(off)}")
    for k, what in enumerate(("cut", "heaped")):
        shares = [
            row["cut_and_heaped_cm3"][-1][k] / row["newton_cut_and_heaped_cm3"][-1][k]
            for row in rows.values()
            if row["newton_cut_and_heaped_cm3"][-1][k] > 0.0
        ]
        if shares:
            lines.append(f"- soil {what} in the end, ours over Newton's: {_range(shares)}")
    for name in stages:
        for k, what in enumerate(("along the way", "upwards")):
            ratios = [row["stages"][name]["ratio"][k] for row in rows.values() if name in row["stages"]]
            if known := [ratio for ratio in ratios if ratio is not None]:
                lines.append(f"- force, {name}, {what}, ours over Newton's: {_range(known)}")
        apart = [row["stages"][name]["off"] for row in rows.values() if name in row["stages"]]
        if known := [100.0 * value for value in apart if value is not None]:
            lines.append(f"- force, {name}, apart in %: {spread(known)}")
    return lines


def _range(values: Sequence[float]) -> str:
    return f"mean {np.mean(values):.2f}, {np.min(values):.2f} to {np.max(values):.2f}"


def asked(options: argparse.Namespace, numerics: Numerics) -> list[Case]:
    """The worlds that the command line names."""
    drawn = islice(scenes(options.seed), options.count)
    cases = [Case.drawn(f"scene-{options.seed}-{k}", scene, numerics) for k, scene in enumerate(drawn)]
    if options.pairs:
        for scene in pair(options.seed):
            cases.append(Case.drawn(f"pair-{options.seed}-friction-{scene.tool_friction:g}", scene, numerics))
    return cases + [Case.of_set(folder, numerics) for folder in options.sets]


class Judgement:
    """The result of one call, written after every world.

    Args:
        cases: all worlds that are asked for.
        options: the command line.
    """

    def __init__(self, cases: Sequence[Case], options: argparse.Namespace) -> None:
        self.cases, self.options = cases, options
        self.result: dict[str, Any] = {
            "made_by": stamp(options.device),
            "seeds": options.seeds,
            "presets": options.presets,
            "worlds": {c.name: {**told(c), "kind": c.kind, "presets": {}} for c in cases},
        }

    def kept(self, case: Case) -> Kept | None:
        """The world, where there is one."""
        file = place(self.options.out, case)
        return Kept.load(file, told(case)) if file.is_file() else case.made

    @cached_property
    def worlds(self) -> list[tuple[Case, Kept]]:
        """Those that are there."""
        return [(case, kept) for case in self.cases for kept in [self.kept(case)] if kept is not None]

    def score(self, say: Callable[[str], None]) -> None:
        """Judge all worlds that are there with all presets."""
        o = self.options
        for case, kept in self.worlds:
            entry = self.result["worlds"][case.name]
            entry["refinement"] = refinement(case, kept, o.out)
            for preset in o.presets:
                entry["presets"][preset] = judge(case, kept, preset, o.offsets, range(o.seeds), o.device)
                say(f"{case.name}, {preset}: judged in {entry['presets'][preset]['seconds']:.0f} s")
                self.write()

    def write(self) -> None:
        """Result and table."""
        write_result(self.options.out, plain(self.result), table(self.result), {})


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0 when every world was judged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=at_least(0), help="scenes that are drawn; 6, or with --sets none")
    parser.add_argument("--seed", type=int, default=1, help="of the scenes")
    parser.add_argument("--pairs", action="store_true", help="also one scene with tool friction 0.3 and 0.9")
    parser.add_argument("--sets", type=Path, nargs="+", default=[], metavar="DIR", help="measurement sets with truths")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="of these worlds, by name")
    parser.add_argument("--out", type=Path, default=Path("runs/solvers"), help="worlds, result.json and table.md")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--side-by-side", type=at_least(1), default=4, help="worlds that Newton ploughs at a time")
    parser.add_argument("--no-plough", action="store_true", help="judge the worlds that are there; needs no Newton")
    parser.add_argument("--worlds-only", action="store_true", help="make the worlds and stop")
    parser.add_argument(
        "--refine", nargs="*", metavar="NAME", help="plough these with finer voxels too; one of each kind"
    )
    parser.add_argument("--presets", nargs="+", default=["small"], help="of our solver")
    parser.add_argument(
        "--offsets", nargs="*", type=float, default=list(OFFSETS), help="of our angles, degrees; none: the truth alone"
    )
    parser.add_argument("--seeds", type=at_least(1), default=2, help="particle seeds that ours are averaged over")
    parser.add_argument(
        "--voxel", type=float, default=Numerics.voxel, help="edge of Newton's cells, m; less for sets of narrow tools"
    )
    parser.add_argument("--substeps", type=at_least(1), default=Numerics.substeps, help="of Newton in a frame")
    parser.add_argument("--iterations", type=at_least(1), default=Numerics.iterations, help="most in a substep")
    options = parser.parse_args(arguments)
    if not options.voxel > 0.0:
        raise ParameterError("--voxel must be positive")
    if options.count is None:
        options.count = 0 if options.sets else 6
    hush()
    began = time.perf_counter()

    def say(what: str) -> None:
        print(f"{time.perf_counter() - began:6.0f} s  {what}", file=sys.stderr, flush=True)

    numerics = Numerics(options.voxel, options.substeps, options.iterations)
    cases = asked(options, numerics)
    names = [case.name for case in cases]
    unknown = [n for n in [*(options.only or ()), *(options.refine or ())] if n not in names]
    if unknown or not cases:
        raise ParameterError(f"{', '.join(unknown) or 'no world'}: asked for are {', '.join(names) or 'none'}")
    cases = [case for case in cases if not options.only or case.name in options.only]
    if not options.no_plough:
        plough_missing(cases, options.out, options.device, options.side_by_side, say)
        if options.refine is not None:
            first = {case.kind: case.name for case in reversed(cases)}.values()
            finer = [case.finer() for case in cases if case.name in (options.refine or first)]
            plough_missing(finer, options.out, options.device, options.side_by_side, say, fine=True)
    if options.worlds_only:
        return 0
    judgement = Judgement(cases, options)
    judgement.score(say)
    judgement.write()
    print(table(judgement.result))
    return 0 if len(judgement.worlds) == len(cases) else 1


if __name__ == "__main__":
    raise SystemExit(main())
