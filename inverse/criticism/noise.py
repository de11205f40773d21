"""The noise model: covariance of observation minus prediction for a correct model, in a low-dimensional projection.

Pictures are projected on the leading principal components of all simulations, those whose variance is well above the
seed-to-seed scatter. Instruments without a place (forces, stresses) keep their features. The covariance of these scores
is a sum of independent parts:

================== ====================================================================================================
instruments        frames before the tool moves; stated for the others
scatter            residuals of base simulations with different seeds about their trend; the covariance is shrunk
                   towards its diagonal (Ledoit & Wolf 2004, J. Multivariate Anal. 88:365)
unknown albedo     random draws of the colour of buried soil
observation        effects of observation, each at its smallest meaningful size
discretisation     pictures: a multiple of all parts above, measured on pairs of coarse and fine simulations;
                   instruments without a place: one variance for each stage, moderated by the others (Smyth 2004). Two
                   unknown factors, one for pictures and one for forces, are integrated over. Without pairs, it lies
                   along what the parameters of all models can change
================== ====================================================================================================

Fine simulations also correct coarse ones (Kennedy & O'Hagan 2000, Biometrika 87:1): their mean difference, shrunk by
its own uncertainty, is subtracted from the observation.
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

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.base import Candidate, Experiment, Run

from .design import Prior

MIN_VARIANCE_RATIO = 4.0
"""A component is kept if its variance exceeds the scatter's by this factor: twice its standard deviation."""
MAX_COMPONENTS = 40
FINE_ERROR_RATIO = 1.3
"""Error of a fine simulation over the difference of coarse and fine: for cells of 1 and 1.5, it is 2 for a method of
first order and 0.8 for second order (Roache 1994). The value is the geometric mean."""
FINE_ERROR_LOG_STD = 0.5
"""Standard deviation of the logarithm of that ratio, which covers both orders."""
UNPAIRED_RATIO, UNPAIRED_LOG_STD = 0.2, 1.0
"""Without pairs: discretisation error over the scatter of all simulations about the base model's trend, and the
standard deviation of its logarithm."""
LOG_FACTOR_STEPS = np.array(list(product(range(6), range(6))))
"""(f, 2) logarithms of both factors of the discretisation error, in standard deviations. None is negative: agreement of
most features does not show that the decisive one agrees."""
FACTORS = np.exp(FINE_ERROR_LOG_STD * LOG_FACTOR_STEPS)
"""(f, 2) values of both factors on which they are integrated: of instruments with a place, and of the others."""
DISCREPANCY_STDS = 2.0
"""From this many standard deviations on, a factor is a model discrepancy."""
STAGE_CORRELATION, CHANNEL_CORRELATION = 0.9, 0.5
"""Correlation of an unplaced instrument's discretisation error within a stage, and between two of one unit there."""


@dataclass(frozen=True)
class Tables:
    """Feature tables (m, t, s) of simulations.

    Attributes:
        base: of the base model.
        fine: of the base model with fine cells.
        effects: by effect.
        variants: (t, s) the reference simulation in another variant or with an effect of observation, by name.
        reference: (t, s) one simulation of the base model.
    """

    base: tuple[Sequence[Run], FloatArray]
    fine: tuple[Sequence[Run], FloatArray]
    effects: Mapping[str, tuple[Sequence[Run], FloatArray]]
    variants: Mapping[str, FloatArray]
    reference: FloatArray


