"""Hidden effects in the solver's own soil: how often is the right one named, with real simulations and pictures?

``python -m splatsoil.benchmarks.hidden_soil SET`` takes bed, tool, motion and cameras of a measurement set. Each truth
is one more simulation with its own particles, effect and angle, drawn and averaged into features like any prediction,
with the cameras' noise on top. Its analysis is a whole diagnosis. Truths are drawn by a stream of random numbers of
their own and opened only to score. World and analysis share solver and renderer: this measures the statistics and the
confusion of effects, not what another simulator or a real camera would do (docs/hidden-effects.md). What was judged is
kept in the folder, and a second call goes on from there.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import keep_to_one_protocol, sources, stamp
from splatsoil.benchmarks._tally import Found, Tally, entry, table, tally
from splatsoil.inverse.criticism.diagnosis import Diagnosis, diagnose
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.executors import executor, in_order

from splatsoil.experiment.base import Candidate
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.experiment.states import States
from splatsoil.experiment.strokes import Predict
from splatsoil.files import plain, read_json, write_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction, reconstruct

FloatArray = npt.NDArray[np.float64]

EFFECTS = ("cohesion", "dilatancy", "tool_friction", "rate_dependence", "softening", "tilt", "exposure", "light")
ANGLES = (30.0, 40.0)
"""Range of the true friction angle, degrees."""
FITTED = np.linspace(25.0, 50.0, 8)
"""Angles that fits simulate, degrees."""
FIRST_SEED = 1000
"""Of the truths' particles; the analysis uses seeds below."""
FRICTION = "friction_angle"


class Hidden:
    """An experiment whose observation is another one's, so that nothing else of the truth can reach the analysis."""

    def __init__(self, experiment: PlowExperiment, observed: FloatArray) -> None:
        self._experiment, self.observed = experiment, observed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._experiment, name)

    def states(self, values: Mapping[str, float]) -> States:
        """See :class:`~splatsoil.experiment.states.Strained`."""
        return self._experiment.states(values)

    def strokes(self) -> Mapping[str, Predict]:
        """See :class:`~splatsoil.experiment.strokes.Stroked`."""
        return self._experiment.strokes()


@dataclass(frozen=True)
class Kind:
    """What is hidden.

    Attributes:
        name: of the row.
        times: size of each effect, in smallest detectable ones.
        effects: how many at once.
        among: from which they are drawn.
        dropped: whether they are taken out of the analysis's library.
    """

    name: str
    times: float = 0.0
    effects: int = 0
    among: Literal["physics", "observation"] = "physics"
    dropped: bool = False


NOTHING = Kind("nothing")


def kinds_of(strengths: Sequence[float]) -> list[Kind]:
    """All rows: nothing, single effects in several strengths, reported ones, pairs, and truths out of the library."""
    single = [Kind(f"one effect, {times:g} × smallest detectable", times, 1) for times in strengths]
    return [
        NOTHING,
        *single,
        Kind("observation only, 3 ×", 3.0, 1, "observation"),
        Kind("two effects, 3 × each", 3.0, 2),
        Kind("control: the truth taken out of the library, 4 ×", 4.0, 1, dropped=True),
    ]


@dataclass(frozen=True)
class Truth:
    """One experiment's: the friction angle in degrees, the effects' sizes in their units, and a seed of its particles
    and noise."""

    angle: float
    sizes: Mapping[str, float]
    seed: int


