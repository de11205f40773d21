"""How much of each effect do the data contain? Its signal-to-noise ratio, from the soil to the comparison.

``splatsoil benchmark information --page docs/information.md`` makes a set of known soil with our own solver, and
compares what each effect changes with the noise in four representations: (a) true heights and the force on the tool;
(b) the comparison's features of particles that fill the true surface, drawn by us; (c) the same from the reconstructed
surface; (d) those once the angle is refitted and all of the comparison's noise counts. Simulations are kept in the
folder, and a second call continues from there.

With ``--heights``, the set has heights, too, and the table is of (d) by instruments.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
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
    sized,
    sources,
    stamp,
    tell,
    with_section,
)
from splatsoil.benchmarks._truth import CELL, Truth
from splatsoil.envs.measured import reconstructed
from splatsoil.inverse.criticism.design import Prior
from splatsoil.inverse.criticism.diagnosis import BASE_RUNS, FINE, OBSERVATION_STEP, PAIRS
from splatsoil.inverse.criticism.noise import Noise, Tables, noise_of, trend_of
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import SimulationError
from splatsoil.experiment import Candidate, Layout, Run, Site
from splatsoil.experiment.heights import CHANNEL
from splatsoil.experiment.plow import MAX_ROWS, PlowExperiment
from splatsoil.experiment.scene_parts import bins_of
from splatsoil.files import write_text
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.mpm import PRESETS
from splatsoil.parameters import Parameter
from splatsoil.quiet import hush
from splatsoil.soil.library import library
from splatsoil.synthetic import Recipe, make_set, plow

ANGLE, SEED = 35.0, 1
"""Of the soil, degrees, and the seed of its surface, its looks and the cameras' noise."""
TRUTH = {"friction_angle": ANGLE}
HEIGHT = "height"
HEIGHTS = GRIDS, DEPTH_MAPS = "grids", "depth-maps"
"""Instruments of heights, as ``--heights`` names them."""


class TrueSoil(PlowExperiment):
    """Pictures of soil whose surface is known, and before them its true heights: changes since the first frame in mm,
    on a grid of `CELL`, averaged over the same frames as pictures."""

    @cached_property
    def layout(self) -> Layout:
        """Labels of heights and features."""
        seen, bed = super().layout, self.base.measurement.bed
        x, y = (bed.lower[k] + CELL * (np.arange(round(bed.extents[k] / CELL)) + 0.5) for k in (0, 1))
        sites = tuple(Site(HEIGHT, float(u), float(v), "mm") for v in y for u in x)
        regions = np.concatenate([np.full((len(seen.times), len(sites)), HEIGHT), seen.regions], axis=1)
        return replace(seen, sites=sites + seen.sites, regions=regions)

    @cached_property
    def observed(self) -> FloatArray:
        """(t, s): of heights 0, as nobody has seen them."""
        return self._after(0.0, super().observed)

    @cached_property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(t, s): heights are known everywhere."""
        return self._after(1.0, super().seen).astype(bool)

    @cached_property
    def sensor(self) -> FloatArray:
        """(t, s): heights are known exactly."""
        return self._after(0.0, super().sensor)

    def predict(self, run: Run) -> FloatArray:
        """(t, s) true heights, and what would be seen."""
        prediction = self.prediction(run)
        motion, measurement, frames = prediction.trajectory, self.base.measurement, self.comparator.frames
        truth = Truth(measurement, {}, motion.spacing**3, dict(run.values), ())
        first, *later = (
            1e3 * truth.heights(motion.at(f)[0], truth.volume) for f in (self.comparator.reference, *frames)
        )
        rows = [np.mean([later[i] - first for i in group], axis=0) for group in bins_of(measurement, frames, MAX_ROWS)]
        return np.concatenate([np.reshape(rows, (len(rows), -1)), self.features(prediction)], axis=1)

    def _after(self, height: float, features: npt.NDArray[Any]) -> FloatArray:
        count = len(self.layout.sites) - features.shape[1]
        return np.concatenate([np.full((len(features), count), height), features], axis=1)


def precision_of(covariance: FloatArray, free: FloatArray | None = None) -> FloatArray:
    """(p, p) inverse of a covariance; with what an unknown parameter changes (p,), of what is orthogonal to that."""
    precision = np.linalg.inv(covariance + 1e-9 * np.eye(len(covariance)))
    along = precision @ (np.zeros(len(covariance)) if free is None else free)
    return np.asarray(precision if free is None else precision - np.outer(along, along) / (free @ along))


def sigmas(changes: FloatArray, precision: FloatArray, scatter: FloatArray) -> tuple[float, float]:
    """Mahalanobis length of a change, in standard deviations of the noise, and what scatter alone reaches in one of 20.

    The length's square is the mean product of different rows (a U-statistic: Hoeffding 1948, Ann. Math. Stat. 19:293),
    whose own scatter cancels. Where that is negative it is 0.

    Args:
        changes: (k, p) the same change, each with scatter of its own; a single one has none.
        precision: (p, p) of the noise.
        scatter: (p, p) covariance of the changes.
    """
    products, k = changes @ precision @ changes.T, len(changes)
    if k == 1:
        return float(np.sqrt(products.sum())), 0.0
    square = (products.sum() - np.trace(products)) / (k * (k - 1))
    spread = np.sqrt(2.0 * np.trace(precision @ scatter @ precision @ scatter) / (k * (k - 1)))
    return float(np.sqrt(max(square, 0.0))), float(np.sqrt(1.645 * spread))  # the normal distribution's 95 %


def times_of(p: Parameter) -> float:
    """An effect's size over its smallest meaningful one: `OBSERVATION_STEP`, or what its bounds leave."""
    return (sized(p, OBSERVATION_STEP) - (p.off or 0.0)) / p.meaningful


