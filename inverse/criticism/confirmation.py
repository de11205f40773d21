"""Confirmation: the best effects refitted on part of the data, and what then remains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .estimates import bounded, prior, untried
from .evidence import Evidence, Vantage, Visit, joined
from .floor import Floor
from .misfit import Omnibus, omnibus
from .noise import Noise
from .reading import read
from .refit import Known, Refit
from .refits import Report, refitted, repeated
from .score import Scorer
from .sight import Sight
from .simulations import Simulations
from .verdicts import CLEAN, LEVEL, ruled_out

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Confirmation:
    """An effect refitted on part of the times and judged on the others.

    Attributes:
        name: of the effect; empty for the model as it is.
        fit: the refit, by which the effect is judged.
        values: the parameters by all times.
        stds: standard deviations of these.
        systematic: what of these is the model's own fault; see :mod:`.estimates`.
        chi2: of all times, against the mean of several seeds, as far as these tell of anything; see
            :class:`~splatsoil.inverse.criticism.sight.Sight`.
        freedom: numbers that this sums, but for one a parameter.
        fall: by how much that is less than the model's as it is.
        unseen: likewise, on times the refit hasn't seen alone.
        told: chance of what other pictures say of its parameters if they were off; see
            :class:`~splatsoil.experiment.base.Calibration`.
        agrees: likewise, if they were as refitted.
        held_out: root mean square of single simulations' residuals on times the refit hasn't seen, over the seeds that
            were simulated (one, where it stopped), of features in the layout's unit.
        floor: what noise alone leaves there; of soil that has the effect, where that was simulated.
        remainder: what of it stands on slow waves.
        visits: simulations that the parameters were read off; none where the last derivatives told them.
        stopped: whether the refit's first steps said that another effect explains much more, and it took no others.
    """

    name: str
    fit: Refit
    values: Mapping[str, float]
    stds: Mapping[str, float]
    systematic: Mapping[str, float]
    chi2: float
    freedom: int
    fall: float
    unseen: float
    told: float
    agrees: float
    held_out: float
    floor: float
    remainder: Omnibus
    visits: tuple[Visit, ...] = ()
    stopped: bool = False

    @property
    def dispersion(self) -> float:
        """What is left over what noise leaves, 1 at least: where no model explains the data, what is no part of any of
        them changes χ² by as much more (McCullagh and Nelder 1989, Generalized Linear Models, section 4.5)."""
        return max(1.0, self.chi2 / self.freedom)

    @property
    def ruled_out(self) -> bool:
        """Other pictures deny the size that soil asks for, and don't ask for the effect themselves."""
        return ruled_out(self.told, self.agrees)


def confirm(
    experiment: Experiment,
    evidence: Evidence,
    floor: Floor,
    chosen: Sequence[Candidate],
    simulate: Simulations,
    steps: int,
    basis: FloatArray,
    told: Report,
    vantage: Vantage | None = None,
) -> dict[str, Confirmation]:
    """Refit the model as it is, and with each chosen effect, on every other time; judge on the rest.

    ``steps`` is the number of simulations from each point where a refit starts; ``vantage`` is another such point.
    Effects that no seed of the model's own simulates where their refit ended are left out.

    Raises:
        SimulationError: the model can't be simulated where its own ended.
    """
    shown, hidden = split_times(experiment)
    whiten = Sight.of(experiment, floor, basis, vantage, shown)
    # A surface through many simulations has hardly any of one's chance, and its own doubt beside.
    through, whole = (Sight.of(experiment, floor, basis, vantage, rows, averaged=True) for rows in (shown, None))
    apart = whole if shown.all() else Sight.of(experiment, floor, basis, vantage, hidden, averaged=True)
    trials = refitted(experiment, evidence, floor, chosen, simulate, steps, told, vantage, whiten, through)
    ends = repeated(simulate, trials, len(evidence.repeats))
    if not ends[0]:
        raise SimulationError("the model can't be simulated where its refit ended")
    out: dict[str, Confirmation] = {}
    for trial, end in zip(trials, ends, strict=True):
        name, fit, visits, known, free = trial.name, trial.fit, trial.visits, trial.known, trial.free
        if name and not ends[0].keys() & end.keys():
            continue  # nothing to compare them by
        left, mask = experiment.observed - fit.prediction, judged(experiment, hidden)
        before, after = (experiment.observed - table for table in means(ends[0], end))
        apart_from = np.concatenate([floor.nuisance, reach_of(floor.single, fit.slopes)], axis=1)
        remainder = omnibus(floor.single, apart_from, left[experiment.seen], basis)
        white = whole(after)
        chi2 = float(np.sum(white**2)) + known.chi2(trial.at)
        precision = beforehand(free, fit.values, known)
        values, stds = dict(fit.values), stds_of(free, whiten(fit.slopes), precision, remainder)
        emulated: tuple[Visit, ...] = ()
        if trial.emulated:
            # A surface that isn't one tells nothing more than the last derivatives do.
            with suppress(ValueError):
                together = joined(visits, end.values())
                reading = read(together, whole, experiment.observed, free, known)
                values, stds, emulated = dict(reading.values), dict(reading.stds), together
        solvers = [experiment.reproducibility(p, values[p.name], name) for p in free]
        own = np.hypot(untried(floor, fit.slopes, precision), solvers)
        stds, systematic = widened(stds, [bounded(s, p, fit.values[p.name]) for s, p in zip(own, free, strict=True)])
        out[name] = Confirmation(
            name=name,
            fit=fit,
            values=values,
            stds=stds,
            systematic=systematic,
            chi2=chi2,
            freedom=max(white.size - len(free), 1),
            fall=_chi2(whole, before) + known.chi2(trial.off) - chi2 if name else 0.0,
            unseen=_chi2(apart, before) - _chi2(apart, after),
            told=trial.told,
            agrees=trial.agrees,
            held_out=math.sqrt(np.mean([(experiment.observed - v.table)[mask] ** 2 for v in end.values()])),
            floor=noise_on(floor.single, mask),
            remainder=remainder,
            visits=emulated,
            stopped=trial.stopped,
        )
    return out


