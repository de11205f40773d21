"""Hsiao and Kumar's protocol: worlds that are photographed and reconstructed, and trials that search their angle."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._simulations import FEWEST, density_of
from splatsoil.inverse.bayesopt import BayesianOptimiser, Told

from splatsoil.comparison import Comparator
from splatsoil.errors import SimulationError
from splatsoil.files import write_json, write_npz
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS, Preset, Resolution, simulate_together
from splatsoil.parameters import ParameterSpace
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.soil.settings import FRICTION_ANGLE
from splatsoil.synthetic import make_set, paper

FloatArray = npt.NDArray[np.float64]
Say = Callable[[str], None]
Images = Mapping[tuple[str, int], npt.NDArray[np.float32]]

#: Mean absolute error and its standard deviation over ten trials, degrees (Hsiao and Kumar).
PUBLISHED = {25.0: (0.64, 1.01), 30.0: (1.07, 0.71), 35.0: (1.24, 0.96), 45.0: (1.38, 1.36)}
#: Frames that the published loss looks at.
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
        worlds: observations for each angle, which trials take in turn.
        evaluations: in a trial.
        cells: of our model, across the tool.
        published_cells: of the model in the published way.
        truth_cells: of the worlds. With 8.7 a bed of 1 m has 87 cells, which share no factor with 64 and 32.
        views: photographs before anything moves.
        scale: size of the pictures over 1280 x 720.
        device: of everything.
        reconstruction: preset of the reconstruction.
        scan: seeds and angles of the error budget's landscapes; no seeds, no budget.
    """

    angles: tuple[float, ...] = tuple(PUBLISHED)
    trials: int = 10
    worlds: int = 1
    evaluations: int = 10
    cells: float = 6.4
    published_cells: float = 3.2
    truth_cells: float = 8.7
    views: int = 40
    scale: float = 1.0
    device: str = "cpu"
    reconstruction: str = "small"
    scan: tuple[int, int] = (3, 9)

    def preset(self, name: str, cells: float) -> Preset:
        """The paper's preset with another number of cells across the tool."""
        return replace(PRESETS["paper"], name=name, cells_across_tool=cells)


@dataclass(frozen=True)
class Look:
    """What one predicted picture series came to: both losses, and the block residuals where they were taken."""

    published: float
    ours: float | None = None
    blocks: FloatArray = field(default_factory=lambda: np.zeros(0))

    def loss(self, way: str) -> float:
        """The loss that a search minimises."""
        value = self.published if way == "published" else self.ours
        assert value is not None
        return value


class Sight:
    """One world as a model sees it: reconstruction, simulator, and both losses."""

    def __init__(self, measurement: Measurement, reconstruction: Reconstruction, protocol: Protocol) -> None:
        self.protocol = protocol
        resolution = Resolution.derive(measurement, protocol.preset("model", protocol.cells))
        self.model = Model(measurement, reconstruction, preset="paper", device=protocol.device)
        self.model.resolution = resolution
        coarser = Resolution.derive(measurement, protocol.preset("published", protocol.published_cells))
        # The published loss looks at four frames: no others are drawn for it.
        self.few = self.model.variant(frames=(0, *FRAMES), resolution=coarser)
        # Patches of two cells: what is smaller is chance.
        self.comparator = Comparator(
            measurement, surface=reconstruction.surface, frames=self.model.frames, patch=2.0 * resolution.cell
        )

    def drawn(self, model: Model, jobs: Sequence[tuple[float, int]]) -> Iterator[Images | None]:
        """Pictures for each angle and particle seed; the simulations run as one batch. None where one failed."""
        found = simulate_together(
            model.measurement,
            [model.particles(seed) for _, seed in jobs],
            [{"friction_angle": angle} for angle, _ in jobs],
            model,
        )
        for trajectory, (_, seed) in zip(found, jobs, strict=True):
            yield None if isinstance(trajectory, SimulationError) else model.draw(trajectory, seed)

    def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[Look | None]:
        """What a search needs to know of each angle and particle seed; None where the simulation failed."""
        model = self.few if way == "published" else self.model
        with threads(self.protocol.device) as pool:
            waiting: list[Future[Look] | None] = [
                None if images is None else pool.submit(look, self.comparator, images, way == "ours")
                for images in self.drawn(model, jobs)
            ]
            return [None if future is None else future.result() for future in waiting]


