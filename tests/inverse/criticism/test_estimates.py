"""What a diagnosis says of parameters, where truths are of numerics that nobody tried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated, fitted, outside
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.estimates import at_odds, untried, weighed, weighed_there
from splatsoil.inverse.criticism.evidence import Evidence, gather, switched_on
from splatsoil.inverse.criticism.floor import floor_of
from splatsoil.inverse.criticism.misfit import smooth_basis
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.emulated import EmulatedExperiment

TRIED, WORLDS = 5, 40


def looked(experiment: EmulatedExperiment, simulate: Callable[..., Any], at: dict[str, float], **how: int) -> Evidence:
    """Evidence with every effect switched on at a fit."""
    return switched_on(experiment, simulate, gather(experiment, simulate, at, **how))


def worlds(size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(w,) errors of the angle, stds by noise and by numerics, where the truth has a way of computing of its own.

    It and the ways that are tried are drawn alike, ``size`` times the noise.
    """
    found = []
    for world in range(WORLDS):
        generator = np.random.default_rng([world, 5])
        made = emulated(world)
        tried = {f"way {k}": outside(made, generator, size) for k in range(TRIED)}
        made = replace(made, patterns=tried)
        observed = made.measured({"angle": 0.0}, [world, 99], outside(made, generator, size))
        experiment = replace(made, observed=observed)
        evidence = looked(experiment, Simulations(experiment), {"angle": fitted(experiment)})
        floor = floor_of(experiment, evidence)
        told = weighed(experiment, evidence, floor, smooth_basis(experiment.layout, floor.noise))["angle"]
        assert told.std == pytest.approx(np.hypot(told.noise, told.systematic)) and told.unit == "deg"
        found.append((told.value, told.noise, told.systematic))
    errors, noise, numerics = np.array(found).T
    return errors, noise, numerics


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_the_error_is_as_large_as_is_said_though_nobody_tried_the_truths_numerics() -> None:
    """Without what untried numerics do, the angle is off by 1.5 times what is stated (root mean square)."""
    errors, noise, numerics = worlds(8.0)
    assert 0.7 < rms(errors / np.hypot(noise, numerics)) < 1.35
    assert rms(errors / noise) > 1.35
    # A spread as wide as what is believed before any data would hold any truth.
    assert rms(np.hypot(noise, numerics)) < 0.8 * 20.0 / np.sqrt(12.0)


def test_noise_is_that_of_least_squares_that_knows_the_covariance() -> None:
    """Four repeats have a mean whose chance is a quarter of one simulation's."""
    ratios = []
    for world in range(12):
        made = replace(emulated(world), patterns={})
        experiment = replace(made, observed=made.measured({"angle": 0.0}, [world, 99]))
        evidence = looked(experiment, Simulations(experiment), {"angle": 0.0}, repeats=4)
        floor = floor_of(experiment, evidence)
        told = weighed(experiment, evidence, floor, smooth_basis(experiment.layout, floor.noise))["angle"]
        assert told.determined
        slope = experiment.slopes["angle"].reshape(-1)
        covariance = 1.25 * experiment.chance_root @ experiment.chance_root.T
        covariance += np.diag(np.broadcast_to(experiment.sensor, experiment.layout.shape).reshape(-1) ** 2)
        ratios.append(told.noise * np.sqrt(slope @ np.linalg.solve(covariance, slope)))
    assert 0.85 < np.median(ratios) < 1.08
    # bounds that say nearly as much as the measurement: uniform between them is less than twice the ± wide
    (angle,) = experiment.parameters
    narrow = replace(experiment, parameters=(replace(angle, lower=-told.noise, upper=told.noise),))
    assert not weighed(narrow, evidence, floor, smooth_basis(experiment.layout, floor.noise))["angle"].determined


def test_steps_go_on_where_one_would_leave_what_derivatives_were_measured_over() -> None:
    """Soil that answers less and less to a larger angle: from a fit eight degrees off one step overshoots."""
    once, there = [], []
    for world in range(8):
        made = replace(emulated(world), patterns={})
        made = replace(made, curves={**made.curves, "angle": -0.08 * made.slopes["angle"]})
        experiment = replace(made, observed=made.measured({"angle": 0.0}, [world, 99]))
        simulate = Simulations(experiment)
        evidence = looked(experiment, simulate, {"angle": 8.0})
        floor = floor_of(experiment, evidence)
        basis = smooth_basis(experiment.layout, floor.noise)
        once.append(weighed(experiment, evidence, floor, basis)["angle"])
        asked = simulate.asked
        there.append(weighed_there(experiment, evidence, floor, basis, simulate)["angle"])
        assert simulate.asked > asked
        near = looked(experiment, simulate, {"angle": 0.0})
        asked, own = simulate.asked, floor_of(experiment, near)
        assert weighed_there(experiment, near, own, basis, simulate) == weighed(experiment, near, own, basis)
        assert simulate.asked == asked
    errors = {name: np.array([e.value for e in found]) for name, found in (("once", once), ("there", there))}
    assert rms(errors["once"]) > 4.0
    assert rms(errors["there"]) < 1.0 and rms(errors["there"] / [e.std for e in there]) < 2.0


