"""What observation and prediction differ by with nothing wrong, along the few directions in which any model acts.

Squares of pictures are projected on the leading modes of all simulations (principal components whose variance is well
above chance's); instruments without a place (forces, stresses) are kept as they are. Noise in these scores has parts:

========== ============================================================================================================
instruments from still frames; stated for the others
chance      what base simulations with particles of their own scatter by about their trend, shrunk towards its diagonal
            (Ledoit & Wolf 2004, J. Multivariate Anal. 88:365)
guesses     colours that no photograph shows, other drawings of the same simulation
nuisances   effects of observation in their smallest meaningful sizes
numerics    the model's own error: so many times all of the above as pairs of coarse and fine runs say; for instruments
            without a place a size for each stage, moderated by the others' (Smyth 2004). Its factors, one for pictures
            and one for forces, are unknown and integrated over. Without pairs it lies along what soil could do
            otherwise (all simulations)
========== ============================================================================================================

Fine runs also correct coarse ones (Kennedy & O'Hagan 2000, Biometrika 87:1): their mean difference, as far as it stands
above chance, is taken off the observation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.special import digamma, logsumexp, polygamma

from splatsoil.experiment.base import Candidate, Experiment

from .design import Prior, Run

FloatArray = npt.NDArray[np.float64]

ABOVE_CHANCE = 4.0
"""Variance of a mode over chance's from which it is kept: twice its standard deviation."""
MOST_MODES = 40
REMAINING = 1.3
"""What a fine run's own error is expected to be over the difference of coarse and fine: 2 for an error of first order
in the cell and cells of 1 and 1.5, 0.8 for second order (Roache 1994); the geometric mean."""
DOUBT = 0.5
"""Standard deviation of the logarithm of that factor, which holds both orders."""
UNMEASURED, NO_PAIRS = 0.2, 1.0
"""Numerics, over what soil could do otherwise (every effect's simulations about the trend, and the base model's about
their mean), and the deviation of its logarithm, where there are no pairs."""
STEPS = np.array(list(product(range(6), range(6))))
"""(f, 2) standard deviations by which the logarithms of both factors of the numerics, of placed instruments and of
others, exceed what is expected. None is less: that most features agree is no proof that the one which counts does."""
FACTORS = np.exp(DOUBT * STEPS)
"""(f, 2) factors that are integrated over."""
SOMETHING_ELSE = 2.0
"""Standard deviations above the expected factor from which the model's own error is more than numerics."""
STAGE, CHANNEL = 0.9, 0.5
"""Correlation of an unplaced instrument's numerics within a stage, and between two of one unit there."""


@dataclass(frozen=True)
class Tables:
    """Simulations (m, t, s) by what they were made for.

    Attributes:
        base: of the model as it is.
        fine: pairs' fine ones.
        effects: by effect.
        drawn: one base simulation reported or drawn otherwise, by guess or parameter.
        reference: (t, s) that one, as usual.
    """

    base: tuple[Sequence[Run], FloatArray]
    fine: tuple[Sequence[Run], FloatArray]
    effects: Mapping[str, tuple[Sequence[Run], FloatArray]]
    drawn: Mapping[str, FloatArray]
    reference: FloatArray


