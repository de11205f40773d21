"""Bayesian optimisation against Markov chains: the same budgets of simulator calls, what each makes of them.

    splatsoil benchmark bo-vs-mcmc --out runs/bo-vs-mcmc

| way | what it does with N calls |
|---|---|
| `bo` | the search of `splatsoil fit`: log noisy expected improvement of the loss, and where that is least |
| `paper` | the same with Hsiao and Kumar's settings: one random start, expected improvement |
| `mcmc` | emcee on a comparison's posterior, by an emulator of the features trained on N space-filling calls |
| `both` | the same, trained on the N calls that `bo` chose: what `splatsoil fit` says |
| `direct` | emcee on the calls themselves: N calls are N steps of walkers |

The calls go to an emulator of real simulations, made once and kept; each call has a draw of the measured seed-to-seed
scatter. So a thousand calls take a second, and every way meets the same landscape; what the emulator does not show of
the simulator is not tested.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import at_least, output_options, stamp, ticker, write_result
from splatsoil.benchmarks._simulations import FEWEST, density_of, simulated, world_parser
from splatsoil.inverse.bayesopt import BayesianOptimiser, sobol
from splatsoil.inverse.executors import Executor, Serial, executor
from splatsoil.inverse.mcmc import sample
from splatsoil.inverse.posterior import Density

from splatsoil.files import plain
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]

BUDGETS = (6, 10, 20)
DIRECT_BUDGETS = (20, 100, 1000)
WAYS = ("bo", "paper", "mcmc", "both", "direct")
#: Truths are drawn from this part of the prior's width, in its middle.
INNER = 0.8
COLOURS = {"bo": "#c44e52", "paper": "#dd8452", "mcmc": "#4c72b0", "both": "#8172b3", "direct": "#55a868"}


class EmulatedWorld:
    """Calls answered by an emulator of many real simulations, with seed-to-seed scatter of its measured covariance.

    Features are a comparison's scores; the loss is their mean square residual over what the prior's middle would leave
    on average.
    """

    def __init__(self, density: Density) -> None:
        self.space, self.density = density.prior.space, density
        self.count = len(density.noise.chance)
        self.factor = np.linalg.cholesky(density.noise.chance + 1e-12 * np.eye(self.count))
        spread = self._emulated(sobol(256, len(self.space), 0))
        self.unit = float(np.mean(np.sum((spread - spread.mean(axis=0)) ** 2, axis=1)))
        self.observed = np.zeros(self.count)

    def observe(self, truth: FloatArray, rng: np.random.Generator) -> None:
        """Make an observation of a truth (n,) in [-1, 1]^n."""
        self.observed = self._simulate(truth, rng)

    def call(self, point: FloatArray, rng: np.random.Generator) -> tuple[float, FloatArray]:
        """Simulate a point (n,): loss, and predicted minus observed features (b,)."""
        residual = self._simulate(point, rng) - self.observed
        return float(np.sum(residual**2)) / self.unit, residual

    def _emulated(self, points: FloatArray) -> FloatArray:
        """(q, p) mean scores at points (q, n)."""
        return self.density.predict(points)[0] @ self.density.comparison.likelihood.root.T

    def _simulate(self, point: FloatArray, rng: np.random.Generator) -> FloatArray:
        return self._emulated(point[None])[0] + self.factor @ rng.standard_normal(self.count)


@dataclass(frozen=True)
class Answer:
    """What a way says after some calls: estimate (n,), 90 % interval (n,) each, and seconds of its own thinking."""

    estimate: FloatArray
    low: FloatArray
    high: FloatArray
    seconds: float


def play(world: EmulatedWorld, budgets: Sequence[int], seed: int, **options: Any) -> tuple[dict[int, Answer], Any]:
    """Bayesian optimisation with options of its own: an answer at each budget, and the calls (points, features)."""
    rng = np.random.default_rng([seed, 31])
    optimiser = BayesianOptimiser(len(world.space), seed=seed, **options)
    answers: dict[int, Answer] = {}
    points: list[FloatArray] = []
    features: list[FloatArray] = []
    spent = 0.0
    while len(points) < max(budgets):
        began = time.perf_counter()
        action = optimiser.ask()[0].astype(np.float64)
        spent += time.perf_counter() - began
        loss, residual = world.call(action, rng)
        optimiser.tell(action, loss)
        points.append(action)
        features.append(residual)
        if len(points) in budgets:
            began = time.perf_counter()
            found = optimiser.result()
            seconds = spent + time.perf_counter() - began
            _, low, high = found.interval()
            answers[len(points)] = Answer(found.estimate, low, high, seconds)
    return answers, (np.array(points), np.array(features))


def sample_emulated(space: ParameterSpace, points: FloatArray, features: FloatArray, seed: int) -> Answer:
    """emcee on an emulator of calls (k, n), (k, b); features are residuals, so the observed ones are 0."""
    began = time.perf_counter()
    count = features.shape[1]
    density = density_of(space, points, features, np.zeros(count), 0.0, seed)
    chains = sample(density, len(space), seed=seed, ensembles=2, most_steps=1000)
    low, high = np.quantile(chains.flat, [0.05, 0.95], axis=0)
    return Answer(chains.flat.mean(axis=0), low, high, time.perf_counter() - began)


def sample_directly(world: EmulatedWorld, budgets: Sequence[int], seed: int) -> dict[int, Answer]:
    """emcee on the calls: each density is one. A call's seed-to-seed scatter adds to the observation's."""
    rng, n = np.random.default_rng([seed, 37]), len(world.space)
    inverse = np.linalg.pinv(2.0 * world.density.noise.chance)

    def density(point: FloatArray) -> float:
        if np.any(np.abs(point) > 1.0):
            return -np.inf
        _, residual = world.call(point, rng)
        return -0.5 * float(residual @ inverse @ residual)

    walkers = max(4, 2 * n + 2)
    sampler = emcee.EnsembleSampler(walkers, n, density)
    start = emcee.State(sobol(walkers, n, seed), random_state=np.random.RandomState(seed).get_state())
    steps = max(budgets) // walkers
    began = time.perf_counter()
    sampler.run_mcmc(start, steps, skip_initial_state_check=True)
    seconds = time.perf_counter() - began
    answers = {}
    for budget in budgets:
        kept = max(budget // walkers, 1)
        chain = sampler.get_chain()[kept // 4 : kept].reshape(-1, n)
        low, high = np.quantile(chain, [0.05, 0.95], axis=0)
        answers[budget] = Answer(chain.mean(axis=0), low, high, seconds * kept / steps)
    return answers


def truth_of(seed: int, n: int) -> FloatArray:
    """A truth (n,) in the middle of [-1, 1]^n."""
    return np.random.default_rng([seed, 29]).uniform(-INNER, INNER, n)


def trial(
    world: EmulatedWorld, ways: Sequence[str], budgets: Sequence[int], direct: Sequence[int], seed: int
) -> dict[str, dict[int, Answer]]:
    """All ways on one truth, drawn by the seed."""
    n, rng = len(world.space), np.random.default_rng([seed, 41])
    world.observe(truth_of(seed, n), rng)
    usable = [b for b in budgets if b >= FEWEST]
    out: dict[str, dict[int, Answer]] = {}
    if "bo" in ways or "both" in ways:
        out["bo"], (points, features) = play(world, budgets, seed)
        out["both"] = {b: sample_emulated(world.space, points[:b], features[:b], seed) for b in usable}
    if "paper" in ways:
        out["paper"], _ = play(world, budgets, seed, start=1, acquisition="best")
    if "mcmc" in ways:
        points = sobol(max(budgets), n, seed)
        features = np.array([world.call(p, rng)[1] for p in points])
        out["mcmc"] = {b: sample_emulated(world.space, points[:b], features[:b], seed) for b in usable}
    if "direct" in ways:
        out["direct"] = sample_directly(world, direct, seed)
    return {way: answers for way, answers in out.items() if way in ways}


def run(
    world: EmulatedWorld,
    *,
    ways: Sequence[str] = WAYS,
    budgets: Sequence[int] = BUDGETS,
    direct: Sequence[int] = DIRECT_BUDGETS,
    seeds: int = 12,
    pool: Executor | None = None,
) -> dict[str, Any]:
    """Errors, widths and coverage of all ways over seeds, in physical units."""
    space, report = world.space, ticker("truths")
    rows: dict[tuple[str, int], list[tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], float]]] = {}
    pool, job = pool or Serial(), partial(trial, world, ways, budgets, direct)
    for seed, answers_of in enumerate(pool.map(job, range(seeds))):
        truth = truth_of(seed, len(space))
        for way, answers in answers_of.items():
            for budget, answer in answers.items():
                error = space.from_unit(answer.estimate) - space.from_unit(truth)
                width = space.from_unit(answer.high) - space.from_unit(answer.low)
                inside = (answer.low <= truth) & (truth <= answer.high)
                rows.setdefault((way, budget), []).append((error, width, inside, answer.seconds))
        report(seed + 1, seeds)
    entries = []
    for (way, budget), found in sorted(rows.items(), key=lambda row: (WAYS.index(row[0][0]), row[0][1])):
        error, width, inside, seconds = (np.array(column) for column in zip(*found, strict=True))
        spread = np.abs(error).std(axis=0, ddof=1) if len(found) > 1 else np.zeros(len(space))
        entry = {"way": way, "calls": budget, "mae": np.abs(error).mean(axis=0), "mae_std": spread}
        entry |= {"width_90": width.mean(axis=0), "coverage_90": inside.mean(axis=0), "seconds": float(seconds.mean())}
        entries.append(plain({**entry, "errors": error}))
    return {"parameters": [{"name": p.name, "unit": p.unit} for p in space], "seeds": seeds, "entries": entries}


def table(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    lines = [f"{result['landscape']}. {result['seeds']} truths and seeds; error and width in the parameter's unit."]
    for i, parameter in enumerate(result["parameters"]):
        unit = "°" if parameter["unit"] == "deg" else f" {parameter['unit']}"
        lines += [
            "",
            f"**{parameter['name']}**",
            "",
            "| way | calls | mean abs. error ± its spread | 90 % interval's width | contains the truth | own time |",
            "|---|---|---|---|---|---|",
        ]
        for e in result["entries"]:
            lines.append(
                f"| {e['way']} | {e['calls']} | {e['mae'][i]:.3g} ± {e['mae_std'][i]:.2g}{unit} | "
                f"{e['width_90'][i]:.3g}{unit} | {100.0 * e['coverage_90'][i]:.0f} % | {e['seconds']:.1f} s |"
            )
    return "\n".join(lines)


def figure(result: dict[str, Any]) -> Figure:
    """Error and interval width against calls, for each parameter."""
    from matplotlib.figure import Figure

    count = len(result["parameters"])
    drawn = Figure(figsize=(8.4, 2.8 * count), layout="constrained")
    for i, (row, parameter) in enumerate(
        zip(drawn.subplots(count, 2, squeeze=False), result["parameters"], strict=True)
    ):
        for way in WAYS:
            found = [e for e in result["entries"] if e["way"] == way]
            calls = [e["calls"] for e in found]
            standard = [e["mae_std"][i] / result["seeds"] ** 0.5 for e in found]
            row[0].errorbar(calls, [e["mae"][i] for e in found], standard, color=COLOURS[way], marker="o", label=way)
            row[1].plot(calls, [e["width_90"][i] for e in found], color=COLOURS[way], marker="o", label=way)
        for axis, what in zip(row, ("mean absolute error", "90 % interval's width"), strict=True):
            axis.set(xscale="log", yscale="log", xlabel="simulator calls")
            axis.set_title(f"{parameter['name'].replace('_', ' ')}: {what} [{parameter['unit']}]", fontsize=9)
        row[0].legend(fontsize=7)
    return drawn


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = world_parser(__doc__)
    parser.add_argument("--seeds", type=at_least(1), default=12, help="truths, each with its own scatter")
    parser.add_argument("--budgets", type=int, nargs="+", default=list(BUDGETS))
    parser.add_argument(
        "--direct-budgets", type=int, nargs="+", default=list(DIRECT_BUDGETS), help="calls of emcee on the simulator"
    )
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--simulations", type=at_least(1), default=64, help="behind the emulated landscape")
    output_options(parser)
    options = parser.parse_args(arguments)
    hush()
    began = time.perf_counter()
    with executor(options.executor) as pool:
        data, file = simulated(options, options.simulations, pool)
        density = density_of(data.space, data.points, -data.residuals, np.zeros(data.residuals.shape[1]), 0.0)
        chosen = {"ways": options.ways, "budgets": options.budgets, "direct": options.direct_budgets}
        found = run(EmulatedWorld(density), **chosen, seeds=options.seeds, pool=pool)
    source = "the synthetic set" if options.set is None else str(options.set)
    count = len(density.noise.chance)
    landscape = f"{count} scores of {len(data.points)} simulations of {source}, preset `{options.preset}`, emulated"
    result = {
        "benchmark": "bo-vs-mcmc",
        "landscape": landscape,
        **found,
        "simulations": str(file),
        **stamp(options.device),
        "seconds": time.perf_counter() - began,
    }
    if options.out is not None:
        write_result(options.out, result, table(result), {"bo-vs-mcmc.svg": figure(result)})
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
