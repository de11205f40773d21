"""The published table, again: friction angles of Hsiao and Kumar's scene from photographs of simulated sand.

    splatsoil benchmark paper-table --device cuda:0 --picture-scale 0.5 --out runs/paper-table

For each angle, synthetic experiments are simulated with other particles and a finer grid, whose nodes meet the model's
at the walls only, and photographed by the path tracer. Each is reconstructed from its views, and each trial spends 10
evaluations on one:

| way | cells | loss | search |
|---|---|---|---|
| `published` | 3.2 | mean square colour difference, four frames, whole pictures | random start, expected improvement |
| `ours` | 6.4 | the robust loss, all frames | Sobol start, log noisy expected improvement |
| `features` | | none: a comparison's posterior mean, from the features of `ours`' evaluations | |

The angle is searched in [25°, 55°]. All trials of an experiment go on side by side: one batch of simulations for each
step. Experiments, reconstructions and trials are kept in the folder, and an interrupted benchmark continues.
``--devices cuda:0 cuda:1 --executor processes:4`` shares the experiments out over processes and devices.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import (
    Clock,
    at_least,
    here,
    keep_to_one_protocol,
    output_options,
    parser_of,
    sources,
    stamp,
    write_result,
)
from splatsoil.benchmarks._simulations import FEWEST, density_of
from splatsoil.inverse.bayesopt import BayesianOptimiser
from splatsoil.inverse.executors import executor

from splatsoil.comparison import Comparator
from splatsoil.errors import SimulationError
from splatsoil.files import plain, read_json, write_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS, Preset, Resolution, simulate_together
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.soil.settings import FRICTION_ANGLE
from splatsoil.synthetic import Recipe, make_set, paper

FloatArray = npt.NDArray[np.float64]
Images = Mapping[tuple[str, int], npt.NDArray[np.float32]]

#: Mean absolute error and its standard deviation over ten trials, degrees (Hsiao and Kumar).
PUBLISHED = {25.0: (0.64, 1.01), 30.0: (1.07, 0.71), 35.0: (1.24, 0.96), 45.0: (1.38, 1.36)}
#: What this project aims at for all four, degrees.
TARGET = (0.3, 0.3)
#: Frames that the published loss compares.
FRAMES = (50, 100, 150, 199)
SPACE = ParameterSpace([replace(FRICTION_ANGLE, lower=25.0, upper=55.0)])
#: Ways that spend evaluations of their own.
SEARCHES = ("published", "ours")
WAYS = (*SEARCHES, "features")
#: Seed of the published way's first search: its start is random, and another one than ours.
FIRST_OF_PUBLISHED = 1000


@dataclass(frozen=True)
class Protocol:
    """How the table is made.

    Attributes:
        angles: true friction angles, degrees.
        trials: for each angle.
        worlds: experiments for each angle, which trials take in turn.
        evaluations: in a trial.
        cells: of our model, across the tool.
        published_cells: of the model in the published way.
        truth_cells: of the experiments. With 8.7 a bed of 1 m has 87 cells, which share no factor with 64 and 32.
        views: photographs before anything moves.
        picture_scale: size of the pictures over 1280 x 720.
        device: of everything.
        reconstruction: preset of the reconstruction.
    """

    angles: tuple[float, ...] = tuple(PUBLISHED)
    trials: int = 10
    worlds: int = 1
    evaluations: int = 10
    cells: float = 6.4
    published_cells: float = 3.2
    truth_cells: float = 8.7
    views: int = 40
    picture_scale: float = 1.0
    device: str = "cpu"
    reconstruction: str = "small"

    def preset(self, name: str, cells: float) -> Preset:
        """The paper's preset with another number of cells across the tool."""
        return replace(PRESETS["paper"], name=name, cells_across_tool=cells)

    def kept(self) -> dict[str, Any]:
        """What a folder keeps; trials and angles may grow, nothing else may change."""
        free = ("angles", "trials", "device")
        return {k: v for k, v in vars(self).items() if k not in free} | {"code": sources([Path(__file__)])}


class Sight:
    """One experiment as a model sees it: reconstruction, simulator, and both losses."""

    def __init__(self, measurement: Measurement, reconstruction: Reconstruction, protocol: Protocol) -> None:
        resolution = Resolution.derive(measurement, protocol.preset("model", protocol.cells))
        self.model = Model(measurement, reconstruction, preset="paper", device=protocol.device)
        self.model.resolution = resolution
        coarser = Resolution.derive(measurement, protocol.preset("published", protocol.published_cells))
        # the published loss compares four frames: no others are drawn for it
        self.few = self.model.variant(frames=(0, *FRAMES), resolution=coarser)
        patch = 2.0 * resolution.cell  # what is smaller differs from seed to seed
        surface, frames = reconstruction.surface, self.model.frames
        self.comparator = Comparator(measurement, surface=surface, frames=frames, patch=patch)

    def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[tuple[float, FloatArray] | None]:
        """Loss and block residuals (b,) of each angle and particle seed; None where the simulation failed.

        The simulations run as one batch.
        """
        model = self.few if way == "published" else self.model
        runs = simulate_together(
            model.measurement,
            [model.particles(seed) for _, seed in jobs],
            [{"friction_angle": angle} for angle, _ in jobs],
            model,
        )
        found: list[tuple[float, FloatArray] | None] = []
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