@dataclass(frozen=True)
class Noise:
    """Scores and their noise.

    Attributes:
        mask: (t, s) features that are compared.
        mean: (n,) of them, taken off before they are projected.
        basis: (n, p).
        observed: (p,) scores, corrected for the cell.
        correction: (p,) what is taken off for it.
        base: (m, p) scores of the base simulations.
        points: (m, k) of these.
        chance: (p, p) covariance of one simulation's own.
        fixed: (p, p) covariance of all parts but numerics.
        numerics: (p, p) that of numerics of factors 1.
        placed: (p,) scores of instruments that have a place.
        share: numerics of factor 1 over the other parts, for these; without pairs, over what soil could do otherwise.
        factor_std: standard deviation of the logarithm of the numerics' factor.
        patterns: (k, p) what each observation effect does in its smallest meaningful sizes, by name.
        trend: (m, m) projector on the base simulations' trend.
    """

    mask: npt.NDArray[np.bool_]
    mean: FloatArray
    basis: FloatArray
    observed: FloatArray
    correction: FloatArray
    base: FloatArray
    points: FloatArray
    chance: FloatArray
    fixed: FloatArray
    numerics: FloatArray
    placed: npt.NDArray[np.bool_]
    share: float
    factor_std: float
    patterns: Mapping[str, FloatArray]
    trend: FloatArray

    def scores(self, tables: FloatArray) -> FloatArray:
        """(m, p) of tables (m, t, s)."""
        return np.asarray((tables[:, self.mask] - self.mean) @ self.basis)

    @property
    def cell(self) -> FloatArray:
        """(t, s) what finer cells add to a prediction."""
        out = np.zeros(self.mask.shape)
        out[self.mask] = self.basis @ self.correction
        return out

    def covariance(self, factors: npt.ArrayLike) -> FloatArray:
        """(p, p) with numerics of factors (2,), that of placed instruments and that of others, or of one for both."""
        size = np.where(self.placed, *np.broadcast_to(np.asarray(factors, dtype=np.float64), 2))
        return self.fixed + np.outer(size, size) * self.numerics

    @property
    def expected(self) -> FloatArray:
        """(f,) logarithms of the probability of each of `FACTORS`, if nothing is wrong."""
        return self._probability(np.zeros(FACTORS.shape, dtype=bool))

    @property
    def beyond(self) -> FloatArray:
        """(f,) the same where one of the factors at least is more than numerics: any such one is as probable."""
        large = np.log(FACTORS) >= SOMETHING_ELSE * self.factor_std - 1e-9
        density = np.where(large.any(axis=1), self._probability(large), -np.inf)
        return np.asarray(density - logsumexp(density))

    def _probability(self, free: npt.NDArray[np.bool_]) -> FloatArray:
        density = np.sum(np.where(free, 0.0, -0.5 * (np.log(FACTORS) / self.factor_std) ** 2), axis=1)
        return np.asarray(density - logsumexp(density))


def noise_of(
    experiment: Experiment,
    prior: Prior,
    tables: Tables,
    candidates: Sequence[Candidate],
    aside: npt.NDArray[np.bool_] | None = None,
) -> Noise:
    """Projection and noise.

    Args:
        experiment: whose features these are.
        prior: of the base model.
        tables: the simulations.
        candidates: effects, of which those of observation are nuisances.
        aside: (t, s) features to leave out.
    """
    mask = compared(experiment) if aside is None else compared(experiment) & ~aside
    placed = np.broadcast_to(experiment.layout.placed, mask.shape)[mask]
    (base_runs, base), (fine_runs, fine) = tables.base, tables.fine
    points = prior.unit(base_runs)
    varied = np.concatenate([base, *(found for _, found in tables.effects.values())])[:, mask]
    mean = varied.mean(axis=0)
    hat = trend_of(points, points)
    rest = (base[:, mask] - hat @ base[:, mask]) / np.sqrt(np.maximum(1.0 - np.diag(hat), 1e-9))[:, None]
    basis = _modes(varied - mean, rest, placed)
    count = basis.shape[1]
    in_place = np.arange(count) < count - int((~placed).sum())
    both = np.outer(in_place, in_place)

    def scored(found: FloatArray) -> FloatArray:
        return np.asarray((found[..., mask] - mean) @ basis)

    def apart(runs: Sequence[Run], found: FloatArray) -> FloatArray:
        """Scores about the base simulations' trend."""
        return np.asarray(scored(found) - trend_of(prior.unit(runs), points) @ own)

    own = scored(base)
    chance = shrunk(rest @ basis) if experiment.chance else np.zeros((count, count))
    drawn = {name: scored(table) - scored(tables.reference) for name, table in tables.drawn.items()}
    patterns = {
        c.name: np.array([drawn[p.name] for p in c.parameters if p.name in drawn])
        for c in candidates
        if c.kind == "observation" and any(p.name in drawn for p in c.parameters)
    }
    rows = drawings(experiment, tables, candidates)[:, mask] @ basis
    fixed = chance + _instruments(experiment, mask, basis) + rows.T @ rows
    if len(fine_runs):
        pairs = apart(fine_runs, fine)
        # of a fine run, and of the trend there; its covariance is estimated: the mean of an F-distribution
        free = len(own) - np.trace(hat)
        scatter = chance * (1.0 + np.sum(trend_of(prior.unit(fine_runs), points) ** 2) / len(pairs))
        scatter *= free / max(free - 2.0, 1.0)
        share = _share(pairs[:, in_place], *(c[np.ix_(in_place, in_place)] for c in (fixed, scatter)))
        numerics = np.where(both, share**2 * fixed, 0.0)
        difference = np.where(in_place, pairs.mean(axis=0), 0.0)
        of_mean = numerics + scatter / len(pairs) + 1e-9 * np.eye(count)
        correction = np.where(in_place, numerics @ np.linalg.solve(of_mean, difference), 0.0)
        numerics = REMAINING**2 * (numerics + _of_unplaced(experiment, mask, pairs, in_place))
        share, factor_std = REMAINING * share, DOUBT
    else:
        varied_by = [apart(*made) for made in tables.effects.values()] + [own - own.mean(axis=0)]
        otherwise = _positive(sum(e.T @ e / len(e) for e in varied_by) / len(varied_by) - chance)
        correction, share, factor_std = np.zeros(count), UNMEASURED, NO_PAIRS
        numerics = share**2 * otherwise
    return Noise(
        mask=mask,
        mean=mean,
        basis=basis,
        observed=scored(experiment.observed) - correction,
        correction=correction,
        base=own,
        points=points,
        chance=chance,
        fixed=fixed,
        numerics=numerics,
        placed=in_place,
        share=share,
        factor_std=factor_std,
        patterns=patterns,
        trend=hat,
    )


