"""The second look: taken where the fit may have been led astray, and right about what is missing from there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated
from splatsoil.inverse.criticism.afresh import look_afresh, promising
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.diagnosis import Options
from splatsoil.inverse.criticism.evidence import Evidence, Vantage, gather
from splatsoil.inverse.criticism.sight import Sight
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.experiment.emulated import EmulatedExperiment

WORLD = 77


def hiding(effect: str, size: float, angle: float = 1.0) -> EmulatedExperiment:
    """An experiment whose observation holds an effect."""
    plain = emulated(WORLD)
    return replace(plain, observed=plain.measured({"angle": angle, effect: size}, (WORLD, 5)))


def look(experiment: Experiment, evidence: Evidence, off: bool, simulate: Simulations) -> Vantage | None:
    bench = Bench.of(experiment, evidence)
    return look_afresh(experiment, evidence, off, simulate, bench.floor, bench.basis)


@pytest.mark.parametrize(("at", "off", "looks"), [(8.0, True, True), (8.0, False, False), (0.2, True, False)])
def test_it_is_taken_where_a_misfit_stands_far_from_the_defaults(at: float, off: bool, looks: bool) -> None:
    experiment = hiding("effect 2", 1.0)
    simulate = Simulations(experiment)
    evidence = gather(experiment, simulate, {"angle": at}, repeats=3)
    found = look(experiment, evidence, off, simulate)
    assert (found is not None) is looks
    if found is not None:
        assert found.values == {"angle": experiment.parameters[0].default}
        physics = {c.name for c in experiment.candidates if c.kind == "physics"}
        assert found.directions.keys() == physics, "what cameras report is drawn of the same soil everywhere"


def test_a_bound_is_reason_enough_and_defaults_that_fail_are_none() -> None:
    experiment = hiding("effect 2", 1.0)
    upper = experiment.parameters[0].upper
    evidence = gather(experiment, Simulations(experiment), {"angle": upper}, repeats=3)
    assert look(experiment, evidence, False, Simulations(experiment)) is not None

    class Brittle(Simulations):
        def __call__(self, values, **others):  # type: ignore[no-untyped-def]
            if values["angle"] < 1.0:
                raise SimulationError("blew up")
            return super().__call__(values, **others)

    assert look(experiment, evidence, False, Brittle(experiment)) is None


def test_the_missing_effect_promises_most_from_there_and_what_promises_nothing_is_left_out() -> None:
    sizes = detectable(WORLD, Options())
    for effect in ("effect 2", "effect 5"):
        experiment = hiding(effect, 4.0 * sizes[effect])
        simulate = Simulations(experiment)
        evidence = gather(experiment, simulate, {"angle": 8.0}, repeats=4)
        bench = Bench.of(experiment, evidence)
        found = look(experiment, evidence, True, simulate)
        assert found is not None and bench.scorer is not None
        sight = Sight.of(experiment, bench.floor, bench.basis, found)
        names = promising(experiment, found, sight, bench.candidates, bench.scorer.price)
        assert names[0] == effect
        assert promising(experiment, found, sight, bench.candidates, lambda candidate: 1e9) == []


def test_sight_sees_what_was_switched_on_there() -> None:
    experiment = hiding("effect 2", 1.0)
    simulate = Simulations(experiment)
    evidence = gather(experiment, simulate, {"angle": 8.0}, repeats=4)
    bench = Bench.of(experiment, evidence)
    found = look(experiment, evidence, True, simulate)
    assert found is not None
    bare = replace(bench.floor, directions=bench.floor.directions[:, :0])
    table = next(iter(found.directions.values()))[0]
    alone, more = (Sight.of(experiment, bare, bench.basis[:, :1], v) for v in (None, found))
    whole = np.linalg.norm(more.solver.whiten(table[experiment.seen]))
    assert np.linalg.norm(more(table)) == pytest.approx(whole, rel=1e-6)
    assert np.linalg.norm(alone(table)) < 0.9 * whole