def simulated(
    experiment: PlowExperiment, ask: Simulations, prior: Prior, effects: Sequence[Candidate], seeds: int, whole: bool
) -> Tables:
    """Simulations: with each effect, and of the model as it is with the same seeds and over its prior.

    Observation effects are drawn as changes by their smallest meaningful size; with ``whole`` all of them are, as are
    unknown albedo, and pairs of coarse and fine runs are there. An effect that fails but for one seed is left out.
    """

    def made(runs: Sequence[Run], *allowed: type[Exception]) -> tuple[Sequence[Run], FloatArray]:
        kept, tables = list[Run](), list[FloatArray]()
        for r in runs:
            text = f"{type(experiment).__name__}: {', '.join(r.effects) or r.variant or 'base'}"
            with suppress(*allowed):
                tables.append(ask(r, text))
                kept.append(r)
        if len(kept) < len(runs):
            print(f"{text}: {len(kept)} of {len(runs)} could be simulated", file=sys.stderr)
        return kept, np.array(tables).reshape(len(kept), *experiment.layout.shape)

    def spread(count: int, first: int, variant: str = "") -> list[Run]:
        points = (2.0 * (np.arange(count) + 0.5) / max(count, 1) - 1.0)[:, None]
        return [Run(v, seed=first + i, variant=variant) for i, v in enumerate(prior.values(points))]

    drawn = {}
    # What needs more frames of the simulation comes first, so that one serves all.
    for c in sorted(experiment.candidates if whole else effects, key=lambda c: c.name != "time_offset"):
        for p in c.parameters if c.kind == "observation" else ():
            drawn[p.name] = made([Run({**TRUTH, p.name: sized(p, OBSERVATION_STEP)}, (c.name,))])[1][0], times_of(p)
    reference = made([Run(TRUTH)])[1][0]
    drawings = {name: reference + (table - reference) / times for name, (table, times) in drawn.items()}
    for name in (*experiment.albedo_draws, *experiment.renderings) if whole else ():
        drawings[name] = made([Run(TRUTH, variant=name)])[1][0]
    base = made([*(Run(TRUTH, seed=s) for s in range(seeds)), *spread(BASE_RUNS, 101)])
    fine = made(spread(PAIRS if whole else 0, 201, FINE))
    values = {c.name: {**TRUTH, c.size: sized(c.measure, OBSERVATION_STEP)} for c in effects if c.kind == "physics"}
    found = {n: made([Run(v, (n,), s) for s in range(seeds)], SimulationError) for n, v in values.items()}
    return Tables(base, fine, {n: f for n, f in found.items() if len(f[0]) > 1}, drawings, reference)


def changes_of(candidate: Candidate, noise: Noise, tables: Tables) -> FloatArray:
    """(k, p) what an effect changes, seed by seed; one row for an effect of observation, which has no scatter."""
    if candidate.kind == "observation":
        off, on = noise.scores(np.stack([tables.reference, tables.variants[candidate.size]]))
        return np.asarray(times_of(candidate.measure) * (on - off)[None])
    runs, found = tables.effects[candidate.name]
    return np.asarray(noise.scores(found) - noise.base[[run.seed for run in runs]])


