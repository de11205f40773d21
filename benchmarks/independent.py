"""Which angle does our solver read off an independent one's worlds, and how far do that one's own numerics move it?

The independent solver is Newton's implicit MPM (``newton`` on PyPI; extra ``independent``). From a set's own
first particles it ploughs at several friction angles, and at the true one with a piece of its numerics changed. The
angle of every such world is then estimated from its heights, and from their slopes, as in
:mod:`splatsoil.benchmarks.numerics`, with our presets; and with the independent solver's own runs, which says what its
numerics are worth in degrees. Where a run began with the set's own particles, it is also told how far from the set's
they end, which says whether the set was made that way.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from splatsoil.benchmarks._common import at_least, here, stamp
from splatsoil.benchmarks._newton import Numerics, Run, World, load_newton, plough
from splatsoil.benchmarks.numerics import FloatArray, Scan, Truth, scan, volume_range

from splatsoil.errors import RunError, SimulationError
from splatsoil.files import write_json
from splatsoil.mpm import Resolution
from splatsoil.soil.matching import cone_intercept

OFFSETS = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0)
"""Angles of the independent worlds, degrees from the true one."""
BEYOND = 3.0
"""Our scan ends this far, in degrees, outside the range of the worlds."""
OTHER_SEED = 5
TWICE = "cohesion as tension and as yield stress"
MOVED = 0.003
"""Particles of a set that were carried further than this, in m, tell whether a run repeats it."""


def base_worlds(truth: Truth, angles: Sequence[float]) -> list[World]:
    """The set's own first particles at these angles."""
    spacing, cohesion = truth.volume ** (1.0 / 3.0), truth.values.get("cohesion", 0.0)
    return [World(f"{a:g}°", float(a), truth.particles[0], spacing, cohesion=cohesion) for a in angles]


def twice_cohesive(truth: Truth) -> list[World]:
    """The set's soil as it comes out where its cohesion is given both as a tension that it bears and as a yield stress.

    Newton's strength is the yield stress + friction (p + tension), so that each of them is the whole cohesion.
    """
    angle, cohesion = truth.values["friction_angle"], truth.values.get("cohesion", 0.0)
    if not cohesion:
        return []
    stress, spacing = cone_intercept(angle, cohesion), truth.volume ** (1.0 / 3.0)
    return [World(TWICE, angle, truth.particles[0], spacing, cohesion=cohesion, yield_stress=stress)]


def changed(truth: Truth, numerics: Numerics) -> list[tuple[Numerics, list[World]]]:
    """The true angle with one piece of numerics changed; worlds in one entry can run side by side."""
    angle, spacing = truth.values["friction_angle"], truth.volume ** (1.0 / 3.0)
    cohesion = truth.values.get("cohesion", 0.0)

    def world(label: str, scale: float = 1.0) -> World:
        particles = truth.particles[0] if scale == 1.0 else truth.start(scale * spacing, 0)
        return World(label, angle, particles, scale * spacing, cohesion=cohesion)

    finer = [
        replace(numerics, voxel=numerics.voxel * 2 / 3, iterations=round(numerics.iterations * 1.5)),
        replace(numerics, voxel=numerics.voxel / 2, iterations=2 * numerics.iterations),
    ]
    other = replace(world("other particles"), particles=truth.start(spacing, OTHER_SEED))
    side_by_side = [other, replace(world("Young's modulus 1 MPa"), young=1.0e6), world("particles x 27/8", 2 / 3)]
    return [
        (numerics, side_by_side),
        (replace(numerics, late=False), [world("projection at the substep's end")]),
        (replace(numerics, grid="sparse"), [world("cells laid anew")]),
        (replace(numerics, substeps=2 * numerics.substeps), [world("substeps x 2")]),
        (replace(numerics, iterations=4 * numerics.iterations), [world("iterations x 4")]),
        (finer[0], [world("voxel x 2/3", 2 / 3)]),
        (finer[1], [world("voxel x 1/2", 1 / 2)]),
        (replace(finer[1], substeps=2 * numerics.substeps), [world("voxel x 1/2, substeps x 2", 1 / 2)]),
    ]


def heights(truth: Truth, particles: Mapping[int, FloatArray], volume: float) -> FloatArray:
    """(frames, ny, nx) in m of the frames after the first."""
    return np.array([truth.heights(particles[f], volume) for f in sorted(particles) if f > 0])


