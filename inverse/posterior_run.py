"""A run folder's posterior: what is simulated for it, and the files it leaves."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from splatsoil.envs.levels import is_full
from splatsoil.envs.problem import Problem

from splatsoil.errors import RunError
from splatsoil.files import plain, write_json
from splatsoil.threads import one_thread

from .campaign import Job, run_campaign
from .evaluations import EvaluationRecord, digest
from .feature_fit import DENIED, FORCE_DENIED, agreement
from .fitting import FitSetup
from .posterior import Data, Posterior, check_scores, checks, design, repeats, sample_posterior, summarise
from .posterior_files import write_figures, write_inference_data
from .run_folder import RunFolder

#: Space-filling evaluations for each free parameter, and for all together; repeats at the fit's estimate; checks.
DESIGN_EACH, DESIGN_ALL, REPEATS, CHECKS = 8, 4, 4, 3

Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Effort:
    """How many simulations a posterior may add to the fit's.

    Attributes:
        design: space-filling ones over the parameters' bounds; None for a number that suits theirs.
        repeats: at the fit's estimate, with other particles.
        checks: at places drawn from the posterior, to hold the emulator to its word; then it learns from them.
    """

    design: int | None = None
    repeats: int = REPEATS
    checks: int = CHECKS


def setup_of(described: Mapping[str, Any]) -> FitSetup:
    """The setup that ``fit.json`` describes."""
    names = FitSetup.__dataclass_fields__
    known: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in described.items() if k in names}
    return FitSetup(**known)


@one_thread()
def run_posterior(
    problem: Problem,
    run: RunFolder,
    setup: FitSetup,
    *,
    effort: Effort | None = None,
    executor: Executor | None = None,
    seed: int = 0,
    progress: Report | None = None,
) -> dict[str, Any]:
    """Simulate what is missing, emulate, sample, check, and write ``posterior.json`` and the folder ``posterior/``.

    Args:
        problem: simulate-and-compare, of the fit.
        run: its folder; only this process may write to it meanwhile.
        setup: of the fit.
        effort: how much to simulate.
        executor: where; in this process by default.
        seed: of design and chains.
        progress: called with (what, share done).

    Returns:
        What ``posterior.json`` holds.

    Raises:
        RunError: the fit has no evaluations, too few succeeded, or the folder can't be written.
    """
    began = time.perf_counter()
    effort = effort or Effort()
    report = progress or (lambda what, share: None)
    space = problem.space
    count = effort.design if effort.design is not None else DESIGN_EACH * len(space) + DESIGN_ALL
    planned = count + effort.repeats + effort.checks
    fit = digest(setup.description())
    with run.lock(), run.evaluations(writable=True) as store:
        fitted = [record for record in store.records(fit) if is_full(record.parameters)]
        if not fitted:
            raise RunError(f"{run.path}: has no evaluations of this fit by this version of splatsoil; fit again first")
        finished = 0

        def evaluate(kind: str, jobs: list[Job]) -> list[EvaluationRecord]:
            nonlocal finished
            before = finished

            def told(done: int, record: EvaluationRecord) -> None:
                report(f"{kind} {done} of {len(jobs)}", 0.9 * (before + done) / max(planned, 1))

            described = {"agent": f"posterior-{kind}", "fit": fit, "seed": seed, "jobs": digest({"jobs": _plain(jobs)})}
            found = run_campaign(
                problem, jobs, store, setup.model(), described, executor=executor, after_evaluation=told
            )
            finished += len(jobs)
            return found

        estimate = {name: entry["estimate"] for name, entry in run.fit()["parameters"].items()}
        records = [*fitted, *evaluate("design", design(space, count, seed))]
        records += evaluate("repeat", repeats(estimate, effort.repeats, seed))
        pictures_alone = agreement(Data.of(problem, records), seed=seed) < DENIED
        posterior = sample_posterior(
            Data.of(problem, records, pictures_alone=pictures_alone),
            seed=seed,
            file=run.path / "posterior" / "chains-first.h5" if effort.checks else run.path / "posterior" / "chains.h5",
            evidence=not effort.checks,
            progress=lambda done, most: report(f"chains, step {done}", 0.9),
        )
        checked: list[dict[str, Any]] = []
        if effort.checks:
            new = evaluate("check", checks(posterior, effort.checks, seed))
            checked = _judged(posterior, records, new, problem)
            records += new
            posterior = sample_posterior(
                Data.of(problem, records, pictures_alone=pictures_alone),
                seed=seed,
                file=run.path / "posterior" / "chains.h5",
                progress=lambda done, most: report(f"chains, step {done}", 0.95),
            )
    result: dict[str, Any] = plain(
        _told(posterior, records, checked, setup, time.perf_counter() - began, denied=pictures_alone)
    )
    write_inference_data(posterior, run.path / "posterior" / "posterior.nc")
    result["figures"] = write_figures(posterior, run.path / "posterior")
    write_json(run.path / "posterior.json", result)
    return result


def _plain(jobs: list[Job]) -> list[Any]:
    return [[dict(job.parameters), job.seed] for job in jobs]


def _judged(
    posterior: Posterior,
    records: list[EvaluationRecord],
    new: list[EvaluationRecord],
    problem: Problem,
) -> list[dict[str, Any]]:
    """Each check's χ² per component by the emulator that had not seen it."""
    good = [r for r in new if r.status == "ok"]
    if not good:
        return []
    # Only blocks that all evaluations see: the same ones for emulator and checks.
    both = Data.of(problem, [*records, *good], pictures_alone=True)
    known = len(both.points) - len(good)
    data = replace(both, points=both.points[:known], residuals=both.residuals[:known])
    if data.residuals.shape == posterior.data.residuals.shape:
        judge = posterior
    else:
        from .posterior import likelihood_of

        judge = replace(posterior, data=data, likelihood=likelihood_of(data))
    scores = check_scores(judge, both.residuals[known:], both.points[known:])
    return [{"parameters": dict(r.parameters), "chi2": float(s)} for r, s in zip(good, scores, strict=True)]


def _told(
    posterior: Posterior,
    records: list[EvaluationRecord],
    checked: list[dict[str, Any]],
    setup: FitSetup,
    seconds: float,
    *,
    denied: bool,
) -> dict[str, Any]:
    result = summarise(posterior)
    if denied:
        result["notes"].append(FORCE_DENIED)
    elif posterior.data.beside is not None:
        result["notes"].append("The measured force on the tool counts beside the pictures.")
    failed = sum(r.status == "failed" for r in records)
    if failed:
        result["notes"].append(f"{failed} of {len(records)} simulations failed and were left out.")
    if checked and np.mean([c["chi2"] for c in checked]) > 3.0:
        result["notes"].append(
            "Simulations at places drawn from the first posterior lay farther from the emulator than it promised "
            f"(χ² per component {np.mean([c['chi2'] for c in checked]):.1f} instead of 1). "
            "It has learned from them since."
        )
    return {
        **result,
        "fit": setup.name,
        "checks": checked,
        "evaluations": len(records),
        "failed": failed,
        "simulation_seconds": round(sum(r.seconds for r in records), 3),
        "seconds": round(seconds, 3),
        "seed": setup.seed,
        "device": setup.device,
        "preset": setup.preset,
        "version": setup.version,
        "setup": setup.description(),
    }
