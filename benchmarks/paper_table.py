"""The published table, again: friction angles of Hsiao and Kumar's scene from photographs of simulated sand.

    splatsoil benchmark paper-table --device cuda:0 --picture-scale 0.5 --out runs/paper-table

For each angle, a synthetic experiment is simulated with other particles and a finer grid, whose nodes meet the model's
at the walls only, and photographed by the path tracer. It is reconstructed from its views, and each trial spends 10
evaluations on it:

| way | cells | loss | search |
|---|---|---|---|
| `published` | 3.2 | mean square colour difference, four frames, whole pictures | random start, expected improvement |
| `ours` | 6.4 | the robust loss, all frames | Sobol start, log noisy expected improvement |
| `features` | | none: a comparison's posterior mean, from the features of `ours`' evaluations | |

A trial is an episode of PlowSand, and searches are those of the agents `paper` and `both` of `bo-vs-mcmc`. The angle is
searched in [25°, 55°]. Experiments, reconstructions and trials are kept in the folder, and an interrupted benchmark
continues.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._agents import FEWEST, least, posterior, searched
from splatsoil.benchmarks._common import (
    Clock,
    at_least,
    keep_to_one_protocol,
    markdown,
    parser_of,
    sources,
    stamp,
    tell,
)
from splatsoil.benchmarks.bo_vs_mcmc import accuracy, scored
from splatsoil.envs.measured import MeasuredProblem, reconstructed
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.problem import Evaluation, Problem
from splatsoil.inverse.bayesopt import BayesianOptimiser

from splatsoil.comparison import Comparator
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.files import plain, read_json, write_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model, Prediction
from splatsoil.mpm import PRESETS, Preset, Resolution
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush
from splatsoil.soil.settings import FRICTION_ANGLE
from splatsoil.synthetic import Recipe, make_set, paper

PUBLISHED = {25.0: (0.64, 1.01), 30.0: (1.07, 0.71), 35.0: (1.24, 0.96), 45.0: (1.38, 1.36)}
"""Mean absolute error and its standard deviation over ten trials, degrees, by true angle (Hsiao and Kumar)."""
TARGET = (0.3, 0.3)
"""What this project aims at for all four, degrees."""
FRAMES = (50, 100, 150, 199)
"""That the published loss compares."""
SPACE = ParameterSpace([replace(FRICTION_ANGLE, lower=25.0, upper=55.0)])
CELLS = {"published": 3.2, "ours": 6.4, "truth": 8.7}
"""Across the tool. With 8.7 a bed of 1 m has 87 cells, which share no factor with 64 and 32."""
SEARCHES: Mapping[str, tuple[int, dict[str, Any]]] = {
    "published": (1000, {"start": 1, "acquisition": "best"}),
    "ours": (0, {}),
}
"""Ways that spend evaluations of their own: seed of the first trial, and options of the optimiser."""
WAYS = (*SEARCHES, "features")


def preset(which: str) -> Preset:
    """The paper's preset with the number of cells of a way, or of the truth."""
    return replace(PRESETS["paper"], name=which, cells_across_tool=CELLS[which])


def published_loss(comparator: Comparator, images: Mapping[tuple[str, int], npt.NDArray[np.float32]]) -> float:
    """Mean square colour difference of the four frames."""
    keys = [(c, f) for c, f in comparator.keys if f in FRAMES]
    return float(np.mean([np.mean(np.square(comparator.observed[k] - images[k])) for k in keys]))


class Photographed(MeasuredProblem):
    """A synthetic experiment as one way sees it: on its cells, by its loss."""

    def __init__(self, model: Model, way: str) -> None:
        resolution = Resolution.derive(model.measurement, preset(way))
        # the published loss compares four frames: no others are drawn for it
        frames = (0, *FRAMES) if way == "published" else None
        super().__init__(PlowExperiment(model.variant(frames=frames, resolution=resolution), candidates=()))
        self.space, self.way = SPACE, way

    def judge(self, prediction: Prediction) -> Evaluation:
        """By the way's loss."""
        if self.way == "ours":
            return super().judge(prediction)
        return Evaluation(published_loss(self.comparator, prediction.images), np.zeros(self.block_count))


