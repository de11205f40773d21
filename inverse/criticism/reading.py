"""What all simulations with an effect on say of the parameters together.

Derivatives that a refit measures hold the chance of two simulations, which looks like information: along a valley in
which two parameters make up for each other there is little else. An emulator through all simulations that were made
knows its own doubt. So the parameters' distribution is sampled on it, further simulations are made where that says that
they may lie, and estimate and spread are what it ends with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.stats import qmc

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter, ParameterSpace

from .derivatives import around
from .evidence import Visit
from .refit import Known, Refit, half_ranges
from .surface import Surface

FloatArray = npt.NDArray[np.float64]

MOST = 4
"""Parameters, beyond which a dozen simulations make no emulator."""
TURNS, POINTS = 6, 2048
"""Boxes at most, and points in each."""
FAR, ENOUGH = 9.0, 300
"""Log density below the largest that counts as nothing; points above it that are enough."""
PRIOR = 0.5
"""Standard deviation of a parameter about its default, of an axis from -1 to 1, before anything is known: where data
leave a long valley open, its modest end is the likelier one."""
ABROAD = 0.5
"""How far outside of the simulations' range to simulate, of an axis from -1 to 1."""
ONE_STD = 0.683
"""Share of a normal distribution within a standard deviation."""
DRAWS = 500
"""Kept of the points."""
BATCHES, FEWEST, TOGETHER = 4, 3, 4
"""Simulations where the parameters may lie: so many times at most and at least, so many."""
UNKNOWN = 0.1
"""Share of what is possible that may lie where too little was simulated."""


@dataclass(frozen=True)
class Reading:
    """Parameters by all simulations.

    Attributes:
        values: where χ² is expected to be least, by name.
        stds: distance from these that holds 68.3 % of the draws, by name.
        draws: (k, n) of the parameters, in [-1, 1].
        unknown: (k,) True where the surface is in doubt there by more than the noise in some direction.
    """

    values: Mapping[str, float]
    stds: Mapping[str, float]
    draws: FloatArray
    unknown: npt.NDArray[np.bool_]


def explored(
    predict: Callable[[Mapping[str, float]], FloatArray],
    visits: Sequence[Visit],
    whiten: Callable[[FloatArray], FloatArray],
    observed: FloatArray,
    parameters: Sequence[Parameter],
    known: Known,
    start: Refit,
    shapes: Sequence[Parameter] = (),
    *,
    ahead: Callable[[Sequence[Mapping[str, float]]], object] = lambda points: None,
) -> Refit:
    """Simulate where the parameters may lie by what is known so far, then at the most probable ones, and go there if
    that is better by all simulations. Slopes are those of the surface where the refit then stands.

    Args:
        predict: (t, s) features by parameters; adds a visit.
        visits: see :func:`read`, like the next four.
        whiten: only what the choice may see.
        observed: (t, s).
        parameters: free ones.
        known: what other measurements say of them.
        start: a refit of them, and what is returned where nothing changes the features.
        shapes: those that no simulation has varied yet.
        ahead: told of several points before they are predicted one by one.
    """
    space, first, better = ParameterSpace(parameters), len(visits), start

    def visit(points: Sequence[Mapping[str, float]]) -> None:
        ahead(points)
        for values in points:
            # Where nothing can be simulated nothing is learned.
            with suppress(SimulationError):
                predict(values)

    visit([{**start.values, p.name: end} for p in shapes for end in around(p, float(start.values[p.name]))])
    try:
        for batch in range(BATCHES):
            found = read(visits, whiten, observed, parameters, known, seed=batch, bold=True)
            if batch >= FEWEST and np.mean(found.unknown) < UNKNOWN:
                break
            # What isn't known first.
            draws = found.draws[np.argsort(~found.unknown, kind="stable")][:TOGETHER]
            visit([space.to_dict(space.from_unit(draw)) for draw in draws])
        values = read(visits, whiten, observed, parameters, known, seed=BATCHES).values
        with suppress(SimulationError):
            table = predict(values)
            # Not by the two simulations: the luckier one of many would win.
            here, there = (space.to_unit(space.to_vector(at)) for at in (start.values, values))
            belief = _Belief.of(visits, whiten, observed, parameters, known)
            before, after = belief.expected_chi2(np.stack([here, there]))
            if after <= before:
                chi2 = float(np.sum(whiten(observed - table) ** 2) + known.chi2(space.to_vector(values)))
                better = replace(start, values=values, chi2=chi2, prediction=table)
        slopes = tangent(visits, whiten, parameters, better.values)
    except ValueError:
        return start
    return replace(better, simulations=start.simulations + len(visits) - first, slopes=slopes)


def tangent(
    visits: Sequence[Visit],
    whiten: Callable[[FloatArray], FloatArray],
    parameters: Sequence[Parameter],
    values: Mapping[str, float],
) -> FloatArray:
    """(t, s, k) derivatives by the parameters at some values, of the surface through all simulations.

    Raises:
        ValueError: see :func:`read`.
    """
    space, surface = ParameterSpace(parameters), _surface(visits, whiten, parameters)
    tables = np.stack([visit.table for visit in visits])
    # The surface has seen its few directions of the whitened features alone. What these are in tables, those that were
    # simulated tell.
    patterns = surface.patterns(tables)
    slopes = np.tensordot(surface.slopes(space.to_unit(space.to_vector(values))), patterns, axes=1)
    return np.moveaxis(slopes, 0, -1) / half_ranges(parameters, values)


