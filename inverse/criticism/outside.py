"""Outside the library: which strength, free in its form, would explain the data, and what does it look like?

The coefficients a of a :class:`~.free_strength.FreeStrength` have the prior N(0, τ²K), K smooth along each argument.
Model and coefficients are fitted together by Gauss-Newton on the features, nuisances projected out. Which arguments are
needed, and τ, follow from the marginal likelihood of the model made linear where the fit ended (MacKay 1992); so do the
bands. The level of the functions belongs to the friction angle, which is free: only their shapes are told, relative to
their mean over the states visited.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.experiment.states import States, Strained
from splatsoil.parameters import Parameter

from .derivatives import around, ignorance
from .evidence import Evidence
from .floor import Floor
from .free_strength import NODES, FreeStrength, Range, coordinates, hats, ranges
from .misfit import Omnibus, omnibus
from .refit import measured_over, mended
from .simulations import Simulations
from .verdicts import explained

FloatArray = npt.NDArray[np.float64]

STEP = 0.2
"""Of a coefficient's derivative: a fifth more strength."""
SCALES = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Standard deviations τ of the coefficients that are tried."""
LENGTH = 0.5
"""Of K's correlation, in ranges of the argument."""
PRIOR = 0.4
"""τ while the fit is made."""
TRIES = 4
"""Simulations of the fit after the derivatives."""
POINTS = 41
"""Of a drawn curve."""
CLEAR = 2.0
"""Standard deviations from which a change counts."""
NEEDED = 3.0
"""Log evidence that an argument must bring in (odds of 20; Kass & Raftery 1995)."""
FEW = 0.5
"""Share of the misfit below which no strength of this kind is called the explanation."""

WORDS = {
    ("pressure", -1): "cohesion-like",
    ("pressure", 1): "weak under little pressure",
    ("inertial number", 1): "rate-like",
    ("inertial number", -1): "weaker in fast flow",
    ("plastic strain", -1): "softening-like",
    ("plastic strain", 1): "hardening-like",
}


@dataclass(frozen=True)
class Shape:
    """Friction as a function of one argument.

    Attributes:
        argument: pressure in Pa, inertial number or plastic strain.
        at: (m,) the argument, over what the soil went through.
        factor: (m,) friction over its mean there.
        low, high: (m,) 5 and 95 % of it.
        change: logarithm of the factor at the upper end less that at the lower one.
        std: of that.
        evidence: logarithm of the odds that friction depends on the argument.
        reading: in words; empty where the argument isn't needed or nothing is clear.
    """

    argument: str
    at: FloatArray
    factor: FloatArray
    low: FloatArray
    high: FloatArray
    change: float
    std: float
    evidence: float
    reading: str


@dataclass(frozen=True)
class StrengthReading:
    """What a free strength says of a misfit.

    Attributes:
        shapes: of each argument of which the soil has seen enough.
        misfit: with the strength.
        explained: share of the misfit beyond chance that it explains.
        held: model's parameters at the fit.
        scale: τ.
    """

    shapes: tuple[Shape, ...]
    misfit: Omnibus
    explained: float
    held: Mapping[str, float]
    scale: float

    @property
    def readings(self) -> tuple[str, ...]:
        """What is clear, the strongest evidence first."""
        told = sorted((s for s in self.shapes if s.reading), key=lambda s: -s.evidence)
        return tuple(s.reading for s in told)


def read_strength(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    simulate: Simulations,
    basis: FloatArray,
    before: Omnibus,
    *,
    progress: Callable[[float], None] | None = None,
) -> StrengthReading | None:
    """Fit a free strength beside the model's parameters; None where the soil's states are unknown or hardly vary.

    Args:
        experiment: what was observed, and the model.
        evidence: around the model's fit.
        floor: its noise and nuisances.
        simulate: where predictions come from.
        basis: (n, k) slow waves.
        before: misfit of the model as it is.
        progress: called with the share done.

    Raises:
        SimulationError: the fit itself can't be simulated with the free strength on.
    """
    if not isinstance(experiment, Strained):
        return None
    states = experiment.states(evidence.values)
    spans = ranges(states)
    if not spans:
        return None
    effect = FreeStrength.over(spans)
    told = progress or (lambda share: None)
    fit = _fit(experiment, evidence, floor, simulate, effect, told)
    columns = fit.slopes[experiment.seen]
    tangent = np.concatenate([floor.nuisance, columns * fit.prior[None]], axis=1)
    left = (experiment.observed - fit.prediction)[experiment.seen]
    after = omnibus(floor.single, tangent, left, basis)
    gone = explained(before, after)
    return _read(fit, spans, states, after, gone)


