"""Expected information against closed forms, and against an experiment whose models are known functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.evidence import DISCREPANCY
from splatsoil.inverse.criticism.next_stroke import (
    Information,
    entropy,
    expected_information,
    information,
    posterior_draws,
    probable,
)
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.base import Run
from splatsoil.experiment.emulated import EmulatedExperiment

EVEN = {"a": 0.5, "b": 0.5}
EVEN_NAMES = {"": 0.5, "one": 0.5}


def two_gaussians(distance: float, p: float) -> float:
    """Mutual information in bits of a label of probability p and a number that is normal about 0 or a distance."""

    def density(x: float) -> float:
        return p * norm.pdf(x) + (1.0 - p) * norm.pdf(x - distance)

    mixed = quad(lambda x: -density(x) * np.log2(density(x)), -9.0, 9.0 + distance, limit=200)[0]
    return float(mixed - 0.5 * np.log2(2.0 * np.pi * np.e))


def scattered(n: int, distance: float, spread: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Simulations of two models in two dimensions that lie apart in the first, with a spread of their own in both."""
    rng = np.random.default_rng(seed)
    made = {name: spread * rng.standard_normal((n, 2)) for name in EVEN}
    made["b"][:, 0] += distance
    return made


@pytest.mark.parametrize(("distance", "p"), [(1.0, 0.5), (2.0, 0.5), (3.0, 0.5), (2.0, 0.9)])
def test_two_gaussians_have_the_information_of_the_closed_form(distance: float, p: float) -> None:
    """Noise of variance 0.6 and models' own spread of 0.4 make a variance of 1."""
    found = information(scattered(200, distance, np.sqrt(0.4)), {"a": p, "b": 1.0 - p}, 0.6 * np.eye(2))
    assert found.mean == pytest.approx(two_gaussians(distance, p), abs=3.0 * found.std + 0.01)
    assert found.std < 0.06


def test_correlated_noise_counts_as_it_is() -> None:
    """Two numbers whose noise is nearly the same: their difference tells what each alone does not."""
    covariance = np.array([[1.0, 0.99], [0.99, 1.0]])
    made = {name: np.zeros((50, 2)) for name in EVEN}
    made["b"][:, 0] = 0.3
    distance = float(np.sqrt(made["b"][0] @ np.linalg.solve(covariance, made["b"][0])))
    assert distance > 2.0
    found = information(made, EVEN, covariance)
    assert found.mean == pytest.approx(two_gaussians(distance, 0.5), abs=0.05)


def test_models_that_predict_the_same_tell_nothing() -> None:
    found = [information(scattered(8, 0.0, 1.0, seed), EVEN, 0.1 * np.eye(2), seed) for seed in range(20)]
    assert np.mean([f.mean for f in found]) < 0.05
    assert all(not f.distinguished for f in found)


def test_few_simulations_in_many_dimensions_do_not_make_models_differ() -> None:
    """Eight simulations of each model, alike, each one unlike all others in 40 numbers that hardly have noise."""
    rng = np.random.default_rng(1)
    found = information({name: rng.standard_normal((8, 40)) for name in EVEN}, EVEN, 0.01 * np.eye(40))
    assert found.mean < 2.0 * found.std + 0.02


def test_models_far_apart_tell_all_there_is() -> None:
    rng = np.random.default_rng(2)
    probability = {"a": 0.7, "b": 0.2, "c": 0.1}
    made = {name: rng.standard_normal((6, 3)) + 50.0 * np.eye(3)[k] for k, name in enumerate(probability)}
    found = information(made, probability, np.eye(3))
    assert found.mean == pytest.approx(entropy(probability), abs=0.01)
    assert entropy(probability) == pytest.approx(1.1568, abs=1e-4)
    assert found.distinguished == [("a", "b"), ("a", "c"), ("b", "c")]


def test_few_simulations_must_differ_by_more() -> None:
    """Differences of 1 ± 0.35, from 3 simulations or from 12 (ends of 95 % of Student's t: 4.30 and 2.20)."""
    zero = np.zeros(12)
    for count, clear in ((3, False), (12, True)):
        more = 1.0 + 0.35 * np.sqrt(count) * scaled(np.arange(count, dtype=np.float64))
        few = Information({"a": more, "b": zero[:count]}, {"a": 1.0, "b": 0.0}, {})
        assert few.std == pytest.approx(0.35)
        assert few.exceeds(Information({"a": zero[:count], "b": zero[:count]}, few.probability, {})) is clear


