"""Chance in derivatives: how much there is, and that it draws no size towards nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.dilution import informed, reliable, undiluted
from splatsoil.inverse.criticism.evidence import Evidence, gather, switched_on
from splatsoil.inverse.criticism.noise import Noise
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.emulated import EmulatedExperiment

WORLDS = range(40, 52)
CHAOS = 0.5


def looked(experiment: EmulatedExperiment, simulate: Callable[..., Any], at: dict[str, float], **how: int) -> Evidence:
    """Evidence with every effect switched on at a fit."""
    return switched_on(experiment, simulate, gather(experiment, simulate, at, **how))


def test_the_share_that_is_no_chance_is_the_one_that_was_put_in() -> None:
    generator = np.random.default_rng(3)
    count, level = 4000, 0.7
    truth = generator.standard_normal(count)
    for scale in (0.0, 0.3, 1.0, 3.0):
        first, second = (scale * truth + level * generator.standard_normal(count) for _ in range(2))
        mean, half = 0.5 * (first + second), 0.5 * (first - second)
        share = reliable(np.array([mean @ mean]), np.array([half @ half]))
        wanted = scale**2 / (scale**2 + 0.5 * level**2)
        assert share[0] == pytest.approx(wanted, abs=0.06)


def test_two_parameters_that_chance_makes_look_distinct_are_not() -> None:
    generator = np.random.default_rng(4)
    truth = generator.standard_normal((3000, 1)) * np.array([[1.0, -0.9]])
    first, second = (truth + generator.standard_normal(truth.shape) for _ in range(2))
    mean, half = 0.5 * (first + second), 0.5 * (first - second)
    known = informed(mean.T @ mean, half.T @ half)
    exact = truth.T @ truth
    assert np.abs(known - exact).max() < 0.06 * exact.max()
    assert np.linalg.eigvalsh(known)[0] < 0.1 * np.linalg.eigvalsh(mean.T @ mean)[0]
    assert np.linalg.eigvalsh(informed(exact, 2.0 * exact)).min() > -1e-6


def test_sizes_come_out_right_where_soil_falls_otherwise_each_time() -> None:
    """Against the truth; with the doubts forgotten, as derivatives by single seeds do, sizes are drawn to nothing."""
    right, drawn, off = [], [], []
    for world in WORLDS:
        base = emulated(world, chaos=CHAOS)
        experiment = replace(base, observed=base.measured({"angle": 0.0, "effect 1": 6.0}, [world, 99]))
        evidence = looked(experiment, Simulations(experiment), {"angle": 0.0})
        residual = (experiment.observed - evidence.mean)[experiment.seen]
        for known, out in ((evidence, right), (replace(evidence, doubts={}), drawn)):
            scorer = Bench.of(experiment, known).scorer
            assert scorer is not None
            score = scorer.score(residual)["effect 1"]
            out.append(score.estimate)
            if known is evidence:
                off.append((score.estimate - 6.0) / score.std)
                assert 0.0 < score.reliability < 1.0
    assert np.median(right) == pytest.approx(6.0, abs=1.0)
    assert np.median(drawn) < np.median(right) - 1.0
    assert np.mean(np.abs(off) < 2.0) >= 0.75


def test_what_is_reported_has_no_chance_and_is_asked_for_while_the_points_simulation_is_at_hand() -> None:
    experiment = emulated(9, chaos=CHAOS)
    asked: list[tuple[tuple[str, ...], int, str]] = []

    def simulate(values: Mapping[str, float], numerics: str = "", **how: Any) -> Any:
        asked.append((how["effects"], how["seed"], numerics))
        told = {"effects": how["effects"], "seed": how["seed"], "numerics": numerics}
        return experiment.predict(values, **told)

    evidence = looked(experiment, simulate, {"angle": 0.0}, repeats=3)
    reported = {c.name for c in experiment.candidates if c.kind == "observation"}
    assert reported and not reported & evidence.doubts.keys()
    assert evidence.doubts.keys() == {"angle", *(c.name for c in experiment.candidates)} - reported
    # Repeats are seeds 1 to 3; derivatives share none with them.
    assert {seed for effects, seed, _ in asked if effects} == {0, 4}
    point = asked.index(((), 0, ""))
    assert {effects[0] for effects, _, _ in asked[point + 1 : point + 1 + len(reported)]} == reported
    quiet = looked(replace(experiment, chance=False, chaos=0.0), simulate, {"angle": 0.0})
    assert not quiet.doubts


def test_starts_of_refits_have_the_size_that_is_expected_of_them() -> None:
    base = emulated(11, chaos=CHAOS)
    evidence = looked(base, Simulations(base), {"angle": 0.0})
    noise = Noise(np.eye(base.seen.size), base.seen)
    told = undiluted(evidence, noise, np.zeros((base.seen.size, 0)))
    for name, tables in (("angle", told.slopes), ("effect 1", told.directions), ("effect 8", told.directions)):
        raw = evidence.slopes[name] if name == "angle" else evidence.directions[name]
        doubt = evidence.doubt(name, raw)
        share = 1.0 - np.sum(doubt**2) / np.sum(raw**2)
        assert np.allclose(tables[name], share * raw)
        exact, size = base.slopes[name], np.linalg.norm
        assert size(tables[name] - exact) <= size(raw - exact) + 1e-9