@dataclass(frozen=True)
class Noise:
    """Scores and their noise model.

    Attributes:
        mask: (t, s) features that are compared.
        mean: (n,) of them, subtracted before the projection.
        basis: (n, p) of the projection.
        observed: (p,) scores, corrected for the cell size.
        correction: (p,) mean difference of fine and coarse simulations.
        base: (m, p) scores of the base simulations.
        points: (m, k) their parameters in [-1, 1].
        scatter: (p, p) covariance between simulations with different seeds.
        fixed: (p, p) covariance of all parts but the discretisation error.
        discretisation: (p, p) covariance of the discretisation error for factors of 1.
        placed: (p,) scores of instruments that have a place.
        ratio: standard deviation of the discretisation error over that of all other parts, for these scores.
        factor_std: standard deviation of the logarithm of a factor of the discretisation error.
        patterns: (k, p) change by each effect of observation at its smallest meaningful sizes, by name.
        trend: (m, m) projector on the trend of the base simulations.
    """

    mask: BoolArray
    mean: FloatArray
    basis: FloatArray
    observed: FloatArray
    correction: FloatArray
    base: FloatArray
    points: FloatArray
    scatter: FloatArray
    fixed: FloatArray
    discretisation: FloatArray
    placed: BoolArray
    ratio: float
    factor_std: float
    patterns: Mapping[str, FloatArray]
    trend: FloatArray

    def scores(self, tables: FloatArray) -> FloatArray:
        """(m, p) of tables (m, t, s)."""
        return np.asarray((tables[:, self.mask] - self.mean) @ self.basis)

    @property
    def cell_correction(self) -> FloatArray:
        """(t, s) features of fine cells minus those of coarse cells."""
        out = np.zeros(self.mask.shape)
        out[self.mask] = self.basis @ self.correction
        return out

    def covariance(self, factors: npt.ArrayLike) -> FloatArray:
        """(p, p) for factors (2,) of the discretisation error, of placed instruments and of others, or one for both."""
        size = np.where(self.placed, *np.broadcast_to(np.asarray(factors, dtype=np.float64), 2))
        return self.fixed + np.outer(size, size) * self.discretisation

    @property
    def log_prior(self) -> FloatArray:
        """(f,) log prior probability of each of `FACTORS` for a correct model."""
        return self._log_prior(np.zeros(FACTORS.shape, dtype=bool))

    @property
    def log_prior_discrepancy(self) -> FloatArray:
        """(f,) the same for the model with a discrepancy: one factor at least is large; large ones are equally
        probable."""
        large = np.log(FACTORS) >= DISCREPANCY_STDS * self.factor_std - 1e-9
        density = np.where(large.any(axis=1), self._log_prior(large), -np.inf)
        return np.asarray(density - logsumexp(density))

    def _log_prior(self, flat: BoolArray) -> FloatArray:
        density = np.sum(np.where(flat, 0.0, -0.5 * (np.log(FACTORS) / self.factor_std) ** 2), axis=1)
        return np.asarray(density - logsumexp(density))


def noise_of(
    experiment: Experiment,
    prior: Prior,
    tables: Tables,
    candidates: Sequence[Candidate],
    held_out: BoolArray | None = None,
) -> Noise:
    """Projection and noise model.

    Args:
        experiment: whose features these are.
        prior: of the base model.
        tables: the simulations.
        candidates: effects; those of observation are nuisances.
        held_out: (t, s) features to leave out.
    """
    mask = compared(experiment) if held_out is None else compared(experiment) & ~held_out
    placed = np.broadcast_to(experiment.layout.placed, mask.shape)[mask]
    (base_runs, base), (fine_runs, fine) = tables.base, tables.fine
    points = prior.unit(base_runs)
    varied = np.concatenate([base, *(table for _, table in tables.effects.values())])[:, mask]
    mean = varied.mean(axis=0)
    hat = trend_of(points, points)
    rest = (base[:, mask] - hat @ base[:, mask]) / np.sqrt(np.maximum(1.0 - np.diag(hat), 1e-9))[:, None]
    basis = _principal_components(varied - mean, rest, placed)
    count = basis.shape[1]
    in_place = np.arange(count) < count - int((~placed).sum())
    both = np.outer(in_place, in_place)

    def scores(table: FloatArray) -> FloatArray:
        return np.asarray((table[..., mask] - mean) @ basis)

    def about_trend(runs: Sequence[Run], table: FloatArray) -> FloatArray:
        """Scores minus the trend of the base simulations."""
        return np.asarray(scores(table) - trend_of(prior.unit(runs), points) @ own)

    own = scores(base)
    scatter = shrunk(rest @ basis) if experiment.stochastic else np.zeros((count, count))
    changes = {name: scores(table) - scores(tables.reference) for name, table in tables.variants.items()}
    patterns = {
        c.name: np.array([changes[p.name] for p in c.parameters if p.name in changes])
        for c in candidates
        if c.kind == "observation" and any(p.name in changes for p in c.parameters)
    }
    rows = nuisances(experiment, tables, candidates)[:, mask] @ basis
    fixed = scatter + _instruments(experiment, mask, basis) + rows.T @ rows
    if len(fine_runs):
        pairs = about_trend(fine_runs, fine)
        # Scatter of a fine simulation and of the trend; estimated, hence the mean of an F-distribution.
        free = len(own) - np.trace(hat)
        pair_scatter = scatter * (1.0 + np.sum(trend_of(prior.unit(fine_runs), points) ** 2) / len(pairs))
        pair_scatter *= free / max(free - 2.0, 1.0)
        ratio = _excess_ratio(pairs[:, in_place], *(c[np.ix_(in_place, in_place)] for c in (fixed, pair_scatter)))
        discretisation = np.where(both, ratio**2 * fixed, 0.0)
        difference = np.where(in_place, pairs.mean(axis=0), 0.0)
        of_mean = discretisation + pair_scatter / len(pairs) + 1e-9 * np.eye(count)
        correction = np.where(in_place, discretisation @ np.linalg.solve(of_mean, difference), 0.0)
        discretisation = FINE_ERROR_RATIO**2 * (discretisation + _of_unplaced(experiment, mask, pairs, in_place))
        ratio, factor_std = FINE_ERROR_RATIO * ratio, FINE_ERROR_LOG_STD
    else:
        varied_by = [about_trend(*runs) for runs in tables.effects.values()] + [own - own.mean(axis=0)]
        reachable = _positive(sum(e.T @ e / len(e) for e in varied_by) / len(varied_by) - scatter)
        correction, ratio, factor_std = np.zeros(count), UNPAIRED_RATIO, UNPAIRED_LOG_STD
        discretisation = ratio**2 * reachable
    return Noise(
        mask=mask,
        mean=mean,
        basis=basis,
        observed=scores(experiment.observed) - correction,
        correction=correction,
        base=own,
        points=points,
        scatter=scatter,
        fixed=fixed,
        discretisation=discretisation,
        placed=in_place,
        ratio=ratio,
        factor_std=factor_std,
        patterns=patterns,
        trend=hat,
    )


