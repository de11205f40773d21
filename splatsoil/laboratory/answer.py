"""Estimates from a laboratory test: parameters of a model, and the probability of each model, as with images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from splatsoil.arrays import FloatArray
from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Run
from splatsoil.experiment.laboratory import LaboratoryExperiment
from splatsoil.inverse.criticism.design import Prior
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.record import record
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.parameters import ParameterSpace

STARTS = (-0.5, -0.2, 0.1)
"""Starting points of the search, in half-ranges of the parameters about their middles; with scatter, only the last."""
STEP, SCATTER_STEP = 2e-3, 0.1
"""Step of the search's finite differences in half-ranges; with scatter, large enough to exceed it."""
MAX_EVALUATIONS = 12
"""Of the search where simulations have seed-to-seed scatter."""
FAR = 1e3
"""Residual, in standard deviations, of a simulation that could not be made."""

Report = Callable[[str, float], None]


def fitted(experiment: LaboratoryExperiment, folder: Path | None, seed: int, report: Report) -> dict[str, Any]:
    """The parameters of the model as it is, with their uncertainty, and whether its residual is more than noise."""
    return _compared(experiment, folder, seed, report, effects=False)


def diagnosed(experiment: LaboratoryExperiment, folder: Path | None, seed: int, report: Report) -> dict[str, Any]:
    """How probable each model is: the one as it is, and those with an effect more."""
    return _compared(experiment, folder, seed, report, effects=True)


def _compared(
    experiment: LaboratoryExperiment, folder: Path | None, seed: int, report: Report, *, effects: bool
) -> dict[str, Any]:
    simulations = Simulations(experiment, folder, _identity(experiment))
    values, known = search(experiment, simulations, seed, report)
    found = diagnose(
        experiment,
        values,
        simulate=simulations,
        effects=effects,
        seed=seed,
        known=known,
        prior=Prior.of(experiment, values),
        progress=report,
    )
    return {
        **record(experiment, found, simulations.requested),
        "fit": "+".join(experiment.model),
        "values": values,
        "simulated_now": simulations.simulated,
    }


def search(
    experiment: LaboratoryExperiment, simulations: Simulations, seed: int, report: Report
) -> tuple[dict[str, float], list[Run]]:
    """Parameters of least squares, and all simulations that were made for them (Levenberg & Marquardt's way within
    bounds: Branch, Coleman & Li 1999, SIAM J. Sci. Comput. 21(1))."""
    space = ParameterSpace(experiment.parameters)
    runs: list[Run] = []

    def residuals(unit: FloatArray) -> FloatArray:
        values = space.to_dict(space.from_unit(unit))
        report("search", min(0.9, 0.02 * len(runs)))
        try:
            table = simulations(Run(values, seed=seed), "search")
        except SimulationError:
            return np.full(experiment.observed.size, FAR)
        runs.append(Run(values, seed=seed))
        return ((table - experiment.observed) / experiment.sensor).ravel()

    scatter = experiment.stochastic
    found = [
        least_squares(
            residuals,
            np.full(len(space), start),
            bounds=(-1.0, 1.0),
            diff_step=SCATTER_STEP if scatter else STEP,
            max_nfev=MAX_EVALUATIONS if scatter else None,
        )
        for start in (STARTS[-1:] if scatter else STARTS)
    ]
    best = min(found, key=lambda f: float(f.cost))
    # one run at each place, and few of them: an emulator wants places that differ
    return space.to_dict(space.from_unit(best.x)), _apart(runs, space, best.x)


def _apart(runs: list[Run], space: ParameterSpace, best: FloatArray) -> list[Run]:
    """The nearest runs to the best one, each at least a step of the search from those before it, about as many as a
    design has."""
    unit = space.to_unit(np.array([[r.values[p.name] for p in space] for r in runs]))
    kept: list[int] = []
    for index in np.argsort(np.linalg.norm(unit - best, axis=1), kind="stable"):
        if all(np.linalg.norm(unit[index] - unit[k]) > SCATTER_STEP / 2 for k in kept):
            kept.append(int(index))
        if len(kept) >= 5 * (1 + len(space)):
            break
    return [runs[k] for k in kept]


def _identity(experiment: LaboratoryExperiment) -> Mapping[str, Any]:
    resolution = getattr(experiment, "resolution", None)
    return {
        "kind": experiment.kind,
        "model": list(experiment.model),
        "observed": experiment.observed.tolist(),
        "times": list(experiment.layout.times),
        "resolution": None if resolution is None else vars(resolution),
        "always": dict(experiment.values({})),
    }
