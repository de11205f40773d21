"""Where effects are switched on: at the defaults where the fit may have been led astray, and right from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated
from splatsoil.inverse.criticism.diagnosis import Options, diagnose
from splatsoil.inverse.criticism.evidence import gather, switched_on
from splatsoil.inverse.criticism.floor import floor_of
from splatsoil.inverse.criticism.looks import Looks, foreseen, look, promising
from splatsoil.inverse.criticism.sight import Sight
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import SimulationError
from splatsoil.experiment.emulated import EmulatedExperiment

WORLD = 77


def hiding(effect: str, size: float, angle: float = 1.0) -> EmulatedExperiment:
    """An experiment whose observation holds an effect."""
    plain = emulated(WORLD)
    return replace(plain, observed=plain.measured({"angle": angle, effect: size}, (WORLD, 5)))


def looked(experiment: EmulatedExperiment, at: float, simulate: Simulations | None = None) -> Looks:
    simulate = simulate or Simulations(experiment)
    return look(experiment, gather(experiment, simulate, {"angle": at}, repeats=4), simulate)


@pytest.mark.parametrize(
    ("at", "hidden", "astray", "off"), [(8.0, 30.0, True, True), (0.2, 30.0, False, True), (0.9, 0.0, False, False)]
)
def test_a_misfit_far_from_the_defaults_is_looked_at_from_there(
    at: float, hidden: float, astray: bool, off: bool
) -> None:
    experiment = hiding("effect 2", hidden)
    simulate = Simulations(experiment)
    found = looked(experiment, at, simulate)
    assert (found.astray, found.off) == (astray, off)
    names = [c.name for c in experiment.candidates]
    physics = {c.name for c in experiment.candidates if c.kind == "physics"}
    assert list(found.evidence.directions) == names, "what cameras report is drawn at the fit, and all are there"
    on = {
        tuple(visit.values.items()) for visit in found.evidence.visits if visit.effects and visit.effects[0] in physics
    }
    if astray:
        assert found.vantage is not None and found.vantage.directions.keys() == physics
        assert found.vantage.values == {"angle": experiment.parameters[0].default}
        assert not on, "nothing is switched on at the fit"
        assert not found.evidence.doubts.keys() & physics
    else:
        assert found.vantage is None and on
        assert found.evidence.doubts.keys() == {"angle", *physics}


def test_without_a_misfit_a_fit_far_from_the_defaults_is_as_good_as_any() -> None:
    experiment = hiding("effect 2", 0.0, angle=8.0)
    found = looked(experiment, 8.0)
    assert not (found.off or found.astray)


class Noted(Simulations):
    """Notes what is told of ahead, and forgotten, and what is asked for."""

    def __init__(self, experiment: EmulatedExperiment) -> None:
        super().__init__(experiment)
        self.early, self.late, self.forgot = set[str](), set[str](), False

    def ahead(self, work: Callable[..., object], *, apart: bool = False) -> None:
        nothing = np.zeros(self.experiment.layout.shape)
        work(lambda values, **what: (self.early.add(repr((values, what))), nothing)[1])

    def forget(self) -> None:
        self.early.clear()
        self.forgot = True

    def __call__(self, values, **what):  # type: ignore[no-untyped-def]
        self.late.add(repr((values, what)))
        return super().__call__(values, **what)


@pytest.mark.parametrize("at", [0.9, 8.0])
def test_what_looks_need_is_told_of_before_it_is_simulated(at: float) -> None:
    """Helpers make it side by side."""
    experiment = hiding("effect 2", 30.0)
    simulate = Noted(experiment)
    evidence = gather(experiment, simulate, {"angle": at}, repeats=4)
    simulate.late.clear()
    look(experiment, evidence, simulate)
    assert simulate.late and simulate.late == simulate.early


@pytest.mark.parametrize(("at", "hidden", "in_vain"), [(0.9, 30.0, False), (8.0, 30.0, False), (8.0, 0.0, True)])
def test_what_a_look_will_ask_for_is_foreseen_but_where_a_fit_far_off_is_right(
    at: float, hidden: float, in_vain: bool
) -> None:
    experiment = hiding("effect 2", hidden, angle=8.0 if in_vain else 1.0)
    simulate = Noted(experiment)
    evidence = gather(experiment, simulate, {"angle": at}, repeats=4)
    foreseen(experiment, evidence, simulate)
    early = set(simulate.early)
    simulate.late.clear()
    look(experiment, evidence, simulate)
    assert early and early.isdisjoint(simulate.late) is in_vain
    assert in_vain or early <= simulate.late
    assert simulate.forgot or not in_vain


def test_from_the_defaults_nothing_is_denied() -> None:
    """By one seed, and of other soil than that which was fitted."""
    sizes = detectable(WORLD, Options())
    experiment = hiding("effect 2", 4.0 * sizes["effect 2"])
    large = 3.0 * sizes["effect 5"]
    (coarse,) = (c for c in experiment.candidates if c.name == "effect 5")
    coarse = replace(coarse, parameters=(replace(coarse.parameters[0], meaningful=large),))
    among = tuple(coarse if c.name == coarse.name else c for c in experiment.candidates)
    experiment = replace(experiment, candidates=among)
    near, far = (diagnose(experiment, {"angle": at}).effects for at in (0.9, 8.0))
    assert near["effect 2"] == far["effect 2"] == "missing"
    assert near["effect 5"] == "absent"
    assert {far[c.name] for c in among if c.kind == "physics" and c.name != "effect 2"} == {"cannot tell"}


def test_a_bound_is_reason_enough_and_defaults_that_fail_are_none() -> None:
    upper = emulated(WORLD).parameters[0].upper
    experiment = hiding("effect 2", 0.0, angle=upper)
    found = looked(experiment, upper)
    assert found.astray and not found.off

    class Brittle(Simulations):
        def __call__(self, values, **others):  # type: ignore[no-untyped-def]
            if values["angle"] < 1.0:
                raise SimulationError("blew up")
            return super().__call__(values, **others)

    found = looked(experiment, upper, Brittle(experiment))
    assert found.vantage is None
    assert found.evidence.directions.keys() == {c.name for c in experiment.candidates}


def test_the_missing_effect_promises_most_from_there_and_what_promises_nothing_is_left_out() -> None:
    sizes = detectable(WORLD, Options())
    for effect in ("effect 2", "effect 5"):
        experiment = hiding(effect, 4.0 * sizes[effect])
        looks = looked(experiment, 8.0)
        found, bench = looks.vantage, looks.bench
        assert found is not None and bench.scorer is not None
        sight = Sight.of(experiment, bench.floor, bench.basis, found)
        names = promising(experiment, found, sight, bench.candidates, bench.scorer.price)
        assert names[0] == effect
        assert promising(experiment, found, sight, bench.candidates, lambda candidate: 1e9) == []


def test_sight_sees_what_was_switched_on_there() -> None:
    experiment = hiding("effect 2", 30.0)
    looks = looked(experiment, 8.0)
    found, bench = looks.vantage, looks.bench
    assert found is not None
    bare = replace(bench.floor, directions=bench.floor.directions[:, :0])
    table = next(iter(found.directions.values()))[0]
    alone, more = (Sight.of(experiment, bare, bench.basis[:, :1], v) for v in (None, found))
    whole = np.linalg.norm(more.solver.whiten(table[experiment.seen]))
    assert np.linalg.norm(more(table)) == pytest.approx(whole, rel=1e-6)
    assert np.linalg.norm(alone(table)) < 0.9 * whole


@pytest.mark.parametrize("replayed", [False, True])
def test_a_floor_that_knows_of_one_along_other_directions_is_what_it_would_be_alone(replayed: bool) -> None:
    made = emulated(WORLD)
    guessed = {f"guess {k}": 0.3 * made.slopes[f"effect {k}"] for k in range(1, 4)}
    experiment = replace(made, observed=made.measured({"angle": 1.0, "effect 2": 5.0}, (WORLD, 5)), guessed=guessed)
    simulate = Simulations(experiment)
    bare = gather(experiment, simulate, {"angle": 1.0})
    if replayed:
        bare = replace(bare, replays=2.0 * bare.repeats[:1])
    whole = switched_on(experiment, simulate, bare)
    first, alone = floor_of(experiment, bare), floor_of(experiment, whole)
    known = floor_of(experiment, whole, first)
    for part in alone.parts:
        assert known.parts[part].on_directions == alone.parts[part].on_directions
    assert any(alone.parts[part].on_directions != first.parts[part].on_directions for part in alone.parts)
    for one, other in ((known.noise, alone.noise), (known.single, alone.single)):
        assert np.array_equal(one.covariance, other.covariance)
    assert np.array_equal(known.free, alone.free)