def draw(kind: Kind, number: int, seed: int, candidates: Sequence[Candidate], least: Mapping[str, float]) -> Truth:
    """A sealed truth; ``least`` are the effects' smallest detectable sizes. An effect whose bounds don't reach the size
    asked for isn't drawn."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.name.encode()), number])
    angle = float(rng.uniform(*ANGLES))
    possible: dict[str, list[float]] = {}
    for candidate in candidates:
        measure = candidate.measure
        if candidate.kind == kind.among and candidate.name in least:
            far = [
                float(measure.off or 0.0) + side * kind.times * least[candidate.name]
                for side in ([measure.sign] if measure.sign else [-1, 1])
            ]
            if inside := [value for value in far if measure.lower <= value <= measure.upper]:
                possible[candidate.name] = inside
    chosen: Iterable[str] = (
        rng.choice(sorted(possible), min(kind.effects, len(possible)), replace=False) if possible else []
    )
    sizes = {str(name): float(rng.choice(possible[str(name)])) for name in chosen}
    return Truth(angle, sizes, int(rng.integers(FIRST_SEED, 2**20)))


@dataclass(frozen=True)
class Place:
    """Where truths are hidden, and by what they are judged.

    Attributes:
        folder: of the measurement set.
        preset: resolution of truths and analysis.
        device: where to compute.
        effects: the library that the analysis has.
        keep: folder for what is finished.
    """

    folder: Path
    preset: str
    device: str
    effects: tuple[str, ...]
    keep: Path


class Bed:
    """A place made ready; its reconstruction is kept in the folder."""

    def __init__(self, place: Place) -> None:
        measurement = Measurement.load(place.folder)
        kept = place.keep / f"reconstruction-{measurement.hash[:16]}"
        if kept.is_dir():
            reconstruction = Reconstruction.load(kept)
        else:
            reconstruction = reconstruct(measurement, preset=place.preset, device=place.device)
            reconstruction.save(kept)
        self.place = place
        self.model = Model(measurement, reconstruction, preset=place.preset, device=place.device)
        device = place.device.split(":")[0]
        self.identity = {"set": measurement.hash, "preset": place.preset, "device": device, "code": sources()}
        self.whole = PlowExperiment(self.model, [FRICTION], candidates=place.effects)

    def observed(self, truth: Truth) -> FloatArray:
        """(t, s) what the cameras would report."""
        names = {c.name: c.measure.name for c in self.whole.candidates}
        values = {FRICTION: truth.angle, **{names[name]: size for name, size in truth.sizes.items()}}
        told = Simulations(self.whole)(values, effects=tuple(truth.sizes), seed=truth.seed)
        noise = np.random.default_rng([truth.seed, 1]).standard_normal(told.shape) * self.whole.sensor
        return np.where(self.whole.seen, told + noise, 0.0)

    def diagnosed(self, observed: FloatArray, without: Sequence[str] = ()) -> Diagnosis:
        """A diagnosis from nothing but the observation; ``without`` takes effects out of the library."""
        library = [name for name in self.place.effects if name not in without]
        experiment: Any = Hidden(PlowExperiment(self.model, [FRICTION], candidates=library), observed)
        simulate = Simulations(experiment, self.place.keep / "features", self.identity)
        return diagnose(experiment, {FRICTION: fitted(experiment, simulate)}, simulate=simulate)


def fitted(experiment: PlowExperiment, simulate: Simulations) -> float:
    """Where a fit to images would end: least squares over the friction angle, in units of the cameras' noise, features
    as parabolas through simulations that all analyses share."""
    seen, sensor = experiment.seen, experiment.sensor[experiment.seen]
    tables = np.stack([simulate({FRICTION: angle})[seen] / sensor for angle in FITTED])
    fine = np.linspace(FITTED[0], FITTED[-1], 251)
    curves = np.vander(fine, 3) @ np.linalg.lstsq(np.vander(FITTED, 3), tables, rcond=None)[0]
    left = np.sum((experiment.observed[seen] / sensor - curves) ** 2, axis=1)
    return float(fine[np.argmin(left)])


@lru_cache(maxsize=1)
def _bed(place: Place) -> Bed:
    hush()
    return Bed(place)


def detectable(place: Place) -> dict[str, float]:
    """Smallest detectable size of each effect, from a diagnosis of soil at 35° with nothing hidden."""
    file = place.keep / "detectable.json"
    if not file.is_file():
        bed = _bed(place)
        found = bed.diagnosed(bed.observed(Truth(35.0, {}, FIRST_SEED)))
        write_json(file, {n: s.detectable for n, s in found.scores.items() if np.isfinite(s.detectable)})
    return {str(name): float(size) for name, size in read_json(file).items()}


def judge(place: Place, kind: Kind, number: int, seed: int, least: Mapping[str, float]) -> tuple[Truth, Found]:
    """Hide a truth, diagnose what is seen of it, and keep what was found."""
    file = place.keep / "judged" / f"{zlib.crc32(kind.name.encode()):08x}-{number}.json"
    if file.is_file():
        kept = read_json(file)
        return Truth(**kept["truth"]), Found.from_json(kept["found"])
    bed = _bed(place)
    truth = draw(kind, number, seed, bed.whole.candidates, least)
    found = Found.of(bed.diagnosed(bed.observed(truth), tuple(truth.sizes) if kind.dropped else ()), FRICTION)
    write_json(file, plain({"kind": kind.name, "truth": asdict(truth), "found": asdict(found)}))
    return truth, found


def count_up(kind: Kind, judged: Sequence[tuple[Truth, Found]], candidates: Sequence[Candidate]) -> Tally:
    """A row. Truths of which the analysis knows nothing count as none."""
    return tally(
        kind.name,
        [{} if kind.dropped else truth.sizes for truth, _ in judged],
        [found for _, found in judged],
        [truth.angle for truth, _ in judged],
        {c.name: c.kind for c in candidates},
        FRICTION,
        {c.name: c.measure.name for c in candidates},
    )


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("--preset", default="tiny")
    parser.add_argument(
        "--count", type=int, default=4, help="experiments of each kind; three times as many without anything"
    )
    parser.add_argument("--strengths", type=float, nargs="*", default=[1.0, 2.0, 4.0], help="in smallest detectable")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), help="the library that the analysis has")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--executor", default="serial", help="serial, or processes:N")
    parser.add_argument("--out", type=Path, default=Path("runs/hidden-soil"), help="folder for what is finished")
    options = parser.parse_args(arguments)
    began = time.perf_counter()
    own = [Path(__file__), Path(__file__).with_name("hidden_effects.py")]
    decides = {"seed": options.seed, "preset": options.preset, "effects": options.effects, "code": sources(own)}
    place = Place(options.set.resolve(), options.preset, options.device, tuple(options.effects), options.out.resolve())
    keep_to_one_protocol(place.keep, {**decides, "set": Measurement.load(place.folder).hash})
    candidates = _bed(place).whole.candidates
    with executor(options.executor) as pool:
        least = detectable(place)
        jobs = [
            (kind, number)
            for kind in kinds_of(options.strengths)
            for number in range((3 if kind == NOTHING else 1) * options.count)
        ]
        rows: dict[Kind, list[tuple[Truth, Found]]] = {}
        told = in_order(pool, judge, [(place, kind, number, options.seed, least) for kind, number in jobs])
        for (kind, number), (truth, found) in zip(jobs, told, strict=True):
            rows.setdefault(kind, []).append((truth, found))
            hidden = ", ".join(f"{n} {v:.3g}" for n, v in truth.sizes.items()) or "nothing"
            print(
                f"{time.perf_counter() - began:6.0f} s  {kind.name}, {number + 1}: {hidden}; "
                f"{found.verdict} {', '.join(found.members)}",
                file=sys.stderr,
                flush=True,
            )
    result = {
        "rows": [entry(count_up(kind, judged, candidates)) for kind, judged in rows.items()],
        "smallest detectable": least,
    }
    write_json(place.keep / "result.json", plain({"made_by": stamp(options.device), **decides, **result}))
    print(table(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
