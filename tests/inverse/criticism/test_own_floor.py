"""Parameters of soil whose missing effect lets numerics change what they don't change without it, as cohesion does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated, fitted
from splatsoil.inverse.criticism import own_floor
from splatsoil.inverse.criticism.confirmation import confirm
from splatsoil.inverse.criticism.diagnosis import Options, diagnose
from splatsoil.inverse.criticism.misfit import smooth_basis
from splatsoil.inverse.criticism.own_floor import as_it_is
from splatsoil.inverse.criticism.record import record
from splatsoil.inverse.criticism.refit import optimum
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.criticism.words import sentences

from splatsoil.experiment.emulated import EmulatedExperiment, FloatArray

NAME, SHIFT, LOUD = "effect 2", 5.0, 2.0


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
        # Without what numerics that weren't tried may do: this one was.
        stds.append(np.sqrt(best.stds["angle"] ** 2 - best.systematic["angle"] ** 2))
        assert best.values[NAME] == pytest.approx(truth[NAME], rel=0.15)
    assert np.sqrt(np.mean(np.square(errors))) < 2.7
    assert np.sqrt(np.mean(np.square(np.divide(errors, stds)))) < 1.7
    # A spread as wide as what is believed before any data would hold any truth.
    assert max(stds) < SHIFT


def test_parameters_are_known_no_better_than_parts_of_the_data_agree() -> None:
    """What each stage says to each camera has an angle of its own, and no numerics were tried that could tell of it."""
    off, systematic = [], []
    for world in range(4):
        made = replace(emulated(world), patterns={})
        stages = tuple(f"stage {row // 2}" for row in range(made.layout.shape[0]))
        made = replace(made, layout=replace(made.layout, stages=stages))
        truth = {"angle": 0.0, NAME: 6.0 * detectable(world, Options())[NAME]}
        parts = made.layout.parts
        own = 6.0 * np.random.default_rng([world, 3]).standard_normal(parts.max() + 1)[parts]
        experiment = replace(made, observed=made.measured(truth, [world, 99], own * made.slopes["angle"]))
        best = diagnose(experiment, {"angle": fitted(experiment)}).confirmations[NAME]
        off += [(best.values[name] - truth[name]) / best.stds[name] for name in truth]
        systematic.append(best.systematic["angle"])
    assert np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.median(systematic) > 0.5


def test_what_is_systematic_is_no_more_than_bounds_leave_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_floor, "at_odds", lambda *_: np.full(2, 1e6))
    made = emulated(0)
    truth = {"angle": 0.0, NAME: 6.0 * detectable(0, Options())[NAME]}
    experiment = replace(made, observed=made.measured(truth, [0, 99]))
    best = diagnose(experiment, {"angle": fitted(experiment)}).confirmations[NAME]
    (angle,) = experiment.parameters
    # uniform between the bounds
    assert best.systematic["angle"] == pytest.approx((angle.upper - angle.lower) / np.sqrt(12.0))


class Noted(Simulations):
    """Simulations that remember what they were for, and where floors with an effect were measured."""

    def __init__(self, experiment: EmulatedExperiment) -> None:
        super().__init__(experiment)
        self.where: list[dict[str, float]] = []
        self.purposes: list[str] = []
        self.seeds: dict[str, list[int]] = {}

    def __call__(self, values: Mapping[str, float], *, purpose: str = "", **others: Any) -> FloatArray:
        self.purposes.append(purpose)
        self.seeds.setdefault(purpose, []).append(others.get("seed", 0))
        if purpose.startswith("floor with"):
            self.where.append(dict(values))
        return super().__call__(values, purpose=purpose, **others)


@pytest.mark.parametrize(("stds", "moved"), [(0.3, False), (-0.3, False), (2.0, True)])
def test_the_floor_is_measured_where_all_times_put_the_parameters(stds: float, moved: bool) -> None:
    """Refits see every other time only, which may lead them off; what is told is by all times. Where that is no other
    place, what was simulated there counts, once."""
    made = emulated(0)
    truth = {"angle": 0.0, NAME: 4.0 * detectable(0, Options())[NAME]}
    experiment = replace(made, observed=made.measured(truth, [0, 99]))
    simulate = Noted(experiment)
    found = diagnose(experiment, {"angle": fitted(experiment)}, simulate=simulate)
    best, residual = found.confirmations[NAME], (experiment.observed - found.evidence.mean)[experiment.seen]
    told = {name: best.fit.values[name] + stds * std for name, std in best.stds.items()}
    (candidate,) = (c for c in experiment.candidates if c.name == NAME)
    simulate.where.clear()
    before = simulate.made
    own = own_floor.on_its_own_floor(
        experiment, found.evidence, replace(best, values=told), candidate, simulate, residual
    )
    there = told if moved else {name: best.fit.values[name] for name in told}
    assert simulate.where and all(point == there for point in simulate.where)
    assert simulate.made > before or not moved
    tables = [visit.table.tobytes() for visit in own.refit.visits]
    assert len(tables) == len(set(tables))


def test_refits_simulate_by_several_seeds_and_are_compared_by_the_same_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """A seed's own chance is in all that it simulates; where refits are compared, a part of it cancels."""
    made = emulated(0)
    truth = {"angle": 0.0, NAME: 6.0 * detectable(0, Options())[NAME]}
    guessed = {f"guess {k}": 0.01 * k * made.slopes["effect 3"] for k in range(1, 4)}
    experiment = replace(made, observed=made.measured(truth, [0, 99]), guessed=guessed)
    read, read_off, simulate = own_floor.read, [], Noted(experiment)
    floor_of, there = own_floor.floor_of, []
    monkeypatch.setattr(own_floor, "floor_of", lambda *told: there.append(told[1]) or floor_of(*told))
    monkeypatch.setattr(own_floor, "read", lambda visits, *told: read_off.append(visits) or read(visits, *told))
    found = diagnose(experiment, {"angle": fitted(experiment)}, simulate=simulate)
    asked = {purpose: seeds for purpose, seeds in simulate.seeds.items() if purpose.startswith("refit ")}
    compared = {purpose: seeds for purpose, seeds in asked.items() if purpose.endswith("once more")}
    refits = {purpose: seeds for purpose, seeds in asked.items() if purpose not in compared}
    assert len(refits) == len(found.confirmations)
    stopped = {f"refit {name} once more" for name, c in found.confirmations.items() if name and c.stopped}
    assert len(compared) >= 2 and not compared.keys() & stopped
    assert all(seeds == [0, 1, 2, 3] for seeds in compared.values())
    for seeds in refits.values():
        counts = np.bincount(seeds[:-1], minlength=1)
        assert np.count_nonzero(counts) >= min(len(seeds) - 1, 5)
        assert counts.max() <= 0.4 * len(seeds) + 1.0
    # What was repeated and looked at by another seed is there already, and tells as much.
    at_the_fit = [v for v in found.evidence.visits if v.values == found.evidence.values]
    on_the_floor = [v for v in read_off[-1] if v.values == simulate.where[0]]
    for visits in (at_the_fit, on_the_floor):
        assert {1, 2, 3, 4} <= {visit.seed for visit in visits}
    # The point itself may be of another simulation than the guesses are drawn of: they are told from their own mean.
    assert len(there[-1].guesses) == 3
    assert np.abs(there[-1].guesses.mean(axis=0)).max() < 1e-9 < np.abs(there[-1].guesses).max()
    best = found.confirmations[NAME]
    expected = experiment.predict(best.fit.values, effects=(NAME,), seed=0)
    assert np.array_equal(best.fit.prediction, expected)


