"""Refits from a base fit that the missing effect has pushed onto a bound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.refit import Start, settle

from splatsoil.errors import SimulationError
from splatsoil.experiment.emulated import EmulatedExperiment, FloatArray
from splatsoil.parameters import Parameter

TRUTH = {"angle": -3.0, "effect 2": 12.0}


@dataclass(frozen=True)
class Stiffening(EmulatedExperiment):
    """The steeper the soil stands, the less it flows, and the less there is for an effect to change.

    The effect does to the pictures what a larger angle does, and something of its own beside.
    """

    def expected(self, values: Mapping[str, float], numerics: str = "") -> FloatArray:
        """(t, s) features without chance."""
        angle, effect = values["angle"], values.get("effect 2", 0.0)
        rest = super().expected({**values, "angle": 0.0, "effect 2": 0.0}, numerics)
        flows = np.exp(-0.08 * (angle + 1.5 * effect))
        own = 0.25 * effect * np.exp(-0.08 * angle)
        return rest - 80.0 * flows * self.slopes["angle"] + own * self.slopes["effect 2"]


@pytest.fixture(scope="module")
def experiment() -> Stiffening:
    made = Stiffening(**emulated(77).__dict__)
    return replace(made, observed=made.measured(TRUTH, [77, 99]))


def test_the_truth_is_found_from_a_fit_on_the_bound(experiment: Stiffening) -> None:
    angles = np.linspace(-10.0, 10.0, 21)
    losses = [np.sum((experiment.observed - experiment.predict({"angle": angle})) ** 2) for angle in angles]
    assert np.argmin(losses) == 20, "without the effect, the fit must lie on the bound"
    found = diagnose(experiment, {"angle": 10.0})
    assert found.members[0] == "effect 2"
    best = found.confirmations["effect 2"]
    for name, value in TRUTH.items():
        assert abs(best.values[name] - value) < 2.5 * best.stds[name], name
    assert best.stds["effect 2"] < 0.2 * TRUTH["effect 2"]
    assert best.held_out < 1.2 * best.floor


def valley(values: Mapping[str, float]) -> np.ndarray:
    """A function of one parameter with a poor minimum at 9 and the best one at 2."""
    a = values["a"]
    if a < -4.0:
        raise SimulationError("too far")
    return np.array([[3.0 + 0.3 * (a - 9.0) ** 2 if a > 6.0 else 1.425 * (a - 2.0), 0.5]])


PARAMETER = Parameter("a", "1", -5.0, 10.0, 0.0, meaningful=0.1)


def start(value: float) -> Start:
    here = valley({"a": value})
    slope = (valley({"a": value + 0.01}) - here) / 0.01
    return Start({"a": value}, here, slope[..., None])


def test_the_best_of_several_starts_is_kept_and_gone_on_from() -> None:
    def whiten(table: np.ndarray) -> np.ndarray:
        return table[0]

    def settled(*places: float) -> float:
        starts = [start(place) for place in places]
        return settle(valley, whiten, np.zeros((1, 2)), [PARAMETER], starts, chance=False, renewed=["a"]).values["a"]

    assert settled(8.0) > 7.0, "the test needs a start that leads astray"
    assert settled(8.0, 0.0) == pytest.approx(2.0, abs=0.1)
    assert settled(0.0, 8.0) == pytest.approx(2.0, abs=0.1)
