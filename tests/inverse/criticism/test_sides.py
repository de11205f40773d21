"""Effects that show less on one side, against features whose two sides are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.derivatives import step_of
from splatsoil.inverse.criticism.diagnosis import Options, diagnose
from splatsoil.inverse.criticism.evidence import STRIDE, gather, switched_on
from splatsoil.inverse.criticism.sides import lopsided
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.emulated import EmulatedExperiment

BOTH, ONE = "effect 1", "effect 2"
"""Effects without a sign, and with one."""


def bent(world: int, less: float, chance: float = 0.1, chaos: float = 0.0) -> EmulatedExperiment:
    """A world in which the first effect shows ``less`` times its mean on one side, and as much more on the other."""
    made = emulated(world, chaos=chaos)
    step = abs(step_of(made.candidates[0].measure, STRIDE))
    curve = 2.0 * (less - 1.0) / step * made.slopes[BOTH]
    made = replace(made, curves={**made.curves, BOTH: curve}, chance_root=chance * made.chance_root)
    return replace(made, observed=made.measured({"angle": 0.0}, [world, 5]))


def told(experiment: EmulatedExperiment) -> dict[str, float]:
    simulate = Simulations(experiment)
    evidence = switched_on(experiment, simulate, gather(experiment, simulate, {"angle": 0.0}))
    return lopsided(experiment, evidence, Bench.of(experiment, evidence).floor)


def test_sides_seen_from_elsewhere_are_none_of_the_fit() -> None:
    """Where the fit was led astray effects are switched on at the defaults; its own point has no sides then."""
    experiment = bent(0, 0.5)
    simulate = Simulations(experiment)
    evidence = switched_on(experiment, simulate, gather(experiment, simulate, {"angle": 0.0}))
    moved = tuple(replace(v, values={**v.values, "angle": 1.0}) if v.effects == (BOTH,) else v for v in evidence.visits)
    floor = Bench.of(experiment, evidence).floor
    assert BOTH in lopsided(experiment, evidence, floor)
    assert BOTH not in lopsided(experiment, replace(evidence, visits=moved), floor)


@pytest.mark.parametrize("less", [1.0, 0.5, 0.25])
def test_a_side_that_shows_less_is_measured(less: float) -> None:
    found = [told(bent(world, less)) for world in range(6)]
    assert not any(ONE in of_one for of_one in found)
    assert np.median([of_one[BOTH] for of_one in found]) == pytest.approx(1.0 / less, rel=0.15)


def test_chance_is_not_taken_for_sides_that_differ() -> None:
    """Where soil is another one whenever it differs at all, second differences are mostly chance."""
    found = np.array([list(told(bent(world, 1.0, 1.0, chaos=1.0)).values()) for world in range(6)])
    assert np.median(found) < 1.1
    assert np.quantile(found, 0.9) < 1.5


def test_what_is_detectable_is_told_of_the_weaker_side() -> None:
    """Of features of four times as little on one side four times as much is needed there, beyond what is trivial."""
    even, odd = (diagnose(bent(3, less), {"angle": 0.0}, options=Options(refits=0)) for less in (1.0, 0.25))
    trivial = 0.25
    ratio = (odd.scores[BOTH].detectable - trivial) / (even.scores[BOTH].detectable - trivial)
    assert ratio == pytest.approx(4.0, rel=0.25)
    assert odd.scores[ONE].detectable == pytest.approx(even.scores[ONE].detectable, rel=0.1)
    assert odd.scores[BOTH].std == pytest.approx(even.scores[BOTH].std, rel=0.1)