def along_angle(noise: Noise, prior: Prior) -> FloatArray:
    """(p,) what the angle changes, along the modes of the noise."""
    at = prior.space.to_unit(prior.space.to_vector(TRUTH))[None]
    trends = (trend_of(at + step, noise.points) for step in (0.01, -0.01))
    return np.asarray((np.subtract(*trends) @ noise.base)[0])


def by_instrument(
    seen: tuple[PlowExperiment, Tables], prior: Prior, effects: Iterable[Candidate]
) -> list[dict[str, Any]]:
    """One row for each effect: its size, and the sigmas of (d) with some of the instruments and with all."""
    experiment, tables = seen
    placed = experiment.layout.placed
    heights = np.array([site.channel == CHANNEL for site in experiment.layout.sites])
    aside = {"pictures, force": heights, "heights, force": placed & ~heights, "all": np.zeros_like(heights)}
    rows: list[dict[str, Any]] = [
        {"effect": c.name, "parameter": c.size, "unit": c.measure.unit, "value": sized(c.measure, OBSERVATION_STEP)}
        | {"sigmas": {}, "least": {}}
        for c in effects
        if c.kind == "observation" or c.name in tables.effects
    ]
    by_name = {c.name: c for c in effects}
    for name, without in aside.items():
        left_out = np.broadcast_to(without, experiment.layout.shape)
        noise = noise_of(experiment, prior, tables, experiment.candidates, left_out)
        precision = precision_of(noise.covariance(1.0), along_angle(noise, prior))
        for row in rows:
            found = sigmas(changes_of(by_name[row["effect"]], noise, tables), precision, 2.0 * noise.scatter)
            row["sigmas"][name], row["least"][name] = found
    return rows


def left(
    true: tuple[TrueSoil, Tables], seen: tuple[PlowExperiment, Tables], prior: Prior, effects: Iterable[Candidate]
) -> list[dict[str, Any]]:
    """One row for each effect: its size, the sigmas that are left after each step, and what each step divides by."""

    def bare(experiment: PlowExperiment, tables: Tables, aside: npt.NDArray[np.bool_]) -> tuple[Noise, Tables]:
        everywhere = np.broadcast_to(aside, experiment.layout.shape)
        return noise_of(experiment, prior, replace(tables, variants={}), (), everywhere), tables

    heights = np.array([site.channel == HEIGHT for site in true[0].layout.sites])
    views = {"soil": bare(*true, true[0].layout.placed & ~heights), "drawn": bare(*true, heights)}
    views["reconstructed"] = bare(*seen, np.array(False))
    whole = noise_of(seen[0], prior, seen[1], seen[0].candidates)
    free = along_angle(whole, prior)
    steps = {name: (noise, tables, precision_of(noise.fixed)) for name, (noise, tables) in views.items()}
    steps["angle"] = whole, seen[1], precision_of(views["reconstructed"][0].fixed, free)
    steps["observation"] = whole, seen[1], precision_of(whole.fixed, free)
    steps["discretisation"] = whole, seen[1], precision_of(whole.covariance(1.0), free)
    rows = []
    for c in (c for c in effects if c.kind == "observation" or c.name in true[1].effects.keys() & seen[1].effects):
        found = {n: sigmas(changes_of(c, noise, t), p, 2.0 * noise.scatter) for n, (noise, t, p) in steps.items()}
        if c.kind == "observation":
            del found["soil"]
        row: dict[str, Any] = {"effect": c.name, "parameter": c.size, "unit": c.measure.unit}
        row |= {"value": sized(c.measure, OBSERVATION_STEP), "times": times_of(c.measure)}
        known = {name: max(*pair, 1e-9) for name, pair in found.items()}
        row["sigmas"], row["least"] = ({name: pair[k] for name, pair in found.items()} for k in (0, 1))
        row["factors"] = {b: known[a] / known[b] for a, b in pairwise(known)}
        rows.append({**row, "loss": next(iter(known.values())) / known["discretisation"]})
    return rows


