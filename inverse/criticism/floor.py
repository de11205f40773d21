"""The floor: how far observation and prediction may differ with nothing wrong, from the evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import helmert
from scipy.optimize import nnls

from splatsoil.experiment.base import Experiment
from splatsoil.experiment.features import Layout

from .derivatives import ignorance
from .dilution import reliable
from .evidence import Evidence, Vantage
from .noise import Noise, Part, extra_noise, independent
from .sampled_noise import correlated, estimate

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

NUMERICS_PRIOR = 0.5
"""Standard deviation of a numerical difference pattern's amplitude, in units of the change that was tried: thirteen of
another solver's soils hold 0.2 (contact) to 0.6 of them (steps), root mean square. In the noise that stands for
numerics which weren't tried these patterns count in full."""
ACTING = ("chance", "guesses", "numerics")
"""Parts of soil's making, which lie where effects act more than a separable noise says."""
FEWEST_QUIET, FEWEST_SQUARES = 30, 12
"""Features without physics, and places of them, from which the instruments' errors can be told."""
OUTLYING = 3.0
"""Standard deviations beyond which a quiet feature counts as no farther out."""
ROBUST_ROUNDS, REPORTED_ROUNDS = 30, 10
"""Of reweighting quiet features: for the size of errors, and for what cameras report."""


@dataclass(frozen=True)
class Floor:
    """Noise and nuisances of one experiment at one fit.

    Attributes:
        noise: of observed minus the mean prediction, without nuisances.
        single: of observed minus one prediction.
        nuisance: (n, q) patterns that numerics can make, and those by which model and instruments are known to differ,
            times their prior standard deviations.
        tried: how many of these, the first ones, are other numerics.
        parameters: (n, k) derivatives by the model's parameters (and their curvature), likewise.
        directions: (n, k) in which effects act.
        parts: what the noise is made of: instruments, chance, guesses, reconstruction, numerics beyond the patterns.
    """

    noise: Noise
    single: Noise
    nuisance: FloatArray
    tried: int
    parameters: FloatArray
    directions: FloatArray
    parts: Mapping[str, Part]

    @property
    def free(self) -> FloatArray:
        """(n, q + k) all that is projected out."""
        return np.concatenate([self.nuisance, self.parameters], axis=1)

    def share(self, name: str, sites: BoolArray) -> float:
        """A part's share of the whole variance at some sites (s,), whose features are in one unit."""
        mine = self.noise.seen & sites[None]
        totals = {key: float(np.sum(part.scale[mine] ** 2)) for key, part in self.parts.items()}
        return totals[name] / max(sum(totals.values()), 1e-300)


def floor_of(experiment: Experiment, evidence: Evidence, before: Floor | None = None) -> Floor:
    """Assemble the floor; ``before`` is that of the same evidence with other effects' derivatives.

    Chance comes from repeated seeds, what no instrument shows from other guesses of it, the pictures' own errors from
    a control, or else from where physics can't act. What other numerics change is projected out, pattern by pattern;
    what each of these patterns holds beyond parameters, the other patterns and its own chance is a sample of what
    numerics that weren't tried would leave, and goes into the noise.
    """
    layout, seen = experiment.layout, experiment.seen
    parameters = taken_up(experiment, evidence)
    parts = {"instruments": independent(experiment.sensor, experiment.sensor_memory)}
    runs = len(evidence.repeats)
    acting = [(direction, evidence.doubt(name, direction)) for name, direction in evidence.directions.items()]
    directions = _columns([table for direction, _ in acting for table in direction], seen)
    # What is chance in a direction is told from what is chance in its doubt: the noise must be the same along both.
    doubted = _columns([table for both in acting for tables in both for table in tables], seen)
    known_parts = {} if before is None else before.parts
    if experiment.chance and runs > 1:
        parts["chance"] = estimate(
            layout, _contrasts(evidence.repeats), seen, directions, parameters, known=known_parts.get("chance")
        )
    if len(evidence.guesses) > 1:
        parts["guesses"] = estimate(
            layout, _contrasts(evidence.guesses), seen, directions, parameters, known=known_parts.get("guesses")
        )
    if "reconstruction" in known_parts:
        parts["reconstruction"] = known_parts["reconstruction"]
    elif evidence.replays is not None:
        parts["reconstruction"] = _replayed(experiment, evidence, parts)
    elif np.count_nonzero(experiment.quiet) >= FEWEST_QUIET:
        known = _total(layout, parts, seen, runs)[0]
        parts["reconstruction"] = _instruments(experiment, evidence, known)
    patterns = list(evidence.numerics.values())
    if patterns:
        known = _total(layout, parts, seen, runs)[0]
        doubts = [evidence.numerics_doubts.get(name, np.zeros(layout.shape)) for name in evidence.numerics]
        left = _unexplained(known, parameters, patterns, doubts, seen & layout.common[None])
        parts["numerics"] = estimate(
            layout, left, seen, directions, parameters, alike=False, known=known_parts.get("numerics")
        )
    noise, single = _total(layout, parts, seen, runs)
    columns = {name: extra_noise(layout, p, seen, doubted if name in ACTING else None) for name, p in parts.items()}
    averaged, alone = (
        np.concatenate([math.sqrt(_factors(name, runs)[i]) * extra for name, extra in columns.items()], axis=1)
        for i in (0, 1)
    )
    noise, single = noise.plus(averaged), single.plus(alone)
    nuisance = [NUMERICS_PRIOR * _columns(patterns, seen), _columns(experiment.systematic, seen)]
    return Floor(noise, single, np.concatenate(nuisance, axis=1), len(patterns), parameters, directions, parts)


