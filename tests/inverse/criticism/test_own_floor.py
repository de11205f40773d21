"""Parameters of soil whose missing effect lets numerics change what they don't change without it, as cohesion does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated, fitted
from splatsoil.inverse.criticism.diagnosis import Options, diagnose

from splatsoil.experiment.emulated import EmulatedExperiment, FloatArray

NAME, SHIFT = "effect 2", 5.0


@dataclass(frozen=True)
class Clods(EmulatedExperiment):
    """Once the effect is on, a finer grid looks like another angle."""

    def expected(self, values: Mapping[str, float], numerics: str = "") -> FloatArray:
        """(t, s) features without chance."""
        there = values.get(NAME, 0.0) > 0.0 and numerics == "grid"
        return super().expected(values, numerics) + SHIFT * there * self.slopes["angle"]


def test_numerics_of_soil_with_the_effect_shift_no_parameter_unseen() -> None:
    """Observed is what the finer grid makes of such soil: without a floor of its own the angle is off by 4.5 (root mean
    square), 4.8 of its stated standard deviations."""
    errors, stds = [], []
    for world in range(4):
        made = Clods(**emulated(world).__dict__)
        truth = {"angle": 0.0, NAME: 6.0 * detectable(world, Options())[NAME]}
        finer = made.expected(truth, "grid") - made.expected(truth)
        experiment = replace(made, observed=made.measured(truth, [world, 99]) + finer)
        found = diagnose(experiment, {"angle": fitted(experiment)})
        assert found.members[0] == NAME
        best = found.confirmations[NAME]
        errors.append(best.values["angle"])
        stds.append(best.stds["angle"])
        assert best.values[NAME] == pytest.approx(truth[NAME], rel=0.15)
    assert np.sqrt(np.mean(np.square(errors))) < 2.7
    assert np.sqrt(np.mean(np.square(np.divide(errors, stds)))) < 1.7
    # A spread as wide as what is believed before any data would hold any truth.
    assert max(stds) < SHIFT