def look(comparator: Comparator, images: Images, whole: bool) -> Look:
    """Compare predicted pictures; the robust loss and the features only where the whole is asked for."""
    keys = [(c, f) for c, f in comparator.keys if f in FRAMES]
    published = float(np.mean([np.mean(np.square(comparator.observed[k] - images[k])) for k in keys]))
    if not whole:
        return Look(published)
    found = comparator.compare(images)
    return Look(published, found.loss, found.blocks)


@contextmanager
def threads(device: str) -> Iterator[ThreadPoolExecutor]:
    """Comparisons beside a GPU at work take several cores; on a CPU the simulator has them all."""
    with ThreadPoolExecutor(1 if device == "cpu" else min(8, os.cpu_count() or 1)) as pool:
        yield pool


def world(protocol: Protocol, angle: float, number: int, out: Path, say: Say) -> tuple[Measurement, Reconstruction]:
    """An observation and its reconstruction, from the folder or made and kept there."""
    folder = out / "worlds" / f"{angle:g}-{number}"
    if not (folder / "truth.json").is_file():
        say(f"{angle:g}°, world {number}: simulating and photographing")
        setup = paper(views=protocol.views)
        make_set(
            folder,
            setup if protocol.scale == 1.0 else setup.resized(protocol.scale),
            friction_angle=angle,
            preset=protocol.preset("truth", protocol.truth_cells),
            seed=number,
            particle_seed=1_000_003 * (number + 1) + round(10 * angle),
            device=protocol.device,
        )
    measurement = Measurement.load(folder)
    kept = out / "reconstructions" / folder.name
    if not (kept / "reconstruction.json").is_file():
        say(f"{angle:g}°, world {number}: reconstructing")
        reconstruct(measurement, preset=protocol.reconstruction, device=protocol.device).save(kept)
    return measurement, Reconstruction.load(kept)


@dataclass
class Trial:
    """A search going on: what was asked so far, and what came of it."""

    number: int
    way: str
    angles: list[float] = field(default_factory=list)
    looks: list[Look | None] = field(default_factory=list)

    @property
    def told(self) -> list[Told]:
        """What an optimiser is told."""
        points = SPACE.to_unit(np.array(self.angles)[:, None]) if self.angles else np.zeros((0, 1))
        return [Told(p, None if k is None else k.loss(self.way)) for p, k in zip(points, self.looks, strict=True)]

    def seed(self, step: int) -> int:
        """Of the particles in a step."""
        sequence = np.random.SeedSequence([self.number, step, WAYS.index(self.way)])
        return int(sequence.generate_state(1)[0] % 2**31)


def optimiser_of(way: str, seed: int, told: Sequence[Told]) -> BayesianOptimiser:
    """The search of a way, with what it has been told."""
    if way == "published":
        optimiser = BayesianOptimiser(1, seed=FIRST_OF_PUBLISHED + seed, start=1, acquisition="best")
    else:
        optimiser = BayesianOptimiser(1, seed=seed)
    for t in told:
        optimiser.tell(t.action, t.loss)
    return optimiser


def propose(way: str, seed: int, told: Sequence[Told]) -> float:
    """The angle to try next."""
    return float(SPACE.from_unit(optimiser_of(way, seed, told).ask()[0].astype(np.float64))[0])


def conclude(way: str, seed: int, told: Sequence[Told]) -> dict[str, float]:
    """What a search came to."""
    found = optimiser_of(way, seed, told).result()
    best = min(told, key=lambda t: np.inf if t.loss is None else t.loss).action
    estimate, luckiest = (SPACE.from_unit(p) for p in (found.estimate, best))
    std, low, high = found.interval(SPACE.from_unit)
    numbers = {"estimate": estimate, "std": std, "low": low, "high": high, "best": luckiest}
    return {name: float(value[0]) for name, value in numbers.items()}


