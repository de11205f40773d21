"""A run folder's posterior: what is simulated for it, and the files it leaves."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.files import plain, write_json
from splatsoil.threads import one_thread

from .criticism.design import Prior, Run
from .criticism.noise import Noise
from .criticism.simulations import Simulations
from .evaluations import digest
from .mcmc import sample
from .posterior import Density, Posterior, summarise
from .posterior_files import write_figures, write_inference_data
from .run_folder import RunFolder

#: Simulations at places drawn from the posterior.
CHECKS = 3
#: Of their seeds, above those of a comparison.
FIRST_SEED = 1_000_000
#: χ² per score of these from which the emulator is said to have promised too much.
SURPRISING = 3.0

Report = Callable[[str, float], None]


@one_thread()
def run_posterior(
    run: RunFolder,
    experiment: Experiment,
    simulate: Simulations,
    noise: Noise,
    prior: Prior,
    *,
    checks: int = CHECKS,
    seed: int = 0,
    progress: Report = lambda what, share: None,
) -> dict[str, Any]:
    """Sample, check, and write ``posterior.json`` and the folder ``posterior/``.

    Args:
        run: the latest fit's folder; only this process may write to it meanwhile.
        experiment: of the fit's model.
        simulate: its simulations.
        noise: of a comparison of that model.
        prior: of that comparison.
        checks: simulations at places drawn from the posterior, to hold the emulator to its word.
        seed: of chains and checks.
        progress: called with (what, share done).

    Returns:
        What ``posterior.json`` holds.

    Raises:
        RunError: the folder can't be written.
    """
    began = time.perf_counter()
    fit, density = run.fit(), Density.of(noise, prior, run.description["seed"])
    n, own = len(prior.space), list(experiment.parameters)
    # Chains of another density are not gone on with.
    identity = digest({"seed": seed, "there": density(np.zeros((1, n))), "points": noise.points, "scores": noise.base})
    chains = sample(
        density,
        np.full(n, -1.0),
        np.full(n, 1.0),
        seed=seed,
        file=run.path / "posterior" / "chains.h5",
        identity=identity,
        progress=lambda done, most: progress(f"chains, step {done}", 0.5 * done / most),
    )
    posterior = Posterior(density, chains)
    progress("checks", 0.5)
    checked = _checked(posterior, simulate, checks, seed)
    result = {
        **summarise(posterior, own),
        "fit": fit["name"],
        "values": {name: entry["estimate"] for name, entry in fit["parameters"].items()},
        "checks": checked,
        "simulations": len(noise.base) + len(checked),
        "seconds": round(time.perf_counter() - began, 3),
        "seed": seed,
        **{key: fit[key] for key in ("device", "preset", "version")},
    }
    surprise = float(np.mean([c["chi2"] for c in checked])) if checked else 0.0
    if len(checked) < checks:
        result["notes"].append(f"{checks - len(checked)} of {checks} checks could not be simulated.")
    if surprise > SURPRISING:
        result["notes"].append(
            "Simulations at places drawn from the posterior lay farther from the emulator than it promised "
            f"(χ² per score {surprise:.1f} instead of 1): more evaluations would help."
        )
    write_inference_data(posterior, run.path / "posterior" / "posterior.nc")
    result["figures"] = write_figures(posterior, own, run.path / "posterior")
    told: dict[str, Any] = plain(result)
    write_json(run.path / "posterior.json", told)
    return told


def _checked(posterior: Posterior, simulate: Simulations, count: int, seed: int) -> list[dict[str, Any]]:
    """Simulations at draws that could be made: where, and how far they lie from what the emulator promised."""
    prior = posterior.density.prior
    chosen = np.random.default_rng([seed, 7]).choice(len(posterior.unit), count, replace=False)
    jobs = [Run(v, seed=FIRST_SEED + seed + i) for i, v in enumerate(prior.values(posterior.unit[chosen]))]
    simulate.ahead(lambda noted: [noted(job.values, seed=job.seed) for job in jobs])
    out = []
    for job in jobs:
        with suppress(SimulationError):
            table = simulate(job.values, seed=job.seed, purpose="check")
            chi2 = posterior.density.surprise(table[None], prior.unit([job]))
            out.append({"parameters": dict(job.values), "chi2": float(chi2[0])})
    return out
