"""Several evaluations as one batch of simulations, where the problem allows it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from splatsoil.errors import SimulationError

from .problem import Evaluation, Job, Problem

if TYPE_CHECKING:
    from .measured import MeasuredProblem
    from .synthetic import SyntheticProblem


def attempt(problem: Problem, parameters: Mapping[str, float], seed: int) -> Evaluation:
    """An evaluation, a failed simulation being one too, with the time it took."""
    began = time.perf_counter()
    try:
        evaluation = problem.evaluate(parameters, seed)
        if evaluation.loss is not None and not math.isfinite(evaluation.loss):
            raise SimulationError(f"the loss is {evaluation.loss}")
    except SimulationError as error:
        evaluation = failed(problem, error)
    return replace(evaluation, seconds=time.perf_counter() - began)


def failed(problem: Problem, error: SimulationError) -> Evaluation:
    """What a simulation that could not go on comes to."""
    return Evaluation(None, np.zeros(problem.block_count), message=str(error))


def evaluate_together(problems: Sequence[Problem], jobs: Sequence[Job]) -> list[Evaluation]:
    """Evaluate one job (parameters, seed) on each problem; the simulations run as one batch where they can.

    Worlds made up on the spot share everything but their hidden truth, and one measured problem may stand in several
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
    from splatsoil.mpm import simulate_together

    first = problems[0]
    for problem in problems:
        problem.share(first)
    new = {id(p): p for p in problems if p.unobserved() is not None}
    truths = [(p, p.unobserved()) for p in new.values()]
    began = time.perf_counter()
    everything: list[Job] = [truth for _, truth in truths if truth is not None] + list(jobs)
    world = first.world
    particles = [world.particles(seed) for _, seed in everything]
    found = simulate_together(world.measurement, particles, [v for v, _ in everything], world)
    for (problem, _), x, trajectory in zip(truths, particles, found, strict=False):
        if isinstance(trajectory, SimulationError):
            raise trajectory
        problem.record(world.pictures(x, trajectory.positions, trajectory.deformations))
    out = []
    for problem, x, trajectory in zip(problems, particles[len(truths) :], found[len(truths) :], strict=True):
        if isinstance(trajectory, SimulationError):
            out.append(failed(problem, trajectory))
        else:
            out.append(problem.judge(world.pictures(x, trajectory.positions, trajectory.deformations)))
    seconds = (time.perf_counter() - began) / len(out)
    return [replace(evaluation, seconds=seconds) for evaluation in out]


def _measured(problem: MeasuredProblem, jobs: Sequence[Job]) -> list[Evaluation]:
    from splatsoil.model import Prediction
    from splatsoil.mpm import simulate_together

    began = time.perf_counter()
    model = problem.model
    particles = [model.particles(seed) for _, seed in jobs]
    found = simulate_together(model.measurement, particles, [v for v, _ in jobs], model, problem.experiment.progress)
    out = []
    for (values, seed), trajectory in zip(jobs, found, strict=True):
        if isinstance(trajectory, SimulationError):
            out.append(failed(problem, trajectory))
        else:
            images = model.draw(trajectory, seed, values)
            out.append(problem.judge(Prediction(dict(values), seed, images, trajectory, {})))
    seconds = (time.perf_counter() - began) / len(out)
    return [replace(evaluation, seconds=seconds) for evaluation in out]