def taken_up(experiment: Experiment, vantage: Vantage) -> FloatArray:
    """(n, k) what the model's parameters can take up: `Floor.parameters`."""
    prior = {p.name: p for p in experiment.parameters}
    slopes = [ignorance(prior[name], vantage.values[name]) * table for name, table in vantage.slopes.items()]
    slopes += [(3.0 * vantage.widths[name]) ** 2 * table for name, table in vantage.curves.items()]
    return _columns(slopes, experiment.seen)


def _instruments(experiment: Experiment, evidence: Evidence, known: Noise) -> Part:
    """What model and instruments get wrong without any physics, from where physics cannot act.

    There, all that remains after exposure, camera poses and the like are taken out is the fault of the pictures'
    model. Its variance is told as a constant and a share of the predicted signal's square, so that it can be said
    elsewhere too.
    """
    quiet, signal = experiment.quiet, np.abs(evidence.mean)
    scale = known.spread(known.scale)[quiet]
    rest = _unreported(experiment, evidence, experiment.observed - evidence.mean, quiet, scale)
    terms = np.stack([np.ones(rest.size), signal[quiet] ** 2], axis=1)
    size = np.maximum(np.linalg.norm(terms, axis=0), 1e-300)
    squares = rest**2
    for _ in range(ROBUST_ROUNDS):
        (level, share), _ = nnls(terms / size, np.maximum(squares - scale**2, 0.0))
        variance = level / size[0] + share / size[1] * signal**2
        # Soil may have moved where none was expected to: that is no fault of the pictures.
        squares = np.minimum(rest**2, OUTLYING**2 * (variance[quiet] + scale**2))
    # Where nothing moves pictures tell of pictures alone.
    variance[:, ~experiment.layout.common] = 0.0
    if not np.any(variance > 0.0):
        return Part(scale=np.zeros(signal.shape))
    whole = np.sqrt(variance)
    table = np.zeros(signal.shape)
    table[quiet] = np.sign(rest) * np.sqrt(squares)
    found = correlated(experiment.layout, table[None], quiet, np.hypot(whole, known.spread(known.scale)))
    return replace(found, scale=whole)


def _unreported(
    experiment: Experiment, evidence: Evidence, table: FloatArray, quiet: BoolArray, scale: FloatArray
) -> FloatArray:
    """(q,) what is left of a table (t, s) in quiet features (t, s), of noise ``scale`` (q,), once exposure, camera
    poses and the like are taken out; where these effects aren't at hand, what changes all of a camera's frame alike."""
    layout = experiment.layout
    reported = [c.name for c in experiment.candidates if c.kind == "observation" and c.name in evidence.directions]
    if reported:
        tables = np.concatenate([evidence.directions[name] for name in reported])
    else:
        alike = layout.channel_numbers == np.unique(layout.channel_numbers)[:, None]
        tables = np.einsum("ij,cs->icjs", np.eye(layout.shape[0]), alike).reshape(-1, *layout.shape)
    columns = tables[:, quiet].T / scale[:, None]
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-9] / size[size > 1e-9]
    white, weight = table[quiet] / scale, np.ones(len(scale))
    for _ in range(REPORTED_ROUNDS):
        # Soil that moved is none of the cameras' doing (Huber's weights; 1.48 medians are a standard deviation).
        amplitude, *_ = np.linalg.lstsq(weight[:, None] * columns, weight * white, rcond=1e-3)
        far = np.abs(white - columns @ amplitude)
        weight = np.sqrt(np.minimum(1.0, 1.4826 * np.median(far) / np.maximum(far, 1e-300)))
    return np.asarray(scale * (white - columns @ amplitude), dtype=np.float64)


def _contrasts(deviations: FloatArray) -> FloatArray:
    """(r - 1, t, s) independent samples from r deviations from a mean, which are none."""
    count = len(deviations)
    # Helmert's: orthonormal, and orthogonal to the mean.
    return np.tensordot(helmert(count), deviations, axes=1) * np.sqrt((count - 1) / count)


