"""How much of each effect do the data hold? Standard deviations of it that are left, from the soil to the comparison.

``splatsoil benchmark information --page docs/information.md`` makes a set of known soil with our own solver, and holds
what each effect changes against the noise in four representations: (a) true heights and the force on the tool; (b) the
comparison's features of particles that fill the true surface, drawn by us; (c) the same from the reconstructed surface;
(d) those once the angle is refitted and all of the comparison's noise counts. Simulations are kept in the folder, and a
second call goes on from there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import at_least, here, keep_to_one_protocol, sources, stamp, write_result
from splatsoil.benchmarks._speed.page import replaced
from splatsoil.benchmarks.numerics import CELL, Truth
from splatsoil.inverse.criticism.design import Prior, Run
from splatsoil.inverse.criticism.diagnosis import BASE, FINE, PAIRS, STEP
from splatsoil.inverse.criticism.noise import Noise, Tables, noise_of, trend_of
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import RunError
from splatsoil.experiment import Candidate, Layout, Site
from splatsoil.experiment.plow import MOST_ROWS, PlowExperiment
from splatsoil.experiment.scene_parts import bins_of
from splatsoil.files import write_text
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS
from splatsoil.parameters import Parameter
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.soil.library import library
from splatsoil.synthetic import make_set, plow

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

ANGLE, WORLD = 35.0, 1
"""Of the soil, degrees, and the seed of its surface, its looks and the cameras' noise."""
TRUTH = {"friction_angle": ANGLE}
HEIGHT = "height"
COMPUTED = (
    f"Each effect is on at {STEP:g} times its smallest meaningful size; σ is the Mahalanobis length of what it changes "
    "along the modes of all simulations, by products of different particle seeds, in which chance cancels. In (a) to "
    "(c) the noise is chance of particles and instruments; true heights have none of these. In (d) it is the "
    "comparison's own, with guesses, observation and numerics, and what a change of the angle does is left out."
)