def experiments(angle: float, picture_scale: float, device: str, out: Path) -> dict[str, Photographed]:
    """One synthetic experiment by the ways that see it; set and reconstruction are made where the folder lacks them."""
    folder = out / "sets" / f"{angle:g}"
    if not (folder / "truth.json").is_file():
        setup = paper() if picture_scale == 1.0 else paper().resized(picture_scale)
        seed = 1_000_003 + round(10 * angle)
        recipe = Recipe(friction_angle=angle, preset=preset("truth"), particle_seed=seed, device=device)
        make_set(folder, setup, recipe)
    whole = Measurement.load(folder)
    measurement = replace(whole, tool=replace(whole.tool, force=None))  # in print there are photographs alone
    reconstruction = reconstructed(measurement, out / "reconstructions" / folder.name, "small", device)
    model = Model(measurement, reconstruction, preset="paper", device=device)
    return {way: Photographed(model, way) for way in SEARCHES}


def trial(
    problem: Problem, way: str, number: int, evaluations: int, sensor: float, truth: Mapping[str, float]
) -> dict[str, Any]:
    """Scores of a search, and of the posterior from the features of ours where enough simulations succeeded."""
    first, options = SEARCHES[way]
    seed = first + number
    optimiser = BayesianOptimiser(len(problem.space), seed=seed, **options)
    points, features = searched(PlowSandEnv(problem=problem, budget=evaluations), seed, optimiser)
    answers = {way: least(optimiser)} if len(points) else {}
    if way == "ours" and len(points) >= FEWEST:
        answers["features"] = posterior(problem.space, points, features, seed=seed, sensor=sensor)
    return {name: scored(answer, problem.space, truth) for name, answer in answers.items()}


def collect(angles: Sequence[float], trials: int, out: Path) -> list[dict[str, Any]]:
    """Accuracy of each way at each angle, of the trials in the folder."""
    entries = []
    for angle in angles:
        files = [out / "trials" / f"{angle:g}-{n}-{way}.json" for n in range(trials) for way in SEARCHES]
        kept = [read_json(file) for file in files]
        for way in WAYS:
            found = [trial[way] for trial in kept if way in trial]
            if found:
                numbers = {name: value[0] for name, value in accuracy(found).items()}
                entries.append(plain({"angle": angle, "way": way, **numbers}))
    return entries


def table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Errors as Markdown."""
    rows = []
    for angle in dict.fromkeys(e["angle"] for e in entries):
        found = {e["way"]: "{mae:.2f} ± {mae_std:.2f}°".format(**e) for e in entries if e["angle"] == angle}
        printed = "{:.2f} ± {:.2f}°".format(*PUBLISHED[angle]) if angle in PUBLISHED else "–"
        rows.append([f"{angle:g}°", printed, *(found.get(way, "–") for way in WAYS), "{:g} ± {:g}°".format(*TARGET)])
    form = "{angle:g}°", "{way}", "{bias:+.2f}°", "{scatter:.2f}°", "{width_90:.2f}°", "{coverage_90:.0%}"
    head = ("true angle", "way", "bias", "scatter", "90 % interval's width", "contains the truth")
    more = markdown(head, [[cell.format(**e) for cell in form] for e in entries])
    return f"{markdown(('true angle', 'in print', *WAYS, 'target'), rows)}\n\n{more}"


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = parser_of(__doc__, "runs/paper-table")
    parser.add_argument("--angles", type=float, nargs="+", default=list(PUBLISHED))
    parser.add_argument("--trials", type=at_least(1), default=10, help="for each angle")
    parser.add_argument("--evaluations", type=at_least(2), default=10, help="in a trial")
    parser.add_argument("--picture-scale", type=float, default=1.0, help="size of the pictures over 1280 x 720")
    options = parser.parse_args(arguments)
    hush()
    say, out, scale = Clock(), options.out, options.picture_scale
    code = sources("paper_table", "_agents", "bo_vs_mcmc")
    decides = {"evaluations": options.evaluations, "picture_scale": scale, "code": code}
    keep_to_one_protocol(out, decides)
    for angle in options.angles:
        for way, problem in experiments(angle, scale, options.device, out).items():
            for number in range(options.trials):
                file = out / "trials" / f"{angle:g}-{number}-{way}.json"
                if not file.is_file():
                    sensor, truth = problem.comparator.block_noise(), {"friction_angle": angle}
                    write_json(file, plain(trial(problem, way, number, options.evaluations, sensor, truth)))
                    say(f"{angle:g}°: {way}, trial {number}")
    entries = collect(options.angles, options.trials, out)
    result = {"made_by": stamp(options.device), "trials": options.trials, **decides, "entries": entries}
    tell(options, result, table(entries))
    return 0
