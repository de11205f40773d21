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

The angle is searched in [25°, 55°]. All trials of an experiment go on side by side: one batch of simulations for each
step. Experiments, reconstructions and trials are kept in the folder, and an interrupted benchmark continues.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import (
    Clock,
    FloatArray,
    at_least,
    keep_to_one_protocol,
    markdown,
    parser_of,
    sources,
    stamp,
    tell,
)
from splatsoil.benchmarks._simulations import FEWEST, density_of
from splatsoil.benchmarks._truth import reconstructed
from splatsoil.inverse.bayesopt import BayesianOptimiser

from splatsoil.comparison import Comparator
from splatsoil.errors import SimulationError
from splatsoil.files import plain, read_json, write_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS, Preset, Resolution, simulate_together
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction
from splatsoil.soil.settings import FRICTION_ANGLE
from splatsoil.synthetic import Recipe, make_set, paper

Images = Mapping[tuple[str, int], npt.NDArray[np.float32]]

PUBLISHED = {25.0: (0.64, 1.01), 30.0: (1.07, 0.71), 35.0: (1.24, 0.96), 45.0: (1.38, 1.36)}
"""Mean absolute error and its standard deviation over ten trials, degrees, by true angle (Hsiao and Kumar)."""
TARGET = (0.3, 0.3)
"""What this project aims at for all four, degrees."""
FRAMES = (50, 100, 150, 199)
"""That the published loss compares."""
SPACE = ParameterSpace([replace(FRICTION_ANGLE, lower=25.0, upper=55.0)])
SEARCHES = ("published", "ours")
"""Ways that spend evaluations of their own."""
WAYS = (*SEARCHES, "features")
CELLS = {"published": 3.2, "ours": 6.4, "truth": 8.7}
"""Across the tool. With 8.7 a bed of 1 m has 87 cells, which share no factor with 64 and 32."""
FIRST_OF_PUBLISHED = 1000
"""Seed of the published way's first search: its start is random, and another one than ours."""

Found = tuple[float, FloatArray] | None
"""Loss and block residuals (b,) of an evaluation; None where the simulation failed."""


def preset(which: str) -> Preset:
    """The paper's preset with the number of cells of a way, or of the truth."""
    return replace(PRESETS["paper"], name=which, cells_across_tool=CELLS[which])


class Sight:
    """One experiment as a model sees it: reconstruction, simulator, and both losses."""

    def __init__(self, measurement: Measurement, reconstruction: Reconstruction, device: str) -> None:
        ours, coarser = (Resolution.derive(measurement, preset(way)) for way in ("ours", "published"))
        self.model = Model(measurement, reconstruction, preset="paper", device=device)
        self.model.resolution = ours
        # the published loss compares four frames: no others are drawn for it
        self.few = self.model.variant(frames=(0, *FRAMES), resolution=coarser)
        # what is smaller than the patch differs from seed to seed
        surface, frames = reconstruction.surface, self.model.frames
        self.comparator = Comparator(measurement, surface=surface, frames=frames, patch=2.0 * ours.cell)

    def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[Found]:
        """What each angle and particle seed comes to; the simulations run as one batch."""
        model = self.few if way == "published" else self.model
        runs = simulate_together(
            model.measurement,
            [model.particles(seed) for _, seed in jobs],
            [{"friction_angle": angle} for angle, _ in jobs],
            model,
        )
        found: list[Found] = []
        for run, (_, seed) in zip(runs, jobs, strict=True):
            if isinstance(run, SimulationError):
                found.append(None)
            elif way == "published":
                found.append((published_loss(self.comparator, model.draw(run, seed)), np.zeros(0)))
            else:
                compared = self.comparator.compare(model.draw(run, seed))
                found.append((compared.loss, compared.blocks))
        return found


def published_loss(comparator: Comparator, images: Images) -> float:
    """Mean square colour difference of the four frames."""
    keys = [(c, f) for c, f in comparator.keys if f in FRAMES]
    return float(np.mean([np.mean(np.square(comparator.observed[k] - images[k])) for k in keys]))


