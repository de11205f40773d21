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

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binom, chisquare
from splatsoil.benchmarks._common import Clock, at_least, markdown, stamp, tell
from splatsoil.benchmarks._simulations import Data, density_of, simulated, world_parser

from splatsoil.files import plain
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Indices = npt.NDArray[np.int64]

LEVELS = (0.5, 0.9)
SENSOR = 1.0
"""Noise added to a truth's features, grey levels."""
FOLDS = 8
"""Emulators are trained without one of so many parts of the simulations, in turn."""
DRAWS, BINS = 199, 10
"""Posterior draws among which a truth's rank is taken, and the bins of the histogram."""


def folds(data: Data, truths: int, training: int | None) -> list[tuple[Indices, Indices]]:
    """(train, test) indices: each of the first ``truths`` simulations is tested once, by an emulator without it, which
    is trained on ``training`` others, or on all of them."""
    every, found = np.arange(len(data.points)), []
    for number, test in enumerate(np.array_split(every[:truths], FOLDS)):
        train = np.setdiff1d(every, test)
        if training is not None and training < len(train):
            # Repeats stand at the end of the simulations: they stay, since seed-to-seed scatter is measured from them.
            inner, repeats = train[train < truths], train[train >= truths]
            keep = max(training - len(repeats), len(data.space) + 4)
            chosen = np.random.default_rng([0, 21, number]).choice(inner, keep, replace=False)
            train = np.concatenate([np.sort(chosen), repeats])
        found.append((train, test))
    return found


def calibrate(data: Data, truths: int, training: int | None = None, sensor: float = SENSOR) -> list[dict[str, Any]]:
    """One entry for each truth: its rank, and whether intervals contain it, for each parameter.

    Args:
        data: simulations; the first ``truths`` at points of the prior.
        truths: how many of them are taken for the truth in turn.
        training: simulations an emulator is trained on; all others by default.
        sensor: standard deviation of the noise that is added to a truth's features.
    """
    out: list[dict[str, Any]] = []
    say = Clock()
    for number, (train, test) in enumerate(folds(data, truths, training)):
        rng = np.random.default_rng([0, 24, number])
        out += [entry(data, train, int(truth), sensor, rng) for truth in test]
        say(f"{len(out)} of {truths} truths")
    return out


def entry(data: Data, train: Indices, index: int, sensor: float, rng: np.random.Generator) -> dict[str, Any]:
    """Of one truth, by an emulator of the simulations ``train``."""
    features, space = -data.residuals, data.space
    observed = features[index] + sensor * rng.standard_normal(features.shape[1])
    density = density_of(space, data.points[train], features[train], observed, sensor)
    evidence = density.comparison.evidence()
    marginals = [evidence.marginal(p.name) for p in space]
    weights = marginals[0].weights
    chosen = rng.choice(len(weights), DRAWS, p=weights / weights.sum())
    draws = space.to_unit(np.stack([m.values[chosen] for m in marginals], axis=1))
    truth = data.points[index]
    inside = {
        str(level): [
            bool(m.quantile(0.5 - level / 2) <= t <= m.quantile(0.5 + level / 2))
            for m, t in zip(marginals, space.from_unit(truth), strict=True)
        ]
        for level in LEVELS
    }
    found = {"truth": truth, "rank": (draws < truth).sum(axis=0), "within": inside}
    return dict(plain({**found, "mean": draws.mean(axis=0), "std": draws.std(axis=0)}))


def summarise(entries: Sequence[dict[str, Any]], space: ParameterSpace) -> dict[str, Any]:
    """Coverage with its 95 % binomial range when all is right, and ranks with χ²'s p-value, for each parameter."""
    count = len(entries)
    parameters = {}
    for i, p in enumerate(space):
        ranks, truth, mean, std = (np.array([e[k][i] for e in entries]) for k in ("rank", "truth", "mean", "std"))
        bins = np.histogram(ranks, bins=BINS, range=(-0.5, DRAWS + 0.5))[0]
        parameters[p.name] = {
            "coverage": {str(level): float(np.mean([e["within"][str(level)][i] for e in entries])) for level in LEVELS},
            "ranks": bins.tolist(),
            "p_uniform": float(chisquare(bins).pvalue),
            "rms_z": float(np.sqrt(np.mean(((mean - truth) / std) ** 2))),
            "contraction": float(std.mean() * np.sqrt(3.0)),
            "unit": p.unit,
        }
    expected = {str(level): [float(v) / count for v in binom.interval(0.95, count, level)] for level in LEVELS}
    return {"truths": count, "expected": expected, "parameters": parameters}


def table(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    words = (
        f"{result['world']}, preset `{result['preset']}`, {result['made_by']['device']}: {result['truths']} truths, "
        f"each a simulation of its own, emulators trained on {result['training']} others."
    )
    head = ("parameter", "truth in 50 % intervals", "in 90 % intervals", "ranks uniform, p", "rms z", "std / prior's")
    rows = []
    for name, entry in result["parameters"].items():
        held = [f"{100.0 * entry['coverage'][str(level)]:.0f} %" for level in LEVELS]
        rows.append([name, *held, *(f"{entry[key]:.2f}" for key in ("p_uniform", "rms_z", "contraction"))])
    ranges = ", ".join(
        f"{100.0 * level:.0f} %: {100.0 * low:.0f}–{100.0 * high:.0f} %"
        for level, (low, high) in zip(LEVELS, result["expected"].values(), strict=True)
    )
    last = f"95 % of perfectly calibrated posteriors would land within {ranges} with so many truths."
    return f"{words}\n\n{markdown(head, rows)}\n\n{last}"


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
    parser = world_parser(__doc__, "runs/calibration")
    parser.add_argument("--truths", type=at_least(1), default=128)
    parser.add_argument("--training", type=at_least(1), help="simulations for each emulator; all others by default")
    options = parser.parse_args(arguments)
    hush()
    data, file = simulated(options, options.truths)
    entries = calibrate(data, options.truths, options.training)
    result = {
        "made_by": stamp(options.device),
        "world": "the synthetic set of PlowSand-v0" if options.set is None else str(options.set),
        "preset": options.preset,
        "training": options.training or len(data.points) - options.truths // FOLDS,
        "sensor": SENSOR,
        "simulations": str(file),
        **summarise(entries, data.space),
        "entries": entries,
    }
    tell(options, result, table(result), {"ranks.svg": figure(result)})
    return 0
