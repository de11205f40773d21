"""From the evaluations of a fit to a posterior: a design, an emulator, the noise, chains, and what they mean."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.envs.levels import is_full
from splatsoil.envs.problem import Problem

from splatsoil.errors import RunError
from splatsoil.parameters import Parameter, ParameterSpace
from splatsoil.run_files import POSTERIOR_FORMAT

from .beside import Beside
from .campaign import Job
from .emulator import FEWEST, ROUNDING, Emulator, weighed_emulator
from .evaluations import EvaluationRecord, digest
from .likelihood import Likelihood
from .mcmc import Chains, sample
from .misfit import Misfit, Place, measure
from .surrogate import sobol

FloatArray = npt.NDArray[np.float64]

#: Posterior over prior standard deviation: below the first a parameter is determined, above the second it is not.
DETERMINED, UNDETERMINED = 0.5, 0.8
#: A bound is reached where this share of the axis beside it holds more than twice its share of the posterior.
BESIDE, CROWDED = 0.05, 0.10
#: Bins of the histograms kept for the report.
BINS = 60


@dataclass(frozen=True)
class Data:
    """What a posterior is made from.

    Attributes:
        space: the free parameters.
        points: (m, n) of the evaluations, in [-1, 1].
        residuals: (m, b) observed minus predicted features.
        places: of the features, None where unknown.
        sensor_std: of an observed feature's own noise.
        beside: (m, k) residuals of other instruments, in independent units of what they may be off; None for none.
    """

    space: ParameterSpace
    points: FloatArray
    residuals: FloatArray
    places: tuple[Place, ...] | None = None
    sensor_std: float = 0.0
    beside: FloatArray | None = None

    @classmethod
    def of(cls, problem: Problem, records: Sequence[EvaluationRecord], *, pictures_alone: bool = False) -> Data:
        """The same as :meth:`from_records`, with what the problem knows of its features' places and noise, and of
        other instruments, unless these aren't to count.
        """
        places, sensor = getattr(problem, "places", None), float(getattr(problem, "sensor_std", 0.0))
        found = cls.from_records(problem.space, records, places, sensor)
        told = getattr(problem, "beside", None)
        if told is None or pictures_alone:
            return found
        beside = np.stack([told(record.extras) for record in _usable(records)])
        return replace(found, beside=beside if beside.size else None)

    @classmethod
    def from_records(
        cls,
        space: ParameterSpace,
        records: Sequence[EvaluationRecord],
        places: Sequence[Place] | None = None,
        sensor_std: float = 0.0,
    ) -> Data:
        """The evaluations that succeeded, at full resolution; blocks hidden in any of them are left out.

        Raises:
            RunError: too few succeeded, or nothing was seen in all of them.
        """
        good = _usable(records)
        if len(good) < len(space) + FEWEST:
            raise RunError(
                f"{len(good)} evaluations that succeeded are too few for a posterior over {len(space)} parameters; "
                f"{len(space) + FEWEST} are needed at least"
            )
        values = np.stack([space.to_vector(r.parameters) for r in good])
        blocks = np.array([r.blocks for r in good])
        seen = np.all(blocks != 0.0, axis=0)
        if not seen.any():
            raise RunError("no block of the pictures was seen in every evaluation; there is nothing to compare")
        kept = None if places is None else tuple(p for p, s in zip(places, seen, strict=True) if s)
        return cls(space, space.to_unit(values), blocks[:, seen], kept, sensor_std)


def _usable(records: Sequence[EvaluationRecord]) -> list[EvaluationRecord]:
    """Those that succeeded, at full resolution."""
    return [r for r in records if r.status == "ok" and is_full(r.parameters)]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of the parameters, and all they rest on."""

    data: Data
    likelihood: Likelihood
    chains: Chains
    evidence: tuple[float, float] | None

    @property
    def emulator(self) -> Emulator:
        """Of the features."""
        return self.likelihood.emulator

    @property
    def misfit(self) -> Misfit:
        """The model's own error."""
        assert self.likelihood.misfit is not None
        return self.likelihood.misfit

    @property
    def unit(self) -> FloatArray:
        """(k, n) samples in [-1, 1]."""
        return self.chains.flat[:, : len(self.data.space)]

    @property
    def values(self) -> FloatArray:
        """(k, n) samples in physical units."""
        return self.data.space.from_unit(self.unit)


def design(space: ParameterSpace, count: int, seed: int) -> list[Job]:
    """Space-filling evaluations over all of the parameters' bounds, each with particles of its own."""
    points = sobol(count, len(space), _stream(seed, 1))
    return [Job(space.to_dict(space.from_unit(p)), _stream(seed, 100 + k)) for k, p in enumerate(points)]


