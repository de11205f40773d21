"""One truth of a calibration through the commands' whole way: a fit, its design, checks and posterior, all simulated
for this truth alone."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import sources
from splatsoil.envs.measured import LOSS
from splatsoil.envs.synthetic import SyntheticProblem
from splatsoil.envs.synthetic_world import World
from splatsoil.inverse.evaluations import digest
from splatsoil.inverse.fitting import FitSetup, fit
from splatsoil.inverse.posterior_run import Effort, run_posterior
from splatsoil.inverse.run_folder import RunFolder

import splatsoil
from splatsoil.files import code_digest, read_json, write_json
from splatsoil.quiet import hush

FloatArray = npt.NDArray[np.float64]

#: Evaluations of a fit, for each parameter: what the command spends.
EVALUATIONS = 10


class Placed(SyntheticProblem):
    """The made-up world with a truth that stays where it was put."""

    def begin(self, seed: int) -> None:
        """Nothing is drawn."""


def one_truth(
    parameters: Sequence[str],
    effects: Sequence[str],
    preset: str,
    device: str,
    truth: Sequence[float],
    number: int,
    folder: Path,
    draws: int,
    levels: Sequence[float],
    effort: Effort | None = None,
    budget: int | None = None,
) -> dict[str, Any]:
    """Whether a posterior holds its truth; a worker's job, which goes on where it was interrupted.

    Args:
        parameters, effects, preset, device: of the made-up world and the model.
        truth: (n,) in [-1, 1].
        number: of the truth; its particles and noise, and all that the fit draws, follow from it.
        folder: run folder.
        draws: among which the truth's rank is taken.
        levels: of the intervals.
        effort, budget: of posterior and fit; what the commands spend by default.

    Returns:
        One entry, as `calibration.summarise` takes them.
    """
    import torch

    torch.set_num_threads(1)
    hush()
    problem = Placed(parameters, effects, preset=preset, device=device)
    space = problem.space
    point = np.asarray(truth, dtype=np.float64)
    values = space.to_dict(space.from_unit(point))
    world = {"values": values, "number": number, "preset": preset, "device": device.split(":")[0]}
    problem.place(values, 1_000_003 + number)
    world_files = [inspect.getfile(part) for part in (SyntheticProblem, World)]
    setup = FitSetup(
        measurement=digest(world),
        reconstruction="",
        parameters=space.names,
        effects=tuple(effects),
        preset=preset,
        device=problem.device,
        seed=number,
        version=splatsoil.__version__,
        code=code_digest(others=world_files),
        loss=LOSS,
    )
    made_by = {"effort": str(effort), "budget": budget, "sources": sources()}
    key, file = digest({**setup.description(), **made_by}), folder / "calibration.json"
    if file.is_file():
        known: dict[str, Any] = read_json(file)
        if known["key"] == key:
            return known
    described = {"name": f"truth-{number}", "folder": str(folder), "hash": setup.measurement}
    run = RunFolder.prepare(folder, measurement=described, preset=preset, seed=number, version=setup.version)
    fit(problem, run, setup, budget=budget or EVALUATIONS * len(space))
    told = run_posterior(problem, run, setup, effort=effort, seed=number)
    samples = space.to_unit(_samples(folder / "posterior" / "posterior.nc", space.names))
    chosen = samples[np.random.default_rng([number, 23]).choice(len(samples), draws, replace=False)]
    within = {}
    for level in levels:
        low, high = np.quantile(samples, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        within[str(level)] = [bool(a <= t <= b) for a, t, b in zip(low, point, high, strict=True)]
    entry = {
        "key": key,
        "truth": point.tolist(),
        "rank": [int(r) for r in (chosen < point).sum(axis=0)],
        "within": within,
        "mean": chosen.mean(axis=0).tolist(),
        "std": chosen.std(axis=0).tolist(),
        "misfit": bool(told["misfit"]["std"] > 0.0),
        "converged": bool(told["chains"]["converged"]),
        "simulations": int(told["evaluations"]),
        "seconds": float(told["seconds"]),
    }
    write_json(file, entry)
    return entry


def _samples(path: Path, names: Sequence[str]) -> FloatArray:
    """(k, n) draws in physical units."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # a remark on its next major version
        import arviz

    data = arviz.from_netcdf(path)
    return np.stack([np.asarray(data["posterior"][name]).reshape(-1) for name in names], axis=1)
