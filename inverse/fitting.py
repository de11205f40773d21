"""A fit: the agent on the environment, each evaluation stored as it ends, and what it all came to."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from splatsoil.envs.levels import FIDELITY, TwoLevelProblem, is_full
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.problem import Evaluation, Problem, WrappedProblem
from splatsoil.envs.together import attempt, evaluate_together

from splatsoil.errors import RunError, SimulationError
from splatsoil.parameters import Parameter, ParameterSpace
from splatsoil.report.text import undetermined
from splatsoil.run_files import FIT_FORMAT
from splatsoil.threads import one_thread

from .bayesopt import PAPER, START, Episode, optimise
from .campaign import Job, make_record
from .criticism.diagnosis import Diagnosis
from .evaluations import EvaluationRecord, EvaluationStore, digest
from .marginal import Marginal
from .multifidelity import most_steps, optimise_two_levels
from .run_folder import RunFolder
from .surrogate import FloatArray, Minimum, Surrogate

#: Points of the GP's curve kept for the figure.
CURVE = 201


@dataclass(frozen=True)
class FitSetup:
    """Everything that decides what a fit comes to, but its budget (a longer fit begins like a shorter one).

    Attributes:
        measurement: hash of the measurement set.
        reconstruction: digest of the reconstruction that the simulations start from.
        parameters: names of the free parameters.
        effects: names of the effects that are on.
        preset: resolution of the solver.
        device: ``cpu`` or ``cuda:N``.
        seed: of agent and simulations.
        version: of this package.
        code: digest of its sources and of the effects' own files, see :func:`splatsoil.files.code_digest`.
        loss: name of the loss.
        noise_std: measured noise of one evaluation, None to infer it.
        start: Sobol points before the first acquisition.
        search: ``usual``, or ``paper`` for Hsiao and Kumar's: one random start, expected improvement.
        coarse: preset of cheap evaluations that the search may use, too; None: it has none.
        at_once: evaluations that are chosen, and simulated, together.
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
    noise_std: float | None = None
    start: int = START
    search: Literal["usual", "paper"] = "usual"
    coarse: str | None = None
    at_once: int = 1

    @property
    def name(self) -> str:
        """Short name of the model that is fitted: ``base``, or its effects joined by plus signs."""
        # A user's effect is known by its file's name; a path would lead out of the run folder.
        names = (Path(effect).stem if effect.endswith(".py") else effect for effect in self.effects)
        return "+".join(sorted(names)) or "base"

    def model(self) -> dict[str, Any]:
        """What decides a single evaluation, but its parameters and seed. One CUDA device is like another."""
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
        return {
            **self.model(),
            "agent": "bayesopt",
            "parameters": list(self.parameters),
            "seed": self.seed,
            "noise_std": self.noise_std,
            "start": self.start,
            **({} if self.search == "usual" else {"search": self.search}),
            **({} if self.coarse is None else {"coarse": self.coarse}),
            **({} if self.at_once == 1 else {"at_once": self.at_once}),
        }


class StoredProblem(WrappedProblem):
    """A problem whose evaluations go into the run database, and come from it when they are there.

    Args:
        problem: does the work.
        store: open for writing.
        setup: of the fit.
    """

    def __init__(self, problem: Problem, store: EvaluationStore, setup: FitSetup) -> None:
        super().__init__(problem)
        self.store = store
        self.setup = setup
        self.fit = digest(setup.description())
        self.store.register(self.fit, setup.description())
        self.stored = self.store.records(self.fit)
        self._step = 0
        self._ready: dict[str, Evaluation] = {}
        self.last: EvaluationRecord | None = None

    def begin(self, seed: int) -> None:
        """Start an episode, from the fit's first evaluation."""
        self._step = 0
        super().begin(seed)

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """The stored evaluation, or a new one, which is stored before it is returned."""
        if self._step < len(self.stored):
            record, evaluation = self._replay(parameters, seed)
        else:
            key = self._key(parameters, seed)
            found = self.store.find(key)
            if found is None:
                evaluation = self._ready.pop(key) if key in self._ready else attempt(self.inner, parameters, seed)
                job = Job(dict(parameters), seed)
                record = make_record(self.fit, self._step, key, job, evaluation, self.space, self.setup.model())
            else:
                evaluation = _from_record(found)
                record = replace(found, fit=self.fit, step=self._step, created="")
            self.store.append(record)
        self._step += 1
        self.last = record
        return evaluation

    def prepare(self, jobs: Sequence[tuple[Mapping[str, float], int]]) -> None:
        """Simulate side by side what the next steps will ask for (parameters and seeds), as far as it isn't stored."""
        ahead = jobs[max(len(self.stored) - self._step, 0) :]
        fresh = [job for job in ahead if self.store.find(self._key(*job)) is None]
        if len(fresh) > 1:
            done = evaluate_together([self.inner] * len(fresh), fresh)
            self._ready = {self._key(*job): evaluation for job, evaluation in zip(fresh, done, strict=True)}

    def _key(self, parameters: Mapping[str, float], seed: int) -> str:
        return digest({**self.setup.model(), "values": dict(parameters), "seed": seed})

    def _replay(self, parameters: Mapping[str, float], seed: int) -> tuple[EvaluationRecord, Evaluation]:
        """The stored evaluation of this step."""
        record = self.stored[self._step]
        asked, known = (self.space.to_unit(self.space.to_vector(v)) for v in (parameters, record.parameters))
        if record.seed != seed or not np.allclose(asked, known, rtol=0.0, atol=1e-6):
            raise RunError(
                f"{self.store.path}: evaluation {self._step} isn't the one this fit would make; choose another --run"
            )
        return record, _from_record(record)