def apart(truth: Truth, particles: Mapping[int, FloatArray]) -> dict[int, float]:
    """How far, in mm, particles that began as the set's are from where it has them: by frame, median of what moved."""
    start = truth.particles[0]
    found = {}
    for f in sorted(f for f in particles if f > 0):
        moved = np.linalg.norm(truth.particles[f] - start, axis=1) > MOVED
        found[f] = 1e3 * float(np.median(np.linalg.norm(particles[f] - truth.particles[f], axis=1)[moved]))
    return found


def judge(other: FloatArray, ours: Mapping[str, Scan], own: Scan | None) -> dict[str, Any]:
    """Estimates of the angle that a world's heights (frames, ny, nx) look like.

    Args:
        other: the world's heights.
        ours: our scans by preset.
        own: the independent solver's scan; None for a run that is part of it.
    """

    def estimate(found: Scan) -> dict[str, float]:
        return {
            "heights": found.best(other),
            "slopes": found.best(other, slopes=True),
            "residual_mm": 1e3 * found.residual(other),
        }

    return {"presets": {k: estimate(v) for k, v in ours.items()}, "own": None if own is None else estimate(own)}


class Campaign:
    """One measurement set's part of the result: its base first, its changed worlds later.

    Args:
        truth: the set.
        numerics: what the independent solver made it with.
        angles: of the independent worlds, increasing, degrees.
        device: Warp device name.
    """

    def __init__(self, truth: Truth, numerics: Numerics, angles: Sequence[float], device: str) -> None:
        self.truth, self.numerics, self.angles, self.device = truth, numerics, sorted(angles), device
        self.ours: dict[str, Scan] = {}
        self.own: Scan | None = None
        self.entry: dict[str, Any] = {
            "true_angle": truth.values["friction_angle"],
            "angles": self.angles,
            "scan": [self.angles[0] - BEYOND, self.angles[-1] + BEYOND],
            "presets": {},
            "worlds": {},
            "seconds": {},
        }

    def base(self, presets: Sequence[str], seeds: int) -> None:
        """The independent solver's scan, ours with every preset, and what they say of each other and of the set."""
        truth, start = self.truth, time.perf_counter()
        worlds = base_worlds(truth, self.angles)
        more = twice_cohesive(truth)
        runs = plough(truth.measurement, [*worlds, *more], self.numerics, truth.particles, self.device)
        scanned = np.array([heights(truth, run.particles, truth.volume) for run in runs[: len(worlds)]])
        nearest = int(np.argmin(np.abs(np.array(self.angles) - self.entry["true_angle"])))
        volume = volume_range(truth.heights(truth.particles[0], truth.volume), scanned[nearest])
        self.own = Scan(np.array(self.angles), scanned, 0.0, volume)
        self.entry["independent_volume"] = volume
        self.entry["seconds"]["independent base"] = time.perf_counter() - start
        for preset in presets:
            start = time.perf_counter()
            wide = [self.entry["scan"][0], *self.angles, self.entry["scan"][1]]
            found = scan(truth, Resolution.derive(truth.measurement, preset), wide, range(seeds), self.device)
            self.ours[preset] = found
            self.entry["presets"][preset] = {"chance_mm": 1e3 * found.chance, "volume": found.volume}
            self.entry["seconds"][preset] = time.perf_counter() - start
        for world, run in zip([*worlds, *more], runs, strict=True):
            self._enter(world, run, None)
        itself = heights(truth, truth.particles, truth.volume)
        told = {"angle": self.entry["true_angle"], "apart_mm": None, **judge(itself, self.ours, self.own)}
        self.entry["worlds"]["the set itself"] = told

    def change(self, numerics: Numerics, worlds: Sequence[World]) -> None:
        """Worlds with numerics of their own, after the base; one that can't be computed is entered as failed."""
        start = time.perf_counter()
        try:
            runs = plough(self.truth.measurement, worlds, numerics, self.truth.particles, self.device)
        except SimulationError as error:
            for world in worlds:
                self.entry["worlds"][world.label] = {"angle": float(world.angle), "failed": str(error)}
            return
        for world, run in zip(worlds, runs, strict=True):
            self._enter(world, run, self.own)
        self.entry["seconds"][", ".join(w.label for w in worlds)] = time.perf_counter() - start

    def _enter(self, world: World, run: Run, own: Scan | None) -> None:
        surface = heights(self.truth, run.particles, world.spacing**3)
        began_as_the_set = world.particles is self.truth.particles[0]
        self.entry["worlds"][world.label] = {
            "angle": float(world.angle),
            "apart_mm": apart(self.truth, run.particles) if began_as_the_set else None,
            **judge(surface, self.ours, own),
        }


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    lines = []
    for name, entry in result["sets"].items():
        presets = list(entry["presets"])
        heads = [f"`{p}`: heights / slopes, left over" for p in presets]
        lines += [
            f"{name}: {result['seeds']} particle seeds, newton {result['newton']}, {result['made_by']['device']}.",
            "",
            "| world | φ | " + " | ".join(heads) + " | newton's own: heights / slopes | particles off the set's, mm |",
            "|---" * (len(heads) + 4) + "|",
        ]
        for label, world in entry["worlds"].items():
            if "failed" in world:
                failed = " | ".join("failed" for _ in (*heads, 0, 0))
                lines.append(f"| {label} | {world['angle']:g}° | {failed} |")
                continue
            cells = [_cell(world["presets"][p], entry["scan"], left_over=True) for p in presets]
            own = "" if world["own"] is None else _cell(world["own"], (entry["angles"][0], entry["angles"][-1]))
            off = ", ".join(f"{mm:.2f}" for mm in (world["apart_mm"] or {}).values())
            lines.append(f"| {label} | {world['angle']:g}° | " + " | ".join([*cells, own, off]) + " |")
        for solver, (low, high) in (
            ("newton", entry["independent_volume"]),
            *((f"`{p}`", entry["presets"][p]["volume"]) for p in presets),
        ):
            lines.append(f"\nMean height at the true angle, {solver}: {100 * low:+.2f} to {100 * high:+.2f} %.")
        lines.append("")
    return "\n".join(lines)