@dataclass(frozen=True)
class _Fit:
    """Where the fit ended.

    Attributes:
        names: of the model's parameters, then the coefficients.
        model: how many are the model's.
        values: all of them.
        prediction: (t, s) there.
        slopes: (t, s, k) derivatives there.
        target: (n,) whitened residual of the linear model where all coefficients, and changes of parameters, are 0.
        white: (n, k) its whitened derivatives.
        prior: (k,) standard deviations, τ = PRIOR.
    """

    names: tuple[str, ...]
    model: int
    values: FloatArray
    prediction: FloatArray
    slopes: FloatArray
    target: FloatArray
    white: FloatArray
    prior: FloatArray


def _fit(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    simulate: Simulations,
    effect: FreeStrength,
    told: Callable[[float], None],
) -> _Fit:
    """Gauss-Newton with the prior; derivatives are measured anew in each round where simulations have no chance."""
    parameters = experiment.parameters
    names = (*(p.name for p in parameters), *(p.name for p in effect.parameters))
    lower, upper = (
        np.array([getattr(p, side) for p in (*parameters, *effect.parameters)]) for side in ("lower", "upper")
    )
    home = np.array([*(evidence.values[p.name] for p in parameters), *(0.0 for _ in effect.parameters)])
    wide = [ignorance(p, evidence.values[p.name]) for p in parameters]
    root = _prior_root(effect.spans, PRIOR)
    precision = np.zeros((len(home), len(home)))
    precision[: len(wide), : len(wide)] = np.diag(np.array(wide) ** -2.0)
    precision[len(wide) :, len(wide) :] = np.linalg.inv(root @ root.T)
    solver = floor.single.solver.beside(floor.nuisance)
    done, rounds = 0, 1 if experiment.chance else 3
    jobs = rounds * (len(home) + TRIES) + 1

    def run(at: FloatArray) -> FloatArray:
        nonlocal done
        table = simulate(
            {n: float(v) for n, v in zip(names, at, strict=True)}, effects=(effect,), purpose="free strength"
        )
        done += 1
        told(min(done / jobs, 1.0))
        return table

    def whiten(table: FloatArray) -> FloatArray:
        return solver.whiten(table[experiment.seen])

    def cost(table: FloatArray, at: FloatArray) -> float:
        step = at - home
        return float(np.sum(whiten(experiment.observed - table) ** 2) + step @ precision @ step)

    widths = np.array([*measured_over(parameters, evidence.values), *(STEP for _ in effect.parameters)])
    at, here = home, run(home)
    for _ in range(rounds):
        slopes = _slopes((*parameters, *effect.parameters), at, here, run)
        began = best = cost(here, at)
        share = 1.0
        for _ in range(TRIES):
            white = whiten(slopes)
            gradient = white.T @ whiten(experiment.observed - here) - precision @ (at - home)
            step = np.linalg.solve(white.T @ white + precision, gradient)
            there = np.clip(at + share * step, lower, upper)
            if np.max(np.abs(there - at) / (upper - lower)) < 1e-3:
                break
            try:
                table = run(there)
            except SimulationError:
                share *= 0.4
                continue
            moved = there - at
            slopes = mended(slopes, table - here, moved, widths, chance=experiment.chance)
            if (fresh := cost(table, there)) < best:
                at, here, best = there, table, fresh
            else:
                share *= 0.4
        if began - best < 1.0:
            break
    white = whiten(slopes)
    target = whiten(experiment.observed - here) + white @ (at - home)
    prior = np.array([*wide, *(PRIOR for _ in effect.parameters)])
    return _Fit(names, len(wide), at, here, slopes, target, white, prior)