def drawings(experiment: Experiment, tables: Tables, candidates: Sequence[Candidate]) -> FloatArray:
    """(k, t, s) what one simulation reported or drawn otherwise differs by: independent parts of the noise."""
    apart = {name: table - tables.reference for name, table in tables.drawn.items()}
    guessed = [apart[name] for name in experiment.guesses if name in apart]
    named = [p.name for c in candidates if c.kind == "observation" for p in c.parameters]
    rows = [guess / np.sqrt(len(guessed)) for guess in guessed]
    rows += [apart[name] for name in (*experiment.redrawn, *named) if name in apart]
    return np.array(rows).reshape(-1, *experiment.layout.shape)


def compared(experiment: Experiment) -> npt.NDArray[np.bool_]:
    """(t, s) features that are compared: all that are seen where something can move."""
    return np.asarray(experiment.seen & ~experiment.quiet)


def trend_of(where: FloatArray, points: FloatArray) -> FloatArray:
    """(q, m) weights that make the trend at points (q, n) of values at points (m, n): cubic in one parameter, quadratic
    in several, as far as the points allow (ridge)."""

    def terms(x: FloatArray) -> FloatArray:
        columns = [np.ones(len(x)), *x.T, *(x.T**2)]
        if x.shape[1] == 1:
            columns.append(x[:, 0] ** 3)
        columns += [x[:, i] * x[:, j] for i in range(x.shape[1]) for j in range(i)]
        return np.stack(columns, axis=1)

    inner = terms(points)
    return np.asarray(terms(where) @ np.linalg.solve(inner.T @ inner + 1e-6 * np.eye(inner.shape[1]), inner.T))


def shrunk(rows: FloatArray) -> FloatArray:
    """(p, p) covariance of rows (m, p) of mean 0, shrunk towards its diagonal by the amount that is best on average
    (Ledoit & Wolf 2004; Schäfer & Strimmer 2005, Stat. Appl. Genet. Mol. Biol. 4:32)."""
    m = len(rows)
    products = rows[:, :, None] * rows[:, None, :]
    covariance = products.mean(axis=0)
    spread = products.var(axis=0).sum() - np.trace(products.var(axis=0))
    between = np.sum(covariance**2) - np.sum(np.diag(covariance) ** 2)
    share = float(np.clip(spread / max(m - 1, 1) / max(between, 1e-300), 0.0, 1.0))
    return np.asarray((1.0 - share) * covariance + share * np.diag(np.diag(covariance)))


