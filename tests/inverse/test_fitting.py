"""A fit on a problem with a known answer: what it finds, keeps and says, interrupted or not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from splatsoil.inverse.evaluations import EvaluationRecord
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
    result = fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=BUDGET)
    assert run.fit() == json.loads(json.dumps(result))
    assert json.loads((run.path / "fits" / "base.json").read_text()) == run.fit()
    return result


def test_the_angle_is_found_and_written_down(uninterrupted: dict[str, Any]) -> None:
    angle = uninterrupted["parameters"]["friction_angle"]
    assert angle["estimate"] == pytest.approx(36.0, abs=1.5)
    assert abs(angle["estimate"] - 36.0) < 3.0 * angle["std"] < 9.0
    assert angle["low"] < angle["estimate"] < angle["high"] and angle["unit"] == "deg"
    assert uninterrupted["evaluations"] == len(uninterrupted["history"]) == BUDGET and uninterrupted["failed"] == 0
    assert uninterrupted["loss"] == pytest.approx(0.1, abs=0.06)
    curve = uninterrupted["curves"]["friction_angle"]
    assert curve["x"][0] == 20.0 and curve["x"][-1] == 50.0
    assert curve["x"][int(np.argmin(curve["mean"]))] == pytest.approx(angle["estimate"], abs=0.2)
    assert uninterrupted["estimated_from"] == "loss"
    assert uninterrupted["minimum"]["friction_angle"] == {key: angle[key] for key in ("estimate", "low", "high")}
    best = min(uninterrupted["history"], key=lambda step: step["loss"])
    assert uninterrupted["best"] == {key: best[key] for key in ("parameters", "loss", "step")}


class StopError(Exception):
    """What ends a fit in the test below."""


@pytest.mark.parametrize("stop_after", [1, 5])
def test_an_interrupted_fit_goes_on_to_the_same_end(
    analytic: ModuleType, tmp_path: Path, uninterrupted: dict[str, Any], stop_after: int
) -> None:
    """Between two evaluations that were chosen together, too."""

    def stop(done: int, _: EvaluationRecord) -> None:
        if done == stop_after:
            raise StopError

    run = analytic.prepare(tmp_path)
    with pytest.raises(StopError):
        fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=BUDGET, after_evaluation=stop)
    problem = analytic.AnalyticProblem()
    result = fit(problem, run, analytic.SETUP, budget=BUDGET)
    assert problem.calls == BUDGET - stop_after
    assert without_times(result) == without_times(uninterrupted)


def test_a_search_keeps_to_one_thread_and_gives_them_back(analytic: ModuleType, tmp_path: Path) -> None:
    # Sums over several threads end in other digits, and a search that goes on from them elsewhere.
    seen: list[int] = []

    def threads() -> list[int]:
        return [torch.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]

    def look(done: int, record: EvaluationRecord) -> None:
        seen.extend(threads())

    torch.set_num_threads(2)
    with threadpool_limits(limits=2):
        before = threads()
        run = analytic.prepare(tmp_path)
        fit(analytic.AnalyticProblem(), run, analytic.SETUP, budget=4, after_evaluation=look)
        assert max(before) == 2, "one thread from the start tells nothing"
        assert threads() == before
    assert set(seen) == {1}


def test_what_is_there_is_not_simulated_again(analytic: ModuleType, tmp_path: Path) -> None:
    run, problem = analytic.prepare(tmp_path), analytic.AnalyticProblem()
    short = fit(problem, run, analytic.SETUP, budget=4)
    assert without_times(fit(problem, run, analytic.SETUP, budget=4)) == without_times(short)
    assert problem.calls == 0
    longer = fit(problem, run, analytic.SETUP, budget=6)
    assert problem.calls == 2 and longer["history"][:4] == short["history"]
    for other in ({"effects": ("cohesion",)}, {"code": "other"}):
        fit(problem, run, replace(analytic.SETUP, **other), budget=4)
        assert problem.calls == 4, "another model's evaluations are none of this one's"
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == ["base.json", "cohesion.json"]


def test_failed_simulations_are_recorded_as_such_and_said(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path / "some")
    result = fit(analytic.AnalyticProblem(fails_below=30.0), run, analytic.SETUP, budget=8)
    with run.evaluations() as store:
        failed = [r for r in store.records() if r.loss is None]
    assert failed and all("nothing holds at" in r.message for r in failed)
    assert result["failed"] == len(failed) and any("failed" in note for note in result["notes"])
    assert result["parameters"]["friction_angle"]["estimate"] == pytest.approx(36.0, abs=2.0)
    none = analytic.prepare(tmp_path / "all")
    with pytest.raises(RunError, match="all 3 simulations failed; the first said: nothing holds"):
        fit(analytic.AnalyticProblem(fails_below=90.0), none, analytic.SETUP, budget=3)
    assert not (tmp_path / "all" / "fit.json").exists()


def test_a_minimum_at_a_bound_and_a_flat_loss_are_said(analytic: ModuleType, tmp_path: Path) -> None:
    beyond = fit(analytic.AnalyticProblem(truth=60.0), analytic.prepare(tmp_path / "a"), analytic.SETUP, budget=7)
    assert beyond["parameters"]["friction_angle"]["at_bound"] == "upper"
    assert any("upper bound (50 deg)" in note for note in beyond["notes"])
    flat = fit(analytic.AnalyticProblem(constant=True), analytic.prepare(tmp_path / "b"), analytic.SETUP, budget=5)
    assert flat["parameters"]["friction_angle"]["determined"] is False
    assert any("do not determine" in note for note in flat["notes"])
    assert flat["parameters"]["friction_angle"]["std"] > 4.0


def test_a_fit_is_named_by_its_effects_and_stays_in_the_run_folder(analytic: ModuleType) -> None:
    assert replace(analytic.SETUP, effects=("/my/suction.py", "cohesion")).name == "cohesion+suction"