class TrueSoil(PlowExperiment):
    """Pictures of soil whose surface is known, and before them its true heights.

    Heights are changes since the first frame in mm, on a grid of `CELL`, averaged over the same frames as pictures.
    """

    @cached_property
    def layout(self) -> Layout:
        """Labels of heights and features."""
        seen, bed = super().layout, self.base.measurement.bed
        x, y = (bed.lower[k] + CELL * (np.arange(round(bed.extents[k] / CELL)) + 0.5) for k in (0, 1))
        sites = tuple(Site(HEIGHT, float(u), float(v), "mm") for v in y for u in x)
        regions = np.concatenate([np.full((len(seen.times), len(sites)), HEIGHT), seen.regions], axis=1)
        return replace(seen, sites=sites + seen.sites, regions=regions)

    @property
    def heights(self) -> BoolArray:
        """(s,) columns that are heights."""
        return np.array([site.channel == HEIGHT for site in self.layout.sites])

    @cached_property
    def observed(self) -> FloatArray:
        """(t, s): of heights 0, as nobody has seen them."""
        return self._after(0.0, super().observed)

    @cached_property
    def seen(self) -> BoolArray:
        """(t, s): heights are known everywhere."""
        return self._after(1.0, super().seen).astype(bool)

    @cached_property
    def sensor(self) -> FloatArray:
        """(t, s): heights are known exactly."""
        return self._after(0.0, super().sensor)

    def predict(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, s) true heights, and what would be seen."""
        prediction = self.prediction(values, effects=effects, seed=seed, numerics=numerics)
        run, measurement, frames = prediction.trajectory, self.base.measurement, self.comparator.frames
        truth = Truth(measurement, {}, run.spacing**3, dict(values), ())
        first, *later = (1e3 * truth.heights(run.at(f)[0], truth.volume) for f in (self.comparator.reference, *frames))
        rows = [np.mean([later[i] - first for i in group], axis=0) for group in bins_of(measurement, frames, MOST_ROWS)]
        return np.concatenate([np.reshape(rows, (len(rows), -1)), self.features(prediction)], axis=1)

    def _after(self, height: float, features: npt.NDArray[Any]) -> FloatArray:
        return np.concatenate([np.full((len(features), int(self.heights.sum())), height), features], axis=1)


def sigmas(changes: FloatArray, covariance: FloatArray, free: FloatArray | None = None) -> float:
    """Mahalanobis length of a change: how many standard deviations of the noise it is.

    Its square is the mean product of different rows (a U-statistic: Hoeffding 1948, Ann. Math. Stat. 19:293), whose own
    chance cancels. Where that is negative, 0 is returned: chance hides the change.

    Args:
        changes: (k, p) the same change, each with chance of its own; a single one has none.
        covariance: (p, p) of the noise.
        free: (p,) what an unknown parameter changes; only what is orthogonal to it, under the noise, counts.
    """
    precision = np.linalg.inv(covariance + 1e-9 * np.eye(len(covariance)))
    if free is not None:
        along = precision @ free
        precision = precision - np.outer(along, along) / (free @ along)
    products, k = changes @ precision @ changes.T, len(changes)
    square = products.sum() if k == 1 else (products.sum() - np.trace(products)) / (k * (k - 1))
    return float(np.sqrt(max(square, 0.0)))


def size_of(p: Parameter) -> tuple[float, float]:
    """The value at which an effect's parameter is on, upwards where it has two sides, and its size over the smallest
    meaningful one: `STEP`, or what its bounds leave."""
    assert p.off is not None  # of a candidate's parameters
    value = float(np.clip(p.off + (p.sign or 1) * STEP * p.meaningful, p.lower, p.upper))
    return value, (value - p.off) / p.meaningful


def simulated(
    experiment: PlowExperiment, ask: Simulations, prior: Prior, effects: Sequence[Candidate], seeds: int, whole: bool
) -> Tables:
    """Simulations: with each effect, and of the model as it is with the same seeds and over its prior.

    Observation effects are drawn as changes by their smallest meaningful size; with ``whole`` all of them are, as are
    guesses, and pairs of coarse and fine runs are there.
    """

    def told(run: Run) -> str:
        return f"{type(experiment).__name__}: {', '.join(run.effects) or run.numerics or 'as it is'}, seed {run.seed}"

    def made(runs: Sequence[Run]) -> tuple[Sequence[Run], FloatArray]:
        tables = [ask(r.values, effects=r.effects, seed=r.seed, numerics=r.numerics, purpose=told(r)) for r in runs]
        return runs, np.array(tables).reshape(len(runs), *experiment.layout.shape)

    def spread(count: int, first: int, numerics: str = "") -> list[Run]:
        points = (2.0 * (np.arange(count) + 0.5) / max(count, 1) - 1.0)[:, None]
        return [Run(v, seed=first + i, numerics=numerics) for i, v in enumerate(prior.values(points))]

    drawn = {}
    # What needs more frames of the simulation comes first, so that one serves all.
    for c in sorted(experiment.candidates if whole else effects, key=lambda c: c.name != "time_offset"):
        for p in c.parameters if c.kind == "observation" else ():
            value, times = size_of(p)
            drawn[p.name] = made([Run({**TRUTH, p.name: value}, (c.name,))])[1][0], times
    reference = made([Run(TRUTH)])[1][0]
    drawings = {name: reference + (table - reference) / times for name, (table, times) in drawn.items()}
    for name in (*experiment.guesses, *experiment.redrawn) if whole else ():
        drawings[name] = made([Run(TRUTH, numerics=name)])[1][0]
    base = made([*(Run(TRUTH, seed=s) for s in range(seeds)), *spread(BASE, 101)])
    fine = made(spread(PAIRS if whole else 0, 201, FINE))
    values = {c.name: {**TRUTH, c.size: size_of(c.measure)[0]} for c in effects if c.kind == "physics"}
    with_effect = {name: made([Run(v, (name,), s) for s in range(seeds)]) for name, v in values.items()}
    return Tables(base, fine, with_effect, drawings, reference)


def changes_of(candidate: Candidate, noise: Noise, tables: Tables) -> FloatArray:
    """(k, p) what an effect changes, seed by seed; one row for an effect of observation, which has no chance."""
    if candidate.kind == "observation":
        off, on = noise.scores(np.stack([tables.reference, tables.drawn[candidate.size]]))
        return np.asarray(size_of(candidate.measure)[1] * (on - off)[None])
    found = noise.scores(tables.effects[candidate.name][1])
    return np.asarray(found - noise.base[: len(found)])


def left(
    true: tuple[TrueSoil, Tables], seen: tuple[PlowExperiment, Tables], prior: Prior, effects: Iterable[Candidate]
) -> list[dict[str, Any]]:
    """One row for each effect: its size, the sigmas that are left after each step, and what each step divides by."""

    def bare(experiment: PlowExperiment, tables: Tables, aside: BoolArray) -> tuple[Noise, Tables]:
        everywhere = np.broadcast_to(aside, experiment.layout.shape)
        return noise_of(experiment, prior, replace(tables, drawn={}), (), everywhere), tables

    heights, placed = true[0].heights, true[0].layout.placed
    views = {"soil": bare(*true, placed & ~heights), "drawn": bare(*true, heights)}
    views["reconstructed"] = bare(*seen, np.array(False))
    whole = noise_of(seen[0], prior, seen[1], seen[0].candidates)
    at = prior.space.to_unit(prior.space.to_vector(TRUTH))[None]
    free = ((trend_of(at + 0.01, whole.points) - trend_of(at - 0.01, whole.points)) @ whole.base)[0]
    after = (views["reconstructed"][0].fixed, whole.fixed, whole.covariance(1.0))
    rows = []
    for c in effects:
        found = {name: sigmas(changes_of(c, noise, tables), noise.fixed) for name, (noise, tables) in views.items()}
        refitted = (sigmas(changes_of(c, whole, seen[1]), covariance, free) for covariance in after)
        found |= zip(("angle", "observation", "numerics"), refitted, strict=True)
        if c.kind == "observation":
            del found["soil"]
        value, times = size_of(c.measure)
        row = {"effect": c.name, "parameter": c.size, "value": value, "unit": c.measure.unit, "times": times}
        factors = {b: found[a] / max(found[b], 1e-9) for a, b in pairwise(found)}
        loss = next(iter(found.values())) / max(found["numerics"], 1e-9)
        rows.append({**row, "sigmas": found, "factors": factors, "loss": loss})
    return rows


def table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Markdown, what loses most first."""
    lines = [
        "| effect | (a) heights, force | (b) drawn | (c) reconstructed | (d) after nuisances | (a) / (d) | most by |",
        "|---" * 7 + "|",
    ]
    for row in sorted(rows, key=lambda row: -row["loss"]):
        unit = "" if row["unit"] == "1" else " " + row["unit"].replace("deg", "°")
        sigma = [row["sigmas"].get(name) for name in ("soil", "drawn", "reconstructed", "numerics")]
        most = max(row["factors"], key=lambda name: row["factors"][name])
        loss, by = (f"{f:.1f}" if f < 1e3 else "all" for f in (row["loss"], row["factors"][most]))
        cells = ["–" if value is None else f"{value:.1f} σ" for value in sigma]
        named = f"{row['effect'].replace('_', ' ')}, {row['value']:g}{unit}"
        lines.append("| " + " | ".join([named, *cells, loss, f"{most}: {by}"]) + " |")
    return "\n".join(lines)