def _from_record(record: EvaluationRecord) -> Evaluation:
    return Evaluation(
        loss=record.loss,
        blocks=np.array(record.blocks, dtype=np.float64),
        message=record.message,
        extras=dict(record.extras),
        seconds=record.seconds,
    )


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
    """Fit the free parameters and write ``fit.json``; goes on where an interrupted fit of the same setup stopped.

    Args:
        problem: simulate-and-compare, at the resolution that counts.
        run: the run folder; only this process may write to it meanwhile.
        setup: what is fitted and how.
        budget: evaluations, those already stored included; with a coarse preset their cost, in full ones.
        facts: what the fit should say of how it was computed (time step, spacing, ...).
        compare: compares the model with something else, given what the search came to as ``fit.json`` will hold it; the
            parameters are its. Without it, and where simulations are too few for it, they are the loss' minimum.
        after_evaluation: called with the number done and the record of the last.

    Returns:
        What ``fit.json`` holds.

    Raises:
        RunError: every evaluation failed, or the run folder can't be written.
    """
    began = time.perf_counter()
    levels = None if setup.coarse is None else TwoLevelProblem(problem, setup.coarse)
    steps = budget if levels is None else most_steps(budget, levels.cost)
    with run.lock(), run.evaluations(writable=True) as store:
        stored = StoredProblem(levels or problem, store, setup)
        earlier = sum(record.seconds for record in stored.stored[:steps])
        # Each evaluation has particles of its own: chance that all of them shared would shift the estimate, unseen.
        env = PlowSandEnv(problem=stored, budget=steps)

        def told(done: int, _: dict[str, Any]) -> None:
            if after_evaluation is not None and stored.last is not None:
                after_evaluation(done, stored.last)

        try:
            shared: dict[str, Any] = {
                "seed": setup.seed,
                "noise_std": setup.noise_std,
                "replay": [record.action for record in stored.stored],
                "after_step": told,
            }
            if levels is None:
                episode = optimise(
                    env,
                    start=setup.start,
                    search=PAPER if setup.search == "paper" else None,
                    at_once=setup.at_once,
                    before_batch=lambda actions: stored.prepare(env.ahead(actions)),
                    **shared,
                )
            else:
                episode = optimise_two_levels(env, cost=levels.cost, budget=budget, **shared)
        except RuntimeError as error:
            records = store.records(stored.fit)
            if any(record.status == "ok" and is_full(record.parameters) for record in records):
                raise
            first = records[0].message if records else str(error)
            raise RunError(f"{run.path}: all {len(records)} simulations failed; the first said: {first}") from error
        records = store.records(stored.fit)[: len(episode.told)]
        result = summarise(episode, problem.space, setup, records, compare)
    result["seconds"] = round(earlier + time.perf_counter() - began, 3)
    result["run"] = {"measurement": dict(run.description["measurement"])}
    result["facts"] = dict(facts or {})
    run.write_fit(setup.name, result)
    return result


