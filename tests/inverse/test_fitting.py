from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from splatsoil.inverse import fitting
from splatsoil.inverse.bayesopt import PAPER, BayesianOptimiser
from splatsoil.inverse.evaluations import EvaluationRecord, digest
from splatsoil.inverse.fitting import fit
from threadpoolctl import threadpool_info, threadpool_limits

from splatsoil.errors import RunError

BUDGET = 7


def without_times(result: dict[str, Any]) -> dict[str, Any]:
    out = json.loads(json.dumps(result))
    out.pop("seconds")
    for step in out["history"]:
        step.pop("seconds")
    return out


@pytest.fixture(scope="module")
def uninterrupted(analytic: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    run = analytic.prepare(tmp_path_factory.mktemp("runs") / "whole")
    return fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=BUDGET, facts={"spacing": 0.01})


def test_the_angle_is_found_and_written_down(uninterrupted: dict[str, Any]) -> None:
    angle = uninterrupted["parameters"]["friction_angle"]
    assert angle["estimate"] == pytest.approx(36.0, abs=1.5)
    assert abs(angle["estimate"] - 36.0) < 3.0 * angle["std"]
    assert 0.0 < angle["std"] < 3.0
    assert angle["low"] < angle["estimate"] < angle["high"]
    assert angle["unit"] == "deg"
    assert {"loss", "evaluations", "seconds", "seed", "device", "preset", "version"} <= uninterrupted.keys()
    assert uninterrupted["evaluations"] == BUDGET and uninterrupted["failed"] == 0
    assert uninterrupted["loss"] == pytest.approx(0.1, abs=0.06)
    assert uninterrupted["facts"] == {"spacing": 0.01}
    assert len(uninterrupted["history"]) == BUDGET
    curve = uninterrupted["curves"]["friction_angle"]
    assert curve["x"][0] == 20.0 and curve["x"][-1] == 50.0
    assert curve["x"][int(np.argmin(curve["mean"]))] == pytest.approx(angle["estimate"], abs=0.2)
    assert uninterrupted["estimated_from"] == "loss"
    assert uninterrupted["minimum"]["friction_angle"] == {key: angle[key] for key in ("estimate", "low", "high")}


def test_what_is_returned_is_what_is_on_disk(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    result = fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=4)
    assert run.fit() == json.loads(json.dumps(result))
    assert json.loads((tmp_path / "fits" / "base.json").read_text()) == run.fit()


class StopError(Exception):
    """What ends a fit in the tests below."""


@pytest.mark.parametrize("stop_after", [1, 5])
def test_an_interrupted_fit_goes_on_to_the_same_end(
    analytic: ModuleType, tmp_path: Path, uninterrupted: dict[str, Any], stop_after: int
) -> None:
    def stop(done: int, _: EvaluationRecord) -> None:
        if done == stop_after:
            raise StopError

    run = analytic.prepare(tmp_path / "run")
    with pytest.raises(StopError):
        fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=BUDGET, after_evaluation=stop)
    problem = analytic.AnalyticProblem()
    result = fit(problem, analytic.prepare(tmp_path / "run"), analytic.SETUP, budget=BUDGET, facts={"spacing": 0.01})
    assert problem.calls == BUDGET - stop_after
    assert without_times(result) == without_times(uninterrupted)


@pytest.fixture(scope="module")
def pairs(analytic: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], list[int]]:
    """A fit whose evaluations are chosen two at a time, and how many were made together."""
    sizes: list[int] = []
    made = fitting.evaluate_together
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            fitting, "evaluate_together", lambda problems, jobs: sizes.append(len(jobs)) or made(problems, jobs)
        )
        run = analytic.prepare(tmp_path_factory.mktemp("runs") / "pairs")
        found = fit(analytic.AnalyticProblem(), run, replace(analytic.SETUP, at_once=2), budget=BUDGET)
    return found, sizes