def means(one: Mapping[int, Visit], other: Mapping[int, Visit]) -> tuple[FloatArray, FloatArray]:
    """(t, s) mean features of both over the seeds that both have: of as many, chance adds as much to either χ²."""
    shared = sorted(one.keys() & other.keys())
    both = [np.mean([visits[seed].table for seed in shared], axis=0) for visits in (one, other)]
    return both[0], both[1]


def _chi2(sight: Sight, left: FloatArray) -> float:
    return float(np.sum(sight(left) ** 2))


def split_times(experiment: Experiment) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Times that a refit sees, and those hidden from it: every other one, or all where that leaves nothing."""
    shown = np.arange(experiment.layout.shape[0]) % 2 == 0
    if not experiment.seen[~shown].any() or not experiment.seen[shown].any():
        return np.ones_like(shown), np.ones_like(shown)
    return shown, ~shown


def judged(experiment: Experiment, hidden: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(t, s) hidden features whose errors can be put together: those in one unit."""
    return experiment.seen & hidden[:, None] & experiment.layout.common[None]


def noise_on(noise: Noise, mask: npt.NDArray[np.bool_]) -> float:
    """Root mean square of a noise over some features."""
    return float(np.sqrt(np.mean(noise.spread(noise.scale)[mask] ** 2)))


def stds_of(
    free: Sequence[Parameter], columns: FloatArray, precision: FloatArray, remainder: Omnibus
) -> dict[str, float]:
    """Standard deviations of a refit's estimates by whitened slopes (d, k) and what is known beforehand (k, k).

    Where more than noise remains, they are widened by the root of its dispersion (Birge 1932).
    """
    covariance = np.linalg.inv(columns.T @ columns + precision)
    widened = math.sqrt(max(1.0, remainder.dispersion))
    return {p.name: widened * math.sqrt(float(v)) for p, v in zip(free, np.diag(covariance), strict=True)}


def widened(stds: Mapping[str, float], systematic: Sequence[float]) -> tuple[dict[str, float], dict[str, float]]:
    """Standard deviations by noise, by name, widened by what is systematic (k,) in the same order, and the latter."""
    named = dict(zip(stds, map(float, systematic), strict=True))
    return {name: math.hypot(std, named[name]) for name, std in stds.items()}, named


def beforehand(free: Sequence[Parameter], values: Mapping[str, float], known: Known) -> FloatArray:
    """(k, k) precision of parameters by their bounds and by what other measurements say."""
    return prior(free, values) + known.root.T @ known.root


def reach_of(noise: Noise, slopes: FloatArray) -> FloatArray:
    """(n, k) derivatives (t, s, k), each as large as a parameter's error could be: ten times the noise."""
    columns = slopes[noise.seen]
    size = np.linalg.norm(columns / noise.scale[:, None], axis=0)
    return columns * (10.0 * math.sqrt(len(columns)) / np.maximum(size, 1e-300))


def remainder_of(
    experiment: Experiment,
    floor: Floor,
    best: Confirmation,
    candidates: Mapping[str, Candidate],
    evidence: Evidence,
    basis: FloatArray,
) -> Omnibus:
    """What the library can't explain: after the best effect, or after it and a second one that is significant."""
    if best.remainder.p >= CLEAN:
        return best.remainder
    seen = experiment.seen
    left = (experiment.observed - best.fit.prediction)[seen]
    free = np.concatenate([floor.nuisance, reach_of(floor.single, best.fit.slopes)], axis=1)
    others = [c for name, c in candidates.items() if name != best.name]
    if not others:
        return best.remainder
    columns = {c.name: evidence.directions[c.name][:, seen].T for c in others}
    doubts = {c.name: evidence.doubts[c.name][:, seen].T for c in others if c.name in evidence.doubts}
    scorer = Scorer.of(floor.single, free, columns, others, doubts=doubts, calibration=evidence.calibration)
    second = max(scorer.score(left).values(), key=lambda score: score.statistic)
    if second.adjusted >= LEVEL:
        return best.remainder
    size = columns[second.name]
    scale = 10.0 * math.sqrt(len(size)) / np.linalg.norm(size / floor.single.scale[:, None], axis=0)
    return omnibus(floor.single, np.concatenate([free, size * scale], axis=1), left, basis)