def summarise(
    episode: Episode,
    space: ParameterSpace,
    setup: FitSetup,
    records: list[EvaluationRecord],
    compare: Callable[[dict[str, Any]], Diagnosis] | None = None,
) -> dict[str, Any]:
    """A fit in plain numbers, physical units and words; see :func:`fit`."""
    surrogate, minimum = episode.optimiser.surrogate(), episode.minimum
    good = [record for record in records if record.status == "ok"]
    done = [record for record in good if is_full(record.parameters)]
    best = min(done, key=lambda record: record.loss if record.loss is not None else math.inf)
    searched = {p.name: _minimiser(p, i, minimum, space) for i, p in enumerate(space)}
    result: dict[str, Any] = {
        "format": FIT_FORMAT,
        "name": setup.name,
        "parameters": searched,
        "estimated_from": "loss",
        "minimum": {name: {key: entry[key] for key in ("estimate", "low", "high")} for name, entry in searched.items()},
        "noise_std": minimum.noise_std,
        "evaluations": len(records),
        "failed": len(records) - len(good),
        "best": {"parameters": _without_level(best.parameters), "loss": best.loss, "step": best.step},
        "seed": setup.seed,
        "device": setup.device,
        "preset": setup.preset,
        "version": setup.version,
        "setup": setup.description(),
        "history": [
            {
                "step": record.step,
                "parameters": _without_level(record.parameters),
                "level": "full" if is_full(record.parameters) else "coarse",
                "seed": record.seed,
                "loss": record.loss,
                "status": record.status,
                "message": record.message,
                "seconds": record.seconds,
                "extras": dict(record.extras),
            }
            for record in records
        ],
    }
    remarks = []
    if compare is not None:
        try:
            found = compare(result)
        except SimulationError as error:
            remarks = [f"The estimate is the loss' minimum alone: the model could not be compared ({error})."]
        else:
            result["estimated_from"] = "comparison"
            result["parameters"] = {p.name: _averaged(p, found) for p in space}
    point = space.to_unit(np.array([entry["estimate"] for entry in result["parameters"].values()]))
    loss, loss_std = surrogate.mean_and_std(point[None])
    return {
        **result,
        "loss": float(loss[0]),
        "loss_std": float(loss_std[0]),
        "notes": [*remarks, *notes(result, space)],
        "curves": {p.name: _curve(i, point, surrogate, space) for i, p in enumerate(space)},
    }


def _without_level(parameters: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in parameters.items() if name != FIDELITY.name}


def notes(result: Mapping[str, Any], space: ParameterSpace) -> list[str]:
    """What a reader must know before believing the numbers."""
    out = []
    for name, entry in result["parameters"].items():
        if not entry["determined"]:
            out.append(
                f"The evaluations hardly say where the loss is least: {name} is not determined by them."
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
    """A parameter, averaged over the models of a comparison."""
    marginal = Marginal.of(parameter, found.evidence)
    determined = bool(found.determined[parameter.name])
    return {
        "estimate": found.estimates[parameter.name][0],
        "std": found.estimates[parameter.name][1],
        "low": marginal.quantile(0.05),
        "high": marginal.quantile(0.95),
        **_about(parameter),
        "at_bound": next(iter(marginal.at_bounds), None) if determined else None,
        "determined": determined,
    }


def _about(parameter: Parameter) -> dict[str, Any]:
    bounds = [parameter.lower, parameter.upper]
    return {"unit": parameter.unit, "title": parameter.title, "bounds": bounds, "off": parameter.off}


def _minimiser(parameter: Parameter, index: int, minimum: Minimum, space: ParameterSpace) -> dict[str, Any]:
    """A parameter where the loss is least."""

    def physical(unit: float) -> float:
        point = minimum.estimate.copy()
        point[index] = unit
        return float(space.from_unit(point)[index])

    centre = float(minimum.estimate[index])
    std = float(minimum.std[index])
    # Half the width of ± one std in physical units: exact on a linear axis, sensible on a logarithmic one. Both
    # ends are pushed inside the bounds together, so that a bound doesn't halve the std.
    middle = float(np.clip(centre, -1.0 + min(std, 1.0), 1.0 - min(std, 1.0)))
    return {
        "estimate": physical(centre),
        "std": 0.5 * (physical(middle + std) - physical(middle - std)),
        "low": physical(float(minimum.low[index])),
        "high": physical(float(minimum.high[index])),
        **_about(parameter),
        "at_bound": minimum.at_bound[index],
        "determined": minimum.determined[index],
    }


def _curve(index: int, point: FloatArray, surrogate: Surrogate, space: ParameterSpace) -> dict[str, list[float]]:
    """The GP along one parameter, the others at their estimates."""
    points = np.repeat(point[None], CURVE, axis=0)
    points[:, index] = np.linspace(-1.0, 1.0, CURVE)
    mean, std = surrogate.mean_and_std(points)
    return {"x": space.from_unit(points)[:, index].tolist(), "mean": mean.tolist(), "std": std.tolist()}
