"""Campaigns: many evaluations whose places are known beforehand, run by an executor, stored as each ends.

One process writes the run database; workers only compute. What is there already isn't computed again, whoever made it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from splatsoil.envs.problem import Evaluation, Problem
from splatsoil.envs.together import attempt

from splatsoil.parameters import ParameterSpace

from .evaluations import EvaluationRecord, EvaluationStore, digest
from .executors import Serial


@dataclass(frozen=True)
class Job:
    """One evaluation to make: parameters by name in physical units, and the simulation's seed."""

    parameters: Mapping[str, float]
    seed: int


class Shipped:
    """A problem on its way to a worker, which unpacks it once however many jobs come with it."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._packed: bytes | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        if self._packed is None:
            self._packed = pickle.dumps(self.problem)
        return _unpack, (self._packed,)


@lru_cache(maxsize=2)
def _unpack(packed: bytes) -> Shipped:
    return Shipped(pickle.loads(packed))


def _work(shipped: Shipped, parameters: Mapping[str, float], seed: int) -> Evaluation:
    # Pictures are for showing; they would be the larger part of what travels back.
    return replace(attempt(shipped.problem, parameters, seed), observed=None, predicted=None)


def run_campaign(
    problem: Problem,
    jobs: Sequence[Job],
    store: EvaluationStore,
    model: Mapping[str, Any],
    campaign: Mapping[str, Any],
    *,
    executor: Executor | None = None,
    after_evaluation: Callable[[int, EvaluationRecord], None] | None = None,
) -> list[EvaluationRecord]:
    """Evaluate all jobs; an interrupted campaign goes on where it stopped.

    Args:
        problem: simulate-and-compare; begun, and picklable unless the executor works in this process.
        jobs: what to evaluate. Their order is the order of the records.
        store: open for writing.
        model: what decides a single evaluation but parameters and seed, see :meth:`FitSetup.model`.
        campaign: what else describes the campaign.
        executor: runs the evaluations; in this process, one by one, by default.
        after_evaluation: called with the number done and the record of the last.

    Returns:
        One record for each job, failed ones among them.

    Raises:
        RunError: the database can't be written, or a worker keeps dying at the same evaluation.
    """
    description = {**model, **campaign}
    fit = digest(description)
    store.register(fit, description)
    found = {record.step: record for record in store.records(fit)}
    keys = [digest({**model, "values": dict(job.parameters), "seed": job.seed}) for job in jobs]
    open_steps = [s for s in range(len(jobs)) if s not in found or found[s].key != keys[s]]
    done = len(jobs) - len(open_steps)

    def keep(record: EvaluationRecord) -> None:
        nonlocal done
        store.append(record)
        found[record.step] = record
        done += 1
        if after_evaluation is not None:
            after_evaluation(done, record)

    pool = executor or Serial()
    shipped = Shipped(problem)
    waiting: dict[Future[Evaluation], int] = {}
    try:
        for step in open_steps:
            known = store.find(keys[step])
            if known is not None:
                keep(replace(known, fit=fit, step=step, created=""))
                continue
            future = pool.submit(_work, shipped, dict(jobs[step].parameters), jobs[step].seed)
            if future.done():
                keep(make_record(fit, step, keys[step], jobs[step], future.result(), problem.space, model))
            else:
                waiting[future] = step
        for future in _ended(waiting):
            step = waiting[future]
            keep(make_record(fit, step, keys[step], jobs[step], future.result(), problem.space, model))
    finally:
        for future in waiting:
            future.cancel()
    return [found[step] for step in range(len(jobs))]


def _ended(waiting: Mapping[Future[Evaluation], int]) -> Iterable[Future[Evaluation]]:
    """Futures as they end; Dask's have their own way of waiting."""
    futures = list(waiting)
    if futures and not isinstance(futures[0], Future):
        from distributed import as_completed as dask_completed

        return dask_completed(futures)
    return as_completed(futures)


def make_record(
    fit: str,
    step: int,
    key: str,
    job: Job,
    evaluation: Evaluation,
    space: ParameterSpace,
    model: Mapping[str, Any],
) -> EvaluationRecord:
    """An evaluation as it is stored."""
    unit = space.to_unit(space.to_vector(job.parameters))
    return EvaluationRecord(
        fit=fit,
        step=step,
        key=key,
        parameters=dict(job.parameters),
        # Environments act in float32: the action that led to these parameters is the nearest one.
        action=tuple(float(np.float32(value)) for value in unit),
        seed=job.seed,
        status="failed" if evaluation.loss is None else "ok",
        loss=evaluation.loss,
        message=evaluation.message,
        blocks=tuple(float(value) for value in evaluation.blocks),
        extras={name: float(value) for name, value in evaluation.extras.items()},
        seconds=evaluation.seconds,
        device=str(model.get("device", "cpu")),
        preset=str(model.get("preset", "")),
        version=str(model.get("version", "")),
        measurement=str(model.get("measurement", "")),
    )
