"""A fit: Bayesian optimisation of the loss, then the posterior of a comparison of models."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.envs.problem import Job, Problem, simulation_seed

from splatsoil.errors import RunError, SimulationError
from splatsoil.parameters import Parameter, ParameterSpace
from splatsoil.report.text import undetermined
from splatsoil.run_files import FIT_FORMAT
from splatsoil.threads import one_thread

from .bayesopt import BayesianOptimiser, FloatArray, Surrogate
from .criticism.diagnosis import Diagnosis
from .evaluations import EvaluationRecord, evaluate
from .run_folder import RunFolder

#: Evaluations that are chosen and simulated as a batch: the cores of a small laptop.
BATCH_SIZE = 2
#: Points of a curve of the Gaussian process.
CURVE_POINTS = 201


@dataclass(frozen=True)
class FitSetup:
    """Everything that decides the result of a fit, except its budget: a longer fit begins like a shorter one.

    Attributes:
        measurement: hash of the measurement set.
        reconstruction: digest of the reconstruction that the simulations start from.
        parameters: names of the free parameters.
        effects: names of the effects that are on.
        preset: resolution of the solver.
        device: ``cpu`` or ``cuda:N``.
        seed: of search and simulations.
        version: of this package.
        code: digest of its sources and of the effects' own files, see :func:`splatsoil.files.code_digest`.
        loss: name of the loss.
    """

    measurement: str
    reconstruction: str
    parameters: tuple[str, ...]
    effects: tuple[str, ...]
    preset: str
    device: str
    seed: int
    version: str
    code: str = ""
    loss: str = ""

    @property
    def name(self) -> str:
        """Name of the fitted model: ``base``, or its effects joined by plus signs."""
        # The stem of a user's file: a path would lead out of the run folder.
        names = (Path(effect).stem if effect.endswith(".py") else effect for effect in self.effects)
        return "+".join(sorted(names)) or "base"

    def model(self) -> dict[str, Any]:
        """What decides an evaluation, besides parameters and seed; CUDA devices are equivalent."""
        return {
            "measurement": self.measurement,
            "reconstruction": self.reconstruction,
            "effects": sorted(self.effects),
            "preset": self.preset,
            "device": self.device.split(":")[0],
            "version": self.version,
            "code": self.code,
            "loss": self.loss,
        }

    def description(self) -> dict[str, Any]:
        """What decides the whole fit."""
        return {**self.model(), "agent": "bayesopt", "parameters": list(self.parameters), "seed": self.seed}


@one_thread()
def fit(
    problem: Problem,
    run: RunFolder,
    setup: FitSetup,
    *,
    budget: int = 10,
    facts: Mapping[str, Any] | None = None,
    compare: Callable[[dict[str, Any]], Diagnosis] | None = None,
    after_evaluation: Callable[[int, EvaluationRecord], None] | None = None,
) -> dict[str, Any]:
    """Fit the free parameters and write ``fit.json``; continues an interrupted fit of the same setup.

    Args:
        problem: simulates and compares.
        run: the run folder; only this process may write to it meanwhile.
        setup: what is fitted and how.
        budget: evaluations, those already stored included.
        facts: how the fit was computed (time step, spacing, ...).
        compare: compares the base with the discrepancy model, given the result of the search; it returns the estimate.
            Without it, or with too few simulations, the estimate is the minimum of the loss.
        after_evaluation: called with the number of evaluations and the last one.

    Returns:
        Contents of ``fit.json``.

    Raises:
        RunError: every evaluation failed, or the run folder can't be written.
    """
    began, earlier = time.perf_counter(), 0.0
    optimiser = BayesianOptimiser(len(problem.space), seed=setup.seed)
    records: list[EvaluationRecord] = []
    with run.lock(), run.evaluations(writable=True) as store:
        known = {record.key for record in store.records()}
        problem.begin(setup.seed)
        while len(records) < budget:
            actions = optimiser.ask(BATCH_SIZE)[: budget - len(records)]
            # Each evaluation has its own seed: common scatter would bias the estimate.
            jobs: list[Job] = [
                (problem.space.to_dict(problem.space.from_unit(action)), simulation_seed(setup.seed, len(records) + k))
                for k, action in enumerate(actions)
            ]
            evaluated = evaluate(problem, jobs, store, setup.model(), batch_size=BATCH_SIZE)
            for action, record in zip(actions, evaluated, strict=True):
                optimiser.tell(action, record.loss)
                records.append(record)
                earlier += record.seconds if record.key in known else 0.0
                if after_evaluation is not None:
                    after_evaluation(len(records), record)
        if all(record.loss is None for record in records):
            raise RunError(f"{run.path}: all {budget} simulations failed; the first said: {records[0].message}")
        result = summarise(optimiser.surrogate(), problem.space, setup, records, compare)
        result["seconds"] = round(earlier + time.perf_counter() - began, 3)
        result["run"] = {"measurement": dict(run.description["measurement"])}
        result["facts"] = dict(facts or {})
        run.write_fit(setup.name, result)
    return result


def summarise(
    surrogate: Surrogate,
    space: ParameterSpace,
    setup: FitSetup,
    records: Sequence[EvaluationRecord],
    compare: Callable[[dict[str, Any]], Diagnosis] | None = None,
) -> dict[str, Any]:
    """A fit as plain data; see :func:`fit`."""
    minimum = surrogate.minimum()
    losses = [np.inf if record.loss is None else record.loss for record in records]
    best = int(np.argmin(losses))
    estimate = space.from_unit(minimum.estimate)
    std, low, high = minimum.interval(space.from_unit)
    searched = {
        p.name: {
            "estimate": float(estimate[i]),
            "std": float(std[i]),
            "low": float(low[i]),
            "high": float(high[i]),
            **_about(p),
            "at_bound": minimum.at_bound[i],
            "determined": minimum.determined[i],
        }
        for i, p in enumerate(space)
    }
    result: dict[str, Any] = {
        "format": FIT_FORMAT,
        "name": setup.name,
        "parameters": searched,
        "estimated_from": "loss",
        "minimum": {name: {key: entry[key] for key in ("estimate", "low", "high")} for name, entry in searched.items()},
        "noise_std": surrogate.noise_std,
        "evaluations": len(records),
        "failed": sum(record.loss is None for record in records),
        "best": {"parameters": dict(records[best].parameters), "loss": losses[best], "step": best},
        "seed": setup.seed,
        "device": setup.device,
        "preset": setup.preset,
        "version": setup.version,
        "setup": setup.description(),
        "history": [
            {
                "step": step,
                **{key: getattr(record, key) for key in ("parameters", "seed", "loss", "status", "message", "seconds")},
                "extras": dict(record.extras),
            }
            for step, record in enumerate(records)
        ],
    }
    failure = []
    if compare is not None:
        try:
            found = compare(result)
        except SimulationError as error:
            failure = [f"The estimate is the loss' minimum alone: the model could not be compared ({error})."]
        else:
            result["estimated_from"] = "comparison"
            result["parameters"] = {p.name: _averaged(p, found) for p in space}
    point = space.to_unit(np.array([entry["estimate"] for entry in result["parameters"].values()]))
    loss, loss_std = surrogate.mean_and_std(point[None])
    return {
        **result,
        "loss": float(loss[0]),
        "loss_std": float(loss_std[0]),
        "notes": [*failure, *notes(result, space)],
        "curves": {p.name: _curve(i, point, surrogate, space) for i, p in enumerate(space)},
    }


def notes(result: Mapping[str, Any], space: ParameterSpace) -> list[str]:
    """Warnings for the reader."""
    out = []
    for name, entry in result["parameters"].items():
        if not entry["determined"]:
            out.append(
                f"The evaluations do not determine {name}."
                if result["estimated_from"] == "loss"
                else undetermined(name)
            )
    for parameter in space:
        bound = result["parameters"][parameter.name]["at_bound"]
        if bound is not None:
            value = parameter.lower if bound == "lower" else parameter.upper
            out.append(
                f"The estimate of {parameter.name} lies on its {bound} bound ({value:g} {parameter.unit}): "
                "the minimum may lie beyond it, or the model may lack an effect."
            )
    if result["failed"]:
        out.append(f"{result['failed']} of {result['evaluations']} simulations failed and were left out.")
    return out


def _averaged(parameter: Parameter, found: Diagnosis) -> dict[str, Any]:
    """A parameter's posterior, averaged over models."""
    marginal = found.evidence.marginal(parameter.name)
    determined = bool(found.determined[parameter.name])
    return {
        "estimate": found.estimates[parameter.name][0],
        "std": found.estimates[parameter.name][1],
        "low": marginal.quantile(0.05),
        "high": marginal.quantile(0.95),
        **_about(parameter),
        "at_bound": next(iter(marginal.bounds_reached(parameter)), None) if determined else None,
        "determined": determined,
    }


def _about(parameter: Parameter) -> dict[str, Any]:
    bounds = [parameter.lower, parameter.upper]
    return {"unit": parameter.unit, "title": parameter.title, "bounds": bounds, "off": parameter.off}


def _curve(index: int, point: FloatArray, surrogate: Surrogate, space: ParameterSpace) -> dict[str, list[float]]:
    """The Gaussian process along one parameter; the others are at their estimates."""
    points = np.repeat(point[None], CURVE_POINTS, axis=0)
    points[:, index] = np.linspace(-1.0, 1.0, CURVE_POINTS)
    mean, std = surrogate.mean_and_std(points)
    return {"x": space.from_unit(points)[:, index].tolist(), "mean": mean.tolist(), "std": std.tolist()}