def repeats(values: Mapping[str, float], count: int, seed: int) -> list[Job]:
    """Evaluations at one place that differ in their particles only: what chance does."""
    return [Job(dict(values), _stream(seed, 100_000 + k)) for k in range(count)]


def checks(posterior: Posterior, count: int, seed: int) -> list[Job]:
    """Evaluations at places drawn from a posterior."""
    rng = np.random.default_rng([seed, 7])
    chosen = posterior.values[rng.choice(len(posterior.values), count, replace=False)]
    space = posterior.data.space
    return [Job(space.to_dict(v), _stream(seed, 200_000 + k)) for k, v in enumerate(chosen)]


def _stream(seed: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, 4, index]).generate_state(1)[0] % 2**31)


def likelihood_of(data: Data, *, seed: int = 0) -> Likelihood:
    """Emulator and noise from evaluations.

    Raises:
        RunError: the evaluations don't differ, or there are too few.
    """
    # Residuals are observed minus predicted: the observation is where they are 0, and predictions are minus them.
    observed = np.zeros(data.residuals.shape[1])
    try:
        emulator = weighed_emulator(data.points, -data.residuals, observed, seed=seed)
    except ValueError as error:
        raise RunError(f"no emulator can be made: {error}") from error
    # Where components are as many as features, all that is left outside is rounding.
    rounding = ROUNDING * float(np.mean(np.sum(emulator.scores**2, axis=1))) / len(observed)
    expected = emulator.outside_variance + (data.sensor_std / emulator.scale) ** 2 + rounding
    misfit = measure(emulator.remainder(observed), expected, emulator.basis, data.places)
    beside = None if data.beside is None else Beside.of(data.points, data.beside, seed=seed)
    return Likelihood(emulator, observed, data.sensor_std**2, misfit, beside)