def moderated(variances: FloatArray, freedom: int) -> FloatArray:
    """(k,) sample variances of so many degrees of freedom each, drawn towards what they have in common as far as chance
    alone explains that they differ (empirical Bayes: Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3:3, section 6.2)."""
    half = 0.5 * freedom
    logs = np.log(np.maximum(variances, 1e-12)) - digamma(half) + np.log(half)
    beyond = float(np.var(logs, ddof=1) - polygamma(1, half)) if len(logs) > 1 else 0.0
    if beyond <= 0.0:
        return np.full(len(logs), np.exp(logs.mean()))
    prior = float(brentq(lambda x: polygamma(1, x) - beyond, 1e-6, 1e6))
    common = np.exp(logs.mean() + digamma(prior) - np.log(prior))
    return np.asarray((prior * common + half * variances) / (prior + half))


def _modes(varied: FloatArray, rest: FloatArray, placed: npt.NDArray[np.bool_]) -> FloatArray:
    """(n, p) leading modes of placed features, beside them the unplaced ones themselves."""
    n, columns = varied.shape[1], []
    if placed.any():
        _, _, right = np.linalg.svd(varied[:, placed], full_matrices=False)
        right = right[:MOST_MODES]
        of_all = np.var(varied[:, placed] @ right.T, axis=0)
        of_chance = np.mean((rest[:, placed] @ right.T) ** 2, axis=0)
        kept = of_all > ABOVE_CHANCE * np.maximum(of_chance, 1e-12)
        kept[0] = True
        modes = np.zeros((n, int(kept.sum())))
        modes[placed] = right[kept].T
        columns.append(modes)
    columns.append(np.eye(n)[:, ~placed])
    return np.concatenate(columns, axis=1)


def _share(apart: FloatArray, noise: FloatArray, scatter: FloatArray) -> float:
    """Size of what fine and coarse runs (m, p) differ by beyond their scatter, over noise, both covariances (p, p)."""
    if not apart.shape[1]:
        return 0.0
    root = np.linalg.cholesky(noise + 1e-9 * np.eye(len(noise)))
    white = solve_triangular(root, apart.T, lower=True)
    by_chance = np.trace(solve_triangular(root, solve_triangular(root, scatter, lower=True).T, lower=True))
    return float(np.sqrt(max(np.mean(white**2) - by_chance / len(root), 0.0)))


def _of_unplaced(
    experiment: Experiment, mask: npt.NDArray[np.bool_], pairs: FloatArray, in_place: npt.NDArray[np.bool_]
) -> FloatArray:
    """(p, p) numerics of instruments without a place, one size for each channel and stage.

    Few pairs say little of a size: that they agree in one stage is often luck. So sizes are moderated by each other.
    """
    out = np.zeros((len(in_place),) * 2)
    layout = experiment.layout
    there = np.argwhere(mask & ~layout.placed)
    if not len(there):
        return out
    stages = np.array(layout.stages)[there[:, 0]]
    channels, units = (np.array([(s.channel, s.unit) for s in layout.sites])[there[:, 1]]).T
    own = pairs[:, ~in_place]
    blocks = [(stages == s) & (channels == c) for s, c in sorted(set(zip(stages, channels, strict=True)))]
    sizes = moderated(np.array([np.mean(own[:, block] ** 2) for block in blocks]), len(pairs))
    spread = np.sqrt(np.sum(sizes[:, None] * blocks, axis=0))
    alike = np.where(channels[:, None] == channels[None], STAGE, CHANNEL) * (stages[:, None] == stages[None])
    alike *= units[:, None] == units[None]
    np.fill_diagonal(alike, 1.0)
    out[np.ix_(~in_place, ~in_place)] = alike * np.outer(spread, spread)
    return out


def _instruments(experiment: Experiment, mask: npt.NDArray[np.bool_], basis: FloatArray) -> FloatArray:
    """(p, p) covariance of what instruments add; neighbouring times of a site are correlated by the sensor's memory."""
    std = experiment.sensor[mask]
    if experiment.sensor_memory == 0.0:
        scaled = std[:, None] * basis
        return np.asarray(scaled.T @ scaled)
    rows, sites = np.nonzero(mask)
    alike = experiment.sensor_memory ** np.abs(rows[:, None] - rows[None]) * (sites[:, None] == sites[None])
    return np.asarray(basis.T @ (alike * np.outer(std, std)) @ basis)


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix."""
    size, modes = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((modes * np.maximum(size, 0.0)) @ modes.T)