def world(protocol: Protocol, angle: float, number: int, out: Path) -> tuple[Measurement, Reconstruction]:
    """An experiment and its reconstruction, from the folder or made and kept there."""
    folder = out / "worlds" / f"{angle:g}-{number}"
    if not (folder / "truth.json").is_file():
        setup = paper(views=protocol.views)
        make_set(
            folder,
            setup if protocol.picture_scale == 1.0 else setup.resized(protocol.picture_scale),
            Recipe(
                friction_angle=angle,
                preset=protocol.preset("truth", protocol.truth_cells),
                seed=number,
                particle_seed=1_000_003 * (number + 1) + round(10 * angle),
                device=protocol.device,
            ),
        )
    measurement = Measurement.load(folder)
    kept = out / "reconstructions" / folder.name
    if not (kept / "reconstruction.json").is_file():
        reconstruct(measurement, preset=protocol.reconstruction, device=protocol.device).save(kept)
    return measurement, Reconstruction.load(kept)


@dataclass
class Trial:
    """A search going on.

    Attributes:
        number: of the trial, and the seed of its search.
        way: of the search.
        optimiser: that chooses angles.
        calls: angle, and loss and block residuals (b,) or None, of each evaluation.
    """

    number: int
    way: str
    calls: list[tuple[float, tuple[float, FloatArray] | None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.way == "published":
            seed = FIRST_OF_PUBLISHED + self.number
            self.optimiser = BayesianOptimiser(1, seed=seed, start=1, acquisition="best")
        else:
            self.optimiser = BayesianOptimiser(1, seed=self.number)

    def ask(self) -> tuple[float, int]:
        """The angle to try next, degrees, and a seed of its particles."""
        sequence = np.random.SeedSequence([self.number, len(self.calls), WAYS.index(self.way)])
        seed = int(sequence.generate_state(1)[0] % 2**31)
        return float(SPACE.from_unit(self.optimiser.ask()[0].astype(np.float64))[0]), seed

    def tell(self, angle: float, found: tuple[float, FloatArray] | None) -> None:
        """What the angle came to; None: its simulation failed."""
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
    marginal = density.comparison.judge().marginal(SPACE.names[0])
    return {"estimate": marginal.mean, "low": marginal.quantile(0.05), "high": marginal.quantile(0.95)}


def search(sight: Sight, angle: float, numbers: Sequence[int], evaluations: int, out: Path) -> None:
    """Trials of one experiment, step by step, side by side; those that are in the folder are not made again."""
    files = {(n, way): out / "trials" / f"{angle:g}-{n}-{way}.json" for n in numbers for way in SEARCHES}
    trials = [Trial(n, way) for (n, way), file in files.items() if not file.is_file()]
    for _ in range(evaluations):
        for way in SEARCHES:
            mine = [t for t in trials if t.way == way]
            asked = [t.ask() for t in mine]
            for trial, (tried, _), found in zip(mine, asked, sight.evaluate(way, asked) if mine else [], strict=True):
                trial.tell(tried, found)
    for trial in trials:
        write_json(files[trial.number, trial.way], trial.result(sight.comparator.block_noise()))


def one_world(protocol: Protocol, angle: float, number: int, out: Path, say: Clock) -> None:
    """A worker's job: an experiment, its reconstruction, and its trials."""
    sight = Sight(*world(protocol, angle, number, out), protocol)
    say(f"{angle:g}°, experiment {number}: reconstructed")
    search(sight, angle, range(number, protocol.trials, protocol.worlds), protocol.evaluations, out)
    say(f"{angle:g}°, experiment {number}: done")


def run(protocol: Protocol, out: Path, pool: Executor, devices: Sequence[str] = ()) -> dict[str, Any]:
    """All trials, those in the folder already not again; errors of each way at each angle.

    Args:
        protocol: what to do.
        out: folder of experiments, trials and results.
        pool: where experiments are worked on.
        devices: that they take in turn; the protocol's by default.
    """
    keep_to_one_protocol(out, protocol.kept())
    turns = cycle([replace(protocol, device=device) for device in devices] or [protocol])
    jobs = [
        (next(turns), angle, number, out, Clock()) for angle in protocol.angles for number in range(protocol.worlds)
    ]
    for future in [pool.submit(one_world, *job) for job in jobs]:
        future.result()
    return collect(protocol, out)


def collect(protocol: Protocol, out: Path) -> dict[str, Any]:
    """Errors of the trials in the folder."""
    entries = []
    for angle in protocol.angles:
        files = [out / "trials" / f"{angle:g}-{n}-{way}.json" for n in range(protocol.trials) for way in SEARCHES]
        kept = [read_json(file) for file in files]
        for way in WAYS:
            trials = [entry[way] for entry in kept if entry.get(way) is not None]
            if not trials:
                continue
            errors = np.array([t["estimate"] for t in trials]) - angle
            spread = {"std": np.abs(errors).std(ddof=1), "scatter": errors.std(ddof=1)} if len(trials) > 1 else {}
            entry = {"angle": angle, "way": way, "mae": np.abs(errors).mean(), "bias": errors.mean(), **spread}
            entry["width_90"] = np.mean([t["high"] - t["low"] for t in trials])
            entry["coverage_90"] = np.mean([t["low"] <= angle <= t["high"] for t in trials])
            entries.append(plain(entry))
    return {"benchmark": "paper-table", "protocol": vars(protocol), "published": PUBLISHED, "entries": entries}


def table(result: Mapping[str, Any]) -> str:
    """The result as Markdown."""
    p = result["protocol"]
    lines = [
        f"{p['trials']} trials of {p['evaluations']} evaluations, {p['worlds']} experiments an angle, pictures "
        f"{p['picture_scale']:g} of 1280 x 720, {p['views']} views, {p['cells']:g} cells across the tool "
        f"(published: {p['published_cells']:g}, experiments: {p['truth_cells']:g}).",
        "",
        "| true angle | in print | " + " | ".join(WAYS) + " | target |",
        "|---" * (len(WAYS) + 3) + "|",
    ]
    for angle in p["angles"]:
        found = {e["way"]: e for e in result["entries"] if e["angle"] == angle}
        cells = [_error(found[way]) if way in found else "–" for way in WAYS]
        printed = "{:.2f} ± {:.2f}°".format(*PUBLISHED[angle]) if angle in PUBLISHED else "–"
        lines.append(f"| {angle:g}° | {printed} | {' | '.join(cells)} | {TARGET[0]:g} ± {TARGET[1]:g}° |")
    lines += [
        "",
        "| true angle | way | bias | scatter | 90 % interval's width | contains the truth |",
        "|---" * 6 + "|",
    ]
    for e in result["entries"]:
        scatter = f"{e['scatter']:.2f}°" if "scatter" in e else "–"
        lines.append(
            f"| {e['angle']:g}° | {e['way']} | {e['bias']:+.2f}° | {scatter} | {e['width_90']:.2f}° | "
            f"{100.0 * e['coverage_90']:.0f} % |"
        )
    return "\n".join(lines)


def _error(entry: Mapping[str, Any]) -> str:
    """Mean absolute error, and its spread over several trials."""
    return f"{entry['mae']:.2f} ± {entry['std']:.2f}°" if "std" in entry else f"{entry['mae']:.2f}°"


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    usual, parser = Protocol(), parser_of(__doc__)
    parser.add_argument("--devices", nargs="+", type=here, help="several, which experiments take in turn")
    parser.add_argument("--executor", default="serial", help="serial, processes:N or dask:ADDRESS")
    parser.add_argument("--angles", type=float, nargs="+", default=list(usual.angles))
    for name, kind, text in (
        ("trials", at_least(1), "for each angle"),
        ("worlds", at_least(1), "experiments for each angle, which trials take in turn"),
        ("evaluations", at_least(1), "in a trial"),
        ("cells", float, "of our model, across the tool"),
        ("published_cells", float, "in the published way"),
        ("truth_cells", float, "of the experiments"),
        ("views", at_least(1), "photographs before anything moves"),
        ("picture_scale", float, "size of the pictures over 1280 x 720"),
        ("reconstruction", str, "preset of the reconstruction"),
    ):
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=getattr(usual, name), help=text)
    output_options(parser)
    options = parser.parse_args(arguments)
    hush()
    devices = options.devices or [options.device]
    chosen = {name: getattr(options, name) for name in vars(usual)}
    chosen |= {"angles": tuple(options.angles), "worlds": min(options.worlds, options.trials), "device": devices[0]}
    out = options.out or Path("runs/paper-table")
    began = time.time()
    with executor(options.executor) as pool:
        result = run(Protocol(**chosen), out, pool, devices)
    result |= {**stamp(devices[0]), "seconds": time.time() - began}
    write_result(out, result, table(result), {})
    print(json.dumps(result, indent=1) if options.json else table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