def scaled(values: np.ndarray) -> np.ndarray:
    return np.asarray((values - values.mean()) / values.std(ddof=1))


def diagnosis(**probability: float) -> dict[str, Any]:
    kinds = {"as_it_is": "base", "light": "observation", "something_else": "discrepancy"}
    names = {"as_it_is": "", "something_else": "something else"}
    return {
        "models": [
            {"name": names.get(name, name), "kind": kinds.get(name, "physics"), "probability": p}
            for name, p in probability.items()
        ]
    }


def test_probable_models_of_the_soil_are_told_apart() -> None:
    found = probable(diagnosis(as_it_is=0.1, something_else=0.36, cohesion=0.3, light=0.2, tilt=0.04))
    assert found == pytest.approx({"cohesion": 0.75, "": 0.25})
    assert list(found) == ["cohesion", ""]
    many = probable(diagnosis(as_it_is=0.4, a=0.14, b=0.13, c=0.12, d=0.11, e=0.1))
    assert set(many) == {"", "a", "b", "c"}


@pytest.mark.parametrize("given", [{"as_it_is": 0.99, "tilt": 0.01}, {"something_else": 0.97, "tilt": 0.03}])
def test_a_single_probable_model_is_refused(given: dict[str, float]) -> None:
    with pytest.raises(RunError, match="no two models to distinguish"):
        probable(diagnosis(**given))


@dataclass(frozen=True)
class Proposal(EmulatedExperiment):
    """An experiment that has not been made, of known functions."""

    def expect(self, table: np.ndarray) -> None:
        object.__setattr__(self, "observed", table)


def proposed(experiment: EmulatedExperiment, **scale: float) -> Proposal:
    """With what some parameters do scaled."""
    slopes = {name: scale.get(name, 1.0) * slope for name, slope in experiment.slopes.items()}
    return Proposal(**{**vars(experiment), "slopes": slopes})


def test_the_experiment_in_which_an_effect_acts_tells_most(make: Callable[..., EmulatedExperiment]) -> None:
    """Twice the effect is seen better; without it no data tell, however many."""
    rng = np.random.default_rng(0)
    angles = [{"friction_angle": float(v)} for v in rng.normal(35.0, 0.5, 8)]
    draws = {
        "": angles,
        "one": [{**a, "one_size": float(s)} for a, s in zip(angles, rng.normal(3.0, 0.5, 8), strict=True)],
    }
    probability = {"": 0.6, "one": 0.4}

    def informed(scale: float) -> Information:
        experiment = proposed(make({}), one_size=scale)
        return expected_information(experiment, draws, probability, Simulations(experiment))

    none, usual, strong = informed(0.0), informed(1.0), informed(3.0)
    assert none.mean < 0.05
    assert strong.exceeds(none) and strong.mean >= usual.mean
    assert strong.distinguished == [("", "one")]
    assert strong.mean == pytest.approx(entropy(probability), abs=0.1)


def test_a_simulation_that_cannot_go_on_costs_itself_alone(make: Callable[..., EmulatedExperiment]) -> None:
    experiment = proposed(make({}))
    draws = {
        "": [{"friction_angle": 34.0 + 0.25 * i} for i in range(6)],
        "one": [{"friction_angle": 34.0 + 0.25 * i, "one_size": 8.0} for i in range(6)],
    }

    def fails(most: int) -> Callable[..., np.ndarray]:
        def simulate(run: Run) -> np.ndarray:
            if run.effects and run.values["friction_angle"] < 34.0 + 0.25 * most:
                raise SimulationError("no step is short enough")
            return Simulations(experiment)(run)

        return simulate

    found = expected_information(experiment, draws, EVEN_NAMES, fails(2))
    assert np.isnan(found.bits["one"]).tolist() == [True] * 2 + [False] * 4
    assert np.isfinite(found.mean)
    with pytest.raises(SimulationError, match="one could hardly be simulated"):
        expected_information(experiment, draws, EVEN_NAMES, fails(4))


def test_draws_are_of_the_posterior(make: Callable[..., EmulatedExperiment]) -> None:
    found = diagnose(make({"one_size": 6.0}), {"friction_angle": 35.0})
    draws = posterior_draws(found.evidence, 0)
    assert "" in draws and DISCREPANCY not in draws
    assert all(found.evidence.probability[name] >= 0.05 for name in draws if name)
    mean, std = found.evidence.models["one"].moments("one_size")
    drawn = np.array([d["one_size"] for d in draws["one"]])
    assert abs(drawn.mean() - mean) < 4.0 * std / np.sqrt(len(drawn))
