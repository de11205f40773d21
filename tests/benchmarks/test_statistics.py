"""The benchmarks' own arithmetic, on worlds whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import bo_vs_mcmc, calibration
from splatsoil.benchmarks._simulations import Data, density_of
from splatsoil.inverse.bayesopt import sobol

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
    }


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
    density = density_of(SPACE, data.points, -data.residuals, np.zeros(data.residuals.shape[1]), 0.0)
    found = bo_vs_mcmc.run(
        bo_vs_mcmc.EmulatedWorld(density),
        ways=("mcmc", "direct"),
        budgets=(6, 16),
        direct=(20, 400),
        seeds=2,
    )
    by = {(e["way"], e["calls"]): e for e in found["entries"]}
    assert set(by) == {("mcmc", 6), ("mcmc", 16), ("direct", 20), ("direct", 400)}
    # Chance of 0.5 on a slope of 5 per half range of 15 degrees: 1.5 degrees, and observation and call have it both.
    assert by["mcmc", 16]["mae"][0] < 5.0 and by["direct", 400]["mae"][0] < 5.0
    assert "| mcmc | 16 |" in bo_vs_mcmc.table({**found, "landscape": "A test"})
    assert bo_vs_mcmc.figure({**found, "landscape": ""}).axes