def _replayed(experiment: Experiment, evidence: Evidence, parts: Mapping[str, Part]) -> Part:
    """What known soils leave that went through the whole chain, beyond chance, guesses and the cameras' noise.

    What the undisturbed bed of the real pictures leaves beyond that of the replays comes on top everywhere. By the
    middle square of the bed: soil that moves where none was expected to does so beside the tool's way, and is no fault
    of the pictures; theirs are all over it.
    """
    assert evidence.replays is not None
    told = np.isfinite(evidence.replays).all(axis=0)
    replays = np.where(told, evidence.replays, 0.0)
    whole = estimate(experiment.layout, replays, experiment.seen & told)
    known = parts["instruments"].scale ** 2
    if "chance" in parts:
        known = known + 2.0 * parts["chance"].scale ** 2
    if "guesses" in parts:
        known = known + parts["guesses"].scale ** 2
    variance = np.maximum(whole.scale**2 - known, 0.0)
    quiet = experiment.quiet & told
    if np.count_nonzero(quiet.any(axis=0)) >= FEWEST_SQUARES:
        scale = np.maximum(np.hypot(whole.scale, experiment.sensor), 1e-9)
        real = _middle_square(experiment, evidence, (experiment.observed - evidence.mean)[None], quiet, scale)
        more = max(0.0, real - _middle_square(experiment, evidence, replays, quiet, scale))
        # Where nothing moves pictures tell of pictures alone.
        variance[:, experiment.layout.common] += more
    return replace(whole, scale=np.sqrt(variance))


def _middle_square(
    experiment: Experiment, evidence: Evidence, tables: FloatArray, quiet: BoolArray, scale: FloatArray
) -> float:
    """Median over sites with quiet features (t, s), and over tables (r, t, s), of the mean square there, beyond what
    cameras report."""
    squares = np.zeros(tables.shape)
    for square, table in zip(squares, tables, strict=True):
        square[quiet] = _unreported(experiment, evidence, table, quiet, scale[quiet]) ** 2
    counts = quiet.sum(axis=0)
    return float(np.median(squares.sum(axis=1)[:, counts > 0] / counts[counts > 0]))


def _factors(name: str, runs: int) -> tuple[float, float]:
    """On a part's variance, in observed minus the mean of ``runs`` predictions, and minus one."""
    return (1.0 + 1.0 / runs, 2.0) if name == "chance" else (1.0, 1.0)


def _total(layout: Layout, parts: Mapping[str, Part], seen: BoolArray, runs: int) -> tuple[Noise, Noise]:
    """Noise against the mean of ``runs`` predictions, and against one."""
    averaged, alone = (
        Noise.of(layout, [(_factors(name, runs)[i], part) for name, part in parts.items()], seen) for i in (0, 1)
    )
    return averaged, alone


def _unexplained(
    noise: Noise,
    parameters: FloatArray,
    patterns: Sequence[FloatArray],
    doubts: Sequence[FloatArray],
    common: BoolArray,
) -> FloatArray:
    """(p, t, s) what each pattern holds beyond the parameters and the other patterns, as large as it is without the
    chance that its doubts (p tables) tell: that is a part of the noise already.

    None counts as larger than the middle one of them, in features (t, s) of one unit: one that is, is projected out
    itself, and says nothing of what numerics that weren't tried would leave.
    """
    columns, chances = _columns(patterns, noise.seen), _columns(doubts, noise.seen)
    out = []
    for k in range(columns.shape[1]):
        others = np.concatenate([parameters, np.delete(columns, k, axis=1)], axis=1)
        scaled = others / noise.scale[:, None]
        size = np.linalg.norm(scaled, axis=0)
        # what changes nothing (an effect's shape, where the effect is off) takes up nothing
        size = np.where(size > 0.0, size, 1.0)
        both = np.stack([columns[:, k], chances[:, k]], axis=1)
        amplitude, *_ = np.linalg.lstsq(scaled / size, both / noise.scale[:, None], rcond=1e-3)
        out.append([noise.spread(column) for column in (both - others @ (amplitude / size[:, None])).T])
    left, chance = np.stack(out, axis=1)
    squares, by_chance = (np.mean(tables[:, common] ** 2, axis=1) for tables in (left, chance))
    left = np.sqrt(reliable(squares, by_chance))[:, None, None] * left
    size = np.sqrt(np.mean(left[:, common] ** 2, axis=1))
    return left * np.minimum(1.0, np.median(size) / np.maximum(size, 1e-300))[:, None, None]


def _columns(tables: Sequence[FloatArray] | FloatArray, seen: BoolArray) -> FloatArray:
    """(n, k) of k tables."""
    if not len(tables):
        return np.zeros((int(seen.sum()), 0))
    return np.stack([table[seen] for table in tables], axis=1)