def _slopes(
    parameters: Sequence[Parameter], at: FloatArray, here: FloatArray, run: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """(t, s, k) derivatives by one-sided differences, 0 where there is nothing to simulate."""
    out = np.zeros((*here.shape, len(parameters)))
    for index, parameter in enumerate(parameters):
        there = at.copy()
        if parameter.name.startswith("strength_"):
            there[index] += STEP if at[index] + STEP <= parameter.upper else -STEP
        else:
            there[index] = around(parameter, float(at[index]))[0]
        try:
            out[..., index] = (run(there) - here) / (there[index] - at[index])
        except SimulationError:
            continue
    return out


def _prior_root(spans: Sequence[Range], scale: float) -> FloatArray:
    """Root of the coefficients' covariance τ²K: smooth along each argument, none between them."""
    places = np.linspace(0.0, 1.0, NODES)
    smooth = np.exp(-0.5 * (np.subtract.outer(places, places) / LENGTH) ** 2) + 1e-4 * np.eye(NODES)
    return np.asarray(scale * np.kron(np.eye(len(spans)), np.linalg.cholesky(smooth)), dtype=np.float64)


def _read(fit: _Fit, spans: Sequence[Range], states: States, after: Omnibus, gone: float) -> StrengthReading:
    """Choose arguments and τ by their evidence, and tell the shapes."""
    # Where more than noise is left even so, the noise is taken to be that much larger (Birge 1932).
    noise = max(1.0, after.dispersion)
    left, triangle = np.linalg.qr(fit.white)
    data = left.T @ fit.target

    def loglik(chosen: Sequence[int], scale: float) -> float:
        cover = _covered(fit, spans, chosen, scale)
        covariance = noise * np.eye(len(data)) + triangle @ cover @ triangle.T
        _, logdet = np.linalg.slogdet(covariance)
        return float(-0.5 * (data @ np.linalg.solve(covariance, data) + logdet))

    count = len(spans)
    subsets = [c for size in range(count + 1) for c in itertools.combinations(range(count), size)]
    # A subset's evidence is its mean over τ.
    table = {c: _logmean([loglik(c, scale) for scale in SCALES]) for c in subsets}
    best = max(table, key=lambda c: table[c])
    scale = max(SCALES, key=lambda s: loglik(best or tuple(range(count)), s))
    shapes = []
    for index, span in enumerate(spans):
        # An argument that isn't needed is shown beside those that are: its band says what could be hidden.
        cover = _covered(fit, spans, sorted({*best, index}), scale)
        gain = cover @ triangle.T @ np.linalg.inv(noise * np.eye(len(data)) + triangle @ cover @ triangle.T)
        mean, posterior = gain @ data, cover - gain @ triangle @ cover
        with_it = max(v for c, v in table.items() if index in c)
        without = max(v for c, v in table.items() if index not in c)
        part = slice(fit.model + index * NODES, fit.model + (index + 1) * NODES)
        needed = index in best and gone >= FEW
        shapes.append(_shape(span, states, mean[part], posterior[part, part], with_it - without, needed))
    held = {n: float(v) for n, v in zip(fit.names[: fit.model], fit.values[: fit.model], strict=True)}
    return StrengthReading(tuple(shapes), after, gone, held, scale)


def _covered(fit: _Fit, spans: Sequence[Range], chosen: Sequence[int], scale: float) -> FloatArray:
    """Prior covariance of all unknowns with some arguments on."""
    cover = np.zeros((len(fit.prior), len(fit.prior)))
    cover[: fit.model, : fit.model] = np.diag(fit.prior[: fit.model] ** 2)
    root = _prior_root(spans, scale)
    whole = root @ root.T
    for index in chosen:
        mine = slice(index * NODES, (index + 1) * NODES)
        place = slice(fit.model + index * NODES, fit.model + (index + 1) * NODES)
        cover[place, place] = whole[mine, mine]
    return cover


def _shape(span: Range, states: States, mean: FloatArray, covariance: FloatArray, odds: float, needed: bool) -> Shape:
    """A curve relative to its mean over the states visited, with its band, and what it looks like."""
    places = np.linspace(span.low, span.high, POINTS)
    level = states.weight @ hats(span, coordinates(states)[span.argument])
    rows = hats(span, places) - level[None]
    middle = rows @ mean
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", rows, covariance, rows), 0.0))
    ends = rows[-1] - rows[0]
    change, spread = float(ends @ mean), float(math.sqrt(max(float(ends @ covariance @ ends), 0.0)))
    clear = needed and odds > NEEDED and abs(change) > CLEAR * spread
    word = WORDS[span.argument, 1 if change > 0.0 else -1] if clear else ""
    at = places if span.argument == "plastic strain" else np.exp(places)
    return Shape(
        span.argument,
        at,
        np.exp(middle),
        np.exp(middle - 1.645 * std),
        np.exp(middle + 1.645 * std),
        change,
        spread,
        odds,
        word,
    )


def _logmean(values: Sequence[float]) -> float:
    top = max(values)
    return top + math.log(sum(math.exp(v - top) for v in values) / len(values))
