"""The benchmarks' own arithmetic, on worlds whose answers are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import bo_vs_mcmc, calibration
from splatsoil.benchmarks._calibration_full import one_truth
from splatsoil.inverse.emulator import Emulator
from splatsoil.inverse.evaluations import EvaluationStore
from splatsoil.inverse.posterior import Data, likelihood_of
from splatsoil.inverse.posterior_run import Effort
from splatsoil.inverse.surrogate import sobol

from splatsoil.errors import ParameterError
from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)])


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def made_up(count: int) -> Data:
    rng = np.random.default_rng(0)
    points = np.concatenate([sobol(count, 1, 0), np.zeros((4, 1))])
    directions = np.linalg.qr(rng.normal(size=(20, 2)))[0].T
    features = np.concatenate([5.0 * points, points**2], axis=1) + 0.5 * rng.normal(size=(len(points), 2))
    return Data(SPACE, points, -features @ directions)


def entry(truth: float, rank: int, inside: tuple[bool, bool]) -> dict:
    within = {"0.5": [inside[0]], "0.9": [inside[1]]}
    return {
        "truth": [truth],
        "rank": [rank],
        "within": within,
        "mean": [0.0],
        "std": [0.5],
        "misfit": False,
        "converged": True,
    }


def test_every_truth_is_tested_once_and_never_trained_on() -> None:
    data = made_up(20)
    parts = calibration.folds(data, 20)
    tested = np.concatenate([test for _, test in parts])
    assert sorted(tested) == list(range(20))
    for train, test in parts:
        assert not set(train) & set(test)
        assert {20, 21, 22, 23} <= set(train), "repeats stay: chance is measured from them"


def test_coverage_and_ranks_are_counted() -> None:
    entries = [entry(0.5, 20 * k + 5, (k < 5, k < 9)) for k in range(10)]
    told = calibration.summarise(entries, SPACE)["parameters"]["friction_angle"]
    assert told["coverage"] == {"0.5": 0.5, "0.9": 0.9}
    assert told["ranks"] == [1] * 10 and told["p_uniform"] == pytest.approx(1.0)
    assert told["rms_z"] == pytest.approx(1.0)
    piled = calibration.summarise([entry(0.5, 199, (False, False))] * 10, SPACE)["parameters"]["friction_angle"]
    assert piled["p_uniform"] < 1e-6 and piled["coverage"]["0.9"] == 0.0


@pytest.mark.slow
def test_a_known_world_is_calibrated() -> None:
    entries = calibration.calibrate(made_up(16), 16, sensor_std=0.1)
    held = np.mean([e["within"]["0.9"][0] for e in entries])
    assert len(entries) == 16 and held >= 11 / 16  # less has a chance of 0.2 % when 90 % is right


def test_ways_meet_the_same_world_and_more_calls_do_not_hurt() -> None:
    data = made_up(24)
    world = bo_vs_mcmc.EmulatedWorld(SPACE, Emulator(data.points, -data.residuals))
    found = bo_vs_mcmc.run(
        world, world.emulator.chance, ways=("mcmc", "direct"), budgets=(6, 16), direct=(20, 400), seeds=2
    )
    by = {(e["way"], e["calls"]): e for e in found["entries"]}
    assert set(by) == {("mcmc", 6), ("mcmc", 16), ("direct", 20), ("direct", 400)}
    # Chance of 0.5 on a slope of 5 per half range of 15 degrees: 1.5 degrees, and observation and call have it both.
    assert by["mcmc", 16]["mae"][0] < 5.0 and by["direct", 400]["mae"][0] < 5.0
    assert "| mcmc | 16 |" in bo_vs_mcmc.table({**found, "landscape": "A test"})
    assert bo_vs_mcmc.figure({**found, "landscape": ""}).axes


def test_a_misfit_is_no_parameter_of_the_answer() -> None:
    """What no parameter explains gives the likelihood a size of the misfit to sample, too."""
    data = made_up(24)
    wrong = np.random.default_rng(3).normal(0.0, 5.0, data.residuals.shape[1])
    assert likelihood_of(Data(SPACE, data.points, data.residuals - wrong)).with_misfit
    answer = bo_vs_mcmc.sample_emulated(SPACE, data.points, -data.residuals + wrong, 0)
    assert answer.estimate.shape == answer.low.shape == answer.high.shape == (1,)


def test_as_many_components_as_features_leave_no_misfit() -> None:
    """Nothing lies outside of the basis but rounding, which isn't compared with itself."""
    rng = np.random.default_rng(4)
    points = sobol(16, 1, 0)
    for _ in range(8):
        features = np.concatenate([5.0 * points, 2.0 * points**2], axis=1) + 0.1 * rng.normal(size=(16, 2))
        # Far from all simulations an observation is rounded more coarsely than they are.
        assert not likelihood_of(Data(SPACE, points, 30.0 * rng.normal(size=2) - features)).with_misfit


@pytest.mark.slow
def test_a_truth_goes_the_whole_way_and_is_kept(tmp_path: Path) -> None:
    chosen: dict[str, Any] = {"effort": Effort(design=4, repeats=2, checks=0), "budget": 5}
    arguments = (("friction_angle",), (), "tiny", "cpu", [0.3], 7, tmp_path / "7", 199, (0.5, 0.9))
    entry = one_truth(*arguments, **chosen)
    assert entry["simulations"] == 11 and 0 <= entry["rank"][0] <= 199
    assert entry["truth"] == [0.3] and set(entry["within"]) == {"0.5", "0.9"}
    # 0.3 of [-1, 1] is 39.5 degrees; a posterior that knows nothing would have a spread of 0.58.
    assert abs(entry["mean"][0] - 0.3) < 4.0 * entry["std"][0] and entry["std"][0] < 0.5
    with EvaluationStore(tmp_path / "7" / "evaluations.db") as store:
        before = len(store.records())
    assert one_truth(*arguments, **chosen) == entry
    with EvaluationStore(tmp_path / "7" / "evaluations.db") as store:
        assert len(store.records()) == before == 11


@pytest.mark.parametrize(("words", "says"), [(["--full"], "--out"), (["a-set", "--full", "--out", "x"], "one")])
def test_options_of_the_full_calibration_that_make_no_sense(words: list[str], says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        calibration.main(words)
