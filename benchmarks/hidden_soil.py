"""Hidden effects in the solver's own soil: how often is the right one named, with real simulations and pictures?

``python -m splatsoil.benchmarks.hidden_soil SET`` takes bed, tool, motion and cameras of a measurement set. Each truth
is one more simulation with its own particles, effect and angle, drawn and averaged into features like any prediction,
with the cameras' noise on top. Its analysis is a whole diagnosis. Truths are drawn by a stream of random numbers of
their own and opened only to score. World and analysis share solver and renderer: this measures the statistics and the
confusion of effects, not what another simulator or a real camera would do (docs/hidden-effects.md).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import stamp
from splatsoil.benchmarks.hidden_effects import Tally, entry, table, tally
from splatsoil.inverse.criticism.diagnosis import Diagnosis, Options, diagnose
from splatsoil.inverse.criticism.refit import optimum
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.plow import PlowExperiment
from splatsoil.experiment.states import States
from splatsoil.experiment.strokes import Predict
from splatsoil.files import plain, write_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import Reconstruction, reconstruct

FloatArray = npt.NDArray[np.float64]

EFFECTS = ("cohesion", "dilatancy", "tool_friction", "rate_dependence", "softening", "tilt", "exposure", "light")
ANGLES = (30.0, 40.0)
"""Range of the true friction angle, degrees."""
FIRST_SEED = 1000
"""Of the truths' particles; the analysis uses seeds below."""


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


class Bed:
    """A measurement set as a place for hidden truths.

    Args:
        folder: of the set.
        preset: resolution of truths and analysis.
        device: where to compute.
        effects: the library that the analysis has.
        keep: folder for finished simulations and the reconstruction, which a second run then doesn't make again.
    """

    def __init__(self, folder: Path, preset: str, device: str, effects: Sequence[str], keep: Path) -> None:
        measurement = Measurement.load(folder)
        place = keep / f"reconstruction-{measurement.hash[:16]}"
        if place.is_dir():
            reconstruction = Reconstruction.load(place)
        else:
            reconstruction = reconstruct(measurement, preset=preset, device=device)
            reconstruction.save(place)
        self.model = Model(measurement, reconstruction, preset=preset, device=device)
        self.effects, self.keep = tuple(effects), keep
        self.identity = {"set": measurement.hash, "preset": preset, "device": device.split(":")[0]}
        self.whole = PlowExperiment(self.model, ["friction_angle"], candidates=self.effects)

    def observed(self, truth: dict[str, float], effects: Sequence[str], seed: int) -> FloatArray:
        """(t, s) what the cameras would report of a truth."""
        simulate = Simulations(self.whole, self.keep / "features", self.identity)
        told = simulate(truth, effects=tuple(effects), seed=FIRST_SEED + seed)
        noise = np.random.default_rng([seed, 1]).standard_normal(told.shape) * self.whole.sensor
        return np.where(self.whole.seen, told + noise, 0.0)

    def diagnosed(self, observed: FloatArray, without: Sequence[str] = ()) -> Diagnosis:
        """A diagnosis from nothing but the observation; ``without`` takes effects out of the library."""
        library = [name for name in self.effects if name not in without]
        experiment: Any = Hidden(PlowExperiment(self.model, ["friction_angle"], candidates=library), observed)
        simulate = Simulations(experiment, self.keep / "features", self.identity)
        values = optimum(experiment, simulate, {"friction_angle": 35.0}, most=4)
        return diagnose(experiment, values, simulate=simulate, options=Options())


def run(bed: Bed, count: int, *, seed: int, strengths: Sequence[float], keep: Path | None = None) -> dict[str, Any]:
    """Nothing, single effects at several strengths, and truths taken out of the library; ``count`` of each."""
    began = time.perf_counter()
    rows: list[Tally] = []
    kinds = {c.name: c.kind for c in bed.whole.candidates}
    sizes = {c.name: c for c in bed.whole.candidates}
    physics = [name for name, kind in kinds.items() if kind == "physics"]
    null = bed.diagnosed(bed.observed({"friction_angle": 35.0}, (), 0))
    least = {name: score.detectable for name, score in null.scores.items() if np.isfinite(score.detectable)}

    def series(name: str, times: float, *, drop: bool = False) -> None:
        truths: list[dict[str, float]] = []
        found, angles = [], []
        for k in range(count):
            number = 100 * (len(rows) + 1) + k
            sealed = np.random.default_rng([seed, number, 2])
            truth = {"friction_angle": float(sealed.uniform(*ANGLES))}
            effects: tuple[str, ...] = ()
            hidden: dict[str, float] = {}
            if times:
                effects = (str(sealed.choice([n for n in physics if n in least])),)
                measure = sizes[effects[0]].measure
                off = float(measure.off or 0.0)
                side = measure.sign or int(sealed.choice([-1, 1]))
                value = float(np.clip(off + side * times * least[effects[0]], measure.lower, measure.upper))
                hidden = {effects[0]: value}
                truth[measure.name] = value
            found.append(bed.diagnosed(bed.observed(truth, effects, 1000 * seed + number), effects if drop else ()))
            truths.append({} if drop else hidden)
            angles.append(truth["friction_angle"])
            print(f"{name}: {k + 1} of {count}, {found[-1].verdict} {found[-1].members}", file=sys.stderr, flush=True)
        rows.append(tally(name, truths, found, angles, kinds, "friction_angle", {n: c.size for n, c in sizes.items()}))
        if keep is not None:
            write_json(keep, result())

    def result() -> dict[str, Any]:
        return plain(
            {
                "made_by": stamp(bed.model.device),
                "preset": bed.model.preset,
                "count": count,
                "seed": seed,
                "smallest detectable": least,
                "seconds": time.perf_counter() - began,
                "rows": [entry(row) for row in rows],
            }
        )

    series("nothing", 0.0)
    for times in strengths:
        series(f"one effect, {times:g} × smallest detectable", times)
    series("control: the truth taken out of the library, 4 ×", 4.0, drop=True)
    return result()


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--count", type=int, default=4, help="experiments of each kind")
    parser.add_argument("--strengths", type=float, nargs="*", default=[2.0, 4.0], help="in smallest detectable sizes")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), help="the library that the analysis has")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--keep", type=Path, default=Path("hidden-soil"), help="folder for finished simulations")
    parser.add_argument("--json", type=Path, metavar="FILE", help="result, written after every kind")
    options = parser.parse_args(arguments)
    bed = Bed(options.set, options.preset, options.device, options.effects, options.keep)
    print(table(run(bed, options.count, seed=options.seed, strengths=options.strengths, keep=options.json)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
