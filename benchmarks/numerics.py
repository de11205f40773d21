"""Does the answer hang on numerics? The solver against an independent one, and against itself.

For each measurement set that carries its true particles: the friction angle is scanned from the true particles at frame
0 with all other parameters true, and heights are compared with the truth at the frames it has. Then one piece of the
numerics at a time is changed; the shift is how far the friction angle of the unchanged solver must move to look like
the changed one. Heights are averaged over particle seeds, whose scatter is stated. Beside them stands the mean force on
the tool while it is pushed, over the measured one. ``--cells`` refines the grid: which angle do coarser cells read off
the finest ones' heights?
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._common import at_least, here

from splatsoil.errors import MeasurementError
from splatsoil.experiment.scene_parts import stages_of
from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution, simulate
from splatsoil.reconstruction import HeightField, fill
from splatsoil.scene import relief_of_particles
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

FloatArray = npt.NDArray[np.float64]

CELL = 0.01
"""Edge of the cells in which heights are compared, m."""
PATCH = 1.5
"""Standard deviation, in cells, of the smoothing under which shifts are measured: patches larger than chance."""
OFFSETS = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0)


@dataclass(frozen=True)
class Truth:
    """Particles of an independent simulator.

    Attributes:
        measurement: the set they belong to.
        particles: (n, 3) in m by frame.
        volume: of one particle, m^3.
        values: true parameters by name.
        effects: effects that are on in the truth and known to the model.
    """

    measurement: Measurement
    particles: dict[int, FloatArray]
    volume: float
    values: dict[str, float]
    effects: tuple[str, ...]

    @classmethod
    def load(cls, folder: Path) -> Truth:
        """Read ``truth.json`` and ``truth_particles.npz``; MeasurementError when the set has none, or other ones."""
        measurement = Measurement.load(folder)
        try:
            told = json.loads((folder / "truth.json").read_text())
            with np.load(folder / "truth_particles.npz") as file:
                low = file["origin"] if "origin" in file.files else 0.0
                particles = {int(k[1:]): file[k] * float(file["scale"]) + low for k in file.files if k[0] == "f"}
                volume = float(file["spacing"]) ** 3
        except OSError as error:
            raise MeasurementError("the benchmark needs true particles", file=folder) from error
        if "parameters" in told:  # a set of ours
            values, effects = {k: float(v) for k, v in told["parameters"].items()}, tuple(told["effects"])
        elif "phi" in told:
            cohesion = float(told["cohesion"])
            values, effects = {"friction_angle": float(told["phi"])}, ("cohesion",) if cohesion else ()
            values |= {"cohesion": cohesion} if cohesion else {}
        else:
            raise MeasurementError(
                "the benchmark needs the true parameters", file=folder / "truth.json", field="parameters"
            )
        return cls(measurement, particles, volume, values, effects)

    def heights(self, x: npt.NDArray[np.floating], volume: float) -> FloatArray:
        """Surface (ny, nx) in m, smoothed over one cell, whatever the particles' size."""
        bed = self.measurement.bed
        # the kernel's width is a length of the bed, the same for every particle size
        spacing = volume ** (1.0 / 3.0)
        positions = torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)
        relief = relief_of_particles(positions, spacing, bed.lower, bed.upper, smoothing=CELL / spacing)
        nx, ny = (round(float(e) / CELL) for e in (bed.upper - bed.lower)[:2])
        xs, ys = (bed.lower[k] + CELL * (np.arange(n) + 0.5) for k, n in ((0, nx), (1, ny)))
        points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        sampled = relief.sample(relief.height, torch.as_tensor(points, dtype=torch.float32))
        return gaussian_filter(sampled.numpy().reshape(ny, nx).astype(np.float64), 1.0)

    def start(self, spacing: float, seed: int) -> FloatArray:
        """Other particles in the volume that the true ones fill at frame 0."""
        bed, first = self.measurement.bed, self.particles[0]
        height = self.heights(first, self.volume)
        plan = bed.upper[:2] - bed.lower[:2]
        height += len(first) * self.volume / float(np.prod(plan)) - (height - bed.lower[2]).mean()
        ny, nx = height.shape
        field = HeightField(
            bed.lower[0] + CELL * (np.arange(nx) + 0.5), bed.lower[1] + CELL * (np.arange(ny) + 0.5), height
        )
        return fill(field, bed, spacing, seed=seed)