def test_evaluations_chosen_together_are_made_together_and_none_beyond_the_budget(
    analytic: ModuleType, uninterrupted: dict[str, Any], pairs: tuple[dict[str, Any], list[int]]
) -> None:
    found, sizes = pairs
    assert sizes == [2, 2, 2] and found["evaluations"] == BUDGET
    assert found["parameters"]["friction_angle"]["estimate"] == pytest.approx(36.0, abs=1.5)
    start = analytic.SETUP.start
    first = [[step["parameters"], step["loss"]] for step in found["history"][:start]]
    assert first == [[step["parameters"], step["loss"]] for step in uninterrupted["history"][:start]]


@pytest.mark.parametrize("stop_after", [1, 4, 5])
def test_a_fit_interrupted_between_two_evaluations_goes_on_to_the_same_end(
    analytic: ModuleType, tmp_path: Path, pairs: tuple[dict[str, Any], list[int]], stop_after: int
) -> None:
    def stop(done: int, _: EvaluationRecord) -> None:
        if done == stop_after:
            raise StopError

    setup = replace(analytic.SETUP, at_once=2)
    with pytest.raises(StopError):
        fit(analytic.AnalyticProblem(), analytic.prepare(tmp_path), setup, budget=BUDGET, after_evaluation=stop)
    problem = analytic.AnalyticProblem()
    result = fit(problem, analytic.prepare(tmp_path), setup, budget=BUDGET)
    assert problem.calls == BUDGET - stop_after
    assert without_times(result) == without_times(pairs[0])


def test_a_search_keeps_to_one_thread_and_gives_them_back(analytic: ModuleType, tmp_path: Path) -> None:
    # Sums over several threads end in other digits, and a search that goes on from them elsewhere.
    seen: list[int] = []

    def threads() -> list[int]:
        return [torch.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]

    torch.set_num_threads(2)
    with threadpool_limits(limits=2):
        before = threads()
        fit(
            analytic.AnalyticProblem(),
            analytic.prepare(tmp_path),
            analytic.SETUP,
            budget=4,
            after_evaluation=lambda done, record: seen.extend(threads()),
        )
        assert max(before) == 2, "one thread from the start tells nothing"
        assert threads() == before
    assert set(seen) == {1}


