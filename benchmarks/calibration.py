"""Are the posteriors calibrated? Simulation-based calibration.

Truths are drawn from the prior and simulated, each with particles of its own; sensor noise is added. For each, an
emulator is trained on other simulations only, and the posterior is that of ``splatsoil fit``.
Over many truths, 50 % and 90 % intervals should contain the truth in 50 % and 90 % of cases, and its rank among
posterior draws should be uniform (Talts et al. 2018, arXiv:1804.06788).

    splatsoil benchmark calibration --out runs/calibration

The set is the synthetic one of PlowSand-v0 unless one is named; every truth is a real simulation of it, and the model
is right but for seed-to-seed scatter. What a wrong model does to a posterior is not tested here.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binom, chisquare
from splatsoil.benchmarks._common import at_least, output_options, stamp, ticker, write_result
from splatsoil.benchmarks._simulations import Data, density_of, simulated, world_parser
from splatsoil.inverse.executors import Executor, Serial, executor

from splatsoil.files import plain
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]

LEVELS = (0.5, 0.9)
#: Emulators are trained without one of so many parts of the simulations, in turn.
FOLDS = 8
#: Posterior draws among which a truth's rank is taken, and the bins of the histogram.
DRAWS, BINS = 199, 10


def folds(data: Data, truths: int, count: int = FOLDS) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """(train, test) indices: each of the first ``truths`` simulations is tested once, by an emulator without it."""
    every = np.arange(len(data.points))
    return [(np.setdiff1d(every, test), test) for test in np.array_split(every[:truths], count)]


def calibrate(
    data: Data,
    truths: int,
    *,
    training: int | None = None,
    sensor_std: float = 1.0,
    seed: int = 0,
    pool: Executor | None = None,
) -> list[dict[str, Any]]:
    """One entry for each truth: its rank, and whether intervals contain it, for each parameter.

    Args:
        data: simulations; the first ``truths`` at points of the prior.
        truths: how many of them are taken for the truth in turn.
        training: simulations an emulator is trained on; all others by default.
        sensor_std: noise added to a truth's features, in their unit.
        seed: of noise, training sets and draws.
        pool: where the folds are worked on; here, one after the other, by default.
    """
    jobs = []
    for number, (train, test) in enumerate(folds(data, truths)):
        if training is not None and training < len(train):
            # Repeats stand at the end of the simulations: they stay, since seed-to-seed scatter is measured from them.
            inner = train[train < truths]
            keep = max(training - (len(train) - len(inner)), len(data.space) + 4)
            chosen = np.random.default_rng([seed, 21, number]).choice(inner, keep, replace=False)
            train = np.concatenate([np.sort(chosen), train[train >= truths]])
        jobs.append((data, train, test, sensor_std, seed, number))
    out: list[dict[str, Any]] = []
    report = ticker("truths")
    for entries in (pool or Serial()).map(one_fold, *zip(*jobs, strict=True)):
        out += entries
        report(len(out), truths)
    return out


def one_fold(
    data: Data, train: npt.NDArray[np.int64], test: npt.NDArray[np.int64], sensor_std: float, seed: int, number: int
) -> list[dict[str, Any]]:
    """Entries of the truths ``test``, by emulators of the simulations ``train``; a worker's job."""
    rng = np.random.default_rng([seed, 24, number])
    out: list[dict[str, Any]] = []
    features, space = -data.residuals, data.space
    for index in test:
        observed = features[index] + sensor_std * rng.standard_normal(features.shape[1])
        density = density_of(space, data.points[train], features[train], observed, sensor_std, seed)
        evidence = density.comparison.judge()
        marginals = [evidence.marginal(p.name) for p in space]
        weights = marginals[0].weights
        chosen = rng.choice(len(weights), DRAWS, p=weights / weights.sum())
        draws = space.to_unit(np.stack([m.values[chosen] for m in marginals], axis=1))
        truth = data.points[index]
        physical = space.from_unit(truth)
        ends = {level: [[m.quantile(0.5 + s * level / 2) for s in (-1, 1)] for m in marginals] for level in LEVELS}
        inside = {
            str(level): [bool(a <= t <= b) for (a, b), t in zip(found, physical, strict=True)]
            for level, found in ends.items()
        }
        entry = {"truth": truth, "rank": (draws < truth).sum(axis=0), "within": inside}
        out.append(plain({**entry, "mean": draws.mean(axis=0), "std": draws.std(axis=0)}))
    return out