def _cell(estimate: Mapping[str, float], ends: Sequence[float], left_over: bool = False) -> str:
    """An estimate; one at the scan's end is only a bound."""

    def text(angle: float) -> str:
        sign = "≤ " if angle <= ends[0] else "≥ " if angle >= ends[-1] else ""
        return f"{sign}{angle:.1f}°"

    more = f", {estimate['residual_mm']:.1f} mm" if left_over else ""
    return f"{text(estimate['heights'])} / {text(estimate['slopes'])}{more}"


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--presets", nargs="+", default=["small", "fine"])
    parser.add_argument(
        "--seeds", type=at_least(1), default=3, help="particle seeds that our heights are averaged over"
    )
    parser.add_argument("--angles", nargs="+", type=float, help="of the independent worlds; none: 9° below to 6° above")
    parser.add_argument("--base", action="store_true", help="leave out the worlds with changed numerics")
    parser.add_argument("--device", type=here, default="cpu", help="cuda:0; a CPU takes a quarter of an hour a world")
    parser.add_argument("--json", type=Path, metavar="FILE", help="result, written after every piece of work")
    options = parser.parse_args(arguments)
    if options.angles and len(set(options.angles)) < 3:
        parser.error("--angles needs three or more, to interpolate between")
    wp.config.log_level = wp.LOG_ERROR
    try:
        newton = load_newton()
    except RunError as error:
        parser.error(str(error))
    campaigns = []
    for folder in options.sets:
        truth = Truth.load(folder)
        angles = options.angles or [truth.values["friction_angle"] + offset for offset in OFFSETS]
        campaigns.append(Campaign(truth, Numerics.of(folder), sorted(set(angles)), options.device))
    result: dict[str, Any] = {
        "newton": newton.__version__,
        "seeds": options.seeds,
        "made_by": stamp(options.device),
        "sets": {c.truth.measurement.name: c.entry for c in campaigns},
    }

    def keep(what: str) -> None:
        print(f"{what}: done", file=sys.stderr, flush=True)
        if options.json:
            write_json(options.json, result)

    # what matters most comes first, for all sets
    for campaign in campaigns:
        campaign.base(options.presets, options.seeds)
        keep(f"{campaign.truth.measurement.name}, base")
    for campaign in () if options.base else campaigns:
        for numerics, worlds in changed(campaign.truth, campaign.numerics):
            campaign.change(numerics, worlds)
            keep(f"{campaign.truth.measurement.name}, {', '.join(w.label for w in worlds)}")
    print(table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