def nuisances(experiment: Experiment, tables: Tables, candidates: Sequence[Candidate]) -> FloatArray:
    """(k, t, s) independent parts of the noise from variants of one simulation: unknown albedo, rendering, and effects
    of observation."""
    changes = {name: table - tables.reference for name, table in tables.variants.items()}
    albedo = [changes[name] for name in experiment.albedo_draws if name in changes]
    named = [p.name for c in candidates if c.kind == "observation" for p in c.parameters]
    rows = [change / np.sqrt(len(albedo)) for change in albedo]
    rows += [changes[name] for name in (*experiment.renderings, *named) if name in changes]
    return np.array(rows).reshape(-1, *experiment.layout.shape)


def compared(experiment: Experiment) -> BoolArray:
    """(t, s) features that are compared: all that are seen where something can move."""
    return np.asarray(experiment.seen & ~experiment.quiet)


def trend_of(where: FloatArray, points: FloatArray) -> FloatArray:
    """(q, m) weights of a polynomial regression: from values at points (m, n) to their trend at points (q, n).

    Cubic in one parameter, quadratic in several; a small ridge serves where points are too few.
    """

    def terms(x: FloatArray) -> FloatArray:
        columns = [np.ones(len(x)), *x.T, *(x.T**2)]
        if x.shape[1] == 1:
            columns.append(x[:, 0] ** 3)
        columns += [x[:, i] * x[:, j] for i in range(x.shape[1]) for j in range(i)]
        return np.stack(columns, axis=1)

    inner = terms(points)
    return np.asarray(terms(where) @ np.linalg.solve(inner.T @ inner + 1e-6 * np.eye(inner.shape[1]), inner.T))


def shrunk(rows: FloatArray) -> FloatArray:
    """(p, p) covariance of rows (m, p) of mean 0, optimally shrunk towards its diagonal (Ledoit & Wolf 2004;
    Schäfer & Strimmer 2005, Stat. Appl. Genet. Mol. Biol. 4:32)."""
    m = len(rows)
    products = rows[:, :, None] * rows[:, None, :]
    covariance = products.mean(axis=0)
    spread = products.var(axis=0).sum() - np.trace(products.var(axis=0))
    between = np.sum(covariance**2) - np.sum(np.diag(covariance) ** 2)
    share = float(np.clip(spread / max(m - 1, 1) / max(between, 1e-300), 0.0, 1.0))
    return np.asarray((1.0 - share) * covariance + share * np.diag(np.diag(covariance)))