def by_features(
    space: ParameterSpace, angles: FloatArray, blocks: FloatArray, sensor: float, seed: int
) -> dict[str, float] | None:
    """The posterior that features allow, None where they are too few or nothing is seen."""
    seen = np.all(blocks != 0.0, axis=0) if len(blocks) else np.zeros(0, dtype=bool)
    if len(blocks) < FEWEST or not seen.any():
        return None
    points, residuals = space.to_unit(angles[:, None]), blocks[:, seen]
    density = density_of(space, points, -residuals, np.zeros(residuals.shape[1]), sensor, seed)
    marginal = density.comparison.judge().marginal(space.names[0])
    low, high = marginal.quantile(0.05), marginal.quantile(0.95)
    return {"estimate": marginal.mean, "std": marginal.std, "low": low, "high": high}


def play(sight: Sight, trials: Sequence[Trial], folder: Path, say: Say) -> None:
    """Let all trials of a world take their evaluations step by step, side by side; each evaluation is kept in the
    folder, and not made again."""
    count = sight.protocol.evaluations
    for step in range(count):
        angles = [(t, propose(t.way, t.number, t.told)) for t in trials]
        for way in SEARCHES:
            mine = [(t, angle) for t, angle in angles if t.way == way]
            files = [folder / f"{t.number}-{way}-{step}.npz" for t, _ in mine]
            kept = [load_look(file, angle) for file, (_, angle) in zip(files, mine, strict=True)]
            new = [k for k, known in enumerate(kept) if known is None]
            made = sight.evaluate(way, [(mine[k][1], mine[k][0].seed(step)) for k in new]) if new else []
            for k, found in zip(new, made, strict=True):
                save_look(files[k], mine[k][1], found)
                kept[k] = (found,)
            for (trial, angle), known in zip(mine, kept, strict=True):
                assert known is not None
                trial.angles.append(angle)
                trial.looks.append(known[0])
        say(f"evaluation {step + 1} of {count} of {len(trials)} searches")


def search(sight: Sight, angle: float, numbers: Sequence[int], out: Path, where: str, say: Say) -> None:
    """Trials of one world that the folder doesn't have yet."""
    trials = [
        Trial(n, way)
        for n in numbers
        for way in SEARCHES
        if not (out / "trials" / f"{angle:g}-{n}-{way}.json").is_file()
    ]
    if not trials:
        return
    began = time.perf_counter()
    play(sight, trials, out / "evaluations" / where, say)
    sensor = sight.comparator.block_noise()
    for t in trials:
        good = [(a, k) for a, k in zip(t.angles, t.looks, strict=True) if k is not None]
        calls = [
            {"angle": a, **({} if k is None else {"published": k.published, "ours": k.ours})}
            for a, k in zip(t.angles, t.looks, strict=True)
        ]
        result: dict[str, Any] = {t.way: conclude(t.way, t.number, t.told) if good else None, "calls": calls}
        if t.way == "ours":
            angles, blocks = np.array([a for a, _ in good]), np.array([k.blocks for _, k in good])
            result["features"] = by_features(SPACE, angles, blocks, sensor, t.number)
        result["seconds"] = (time.perf_counter() - began) / len(trials)
        write_json(out / "trials" / f"{angle:g}-{t.number}-{t.way}.json", result)
    say(f"{angle:g}°: {len(trials)} searches in {time.perf_counter() - began:.0f} s")


def save_look(file: Path, angle: float, found: Look | None) -> None:
    """Keep an evaluation; a failed one, too."""
    told = {} if found is None else {"published": found.published, "blocks": found.blocks}
    if found is not None and found.ours is not None:
        told["ours"] = found.ours
    write_npz(file, angle=angle, **told)


def load_look(file: Path, angle: float) -> tuple[Look | None] | None:
    """A kept evaluation at this angle (None in it: it failed), or None."""
    if not file.is_file():
        return None
    with np.load(file, allow_pickle=False) as data:
        if abs(float(data["angle"]) - angle) > 1e-6:
            return None
        if "published" not in data:
            return (None,)
        ours = float(data["ours"]) if "ours" in data else None
        return (Look(float(data["published"]), ours, data["blocks"]),)