def read(
    visits: Sequence[Visit],
    whiten: Callable[[FloatArray], FloatArray],
    observed: FloatArray,
    parameters: Sequence[Parameter],
    known: Known,
    *,
    seed: int = 0,
    bold: bool = False,
) -> Reading:
    """Sample the parameters.

    Args:
        visits: simulations, three at least; parameters that they lack are at their off value or default.
        whiten: a (t, s) table to independent features (d,) of variance 1.
        observed: (t, s).
        parameters: asked for, four at most.
        known: what other measurements say of them.
        seed: of the draws.
        bold: look outside of the simulations' range, too: to find out where to simulate.

    Raises:
        ValueError: too few simulations, or the features are the same wherever they were made.
    """
    belief = _Belief.of(visits, whiten, observed, parameters, known)
    space, surface = belief.space, belief.surface
    # Far from all simulations the surface falls back to its parabola, which says little.
    beyond = ABROAD if bold else 0.0
    points = surface.points
    low, high = np.maximum(points.min(axis=0) - beyond, -1.0), np.minimum(points.max(axis=0) + beyond, 1.0)
    draws = _sample(belief.log_density, low, high, seed)
    values = space.from_unit(belief.best(np.concatenate([draws, points]), low, high))
    # A root mean square would be ruled by the few draws in a gap between simulations.
    spread = np.quantile(np.abs(space.from_unit(draws) - values), ONE_STD, axis=0)
    unknown = np.any(surface.predict(draws)[1] > belief.wide, axis=1)
    return Reading(space.to_dict(values), dict(zip(space.names, map(float, spread), strict=True)), draws, unknown)


@dataclass(frozen=True)
class _Belief:
    """What all simulations say of the parameters, points (q, n) in [-1, 1].

    Attributes:
        space: of the parameters.
        surface: through the simulations.
        scores: (p,) the observation along the surface's directions.
        wide: variance of an independent feature, 1 unless more than noise lies where no parameter reaches, or is left
            by the best of the simulations.
        known: what other measurements say.
        home: (n,) the defaults.
    """

    space: ParameterSpace
    surface: Surface
    scores: FloatArray
    wide: float
    known: Known
    home: FloatArray

    @classmethod
    def of(
        cls,
        visits: Sequence[Visit],
        whiten: Callable[[FloatArray], FloatArray],
        observed: FloatArray,
        parameters: Sequence[Parameter],
        known: Known,
    ) -> _Belief:
        """See :func:`read`."""
        space, surface, target = ParameterSpace(parameters), _surface(visits, whiten, parameters), whiten(observed)
        outside, scores = surface.remainder(target), surface.project(target)
        wide = max(1.0, float(outside @ outside) / max(len(target) - len(scores), 1))
        home = space.to_unit(space.to_vector({p.name: p.default for p in parameters}))
        belief = cls(space, surface, scores, wide, known, home)
        # What parameters don't mend where they are best would else lie, for all that is known, where nothing is.
        points = surface.points
        best = belief.best(points, points.min(axis=0), points.max(axis=0))
        left = scores - surface.predict(best[None])[0][0]
        return replace(belief, wide=max(wide, float(left @ left) / len(left)))

    def best(self, starts: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """(n,) within bounds where χ² is expected to be least, downhill from the best of some points."""
        start = starts[np.argmin(self.expected_chi2(starts))]
        bounds = list(zip(low, high, strict=True))
        found = minimize(lambda x: float(self.expected_chi2(x[None])[0]), start, bounds=bounds)
        return np.clip(found.x, low, high)

    def log_density(self, where: FloatArray) -> FloatArray:
        """(q,) up to a constant."""
        mean, variance = self.surface.predict(where)
        total = self.wide + variance
        misfit = np.sum((self.scores - mean) ** 2 / total + np.log(total), axis=1)
        return -0.5 * np.asarray(misfit + self._beforehand(where))

    def expected_chi2(self, where: FloatArray) -> FloatArray:
        """(q,) over the surface's doubt, which makes a place possible, and a poor choice."""
        mean, variance = self.surface.predict(where)
        return np.asarray(np.sum((self.scores - mean) ** 2 + variance, axis=1) / self.wide + self._beforehand(where))

    def _beforehand(self, where: FloatArray) -> FloatArray:
        measured = (self.space.from_unit(where) - self.known.centre) @ self.known.root.T
        return np.asarray(np.sum(measured**2, axis=1) + np.sum(((where - self.home) / PRIOR) ** 2, axis=1))


def _surface(
    visits: Sequence[Visit], whiten: Callable[[FloatArray], FloatArray], parameters: Sequence[Parameter]
) -> Surface:
    """Through all simulations."""
    space = ParameterSpace(parameters)
    rest = {p.name: p.off if p.off is not None else p.default for p in parameters}
    points = np.stack([space.to_unit(space.to_vector({n: {**rest, **v.values}[n] for n in rest})) for v in visits])
    return Surface.through(points, np.stack([whiten(v.table) for v in visits]), [v.seed for v in visits])


def _sample(
    log_density: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, seed: int
) -> FloatArray:
    """Draws (k, n) in a box, by importance in boxes that close in."""
    for turn in range(TURNS):
        cube = qmc.Sobol(len(low), rng=np.random.default_rng([seed, turn])).random(POINTS)
        points = low + cube * (high - low)
        logs = log_density(points)
        near = points[logs > logs.max() - FAR]
        if len(near) > ENOUGH:
            break
        margin = 0.1 * (high - low)
        low, high = np.maximum(near.min(axis=0) - margin, low), np.minimum(near.max(axis=0) + margin, high)
    weights = np.exp(logs - logs.max())
    chosen = np.random.default_rng([seed, TURNS]).choice(len(points), DRAWS, p=weights / weights.sum())
    return np.asarray(points[chosen])