def moderated(variances: FloatArray, freedom: int) -> FloatArray:
    """(k,) moderated variances: sample variances of so many degrees of freedom, shrunk towards their common value
    (empirical Bayes: Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3:3, section 6.2)."""
    half = 0.5 * freedom
    logs = np.log(np.maximum(variances, 1e-12)) - digamma(half) + np.log(half)
    beyond = float(np.var(logs, ddof=1) - polygamma(1, half)) if len(logs) > 1 else 0.0
    if beyond <= 0.0:
        return np.full(len(logs), np.exp(logs.mean()))
    prior = float(brentq(lambda x: polygamma(1, x) - beyond, 1e-6, 1e6))
    common = np.exp(logs.mean() + digamma(prior) - np.log(prior))
    return np.asarray((prior * common + half * variances) / (prior + half))


def _principal_components(varied: FloatArray, rest: FloatArray, placed: BoolArray) -> FloatArray:
    """(n, p) principal components of placed features, followed by the unplaced features themselves."""
    n, columns = varied.shape[1], []
    if placed.any():
        _, _, right = np.linalg.svd(varied[:, placed], full_matrices=False)
        right = right[:MAX_COMPONENTS]
        of_all = np.var(varied[:, placed] @ right.T, axis=0)
        of_scatter = np.mean((rest[:, placed] @ right.T) ** 2, axis=0)
        significant = of_all > MIN_VARIANCE_RATIO * np.maximum(of_scatter, 1e-12)
        significant[0] = True
        components = np.zeros((n, int(significant.sum())))
        components[placed] = right[significant].T
        columns.append(components)
    columns.append(np.eye(n)[:, ~placed])
    return np.concatenate(columns, axis=1)


def _excess_ratio(pairs: FloatArray, noise: FloatArray, scatter: FloatArray) -> float:
    """Root mean square of fine minus coarse (m, p) beyond their scatter, in units of the noise; covariances (p, p)."""
    if not pairs.shape[1]:
        return 0.0
    root = np.linalg.cholesky(noise + 1e-9 * np.eye(len(noise)))
    white = solve_triangular(root, pairs.T, lower=True)
    expected = np.trace(solve_triangular(root, solve_triangular(root, scatter, lower=True).T, lower=True))
    return float(np.sqrt(max(np.mean(white**2) - expected / len(root), 0.0)))


def _of_unplaced(experiment: Experiment, mask: BoolArray, pairs: FloatArray, in_place: BoolArray) -> FloatArray:
    """(p, p) covariance of the discretisation error of instruments without a place, one variance for each channel and
    stage. Few pairs estimate a variance poorly, so variances are moderated by each other."""
    out = np.zeros((len(in_place),) * 2)
    layout = experiment.layout
    there = np.argwhere(mask & ~layout.placed)
    if not len(there):
        return out
    stages = np.array(layout.stages)[there[:, 0]]
    channels, units = (np.array([(s.channel, s.unit) for s in layout.sites])[there[:, 1]]).T
    own = pairs[:, ~in_place]
    blocks = [(stages == s) & (channels == c) for s, c in sorted(set(zip(stages, channels, strict=True)))]
    variances = moderated(np.array([np.mean(own[:, block] ** 2) for block in blocks]), len(pairs))
    spread = np.sqrt(np.sum(variances[:, None] * blocks, axis=0))
    correlation = np.where(channels[:, None] == channels[None], STAGE_CORRELATION, CHANNEL_CORRELATION)
    correlation = correlation * (stages[:, None] == stages[None])
    correlation *= units[:, None] == units[None]
    np.fill_diagonal(correlation, 1.0)
    out[np.ix_(~in_place, ~in_place)] = correlation * np.outer(spread, spread)
    return out


def _instruments(experiment: Experiment, mask: BoolArray, basis: FloatArray) -> FloatArray:
    """(p, p) covariance of the instruments' noise, with the sensor's correlation between neighbouring times."""
    std = experiment.sensor[mask]
    if experiment.sensor_memory == 0.0:
        scaled = std[:, None] * basis
        return np.asarray(scaled.T @ scaled)
    rows, sites = np.nonzero(mask)
    correlation = experiment.sensor_memory ** np.abs(rows[:, None] - rows[None]) * (sites[:, None] == sites[None])
    return np.asarray(basis.T @ (correlation * np.outer(std, std)) @ basis)


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix."""
    size, modes = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((modes * np.maximum(size, 0.0)) @ modes.T)
