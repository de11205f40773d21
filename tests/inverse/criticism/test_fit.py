"""A fit is a search and a comparison of what it simulated; later commands start from the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.envs.problem import Evaluation, Image
from splatsoil.inverse.criticism.design import Prior
from splatsoil.inverse.criticism.diagnosis import BASE_RUNS, PAIRS
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.evaluations import EvaluationRecord
from splatsoil.inverse.fitting import FitSetup, fit
from splatsoil.inverse.posterior import Density, run_posterior
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands._stages import compare_models, prior_of
from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Run
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.parameters import Parameter, ParameterSpace

Make = Callable[..., EmulatedExperiment]
BUDGET = 6
DRAWN = 3
"""Drawings of one simulation: as usual, and by two guesses."""


class Searched:
    """An experiment as a search sees it."""

    worst_loss = 1e6
    image_size = (2, 2)

    def __init__(self, experiment: EmulatedExperiment) -> None:
        self.experiment = experiment
        self.space = ParameterSpace(experiment.parameters)
        self.block_count = experiment.observed.size

    def begin(self, seed: int) -> None:
        """Nothing is drawn."""

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        blocks = (self.experiment.observed - self.experiment.predict(Run(parameters, seed=seed))).reshape(-1)
        return Evaluation(float(np.mean(blocks**2)), blocks)

    def observed_image(self) -> Image:
        return np.zeros((2, 2, 3), dtype=np.float32)

    def truth(self) -> None:
        """Nobody knows it."""


def fitted(experiment: EmulatedExperiment, folder: Path, budget: int = BUDGET) -> tuple[RunFolder, dict[str, Any], int]:
    """A fit, and how many simulations its comparison made."""
    measurement = {"name": "emulated", "folder": "nowhere", "hash": "e" * 64}
    run = RunFolder.prepare(folder, measurement=measurement, preset="tiny", seed=3, version="0")
    setup = FitSetup("e" * 64, "", tuple(p.name for p in experiment.parameters), (), "tiny", "cpu", 3, "0")
    simulate = Simulations(experiment, folder / "features")

    def kept(done: int, record: EvaluationRecord) -> None:
        table = experiment.observed - np.reshape(record.blocks, experiment.layout.shape)
        simulate.store(table, Run(record.parameters, seed=record.seed))

    def compared(found: dict[str, Any]) -> Any:
        return compare_models(experiment, simulate, found, lambda what, share: None, 3, with_effects=False)

    result = fit(Searched(experiment), run, setup, budget=budget, compare=compared, after_evaluation=kept)
    return run, result, simulate.simulated


def test_nothing_is_simulated_twice_and_all_say_the_same(make: Make, tmp_path: Path) -> None:
    experiment = make()
    run, result, made = fitted(experiment, tmp_path)
    assert result["estimated_from"] == "comparison"
    assert made == BASE_RUNS - BUDGET + PAIRS + DRAWN
    angle = result["parameters"]["friction_angle"]
    assert abs(angle["estimate"] - 33.0) < 3.0 * angle["std"] < 6.0
    assert angle["low"] < angle["estimate"] < angle["high"] and angle["determined"]
    assert run.fit() == result

    again = Simulations(experiment, tmp_path / "features")
    found = compare_models(experiment, again, run.fit(), lambda what, share: None, 3, with_effects=False)
    assert again.simulated == 0, "a comparison finds every simulation"
    assert found.estimates["friction_angle"] == (angle["estimate"], angle["std"])
    more = Simulations(experiment, tmp_path / "features")
    found = compare_models(experiment, more, run.fit(), lambda what, share: None, 3, with_effects=True)
    assert set(found.evidence.models) > {"one", "two", "three"}
    assert more.requested - more.simulated >= BUDGET + made, "so does a diagnosis"

    resumed, same, none = fitted(experiment, tmp_path)
    assert none == 0 and same["parameters"] == result["parameters"] and resumed.fit()["minimum"] == result["minimum"]


def test_an_interrupted_comparison_goes_on_to_the_same_end(make: Make, tmp_path: Path) -> None:
    _, whole, made = fitted(make(), tmp_path / "whole")

    class Stopping(EmulatedExperiment):
        """Simulates so often, and no more."""

        def predict(self, *words: Any, **others: Any) -> np.ndarray:
            left.pop()
            return super().predict(*words, **others)

    left = [None] * (BUDGET + 5)
    with pytest.raises(IndexError):
        fitted(Stopping(**vars(make())), tmp_path / "cut")
    assert not (tmp_path / "cut" / "fit.json").exists()
    _, result, rest = fitted(make(), tmp_path / "cut")
    assert rest == made - 5 and result["parameters"] == whole["parameters"]


def test_where_too_few_can_be_simulated_the_estimate_is_the_minimum_of_the_loss(make: Make, tmp_path: Path) -> None:
    class Failing(EmulatedExperiment):
        """Only what the search asks for can be made."""

        def predict(self, *words: Any, **others: Any) -> np.ndarray:
            if not left:
                raise SimulationError("soil left the bin")
            left.pop()
            return super().predict(*words, **others)

    left = [None] * 3
    _, result, _ = fitted(Failing(**vars(make())), tmp_path, budget=3)
    assert result["estimated_from"] == "loss"
    assert result["parameters"]["friction_angle"]["estimate"] == result["minimum"]["friction_angle"]["estimate"]
    assert "could not be compared" in result["notes"][0] and "soil left the bin" in result["notes"][0]


def test_the_chains_sample_what_the_comparison_integrates(make: Make, tmp_path: Path) -> None:
    """And a sum over a grid does, too."""
    experiment = make()
    run, result, _ = fitted(experiment, tmp_path)
    simulate = Simulations(experiment, tmp_path / "features")
    prior = prior_of(experiment, run.fit())
    found = compare_models(experiment, simulate, run.fit(), lambda what, share: None, 3, with_effects=False)
    density = Density.of(found.evidence.noise, prior, 3)
    grid = np.linspace(-1.0, 1.0, 2001)
    log = density(grid[:, None])
    weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    angles = prior.space.from_unit(grid[:, None])[:, 0]
    mean = float(weight @ angles)
    std = float(np.sqrt(weight @ (angles - mean) ** 2))
    sampled = run_posterior(run, experiment, simulate, density, checks=2)
    angle, fitted_angle = sampled["parameters"]["friction_angle"], result["parameters"]["friction_angle"]
    assert angle["mean"] == pytest.approx(mean, abs=0.1 * std) and angle["std"] == pytest.approx(std, rel=0.1)
    assert fitted_angle["estimate"] == pytest.approx(mean, abs=0.1 * std)
    assert fitted_angle["std"] == pytest.approx(std, rel=0.1)
    for end in ("low", "high"):
        assert fitted_angle[end] == pytest.approx(angle[end], abs=0.15 * std)
    assert angle["verdict"] == "determined" and sampled["chains"]["converged"]
    assert len(sampled["checks"]) == 2 and np.mean([c["chi2"] for c in sampled["checks"]]) < 4.0
    for name in ("posterior.nc", *sampled["figures"]):
        assert (tmp_path / "posterior" / name).stat().st_size > 1000
    again = run_posterior(run, experiment, simulate, density, checks=2)
    assert again["parameters"] == sampled["parameters"]
    arviz = pytest.importorskip("arviz")
    drawn = arviz.from_netcdf(tmp_path / "posterior" / "posterior.nc").posterior["friction_angle"].to_numpy()
    assert drawn.shape[0] == 4 and drawn.mean() == pytest.approx(angle["mean"], abs=1e-6)


def test_a_prior_holds_both_ends_of_what_a_search_leaves_possible(make: Make) -> None:
    tilt = Parameter("tilt", "deg", -10.0, 10.0, 0.0, off=0.0, meaningful=0.5)
    experiment = EmulatedExperiment(**{**vars(make()), "parameters": (*make().parameters, tilt)})
    low, high = {"friction_angle": 30.0, "tilt": -1.0}, {"friction_angle": 32.0, "tilt": 3.0}
    prior = Prior.of(experiment, low, high)
    assert [(p.lower, p.upper) for p in prior.space] == [(20.0, 50.0), (-3.0, 7.0)]
    runs = [Run({"friction_angle": 50.0, "tilt": t}) for t in (-3.0, -3.1, 7.0)]
    assert prior.inside(runs) == [runs[0], runs[2]]