def test_killed_and_started_again(analytic: ModuleType, tmp_path: Path, uninterrupted: dict[str, Any]) -> None:
    script = Path(analytic.__file__ or "")
    command = [sys.executable, str(script), str(tmp_path / "run"), str(BUDGET)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([*command, "0.2"], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    for line in process.stdout:
        if int(line.split()[0]) == 3:
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with analytic.prepare(tmp_path / "run").evaluations() as store:
        kept = len(store.records())
    assert 3 <= kept < BUDGET
    assert not (tmp_path / "run" / "fit.json").exists()
    problem = analytic.AnalyticProblem()
    result = fit(problem, analytic.prepare(tmp_path / "run"), analytic.SETUP, budget=BUDGET, facts={"spacing": 0.01})
    assert problem.calls == BUDGET - kept
    assert without_times(result) == without_times(uninterrupted)


def test_a_finished_fit_simulates_nothing_again_and_a_longer_one_only_the_rest(
    analytic: ModuleType, tmp_path: Path
) -> None:
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem()
    short = fit(problem, run, analytic.SETUP, budget=4)
    again = fit(problem, run, analytic.SETUP, budget=4)
    assert problem.calls == 0
    assert without_times(again) == without_times(short)
    longer = fit(problem, run, analytic.SETUP, budget=6)
    assert problem.calls == 2
    assert longer["history"][:4] == short["history"]
    shorter = fit(problem, run, analytic.SETUP, budget=4)
    assert problem.calls == 0
    assert without_times(shorter) == without_times(short)


def test_a_fit_with_another_seed_or_effect_shares_the_folder_but_no_evaluation(
    analytic: ModuleType, tmp_path: Path
) -> None:
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem()
    fit(problem, run, analytic.SETUP, budget=4)
    fit(problem, run, replace(analytic.SETUP, effects=("cohesion",)), budget=4)
    assert problem.calls == 4
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == ["base.json", "cohesion.json"]
    assert run.fit()["name"] == "cohesion"
    with run.evaluations() as store:
        assert len(store.records()) == 8
        assert len(store.descriptions()) == 2


def test_a_fit_is_named_by_its_effects_and_stays_in_the_run_folder(analytic: ModuleType) -> None:
    assert analytic.SETUP.name == "base"
    assert replace(analytic.SETUP, effects=("/my/suction.py", "cohesion")).name == "cohesion+suction"


def test_other_code_simulates_again(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem()
    fit(problem, run, analytic.SETUP, budget=4)
    fit(problem, run, replace(analytic.SETUP, code="other"), budget=4)
    assert problem.calls == 4


def test_an_evaluation_that_another_fit_made_is_taken_from_there(analytic: ModuleType, tmp_path: Path) -> None:
    """The same seed and model, another agent's setting: the Sobol start is shared."""
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem()
    fit(problem, run, analytic.SETUP, budget=4)
    fit(problem, run, replace(analytic.SETUP, noise_std=0.02), budget=5)
    assert problem.calls == 1


def test_failed_simulations_are_recorded_as_such_and_said(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    result = fit(analytic.AnalyticProblem(fails_below=30.0), run, analytic.SETUP, budget=8)
    with run.evaluations() as store:
        records = store.records(digest(analytic.SETUP.description()))
    failed = [r for r in records if r.status == "failed"]
    assert failed and all(r.loss is None and "nothing holds at" in r.message for r in failed)
    assert result["failed"] == len(failed)
    assert any("failed" in note for note in result["notes"])
    assert result["parameters"]["friction_angle"]["estimate"] == pytest.approx(36.0, abs=2.0)


def test_the_papers_search_starts_from_one_random_point(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    usual = fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=4)
    paper = fit(analytic.AnalyticProblem(), run, replace(analytic.SETUP, search="paper"), budget=4)
    first = BayesianOptimiser(1, seed=analytic.SETUP.seed, search=PAPER).ask()[0]
    assert paper["history"][0]["parameters"]["friction_angle"] == pytest.approx(35.0 + 15.0 * first)
    assert paper["setup"]["search"] == "paper" and "search" not in usual["setup"]
    assert paper["history"][0]["parameters"] != usual["history"][0]["parameters"]


def test_all_simulations_fail(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    with pytest.raises(RunError, match="all 3 simulations failed; the first said: nothing holds"):
        fit(analytic.AnalyticProblem(fails_below=90.0), run, analytic.SETUP, budget=3)
    assert not (tmp_path / "fit.json").exists()


def test_a_minimum_at_a_bound_and_a_flat_loss_are_said(analytic: ModuleType, tmp_path: Path) -> None:
    beyond = fit(analytic.AnalyticProblem(truth=60.0), analytic.prepare(tmp_path / "a"), analytic.SETUP, budget=7)
    assert beyond["parameters"]["friction_angle"]["at_bound"] == "upper"
    assert any("upper bound (50 deg)" in note for note in beyond["notes"])
    flat = fit(analytic.AnalyticProblem(constant=True), analytic.prepare(tmp_path / "b"), analytic.SETUP, budget=5)
    assert flat["parameters"]["friction_angle"]["determined"] is False
    assert any("not determined" in note for note in flat["notes"])
    assert flat["parameters"]["friction_angle"]["std"] > 4.0


def test_two_parameters(analytic: ModuleType, tmp_path: Path) -> None:
    problem = analytic.AnalyticProblem((analytic.FRICTION, analytic.COHESION))
    setup = replace(analytic.SETUP, parameters=("friction_angle", "cohesion"), effects=("cohesion",))
    result = fit(problem, analytic.prepare(tmp_path), setup, budget=14)
    angle, cohesion = result["parameters"]["friction_angle"], result["parameters"]["cohesion"]
    assert angle["estimate"] == pytest.approx(36.0, abs=3.0)
    assert cohesion["estimate"] == pytest.approx(300.0, abs=150.0)
    assert cohesion["unit"] == "Pa"