def summarise(entries: Sequence[dict[str, Any]], space: ParameterSpace) -> dict[str, Any]:
    """Coverage with its 95 % binomial range when all is right, and ranks with χ²'s p-value, for each parameter."""
    count = len(entries)
    parameters = {}
    for i, p in enumerate(space):
        ranks = np.array([e["rank"][i] for e in entries])
        bins = np.histogram(ranks, bins=BINS, range=(-0.5, DRAWS + 0.5))[0]
        z = np.array([(e["mean"][i] - e["truth"][i]) / e["std"][i] for e in entries])
        parameters[p.name] = {
            "coverage": {str(level): float(np.mean([e["within"][str(level)][i] for e in entries])) for level in LEVELS},
            "ranks": bins.tolist(),
            "p_uniform": float(chisquare(bins).pvalue),
            "rms_z": float(np.sqrt(np.mean(z**2))),
            "contraction": float(np.mean([e["std"][i] for e in entries]) * np.sqrt(3.0)),
            "unit": p.unit,
        }
    expected = {str(level): [float(v) / count for v in binom.interval(0.95, count, level)] for level in LEVELS}
    return {"truths": count, "expected": expected, "parameters": parameters}


def table(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    lines = [
        f"{result['world']}, preset `{result['preset']}`, {result['device']}: {result['truths']} truths, each a "
        f"simulation of its own, emulators trained on {result['training']} others; {result['seconds']:.0f} s.",
        "",
        "| parameter | truth in 50 % intervals | in 90 % intervals | ranks uniform, p | rms z | std / prior's |",
        "|---|---|---|---|---|---|",
    ]
    for name, entry in result["parameters"].items():
        held = " | ".join(f"{100.0 * entry['coverage'][str(level)]:.0f} %" for level in LEVELS)
        lines.append(
            f"| {name} | {held} | {entry['p_uniform']:.2f} | {entry['rms_z']:.2f} | {entry['contraction']:.2f} |"
        )
    ranges = ", ".join(
        f"{100.0 * level:.0f} %: {100.0 * result['expected'][str(level)][0]:.0f}–"
        f"{100.0 * result['expected'][str(level)][1]:.0f} %"
        for level in LEVELS
    )
    lines += ["", f"95 % of perfectly calibrated posteriors would land within {ranges} with so many truths."]
    return "\n".join(lines)


def figure(result: dict[str, Any]) -> Figure:
    """Rank histograms with the band that uniform ranks stay in."""
    from matplotlib.figure import Figure

    names = list(result["parameters"])
    drawn = Figure(figsize=(3.6 * len(names) + 0.4, 2.6), layout="constrained")
    axes = np.atleast_1d(drawn.subplots(1, len(names)))
    low, high = binom.interval(0.95, result["truths"], 1.0 / BINS)
    for axis, name in zip(axes, names, strict=True):
        axis.axhspan(low, high, color="0.88", label="95 % of uniform ranks")
        ranks = result["parameters"][name]["ranks"]
        axis.bar(np.arange(BINS) + 0.5, ranks, width=0.9, color="#3b6ea5")
        axis.set_ylim(0.0, 1.25 * max(high, *ranks))  # room for the legend
        axis.set_xlabel(f"rank of the true {name.replace('_', ' ')}, tenths")
        axis.legend(fontsize=7)
    axes[0].set_ylabel("truths")
    return drawn


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = world_parser(__doc__)
    parser.add_argument("--truths", type=at_least(1), default=128)
    parser.add_argument("--training", type=int, help="simulations for each emulator; all others by default")
    parser.add_argument("--sensor", type=float, default=1.0, help="noise added to a truth's features, grey levels")
    parser.add_argument("--seed", type=int, default=0)
    output_options(parser)
    options = parser.parse_args(arguments)
    hush()
    began = time.perf_counter()
    with executor(options.executor) as pool:
        data, file = simulated(options, options.truths, pool, seed=options.seed)
        truths = min(options.truths, len(data.points))
        chosen: dict[str, Any] = {"training": options.training, "sensor_std": options.sensor, "seed": options.seed}
        entries = calibrate(data, truths, **chosen, pool=pool)
    result = {
        "benchmark": "calibration",
        "world": "the synthetic set of PlowSand-v0" if options.set is None else str(options.set),
        "preset": options.preset,
        "seed": options.seed,
        "training": options.training or len(data.points) - truths // FOLDS,
        "sensor": options.sensor,
        "simulations": str(file),
        **summarise(entries, data.space),
        **stamp(options.device),
        "seconds": time.perf_counter() - began,
        "entries": entries,
    }
    if options.out is not None:
        write_result(options.out, result, table(result), {"ranks.svg": figure(result)})
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