@dataclass(frozen=True)
class Restless(EmulatedExperiment):
    """Once there is much of the effect, what is chance is twice as large: clods stand or fall."""

    much: float = 0.0

    def predict(self, values: Mapping[str, float], *, numerics: str = "", **others: Any) -> FloatArray:
        """(t, s) features."""
        table, mean = super().predict(values, numerics=numerics, **others), self.expected(values, numerics)
        return mean + (LOUD if values.get(NAME, 0.0) > self.much else 1.0) * (table - mean)


def test_an_error_is_held_against_what_soil_with_the_effect_leaves_by_chance() -> None:
    """Such soil leaves more than soil without it, on whose floor the model as it is goes on to be judged."""
    truth = {"angle": 0.0, NAME: 6.0 * detectable(0, Options())[NAME]}
    made = Restless(**emulated(0).__dict__, much=0.7 * truth[NAME])
    experiment = replace(made, observed=made.measured(truth, [0, 99]))
    found = diagnose(experiment, {"angle": fitted(experiment)})
    assert found.members[0] == NAME
    best, before = found.confirmations[NAME], found.confirmations[""]
    assert best.floor > 1.2 * before.floor
    told = sentences(found, {c.name: c for c in experiment.candidates}, found.evidence.values)
    assert any(f"{before.floor:.2g} without it, and {best.floor:.2g} in soil that has it" in line for line in told)


