"""The published table, again: friction angles of Hsiao and Kumar's scene from photographs of simulated sand.

    splatsoil benchmark paper-table --device cuda:0 --picture-scale 0.5 --out runs/paper-table

For each angle, worlds are simulated with other particles and a finer grid, whose nodes meet the model's at the walls
only, and photographed by the path tracer. Each is reconstructed from its views, and each trial spends 10 evaluations on
one:

| way | cells | loss | search |
|---|---|---|---|
| `published` | 3.2 | mean square colour difference, four frames, whole pictures | random start, expected improvement |
| `ours` | 6.4 | the robust loss, all frames | Sobol start, log noisy expected improvement |
| `features` | | none: a comparison's posterior mean, from the features of `ours`' evaluations | |

The angle is searched in [25°, 55°]. All trials of a world go on side by side: one batch of simulations for each step.
An error budget says what the landscapes' minima owe to reconstruction, grid, loss and chance. Every evaluation is kept
in the folder as it ends, and an interrupted benchmark goes on.

On GPUs, give them enough to do: ``--device cuda:0 cuda:1 --executor processes:20`` shares worlds out, then trials and
budgets, over twenty processes and two devices.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks._common import (
    here,
    keep_to_one_protocol,
    output_options,
    sources,
    stamp,
    write_result,
)
from splatsoil.benchmarks._paper import PUBLISHED, SEARCHES, WAYS, Protocol, Say, Sight, search, world
from splatsoil.benchmarks._paper_budget import budget_table, error_budget
from splatsoil.inverse.executors import executor

from splatsoil.files import read_json, write_json
from splatsoil.quiet import hush

#: What this project set out to reach at all four, degrees.
TARGET = (0.3, 0.3)


@dataclass(frozen=True)
class Clock:
    """Says what goes on, and since when; several processes share one."""

    began: float

    def __call__(self, what: str) -> None:
        print(f"{time.time() - self.began:7.0f} s  {what}", file=sys.stderr, flush=True)


def run(
    protocol: Protocol, out: Path, pool: Executor, say: Say, *, devices: Sequence[str] = (), parts: int = 1
) -> dict[str, Any]:
    """All trials and budgets, those in the folder already not again; errors of each way at each angle.

    Args:
        protocol: what to do.
        out: folder of worlds, evaluations and results.
        pool: where worlds are made, then searched.
        say: told what goes on; picklable if the pool is of processes.
        devices: that the jobs take in turn; the protocol's by default.
        parts: jobs that a world's trials are spread over.
    """
    keep_to_one_protocol(out, kept_protocol(protocol))
    turns = cycle([replace(protocol, device=device) for device in devices] or [protocol])
    worlds: list[tuple[float, int]] = []
    jobs: list[tuple[Callable[..., None], float, int, list[int]]] = []
    for angle in protocol.angles:
        for number in range(protocol.worlds):
            mine = [t for t in range(protocol.trials) if t % protocol.worlds == number]
            missing = [
                t for t in mine if any(not (out / "trials" / f"{angle:g}-{t}-{w}.json").is_file() for w in SEARCHES)
            ]
            wanted = number == 0 and protocol.scan[0] > 0 and not (out / "budget" / f"{angle:g}.json").is_file()
            shares = [missing[k::parts] for k in range(parts) if missing[k::parts]]
            if shares or wanted:
                worlds.append((angle, number))
            jobs += [(_search, angle, number, share) for share in shares]
            jobs += [(_budget, angle, number, [])] if wanted else []
    for future in [pool.submit(_world, next(turns), angle, number, out, say) for angle, number in worlds]:
        future.result()
    for future in [pool.submit(job, next(turns), a, number, mine, out, say) for job, a, number, mine in jobs]:
        future.result()
    return collect(protocol, out)


def _world(protocol: Protocol, angle: float, number: int, out: Path, say: Say) -> None:
    """A worker's job: a world and its reconstruction, if the folder doesn't have them."""
    world(protocol, angle, number, out, say)


@lru_cache(maxsize=1)
def _sight(protocol: Protocol, angle: float, number: int, out: Path, say: Say) -> Sight:
    """A world as the model sees it; a worker that stays at one keeps it."""
    return Sight(*world(protocol, angle, number, out, say), protocol)


def _search(protocol: Protocol, angle: float, number: int, trials: list[int], out: Path, say: Say) -> None:
    """A worker's job: some trials of a world."""
    search(_sight(protocol, angle, number, out, say), angle, trials, out, f"{angle:g}-{number}", say)


def _budget(protocol: Protocol, angle: float, number: int, trials: list[int], out: Path, say: Say) -> None:
    """A worker's job: the error budget of an angle."""
    found = error_budget(_sight(protocol, angle, number, out, say), angle, say)
    write_json(out / "budget" / f"{angle:g}.json", found)


def kept_protocol(protocol: Protocol) -> dict[str, Any]:
    """The protocol as kept in the folder; trials and angles may grow, nothing else may change."""
    free = ("angles", "trials", "device", "scan")
    described = {k: v for k, v in vars(protocol).items() if k not in free}
    described["code"] = sources(sorted(Path(__file__).parent.glob("_paper*.py")))
    return described