def measure(effects: Sequence[str], preset: str, seeds: int, device: str, out: Path) -> list[dict[str, Any]]:
    """`left` of the effects of these names, or of all; what is not in the folder is made."""
    place, made = out / "set", out / "reconstruction"
    if not (place / "truth.json").is_file():
        make_set(place, plow(WORLD), friction_angle=ANGLE, preset=preset, seed=WORLD, device=device)
    measurement = Measurement.load(place)
    if not (made / "reconstruction.json").is_file():
        reconstruct(measurement, preset=preset, device=device).save(made)
    reconstruction = Reconstruction.load(made)
    known = replace(reconstruction, surface=plow(WORLD).surface)
    prepared: list[Any] = []
    say = partial(print, file=sys.stderr, flush=True)
    for kind, start in ((TrueSoil, known), (PlowExperiment, reconstruction)):
        experiment = kind(Model(measurement, start, preset=preset, device=device), TRUTH)
        wanted = [c for c in experiment.candidates if not effects or c.name in effects]
        ask = Simulations(experiment, out / "features", {"experiment": kind.__name__}, say)
        prior = Prior.of(experiment, TRUTH)
        prepared.append((experiment, simulated(experiment, ask, prior, wanted, seeds, kind is PlowExperiment)))
    return left(prepared[0], prepared[1], prior, wanted)


def written(page: Path, preset: str, new: str) -> str:
    """A page with the table of a preset replaced.

    Raises:
        RunError: it cannot be read, or has no place for the table.
    """
    try:
        return replaced(page.read_text(encoding="utf-8"), f"information {preset}", new)
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{page}: cannot be read as text ({error})") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, and write it into a page; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [name for name, effect in library().items() if not effect.numerical]
    parser.add_argument("--effects", nargs="+", default=[], choices=known, metavar="EFFECT", help="all by default")
    parser.add_argument("--preset", default="tiny", choices=sorted(PRESETS))
    parser.add_argument("--seeds", type=at_least(2), default=3, help="of the particles, with each effect")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--out", type=Path, default=Path("runs/information"))
    parser.add_argument("--page", type=Path, help="write the table into this page")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options = parser.parse_args(arguments)
    hush()
    if options.page:
        written(options.page, options.preset, "")  # a page without a place for the table fails now, not at the end
    decides = {"preset": options.preset, "device": options.device.split(":")[0], "code": sources([Path(__file__)])}
    keep_to_one_protocol(options.out, decides)
    with only_json() if options.json else nullcontext():
        rows = measure(options.effects, options.preset, options.seeds, options.device, options.out)
        told = {"made_by": stamp(options.device), "preset": options.preset, "seeds": options.seeds, **TRUTH}
        shown = f"{COMPUTED}\n\n{table(rows)}"
        write_result(options.out, {**told, "computed": COMPUTED, "rows": rows}, shown, {})
        if options.page:
            head = f"Preset `{options.preset}`, {options.seeds} seeds. "
            write_text(options.page, written(options.page, options.preset, head + shown))
        if options.json:
            print_json({"ok": True, **told, "rows": rows})
        else:
            print(shown)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
