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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import at_least, here, keep_to_one_protocol, sources, stamp
from splatsoil.benchmarks._hidden import (
    FIRST_SEED,
    NOTHING,
    Kind,
    Truth,
    count_up,
    draw,
    hidden_and_named,
    judge_all,
    kept,
)
from splatsoil.benchmarks._tally import Found, confusion, entry, table
from splatsoil.inverse.criticism.diagnosis import Diagnosis, diagnose
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.executors import executor

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

    def make() -> tuple[Truth, Found]:
        bed = _bed(place)
        truth = draw(kind, number, seed, bed.whole.candidates, least, ANGLES)
        without = tuple(truth.sizes) if kind.dropped else ()
        return truth, Found.of(bed.diagnosed(bed.observed(truth), without), FRICTION)

    return kept(place.keep, kind, number, make)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("--preset", default="tiny")
    parser.add_argument(
        "--count", type=at_least(1), default=4, help="experiments of each kind; three times as many without anything"
    )
    parser.add_argument("--strengths", type=float, nargs="*", default=[1.0, 2.0, 4.0], help="in smallest detectable")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), help="the library that the analysis has")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--executor", default="serial", help="serial, or processes:N")
    parser.add_argument("--out", type=Path, default=Path("runs/hidden-soil"), help="folder for what is finished")
    options = parser.parse_args(arguments)
    own = [Path(__file__).with_name(f"{name}.py") for name in ("hidden_soil", "_hidden", "_tally")]
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
        rows = judge_all(pool, judge, jobs, lambda kind, number: (place, kind, number, options.seed, least))
    result = {
        "rows": [entry(count_up(kind, judged, candidates, FRICTION)) for kind, judged in rows.items()],
        "smallest detectable": least,
    }
    write_json(place.keep / "result.json", plain({"made_by": stamp(options.device), **decides, **result}))
    print(table(result), confusion(hidden_and_named(rows)), sep="\n\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