def collect(protocol: Protocol, out: Path) -> dict[str, Any]:
    """Errors of the trials in the folder."""
    entries = []
    for angle in protocol.angles:
        found: dict[str, list[Mapping[str, float]]] = {way: [] for way in WAYS}
        for trial in range(protocol.trials):
            for way in ("published", "ours"):
                kept = read_json(out / "trials" / f"{angle:g}-{trial}-{way}.json")
                for name in WAYS:
                    if kept.get(name) is not None:
                        found[name].append(kept[name])
        for way, trials in found.items():
            if not trials:
                continue
            errors = np.array([t["estimate"] for t in trials]) - angle
            entries.append(
                {
                    "angle": angle,
                    "way": way,
                    "trials": len(trials),
                    "mae": float(np.abs(errors).mean()),
                    "std": float(np.abs(errors).std(ddof=1)) if len(trials) > 1 else None,
                    "bias": float(errors.mean()),
                    "scatter": float(errors.std(ddof=1)) if len(trials) > 1 else None,
                    "width_90": float(np.mean([t["high"] - t["low"] for t in trials])),
                    "coverage_90": float(np.mean([t["low"] <= angle <= t["high"] for t in trials])),
                }
            )
    budgets = [read_json(f) for a in protocol.angles if (f := out / "budget" / f"{a:g}.json").is_file()]
    return {
        "benchmark": "paper-table",
        "protocol": vars(protocol),
        "published": PUBLISHED,
        "entries": entries,
        "budget": budgets,
    }


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    p = result["protocol"]
    lines = [
        f"{p['trials']} trials of {p['evaluations']} evaluations, {p['worlds']} worlds an angle, pictures "
        f"{p['scale']:g} of 1280 x 720, {p['views']} views, {p['cells']:g} cells across the tool "
        f"(published: {p['published_cells']:g}, worlds: {p['truth_cells']:g}), {p['device'].split(':')[0]}.",
        "",
        "| true angle | in print | " + " | ".join(WAYS) + " | target |",
        "|---" * (len(WAYS) + 3) + "|",
    ]
    for angle in p["angles"]:
        cells = []
        for way in WAYS:
            entry = next((e for e in result["entries"] if e["angle"] == angle and e["way"] == way), None)
            cells.append("–" if entry is None else f"{entry['mae']:.2f}{_spread(entry['std'])}°")
        known = PUBLISHED.get(angle)
        printed = "–" if known is None else f"{known[0]:.2f} ± {known[1]:.2f}°"
        lines.append(f"| {angle:g}° | {printed} | {' | '.join(cells)} | {TARGET[0]:g} ± {TARGET[1]:g}° |")
    lines += ["", "| true angle | way | bias | scatter | 90 % interval's width | holds the truth |", "|---" * 6 + "|"]
    for e in result["entries"]:
        scatter = "–" if e["scatter"] is None else f"{e['scatter']:.2f}°"
        lines.append(
            f"| {e['angle']:g}° | {e['way']} | {e['bias']:+.2f}° | {scatter} | {e['width_90']:.2f}° | "
            f"{100.0 * e['coverage_90']:.0f} % |"
        )
    if result["budget"]:
        lines += ["", *budget_table(result["budget"])]
    return "\n".join(lines)


def _spread(value: float | None) -> str:
    """Of several trials; one has none."""
    return "" if value is None else f" ± {value:.2f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit code 0."""
    usual = Protocol()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--angles", type=float, nargs="+", default=list(usual.angles))
    parser.add_argument("--trials", type=int, default=usual.trials)
    parser.add_argument("--worlds", type=int, default=usual.worlds, help="observations for each angle")
    parser.add_argument("--evaluations", type=int, default=usual.evaluations)
    parser.add_argument("--cells", type=float, default=usual.cells, help="of our model, across the tool")
    parser.add_argument("--published-cells", type=float, default=usual.published_cells, help="in the published way")
    parser.add_argument("--truth-cells", type=float, default=usual.truth_cells, help="of the worlds")
    parser.add_argument("--views", type=int, default=usual.views)
    parser.add_argument("--picture-scale", type=float, default=usual.scale)
    parser.add_argument("--reconstruction", default=usual.reconstruction, help="preset of the reconstruction")
    parser.add_argument("--budget-seeds", type=int, default=usual.scan[0], help="of the error budget; 0 leaves it out")
    parser.add_argument("--budget-points", type=int, default=usual.scan[1], help="angles of its landscapes")
    parser.add_argument(
        "--executor", default="serial", help="where worlds are made and searched: serial, processes:N or dask:ADDRESS"
    )
    parser.add_argument("--device", nargs="+", type=here, default=[usual.device], help="or several, taken in turn")
    output_options(parser)
    options = parser.parse_args(arguments)
    hush()
    protocol = Protocol(
        angles=tuple(options.angles),
        trials=options.trials,
        worlds=min(options.worlds, options.trials),
        evaluations=options.evaluations,
        cells=options.cells,
        published_cells=options.published_cells,
        truth_cells=options.truth_cells,
        views=options.views,
        scale=options.picture_scale,
        device=options.device[0],
        reconstruction=options.reconstruction,
        scan=(options.budget_seeds, options.budget_points),
    )
    out = options.out or Path("runs") / "paper-table"
    began = time.time()
    # Enough jobs for all processes at once: a world's trials in several, and its budget.
    workers = int(options.executor.partition(":")[2]) if options.executor.startswith("processes:") else 1
    parts = max(1, workers // (len(protocol.angles) * protocol.worlds) - (protocol.scan[0] > 0))
    with executor(options.executor) as pool:
        result = run(protocol, out, pool, Clock(began), devices=options.device, parts=parts)
    result |= {**stamp(options.device[0]), "seconds": time.time() - began}
    write_result(out, result, table(result), {})
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