def with_the_effect(world: int) -> tuple[EmulatedExperiment, dict[str, float]]:
    """Soil of which 0.4 of the chance is another one wherever it differs, the effect a part of the model; its truth."""
    made = emulated(world, chaos=0.4)
    truth = {"angle": 5.0 * (-1) ** world, NAME: 6.0 * detectable(world, Options())[NAME]}
    (effect,) = (c for c in made.candidates if c.name == NAME)
    made = replace(
        made,
        model=(NAME,),
        home={**made.home, NAME: 0.0},
        parameters=(*made.parameters, effect.measure),
        candidates=tuple(c for c in made.candidates if c.name != NAME),
    )
    return replace(made, observed=made.measured(truth, [world, 99])), truth


def nearby(experiment: EmulatedExperiment, truth: dict[str, float]) -> dict[str, float]:
    """A fit that began too near the defaults."""
    return optimum(experiment, Simulations(experiment), {"angle": 0.6 * truth["angle"], NAME: 0.8 * truth[NAME]})


def test_parameters_of_a_model_that_has_an_effect_are_told_as_well_as_is_said() -> None:
    """By two seeds' derivatives, as a model without effects is read, three of the six angles end at a bound."""
    off, errors = [], []
    for world in range(6):
        experiment, truth = with_the_effect(world)
        found = diagnose(experiment, nearby(experiment, truth))
        assert found.verdict == "adequate"
        told = found.estimates
        off += [(told[name].value - truth[name]) / told[name].std for name in truth]
        errors.append(told["angle"].value - truth["angle"])
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.6
    # halves of the range are 10; a guess of the default would be off by 5
    assert np.sqrt(np.mean(np.square(errors))) < 3.5


def test_solvers_that_are_apart_count_in_a_model_that_has_an_effect() -> None:
    experiment, truth = with_the_effect(0)
    fit = nearby(experiment, truth)
    both = [diagnose(replace(experiment, apart=apart), fit) for apart in ({}, {"angle": 2.0})]
    alone, among = (found.estimates["angle"] for found in both)
    kept = record(experiment, both[1])["estimates"]["angle"]
    assert (kept["systematic"], kept["std"]) == (among.systematic, among.std)
    assert among.systematic == pytest.approx(np.hypot(alone.systematic, 2.0))
    assert (among.value, among.noise) == (alone.value, alone.noise)


def test_a_refit_that_stopped_early_is_made_anew_before_it_tells_parameters() -> None:
    experiment, truth = with_the_effect(0)
    simulate = Noted(experiment)
    found = diagnose(experiment, nearby(experiment, truth), simulate=simulate)
    basis = smooth_basis(experiment.layout, found.floor.noise)
    told = {"simulate": simulate, "steps": 5, "told": lambda what, share: None}
    kept = confirm(experiment, found.evidence, found.floor, [], simulate, 5, basis, told["told"])[""]
    anew, ended, stopped = (
        as_it_is(experiment, found.evidence, found.floor, basis, refit, **told)
        for refit in (None, kept, replace(kept, stopped=True, visits=kept.visits[:3]))
    )
    assert anew == ended == stopped


def test_what_has_no_chance_is_read_by_derivatives() -> None:
    """There are no simulations to lay a surface through: nothing is refitted for the sake of telling parameters."""
    experiment, truth = with_the_effect(0)
    certain = replace(experiment, chance=False, chance_root=np.zeros_like(experiment.chance_root))
    certain = replace(certain, observed=certain.measured(truth, [0, 99]))
    simulate = Noted(certain)
    told = diagnose(certain, nearby(certain, truth), simulate=simulate).estimates
    assert not any(purpose.startswith("refit") for purpose in simulate.purposes)
    assert all(abs(told[name].value - truth[name]) < 3.0 * told[name].std for name in truth)


def test_solvers_that_are_apart_are_a_part_of_what_is_told() -> None:
    """Soil of another solver looks like other parameters to ours: by how much is known of many, not of this one."""
    apart = {"angle": 3.0, NAME: 1.5}
    off, without = [], []
    for world in range(5):
        made = emulated(world)
        truth = {"angle": 0.0, NAME: 8.0 * detectable(world, Options())[NAME]}
        generator = np.random.default_rng([world, 4])
        looks = {name: truth[name] + apart[name] * generator.standard_normal() for name in truth}
        experiment = replace(made, observed=made.measured(looks, [world, 99]), apart=apart)
        best = diagnose(experiment, {"angle": fitted(experiment)}).confirmations[NAME]
        for name, value in truth.items():
            error, std = best.values[name] - value, best.stds[name]
            assert std > best.systematic[name] >= apart[name]
            off.append(error / std)
            without.append(error / np.sqrt(std**2 - apart[name] ** 2))
    assert np.sqrt(np.mean(np.square(without))) > 1.5 > np.sqrt(np.mean(np.square(off))) > 0.5
