"""Several evaluations as one batch of simulations, where the problem allows it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil.batches import in_batches
from splatsoil.errors import SimulationError

from .problem import Evaluation, Job, Problem

if TYPE_CHECKING:
    from splatsoil.mpm import Trajectory

    from .measured import MeasuredProblem
    from .synthetic import SyntheticProblem


def attempt(problem: Problem, parameters: Mapping[str, float], seed: int) -> Evaluation:
    """An evaluation, a failed simulation being one too, with the time it took."""
    return _evaluations([problem], [partial(problem.evaluate, parameters, seed)], time.perf_counter())[0]


def evaluate_together(problems: Sequence[Problem], jobs: Sequence[Job]) -> list[Evaluation]:
    """Evaluate one job (parameters, seed) on each problem; the simulations run as one batch where they can.

    Synthetic problems share everything but their hidden truth, and one measured problem may stand in several
    places. Anything else is evaluated one by one. The results are those of single evaluations.
    """
    from .measured import MeasuredProblem
    from .synthetic import SyntheticProblem

    if all(isinstance(p, SyntheticProblem) for p in problems):
        return _synthetic(problems, jobs)  # type: ignore[arg-type]
    if isinstance(problems[0], MeasuredProblem) and all(p is problems[0] for p in problems):
        return _measured(problems[0], jobs)
    return [attempt(problem, *job) for problem, job in zip(problems, jobs, strict=True)]


def _synthetic(problems: Sequence[SyntheticProblem], jobs: Sequence[Job]) -> list[Evaluation]:
    began, first = time.perf_counter(), problems[0]
    for problem in problems:
        problem.share(first)
    new = {id(p): (p, truth) for p in problems if (truth := p.unobserved()) is not None}
    made = first.experiment.simulated([*(truth for _, truth in new.values()), *jobs])
    for (problem, _), clean in zip(new.values(), made, strict=False):
        problem.record(clean)
    return _judged(problems, made[len(new) :], began)


def _measured(problem: MeasuredProblem, jobs: Sequence[Job]) -> list[Evaluation]:
    from splatsoil.mpm import simulate_together

    began, model = time.perf_counter(), problem.model

    def simulated(some: Sequence[Job]) -> Sequence[Trajectory | SimulationError]:
        particles = [model.particles(seed) for _, seed in some]
        values, progress = [values for values, _ in some], problem.experiment.progress
        return simulate_together(model.measurement, particles, values, model, progress)

    found = in_batches(simulated, jobs, "simulations")
    made = (
        trajectory if isinstance(trajectory, SimulationError) else model.reported(trajectory, seed, values)
        for (values, seed), trajectory in zip(jobs, found, strict=True)
    )
    return _judged([problem] * len(jobs), made, began)


def _judged(problems: Sequence[Any], made: Iterable[Any], began: float) -> list[Evaluation]:
    """What simulations, or the errors in their place, come to."""

    def judged(problem: Any, one: Any) -> Evaluation:
        if isinstance(one, SimulationError):
            raise one
        evaluation: Evaluation = problem.judge(one)
        return evaluation

    return _evaluations(problems, (partial(judged, *pair) for pair in zip(problems, made, strict=True)), began)


def _evaluations(
    problems: Sequence[Problem], ways: Iterable[Callable[[], Evaluation]], began: float
) -> list[Evaluation]:
    """Evaluations, failed ones where a simulation could not go on; each with an equal share of the time since then."""
    out = []
    for problem, evaluate in zip(problems, ways, strict=True):
        try:
            evaluation = evaluate()
            if evaluation.loss is not None and not math.isfinite(evaluation.loss):
                raise SimulationError(f"the loss is {evaluation.loss}")
        except SimulationError as error:
            evaluation = Evaluation(None, np.zeros(problem.block_count), message=str(error))
        out.append(evaluation)
    return [replace(evaluation, seconds=(time.perf_counter() - began) / len(out)) for evaluation in out]