@dataclass(frozen=True)
class Scan:
    """Heights over friction angles.

    Attributes:
        angles: (n,) in degrees, increasing.
        heights: (n, frames, ny, nx) in m, averaged over seeds.
        chance: scatter of the heights between seeds, m.
        volume: lowest and highest mean height over the frames, relative to frame 0: most of a loss, most of a gain.
        force: (n,) mean horizontal force of the soil on the tool while it is pushed, N, averaged over seeds.
    """

    angles: FloatArray
    heights: FloatArray
    chance: float
    volume: tuple[float, float]
    force: FloatArray

    def best(self, other: FloatArray, slopes: bool = False) -> float:
        """Angle whose heights, or their slopes, lie nearest to ``other`` (frames, ny, nx) in patches."""
        fine, loss = self._loss(other, slopes)
        return float(fine[np.argmin(loss)])

    def residual(self, other: FloatArray) -> float:
        """Difference in patches, m, that no angle takes away."""
        return float(np.sqrt(max(self._loss(other, slopes=False)[1].min(), 0.0)))

    def _loss(self, other: FloatArray, slopes: bool) -> tuple[FloatArray, FloatArray]:
        """Mean square difference by angle, interpolated by a cubic spline."""
        smooth = gaussian_filter(self.heights - other, (0, 0, PATCH, PATCH))
        square = sum(np.gradient(smooth, axis=k) ** 2 for k in (2, 3)) if slopes else smooth**2
        fine = np.linspace(self.angles[0], self.angles[-1], 2001)
        return fine, CubicSpline(self.angles, np.mean(square, axis=(1, 2, 3)))(fine)


def pushing(measurement: Measurement, force: npt.NDArray[np.floating], first: int = 1) -> float:
    """Mean horizontal force in N of rows (f, 3), one a frame from ``first`` on, while the tool is pushed."""
    stages = stages_of(measurement, [float(first + k) for k in range(len(force))])
    pushed = np.array([stage == "pushing" for stage in stages])
    return float(np.linalg.norm(np.asarray(force)[pushed, :2].mean(axis=0))) if pushed.any() else 0.0