def sample_posterior(
    data: Data,
    *,
    seed: int = 0,
    file: Path | None = None,
    evidence: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Emulate, and sample.

    Args:
        data: the evaluations.
        seed: of everything random.
        file: keeps the chains; an interrupted run goes on from it.
        evidence: integrate it, too (nested sampling).
        progress: called with (steps done, most).

    Raises:
        RunError: too few evaluations, or the file can't be written.
    """
    likelihood = likelihood_of(data, seed=seed)
    # Chains of another likelihood, such as an earlier version's, are not gone on with.
    likely = {"scores": likelihood.scores, "there": likelihood.log_likelihood(likelihood.middle)}
    data_of = {"points": data.points, "residuals": data.residuals, "sensor": data.sensor_std, "seed": seed}
    identity = digest({**data_of, **likely})
    chains = sample(
        likelihood,
        likelihood.lower,
        likelihood.upper,
        seed=seed,
        file=file,
        identity=identity,
        progress=progress,
    )
    return Posterior(data, likelihood, chains, log_evidence(likelihood, seed) if evidence else None)


def log_evidence(likelihood: Likelihood, seed: int = 0) -> tuple[float, float]:
    """Logarithm of the prior-weighted mean likelihood, and its standard error, by dynesty's nested sampling."""
    from dynesty import NestedSampler

    sampler = NestedSampler(
        lambda point: float(likelihood.log_likelihood(point[None])[0]),
        likelihood.transform,
        likelihood.dimension,
        nlive=50 * (likelihood.dimension + 3),
        rstate=np.random.default_rng([seed, 11]),
    )
    sampler.run_nested(dlogz=0.1, print_progress=False)
    return float(sampler.results.logz[-1]), float(sampler.results.logzerr[-1])


def check_scores(posterior: Posterior, residuals: FloatArray, points: FloatArray) -> FloatArray:
    """χ² per component of new simulations (k, b) at points (k, n), against what the emulator promised: about 1."""
    emulator = posterior.emulator
    mean, variance = emulator.predict(points)
    covariance = emulator.chance + variance[:, :, None] * np.eye(emulator.count)
    error = emulator.project(-residuals) - mean
    return np.einsum("kp,kp->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / emulator.count


def summarise(posterior: Posterior) -> dict[str, Any]:
    """A posterior in plain numbers, physical units and words."""
    space, values, unit = posterior.data.space, posterior.values, posterior.unit
    parameters = {p.name: _marginal(p, values[:, i], unit[:, i], space, i) for i, p in enumerate(space)}
    chains, emulator, misfit = posterior.chains, posterior.emulator, posterior.misfit
    correlation = np.atleast_2d(np.corrcoef(unit.T)) if len(space) > 1 else np.ones((1, 1))
    return {
        "format": POSTERIOR_FORMAT,
        "parameters": parameters,
        "correlation": correlation.tolist(),
        "evidence": None if posterior.evidence is None else dict(zip(("log", "std"), posterior.evidence, strict=True)),
        "emulator": {
            "evaluations": len(posterior.data.points),
            "features": posterior.data.residuals.shape[1],
            "components": emulator.count,
            "skill": emulator.left_out.skill.tolist(),
            "left_out_rms_z": float(np.sqrt(np.mean(emulator.left_out.z**2))),
            "left_out_coverage_90": emulator.left_out.coverage,
            "chance_std": np.sqrt(np.diag(emulator.chance)).tolist(),
        },
        "misfit": {
            "ratio": misfit.ratio,
            "std": misfit.std,
            "time": misfit.time,
            "length": misfit.length,
            "cameras": misfit.cameras,
        },
        "chains": {
            "ensembles": chains.samples.shape[0],
            "walkers": chains.samples.shape[2],
            "steps": chains.steps,
            "burn_in": chains.burn_in,
            "autocorrelation": float(chains.autocorrelation.max()),
            "acceptance": chains.acceptance,
            "r_hat": float(chains.r_hat.max()),
            "effective": chains.effective,
            "converged": chains.converged,
        },
        "notes": notes(posterior, parameters),
    }


def verdicts(unit: FloatArray) -> list[str]:
    """Of samples (k, n) in [-1, 1]: whether each parameter is determined, by its spread over the prior's."""
    return [
        "determined" if c < DETERMINED else "weakly determined" if c < UNDETERMINED else "not determined"
        for c in unit.std(axis=0) * np.sqrt(3.0)
    ]


def _marginal(p: Parameter, values: FloatArray, unit: FloatArray, space: ParameterSpace, index: int) -> dict[str, Any]:
    low, low50, median, high50, high = (float(q) for q in np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95]))
    # Compared on the axis that the prior is uniform on: the logarithmic one where the parameter is.
    contraction = float(unit.std() * np.sqrt(3.0))
    (verdict,) = verdicts(unit[:, None])
    bounds = [
        name
        for name, near in (("lower", unit < -1.0 + 2.0 * BESIDE), ("upper", unit > 1.0 - 2.0 * BESIDE))
        if verdict != "not determined" and float(near.mean()) > CROWDED
    ]
    counts, edges = np.histogram(unit, bins=BINS, range=(-1.0, 1.0), density=True)
    ends = np.repeat(np.zeros((1, len(space))), BINS + 1, axis=0)
    ends[:, index] = edges
    return {
        "mean": float(values.mean()),
        "std": float(values.std(ddof=1)),
        "median": median,
        "low": low,
        "high": high,
        "low_50": low50,
        "high_50": high50,
        "unit": p.unit,
        "title": p.title,
        "bounds": [p.lower, p.upper],
        "contraction": contraction,
        "verdict": verdict,
        "at_bound": bounds,
        # Density on the axis of the prior, whose own is 1 everywhere on it.
        "histogram": {"edges": space.from_unit(ends)[:, index].tolist(), "density": (2.0 * counts).tolist()},
    }


def notes(posterior: Posterior, parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What a reader must know before believing the numbers."""
    out = []
    for name, entry in parameters.items():
        share = round(100.0 * entry["contraction"])
        if entry["verdict"] == "not determined":
            out.append(
                f"{name} is not determined by this experiment: its posterior is {min(share, 100)} % as wide as "
                "its prior."
            )
        elif entry["verdict"] == "weakly determined":
            out.append(f"{name} is only weakly determined: its posterior is {share} % as wide as its prior.")
        for bound in entry["at_bound"]:
            out.append(
                f"The posterior of {name} crowds at its {bound} bound: the value may lie beyond it, or the model may "
                "lack an effect."
            )
    misfit, chains, left_out = posterior.misfit, posterior.chains, posterior.emulator.left_out
    if misfit.present:
        out.append(
            f"Where no parameter has any say, the model is {misfit.ratio**0.5:.1f} times as far from the video as "
            "chance and noise explain. The likelihood was widened by an error of that size and structure. That it "
            "looks alike where parameters do have a say is an assumption; a shift they can imitate is not covered."
        )
        if posterior.data.places is None:
            out.append("The features' places are unknown, so the misfit was taken as independent from one to the next.")
    if not chains.converged:
        out.append(
            f"The chains have not converged (R-hat {chains.r_hat.max():.3f} after {chains.steps} steps): take the "
            "widths as rough."
        )
    rms = float(np.sqrt(np.mean(left_out.z**2)))
    if not 0.6 < rms < 1.5:
        out.append(
            f"Left-out simulations lie {rms:.1f} standard deviations from what the emulator says, instead of 1: "
            "more evaluations would help."
        )
    return out