def table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Markdown: physics, then observation, what loses most first; what scatter alone could reach is a limit."""
    head = ("effect", "(a) heights, force", "(b) drawn", "(c) reconstructed", "(d) after nuisances", "loss", "most by")
    lines = []
    for row in sorted(rows, key=lambda row: ("soil" not in row["sigmas"], -row["loss"])):
        text = in_words(row)
        hidden = {name: value < row["least"][name] for name, value in row["sigmas"].items()}
        loss, most = f"{'≥ ' * hidden['discretisation']}{row['loss']:.1f}", max(row["factors"], key=row["factors"].get)
        cells = [named(row), *(text.get(name, "–") for name in ("soil", "drawn", "reconstructed", "discretisation"))]
        cells += ["–", "–"] if next(iter(hidden.values())) else [loss, f"{most}: {row['factors'][most]:.1f}"]
        lines.append(cells)
    return markdown(head, lines)


def table_of_instruments(rows: Iterable[Mapping[str, Any]]) -> str:
    """Markdown, what heights and forces contain most of first."""
    ordered = sorted(rows, key=lambda row: -row["sigmas"]["heights, force"])
    lines = [[named(row), *in_words(row).values()] for row in ordered]
    return markdown(("effect", "pictures, force", "heights, force", "all"), lines)


def named(row: Mapping[str, Any]) -> str:
    """An effect and its size."""
    unit = "" if row["unit"] == "1" else " " + row["unit"].replace("deg", "°")
    return f"{row['effect'].replace('_', ' ')}, {row['value']:g}{unit}"


def in_words(row: Mapping[str, Any]) -> dict[str, str]:
    """A row's sigmas; what scatter alone could reach is a limit."""
    least = row["least"]
    return {n: f"< {least[n]:.1f} σ" if v < least[n] else f"{v:.1f} σ" for n, v in row["sigmas"].items()}


def measure(
    effects: Sequence[str], preset: str, seeds: int, device: str, out: Path, heights: str = ""
) -> list[dict[str, Any]]:
    """`left` of the effects of these names, or of all; of a set with ``heights`` (`HEIGHTS`), `by_instrument`. What is
    not in the folder is made."""
    place, say = out / "set", Clock()
    if not (place / "truth.json").is_file():
        recipe = Recipe(ANGLE, preset=preset, seed=SEED, device=device)
        make_set(place, plow(SEED), replace(recipe, heights=heights == GRIDS, depth_maps=heights == DEPTH_MAPS))
    measurement = Measurement.load(place)
    reconstruction = reconstructed(measurement, out / "reconstruction", preset, device)
    known = replace(reconstruction, surface=plow(SEED).surface)
    prepared: list[Any] = []
    for kind, start in ((TrueSoil, known), (PlowExperiment, reconstruction))[bool(heights) :]:
        experiment = kind(Model(measurement, start, preset=preset, device=device), TRUTH)
        wanted = [c for c in experiment.candidates if not effects or c.name in effects]
        ask = Simulations(experiment, out / "features", {"experiment": kind.__name__})
        ask.report = say
        prior = Prior.of(experiment, TRUTH)
        prepared.append((experiment, simulated(experiment, ask, prior, wanted, seeds, kind is PlowExperiment)))
    return by_instrument(prepared[0], prior, wanted) if heights else left(prepared[0], prepared[1], prior, wanted)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, and write it into a page; exit code 0."""
    parser = parser_of(__doc__, "runs/information", page=True)
    known = [name for name, effect in library().items() if not effect.numerical]
    parser.add_argument("--effects", nargs="+", default=[], choices=known, metavar="EFFECT", help="all by default")
    parser.add_argument("--preset", default="tiny", choices=sorted(PRESETS))
    parser.add_argument("--seeds", type=at_least(2), default=3, help="of the particles, with each effect")
    parser.add_argument("--heights", default="", choices=HEIGHTS, help="the set has heights, too: what they give")
    options = parser.parse_args(arguments)
    hush()
    mark = " ".join(["information", options.preset, *[options.heights] * bool(options.heights)])
    if options.page:
        with_section(options.page, mark, "")  # a page without a place for the table fails now, not at the end
    device, own = options.device.split(":")[0], sources("information")
    protocol = {"preset": options.preset, "device": device, "heights": options.heights, "code": own}
    keep_to_one_protocol(options.out, protocol)
    rows = measure(options.effects, options.preset, options.seeds, options.device, options.out, options.heights)
    result = {"made_by": stamp(options.device), "preset": options.preset, "seeds": options.seeds, **TRUTH, "rows": rows}
    shown = table_of_instruments(rows) if options.heights else table(rows)
    shown = f"Preset `{options.preset}`, {options.seeds} seeds.\n\n{shown}"
    if options.page:
        write_text(options.page, with_section(options.page, mark, shown))
    tell(options, result, shown)
    return 0