def scan(truth: Truth, resolution: Resolution, angles: Sequence[float], seeds: Sequence[int], device: str) -> Scan:
    """Simulate all angles for all seeds; on a GPU as one batch."""
    frames = sorted(f for f in truth.particles if f > 0)
    batch = [{**truth.values, "friction_angle": float(a)} for a in angles]
    law = Law(find_effects(truth.effects))
    volume = resolution.spacing**3
    everything, volumes, forces = [], [], []
    for seed in seeds:
        x = truth.start(resolution.spacing, seed)
        groups = [batch] if device != "cpu" else [[values] for values in batch]
        runs = [
            run
            for group in groups
            for run in simulate(
                truth.measurement, x, group, law=law, resolution=resolution, frames=frames, device=device
            )
        ]
        everything.append([[truth.heights(p, volume) for p in run.positions] for run in runs])
        forces.append([pushing(truth.measurement, run.force) for run in runs])
        volumes.append(volume_range(truth.heights(x, volume), np.array(everything[-1][len(angles) // 2])))
    heights = np.array(everything)
    scatter = float(np.sqrt(heights.var(axis=0, ddof=1).mean())) if len(seeds) > 1 else 0.0
    low, high = np.mean(volumes, axis=0)
    found = np.asarray(angles, dtype=np.float64)
    return Scan(found, heights.mean(axis=0), scatter, (float(low), float(high)), np.mean(forces, axis=0))


def volume_range(start: FloatArray, heights: FloatArray) -> tuple[float, float]:
    """Lowest and highest mean of ``heights`` (frames, ny, nx) over the frames, relative to that of ``start``."""
    relative = heights.mean(axis=(1, 2)) / start.mean() - 1.0
    return float(relative.min()), float(relative.max())


def variants(base: Resolution) -> dict[str, Resolution]:
    """The solver with one piece of its numerics changed."""
    fine = 0.75
    return {
        "half the particles' step": replace(base, steps=2 * base.steps),
        "half the grid's substep": replace(base, courant=base.courant / 2.0),
        "stiffness x 3": replace(base, bulk=3.0 * base.bulk, shear=3.0 * base.shear),
        "cell x 3/4": replace(base, cell=fine * base.cell, spacing=fine * base.spacing),
        "particles x 27/8": replace(base, spacing=base.spacing / 1.5),
        "hourglass modes damped twice as fast": replace(base, relaxation=2.0 * base.relaxation),
        "hourglass modes damped half as fast": replace(base, relaxation=0.5 * base.relaxation),
        "no skin": replace(base, skin=0.0),
    }


def refine(
    truth: Truth, preset: str, cells: Sequence[float], seeds: Sequence[int], device: str
) -> list[dict[str, float]]:
    """One row for each number of cells across the tool, the coarsest first, held against the finest one's heights."""
    true_angle = truth.values["friction_angle"]
    resolutions = [
        Resolution.derive(truth.measurement, replace(PRESETS[preset], cells_across_tool=c)) for c in sorted(cells)
    ]
    finest = scan(truth, resolutions[-1], [true_angle], seeds, device)
    rows = []
    for resolution in resolutions[:-1]:
        found = scan(truth, resolution, [true_angle + offset for offset in OFFSETS], seeds, device)
        centre = len(OFFSETS) // 2
        rows.append(_row(resolution, found.volume, float(found.force[centre])))
        rows[-1] |= {
            "angle_off": found.best(finest.heights[0]) - true_angle,
            "rmse_mm": 1e3 * float(np.sqrt(np.mean(_patches(found.heights[centre] - finest.heights[0]) ** 2))),
        }
    return [*rows, _row(resolutions[-1], finest.volume, float(finest.force[0]))]


def _row(resolution: Resolution, volume: tuple[float, float], force: float) -> dict[str, float]:
    return {"cell_mm": 1e3 * resolution.cell, "force": force, "lost": volume[0], "gained": volume[1]}


def _patches(difference: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(difference, (0, PATCH, PATCH)), dtype=np.float64)


def run(
    sets: Sequence[Path],
    preset: str = "small",
    seeds: int = 3,
    device: str = "cpu",
    shifts: bool = True,
    cells: Sequence[float] = (),
) -> dict[str, Any]:
    """Measure all sets; a JSON-able result with one entry for each."""
    result: dict[str, Any] = {"preset": preset, "seeds": seeds, "device": device.split(":")[0], "sets": {}}
    for folder in sets:
        truth = Truth.load(Path(folder))
        base = Resolution.derive(truth.measurement, preset)
        true_angle = truth.values["friction_angle"]
        angles = [true_angle + offset for offset in OFFSETS]
        found = scan(truth, base, angles, range(seeds), device)
        frames = sorted(f for f in truth.particles if f > 0)
        observed = np.array([truth.heights(truth.particles[f], truth.volume) for f in frames])
        centre = len(angles) // 2
        rmse = np.sqrt(np.mean((found.heights[centre] - observed) ** 2, axis=(1, 2)))
        entry: dict[str, Any] = {
            "true_angle": true_angle,
            "best_angle": found.best(observed),
            "rmse_mm": {str(f): round(1e3 * float(e), 2) for f, e in zip(frames, rmse, strict=True)},
            "chance_mm": round(1e3 * found.chance, 2),
            "volume": found.volume,
            "force": float(found.force[centre]),
            "measured_force": _measured(truth.measurement),
            "shifts": {},
            "forces": {},
            "cells": refine(truth, preset, cells, range(seeds), device) if len(cells) > 1 else [],
        }
        for name, resolution in variants(base).items() if shifts else ():
            changed = scan(truth, resolution, [true_angle], range(seeds), device)
            entry["shifts"][name] = found.best(changed.heights[0]) - found.best(found.heights[centre])
            entry["forces"][name] = float(changed.force[0]) / entry["force"] - 1.0
        result["sets"][truth.measurement.name] = entry
    return result


def _measured(measurement: Measurement) -> float | None:
    """Pushing force that the set's file tells, N."""
    rows = measurement.tool.force
    return None if rows is None else pushing(measurement, rows[:, 2:], int(rows[0, 0]))


def table(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    lines = [
        f"Preset `{result['preset']}`, {result['seeds']} particle seeds, {result['device']}.",
        "",
        "| set | true φ | best φ | height RMSE at the truth, mm (frames) | seed scatter, mm | volume | force, N |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, entry in result["sets"].items():
        errors = ", ".join(f"{e:.1f} ({f})" for f, e in entry["rmse_mm"].items())
        lines.append(
            f"| {name} | {entry['true_angle']:.1f}° | {entry['best_angle']:.1f}° | {errors} "
            f"| {entry['chance_mm']:.1f} | {100 * entry['volume'][0]:+.2f} to {100 * entry['volume'][1]:+.2f} % "
            f"| {_over(entry['force'], entry['measured_force'])} |"
        )
    if any(entry["shifts"] for entry in result["sets"].values()):
        names = list(result["sets"])
        lines += [
            "",
            "| change | " + " | ".join(f"shift of φ, of the force, {n}" for n in names) + " |",
            "|---" * (len(names) + 1) + "|",
        ]
        for change in next(iter(result["sets"].values()))["shifts"]:
            entries = [result["sets"][n] for n in names]
            told = " | ".join(f"{e['shifts'][change]:+.1f}°, {100 * e['forces'][change]:+.0f} %" for e in entries)
            lines.append(f"| {change} | {told} |")
    for name, entry in result["sets"].items():
        if entry["cells"]:
            lines += ["", f"| {name}: cell, mm | φ read off the finest, error | heights off, mm | force, N | volume |"]
            lines.append("|---|---|---|---|---|")
        for row in entry["cells"]:
            read = f"{row['angle_off']:+.1f}° | {row['rmse_mm']:.1f}" if "angle_off" in row else "– | –"
            volume = f"{100 * row['lost']:+.2f} to {100 * row['gained']:+.2f} %"
            lines.append(f"| {row['cell_mm']:.1f} | {read} | {row['force']:.0f} | {volume} |")
    return "\n".join(lines)


def _over(force: float, measured: float | None) -> str:
    return (
        f"{force:.0f}" if not measured else f"{force:.0f} of {measured:.0f} ({100 * (force / measured - 1.0):+.0f} %)"
    )


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--seeds", type=at_least(1), default=3)
    parser.add_argument("--cells", nargs="+", type=float, default=[], help="across the tool: refine the grid by these")
    parser.add_argument("--device", type=here, default="cpu", help="cuda:0 runs a scan as one batch")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    result = run(options.sets, options.preset, options.seeds, options.device, cells=options.cells)
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