def world(angle: float, picture_scale: float, device: str, out: Path) -> tuple[Measurement, Reconstruction]:
    """An experiment and its reconstruction, from the folder or made and kept there."""
    folder = out / "worlds" / f"{angle:g}"
    if not (folder / "truth.json").is_file():
        setup = paper() if picture_scale == 1.0 else paper().resized(picture_scale)
        seed = 1_000_003 + round(10 * angle)
        recipe = Recipe(friction_angle=angle, preset=preset("truth"), particle_seed=seed, device=device)
        make_set(folder, setup, recipe)
    measurement = Measurement.load(folder)
    return measurement, reconstructed(measurement, out / "reconstructions" / folder.name, "small", device)


class Trial:
    """A search going on, by its number, which is its seed, and its way."""

    def __init__(self, number: int, way: str) -> None:
        self.number, self.way = number, way
        self.calls: list[tuple[float, Found]] = []
        if way == "published":
            self.optimiser = BayesianOptimiser(1, seed=FIRST_OF_PUBLISHED + number, start=1, acquisition="best")
        else:
            self.optimiser = BayesianOptimiser(1, seed=number)

    def ask(self) -> tuple[float, int]:
        """The angle to try next, degrees, and a seed of its particles."""
        sequence = np.random.SeedSequence([self.number, len(self.calls), WAYS.index(self.way)])
        seed = int(sequence.generate_state(1)[0] % 2**31)
        return float(SPACE.from_unit(self.optimiser.ask()[0].astype(np.float64))[0]), seed

    def tell(self, angle: float, found: Found) -> None:
        """What the angle came to."""
        self.calls.append((angle, found))
        self.optimiser.tell(SPACE.to_unit(np.array([[angle]]))[0], None if found is None else found[0])

    def result(self, sensor: float) -> dict[str, Any]:
        """What the search came to, JSON-able: estimates of its way, and of features where they were taken."""
        good = [(angle, *found) for angle, found in self.calls if found is not None]
        told: dict[str, Any] = {"calls": [{"angle": a, "loss": f and f[0]} for a, f in self.calls], self.way: None}
        if good:
            found = self.optimiser.result()
            _, low, high = found.interval(SPACE.from_unit)
            numbers = {"estimate": SPACE.from_unit(found.estimate), "low": low, "high": high}
            told[self.way] = {name: float(value[0]) for name, value in numbers.items()}
        if self.way == "ours":
            angles, blocks = np.array([a for a, _, _ in good]), np.array([b for _, _, b in good])
            told["features"] = by_features(angles, blocks, sensor, self.number)
        return told


def by_features(angles: FloatArray, blocks: FloatArray, sensor: float, seed: int) -> dict[str, float] | None:
    """The posterior that features (k, b) at angles (k,) allow; None where they are too few or nothing is seen."""
    seen = np.all(blocks != 0.0, axis=0) if len(blocks) else np.zeros(0, dtype=bool)
    if len(blocks) < FEWEST or not seen.any():
        return None
    points, residuals = SPACE.to_unit(angles[:, None]), blocks[:, seen]
    density = density_of(SPACE, points, -residuals, np.zeros(residuals.shape[1]), sensor, seed)
    marginal = density.comparison.evidence().marginal(SPACE.names[0])
    return {"estimate": marginal.mean, "low": marginal.quantile(0.05), "high": marginal.quantile(0.95)}


def trial_files(angle: float, trials: int, out: Path) -> dict[tuple[int, str], Path]:
    """Where trials are kept, by their number and way."""
    return {(n, way): out / "trials" / f"{angle:g}-{n}-{way}.json" for n in range(trials) for way in SEARCHES}