def test_each_way_left_out_is_what_the_estimator_of_the_others_makes_of_it() -> None:
    """Against least squares with the covariance written out, half of what was tried taken for likely."""
    made = emulated(3)
    tried = {f"way {k}": outside(made, np.random.default_rng(k), 2.0) for k in range(3)}
    experiment = replace(made, patterns=tried, observed=made.measured({"angle": 0.0}, [3, 99]))
    evidence = looked(experiment, Simulations(experiment), {"angle": 0.0})
    floor = floor_of(experiment, evidence)
    slopes = np.stack([experiment.slopes[name] for name in ("angle", "effect 1")], axis=-1)
    precision = np.diag([0.1, 2.0])
    along, ways = slopes.reshape(-1, 2), 0.5 * np.stack([table.reshape(-1) for table in tried.values()], axis=1)
    shifts = []
    for k in range(3):
        others = np.delete(ways, k, axis=1)
        inverse = np.linalg.inv(floor.noise.covariance + others @ others.T)
        shifts.append(np.linalg.inv(along.T @ inverse @ along + precision) @ along.T @ inverse @ ways[:, k])
    np.testing.assert_allclose(
        untried(floor, slopes, precision), np.sqrt(np.mean(np.square(shifts), axis=0)), rtol=1e-6
    )
    alone = replace(floor, nuisance=floor.nuisance[:, :0], tried=0)
    np.testing.assert_array_equal(untried(alone, slopes, precision), 0.0)


def test_effects_explain_no_more_than_noise_of_a_truth_that_computes_otherwise() -> None:
    """Mean falls of χ² by effects of one parameter each, half of them on one side only: 0.75 by noise, 2.2 if untried
    numerics counted as much along the effects' directions as anywhere else."""
    falls = []
    for world in range(12):
        generator = np.random.default_rng([world, 6])
        made = emulated(world)
        made = replace(made, patterns={f"way {k}": outside(made, generator, 6.0) for k in range(TRIED)})
        observed = made.measured({"angle": 0.0}, [world, 99], outside(made, generator, 6.0))
        experiment = replace(made, observed=observed)
        evidence = looked(experiment, Simulations(experiment), {"angle": 0.0})
        scorer = Bench.of(experiment, evidence).scorer
        assert scorer is not None
        scores = scorer.score((experiment.observed - evidence.mean)[experiment.seen])
        falls.append(np.mean([score.statistic for score in scores.values()]))
    assert 0.4 < np.mean(falls) < 1.5


def test_the_error_is_as_large_as_parts_of_the_data_contradict_each_other() -> None:
    """Each part has an angle of its own; where all have the same, noise says nearly all of it."""
    made = emulated(4)
    experiment = replace(made, observed=made.expected({"angle": 0.0}))
    evidence = looked(experiment, Simulations(experiment), {"angle": 0.0})
    floor = replace(floor_of(experiment, evidence), nuisance=np.zeros((made.observed.size, 0)), tried=0)
    parts, precision = made.layout.parts, np.zeros((1, 1))
    slopes = made.slopes["angle"][..., None]
    along = slopes.reshape(-1, 1)
    inverse = np.linalg.inv(floor.noise.covariance)
    noise = (along.T @ inverse @ along).item() ** -0.5
    weights = noise**2 * (along.T @ inverse)[0]
    generator, count = np.random.default_rng(8), int(parts.max()) + 1
    assert count == len(np.unique(parts)) > 3
    for spread in (0.0, 4.0 * noise):
        errors, told = [], []
        for draw in range(200):
            own = spread * generator.standard_normal(count)[parts]
            chance = floor.noise.solver.sample(np.random.default_rng([draw, 1]), 1).reshape(parts.shape)
            residual = own * slopes[..., 0] + chance
            errors.append(weights @ residual.reshape(-1))
            told.append(at_odds(floor, parts, slopes, precision, residual)[0])
        if spread:
            assert 0.75 < rms(np.hypot(noise, told)) / rms(np.array(errors)) < 1.25
        else:
            assert rms(np.array(told)) < 0.8 * noise
    alone = np.zeros_like(parts)
    np.testing.assert_array_equal(at_odds(floor, alone, slopes, precision, residual), 0.0)


def test_solvers_that_are_apart_count_in_what_is_weighed_and_in_a_refit_without_a_floor_of_its_own() -> None:
    made = replace(emulated(0), patterns={}, chance=False)
    truth = {"angle": 0.0, "effect 1": 8.0}
    made = replace(made, observed=made.measured(truth, [0, 99]))
    found = diagnose(replace(made, apart={"angle": 2.0}), {"angle": fitted(made)})
    assert found.estimates["angle"].systematic == pytest.approx(2.0)
    assert found.confirmations["effect 1"].systematic["angle"] == pytest.approx(2.0)
    # no more than is open before any data
    wide = diagnose(replace(made, apart={"angle": 1e3}), {"angle": fitted(made)})
    told = (wide.estimates["angle"].systematic, wide.confirmations["effect 1"].systematic["angle"])
    assert told == pytest.approx((20.0 / np.sqrt(12.0),) * 2)
    assert not wide.estimates["angle"].determined
