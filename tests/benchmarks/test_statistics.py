"""The benchmarks' own arithmetic, on worlds whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import bo_vs_mcmc, calibration, paper_table
from splatsoil.inverse.emulator import Emulator
from splatsoil.inverse.posterior import Data
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
    told = calibration.summarise(entries, made_up(8))["parameters"]["friction_angle"]
    assert told["coverage"] == {"0.5": 0.5, "0.9": 0.9}
    assert told["ranks"] == [1] * 10 and told["p_uniform"] == pytest.approx(1.0)
    assert told["rms_z"] == pytest.approx(1.0)
    piled = calibration.summarise([entry(0.5, 199, (False, False))] * 10, made_up(8))["parameters"]["friction_angle"]
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


def test_the_papers_table_counts_errors(tmp_path) -> None:  # type: ignore[no-untyped-def]
    from splatsoil.files import write_json

    protocol = paper_table.Protocol(angles=(35.0,), trials=2)
    for trial, error in enumerate((1.0, -2.0)):
        for way in ("published", "ours"):
            told = {"estimate": 35.0 + error, "low": 34.5, "high": 36.5}
            write_json(tmp_path / "trials" / f"35-{trial}-{way}.json", {way: told})
    (first, _) = paper_table.collect(protocol, tmp_path)["entries"]
    assert (first["mae"], first["bias"]) == (1.5, -0.5)
    assert first["std"] == pytest.approx(0.5**0.5) and first["scatter"] == pytest.approx(4.5**0.5)
    text = paper_table.table(paper_table.collect(protocol, tmp_path))
    assert "| 35° | 1.24 ± 0.96° | 1.50 ± 0.71° |" in text


def test_a_folder_keeps_one_protocol(tmp_path) -> None:  # type: ignore[no-untyped-def]
    from splatsoil.files import write_json

    write_json(tmp_path / "protocol.json", paper_table._kept_protocol(paper_table.Protocol(), tmp_path))
    assert paper_table._kept_protocol(paper_table.Protocol(trials=3), tmp_path)
    with pytest.raises(ParameterError, match="another protocol"):
        paper_table._kept_protocol(paper_table.Protocol(views=8), tmp_path)
