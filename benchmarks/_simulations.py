"""Simulations of a scene over its parameters, made once and kept, and the posterior that they give."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from splatsoil.benchmarks._common import FloatArray, parser_of
from splatsoil.envs.measured import LOSS, MeasuredProblem, cache_folder
from splatsoil.envs.problem import Problem
from splatsoil.envs.synthetic import SyntheticProblem
from splatsoil.envs.synthetic_world import World
from splatsoil.inverse.bayesopt import sobol
from splatsoil.inverse.criticism.design import Prior, Run
from splatsoil.inverse.criticism.diagnosis import BASE_RUNS
from splatsoil.inverse.criticism.noise import Tables, noise_of
from splatsoil.inverse.evaluations import EvaluationRecord, EvaluationStore, digest, evaluate, writer_lock
from splatsoil.inverse.posterior import Density

import splatsoil
from splatsoil.experiment import Layout, Site
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.files import FORWARD, code_digest, own_files
from splatsoil.mpm import PRESETS
from splatsoil.parameters import ParameterSpace

FEWEST = BASE_RUNS // 2
"""Simulations that a comparison needs."""
WORLD = 1
"""Seed of the synthetic set's own truth, which cancels in all that is made from its simulations."""


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
    """The posterior where the model is right but for seed-to-seed scatter: there is no discretisation error.

    Args:
        space: the free parameters.
        points: (m, n) of simulations, in [-1, 1].
        features: (m, b) of these.
        observed: (b,).
        sensor: standard deviation of what instruments add to an observed one.
        seed: of sequences.
    """
    b = features.shape[1]
    nothing = np.zeros((1, b))
    experiment = EmulatedExperiment(
        layout=Layout((0.0,), tuple(Site("all", float(k), 0.0) for k in range(b)), "", "", ("",), np.full((1, b), "")),
        middle=nothing,
        home={},
        slopes={},
        parameters=tuple(space),
        candidates=(),
        scatter_root=np.zeros((b, b)),
        sensor=nothing + sensor,
        observed=observed[None],
    )
    prior = Prior(space)
    made = [Run(values) for values in prior.values(points)], features[:, None]
    tables = Tables(base=made, fine=([], np.zeros((0, 1, b))), effects={}, variants={}, reference=features[:1])
    noise = noise_of(experiment, prior, tables, ())
    return Density.of(replace(noise, discretisation=np.zeros_like(noise.discretisation)), prior, seed)


def world_parser(module_doc: str | None, out: str) -> argparse.ArgumentParser:
    """An argument parser with options that choose what is simulated."""
    parser = parser_of(module_doc, out)
    parser.add_argument("set", type=Path, nargs="?", help="measurement set; none: the synthetic one of PlowSand-v0")
    parser.add_argument("--parameters", nargs="+", default=["friction_angle"])
    parser.add_argument("--with", dest="effects", nargs="*", default=[], metavar="EFFECT")
    parser.add_argument("--preset", default="tiny", choices=sorted(PRESETS))
    return parser


def simulated(options: argparse.Namespace, count: int, repeats: int = 8) -> tuple[Data, Path]:
    """Simulations at Sobol points of the prior, each with particles of its own, and some repeated in the middle.

    Args:
        options: of :func:`world_parser`.
        count: points; their number is best a power of two.
        repeats: simulations in the middle of the prior that differ in their particles only, after the others.

    Returns:
        The simulations, and the database that keeps them in the user's cache.
    """
    problem, world = _problem(options)
    model = {
        **world,
        "effects": sorted(options.effects),
        "preset": options.preset,
        "device": options.device.split(":")[0],
        "version": splatsoil.__version__,
        "code": code_digest(FORWARD, others=own_files(options.effects)),
        "loss": LOSS,
    }
    points = np.concatenate([sobol(count, len(problem.space), 0), np.zeros((repeats, len(problem.space)))])
    seeds = np.random.SeedSequence([0, 9]).generate_state(len(points)) % 2**31
    values = [problem.space.to_dict(problem.space.from_unit(p)) for p in points]
    jobs = list(zip(values, map(int, seeds), strict=True))
    file = cache_folder() / "simulations" / f"{digest({**model, 'parameters': list(options.parameters)})[:16]}.db"
    with writer_lock(file.parent), EvaluationStore(file) as store:
        made = evaluate(problem, jobs, store, model)
        records = list(track(made, "simulations", len(jobs), console=Console(stderr=True)))
    return Data.of(problem.space, records), file


def _problem(options: argparse.Namespace) -> tuple[Problem, dict[str, Any]]:
    chosen: dict[str, Any] = {"preset": options.preset, "device": options.device}
    if options.set is None:
        world = SyntheticProblem(options.parameters, options.effects, **chosen)
        world.begin(WORLD)
        sources = [inspect.getfile(part) for part in (SyntheticProblem, World)]
        return world, {"world": "synthetic", "seed": WORLD, "source": code_digest((), sources)}
    problem = MeasuredProblem.load(options.set, options.parameters, options.effects, **chosen)
    return problem, {"measurement": problem.model.measurement.hash}