def search(sight: Sight, angle: float, trials: int, evaluations: int, out: Path) -> None:
    """Trials of one experiment, step by step, side by side; those that are in the folder are not made again."""
    files = trial_files(angle, trials, out)
    missing = [Trial(*key) for key, file in files.items() if not file.is_file()]
    for _ in range(evaluations):
        for way in SEARCHES:
            mine = [t for t in missing if t.way == way]
            asked = [t.ask() for t in mine]
            for trial, (tried, _), found in zip(mine, asked, sight.evaluate(way, asked) if mine else [], strict=True):
                trial.tell(tried, found)
    for trial in missing:
        write_json(files[trial.number, trial.way], trial.result(sight.comparator.block_noise()))


def collect(angles: Sequence[float], trials: int, out: Path) -> list[dict[str, Any]]:
    """Errors of each way at each angle, of the trials in the folder."""
    entries = []
    for angle in angles:
        kept = [read_json(file) for file in trial_files(angle, trials, out).values()]
        for way in WAYS:
            found = [entry[way] for entry in kept if entry.get(way) is not None]
            if not found:
                continue
            errors = np.array([t["estimate"] for t in found]) - angle
            spread = {"std": np.abs(errors).std(ddof=1), "scatter": errors.std(ddof=1)} if len(found) > 1 else {}
            entry = {"angle": angle, "way": way, "mae": np.abs(errors).mean(), "bias": errors.mean(), **spread}
            entry["width_90"] = np.mean([t["high"] - t["low"] for t in found])
            entry["coverage_90"] = np.mean([t["low"] <= angle <= t["high"] for t in found])
            entries.append(plain(entry))
    return entries


def table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Errors as Markdown."""

    def error(entry: Mapping[str, Any] | None) -> str:
        if entry is None:
            return "–"
        return f"{entry['mae']:.2f} ± {entry['std']:.2f}°" if "std" in entry else f"{entry['mae']:.2f}°"

    rows = []
    for angle in dict.fromkeys(e["angle"] for e in entries):
        found = {e["way"]: e for e in entries if e["angle"] == angle}
        printed = "{:.2f} ± {:.2f}°".format(*PUBLISHED[angle]) if angle in PUBLISHED else "–"
        aim = "{:g} ± {:g}°".format(*TARGET)
        rows.append([f"{angle:g}°", printed, *(error(found.get(way)) for way in WAYS), aim])
    more = [
        [
            f"{e['angle']:g}°",
            e["way"],
            f"{e['bias']:+.2f}°",
            f"{e['scatter']:.2f}°" if "scatter" in e else "–",
            f"{e['width_90']:.2f}°",
            f"{100.0 * e['coverage_90']:.0f} %",
        ]
        for e in entries
    ]
    first = markdown(("true angle", "in print", *WAYS, "target"), rows)
    head = ("true angle", "way", "bias", "scatter", "90 % interval's width", "contains the truth")
    return f"{first}\n\n{markdown(head, more)}"


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = parser_of(__doc__, "runs/paper-table")
    parser.add_argument("--angles", type=float, nargs="+", default=list(PUBLISHED))
    parser.add_argument("--trials", type=at_least(1), default=10, help="for each angle")
    parser.add_argument("--evaluations", type=at_least(1), default=10, help="in a trial")
    parser.add_argument("--picture-scale", type=float, default=1.0, help="size of the pictures over 1280 x 720")
    options = parser.parse_args(arguments)
    hush()
    say, out, scale = Clock(), options.out, options.picture_scale
    decides = {"evaluations": options.evaluations, "picture_scale": scale, "code": sources([Path(__file__)])}
    keep_to_one_protocol(out, decides)
    for angle in options.angles:
        sight = Sight(*world(angle, scale, options.device, out), options.device)
        say(f"{angle:g}°: reconstructed")
        search(sight, angle, options.trials, options.evaluations, out)
        say(f"{angle:g}°: done")
    entries = collect(options.angles, options.trials, out)
    result = {"made_by": stamp(options.device), "trials": options.trials, **decides, "entries": entries}
    tell(options, result, table(entries))
    return 0
