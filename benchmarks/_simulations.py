"""Simulations of a world over its parameters, made once and kept: what benchmarks draw synthetic truths from; and the
posterior that a comparison gives from such simulations."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.envs.measured import LOSS, MeasuredProblem, cache_folder
from splatsoil.envs.problem import Job, Problem
from splatsoil.envs.synthetic import SyntheticProblem
from splatsoil.envs.synthetic_world import World
from splatsoil.inverse.bayesopt import sobol
from splatsoil.inverse.criticism.design import Prior, Run
from splatsoil.inverse.criticism.diagnosis import BASE
from splatsoil.inverse.criticism.noise import Tables, noise_of
from splatsoil.inverse.evaluations import EvaluationRecord, EvaluationStore, digest, evaluate, writer_lock
from splatsoil.inverse.posterior import Density

import splatsoil
from splatsoil.experiment import Layout, Site
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.files import FORWARD, code_digest
from splatsoil.parameters import ParameterSpace

FloatArray = npt.NDArray[np.float64]

#: Simulations that a comparison needs.
FEWEST = BASE // 2

#: Seed of the made-up world's own truth, which cancels in all that is made from its simulations.
WORLD = 1


@dataclass(frozen=True)
class Data:
    """Simulations.

    Attributes:
        space: the free parameters.
        points: (m, n) in [-1, 1].
        residuals: (m, b) observed minus predicted features.
    """

    space: ParameterSpace
    points: FloatArray
    residuals: FloatArray

    @classmethod
    def of(cls, space: ParameterSpace, records: Sequence[EvaluationRecord]) -> Data:
        """Those that succeeded; blocks hidden in any of them are left out."""
        good = [r for r in records if r.loss is not None]
        blocks = np.array([r.blocks for r in good])
        points = space.to_unit(np.stack([space.to_vector(r.parameters) for r in good]))
        return cls(space, points, blocks[:, np.all(blocks != 0.0, axis=0)])


def density_of(
    space: ParameterSpace, points: FloatArray, features: FloatArray, observed: FloatArray, sensor: float, seed: int = 0
) -> Density:
    """The posterior in a world whose model is right but for chance: numerics leave nothing.

    Args:
        space: the free parameters.
        points: (m, n) of simulations, in [-1, 1].
        features: (m, b) of these.
        observed: (b,).
        sensor: standard deviation of what instruments add to an observed one.
        seed: of sequences.
    """
    b = features.shape[1]
    layout = Layout((0.0,), tuple(Site("all", float(k), 0.0) for k in range(b)), "", "", ("",), np.full((1, b), ""))
    nothing = np.zeros((1, b))
    experiment = EmulatedExperiment(
        layout=layout,
        middle=nothing,
        home={},
        slopes={},
        parameters=tuple(space),
        candidates=(),
        chance_root=np.zeros((b, b)),
        sensor=nothing + sensor,
        observed=observed[None],
    )
    prior = Prior(space)
    made = [Run(values) for values in prior.values(points)], features[:, None]
    tables = Tables(base=made, fine=([], np.zeros((0, 1, b))), effects={}, drawn={}, reference=features[:1])
    noise = noise_of(experiment, prior, tables, ())
    return Density.of(replace(noise, numerics=np.zeros_like(noise.numerics)), prior, seed)


def simulations(
    count: int,
    parameters: Sequence[str] = ("friction_angle",),
    effects: Sequence[str] = (),
    *,
    measurement: Path | None = None,
    reconstruction: Path | None = None,
    preset: str = "tiny",
    device: str = "cpu",
    seed: int = 0,
    repeats: int = 8,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Data, Path]:
    """Simulations at Sobol points of the prior, each with particles of its own, and some repeated in the middle.

    Args:
        count: points; their number is best a power of two.
        parameters, effects: of the model.
        measurement: folder of a set; None: the made-up world of PlowSand-v0.
        reconstruction: of the set; made and kept where there is none.
        preset, device: of the solver.
        seed: of points and particles.
        repeats: simulations in the middle of the prior that differ in their particles only, after the others.
        executor: where; in this process by default.
        progress: called with (done, all).

    Returns:
        The simulations, and the database that keeps them in the user's cache.
    """
    problem, world = _problem(parameters, effects, measurement, reconstruction, preset, device)
    model = {
        **world,
        "effects": sorted(effects),
        "preset": preset,
        "device": device.split(":")[0],
        "version": splatsoil.__version__,
        "code": code_digest((*FORWARD,), others=[name for name in effects if name.endswith(".py")]),
        "loss": LOSS,
    }
    points = sobol(count, len(problem.space), seed)
    jobs = jobs_at(problem.space, np.concatenate([points, np.zeros((repeats, len(problem.space)))]), seed)
    file = cache_folder() / "simulations" / f"{digest({**model, 'parameters': list(parameters)})[:16]}.db"
    with writer_lock(file.parent), EvaluationStore(file) as store:
        records = []
        for record in evaluate(problem, jobs, store, model, pool=executor):
            records.append(record)
            if progress is not None:
                progress(len(records), len(jobs))
    return Data.of(problem.space, records), file


def jobs_at(space: ParameterSpace, points: FloatArray, seed: int) -> list[Job]:
    """One evaluation at each point (k, n) of [-1, 1]^n, no two with the same particles."""
    seeds = np.random.SeedSequence([seed, 9]).generate_state(len(points)) % 2**31
    return [(space.to_dict(space.from_unit(p)), int(s)) for p, s in zip(points, seeds, strict=True)]


def _problem(
    parameters: Sequence[str],
    effects: Sequence[str],
    measurement: Path | None,
    reconstruction: Path | None,
    preset: str,
    device: str,
) -> tuple[Problem, dict[str, Any]]:
    if measurement is None:
        world = SyntheticProblem(parameters, effects, preset=preset, device=device)
        world.begin(WORLD)
        sources = [inspect.getfile(part) for part in (SyntheticProblem, World)]
        return world, {"world": "synthetic", "seed": WORLD, "source": code_digest((), sources)}
    problem = MeasuredProblem.load(
        measurement, parameters, effects, preset=preset, device=device, reconstruction=reconstruction
    )
    return problem, {"measurement": problem.model.measurement.hash, "reconstruction": str(reconstruction)}
