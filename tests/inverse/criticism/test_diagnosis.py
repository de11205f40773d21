"""A whole comparison of models on experiments whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from splatsoil.inverse.criticism.diagnosis import diagnose, held_out_mask, verdict_of
from splatsoil.inverse.criticism.record import misfit_of, record

from splatsoil.experiment.base import Run
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.files import plain

Make = Callable[..., EmulatedExperiment]
SEEDS = range(6)
START = {"friction_angle": 35.0}


def test_nothing_hidden_is_not_named_and_the_angle_is_covered(make: Make) -> None:
    z, named = [], 0
    for seed in SEEDS:
        found = diagnose(make(seed=seed), START, seed=seed)
        value, std = found.estimates["friction_angle"]
        z.append((value - 33.0) / std)
        named += found.verdict in ("missing", "one of")
        assert found.determined["friction_angle"]
    assert named == 0
    assert np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.parametrize(("name", "size"), [("one", 6.0), ("two", -6.0), ("blurred", 6.0)])
def test_an_effect_that_is_hidden_is_named_with_its_size_and_takes_the_error_away(
    make: Make, name: str, size: float
) -> None:
    found = diagnose(make({f"{name}_size": size}), START)
    assert (found.verdict, found.members) == ("missing", (name,))
    value, std = found.estimates["friction_angle"]
    assert abs(value - 33.0) < 3.0 * std
    if name != "blurred":
        mean, deviation = found.evidence.models[name].moments(f"{name}_size")
        assert abs(mean - size) < 3.0 * deviation and deviation < 1.0
    before, after = found.held_out
    assert (before.model, after.model) == ("", name)
    assert after.error < 0.6 * before.error and after.error < 1.3 * after.noise
    assert after.log_score > before.log_score


def test_a_pattern_that_no_effect_has_is_not_given_a_name(make: Make, smooth_field: Callable[..., np.ndarray]) -> None:
    experiment = make(extra=8.0 * smooth_field(50, make().layout))
    found = diagnose(experiment, START)
    assert found.verdict not in ("missing", "one of", "adequate")


def test_instruments_without_a_place_are_recorded_as_they_read(make: Make) -> None:
    experiment = make()
    found = diagnose(experiment, START, effects=False)
    sites = tuple(replace(s, reading=np.exp) if s.channel == "force" else s for s in experiment.layout.sites)
    read = record(replace(experiment, layout=replace(experiment.layout, sites=sites)), found, 3)
    (before,), (after,) = record(experiment, found, 3)["curves"], read["curves"]
    for key in ("measured", "low", "high"):
        assert np.allclose(after[key], np.exp(before[key]))
    assert np.allclose(after["predicted"]["before"], np.exp(before["predicted"]["before"]))
    middle = 0.5 * (np.array(before["low"]) + np.array(before["high"]))
    assert np.allclose(middle, before["measured"]) and np.all(np.array(before["high"]) > middle)


def test_without_effects_only_the_base_model_is_judged(make: Make) -> None:
    good = diagnose(make(), START, effects=False)
    assert set(good.evidence.probability) == {"", "something else"} and good.verdict == "adequate"
    bad = diagnose(make({"one_size": 12.0}), START, effects=False)
    assert bad.verdict == "something else"


def test_the_same_seed_gives_the_same_answer_and_the_record_is_plain_json(make: Make) -> None:
    experiment = make({"one_size": 6.0})
    first, second = (record(experiment, diagnose(experiment, START), 3) for _ in range(2))
    assert json.dumps(plain(first)) == json.dumps(plain(second))
    assert sum(m["probability"] for m in first["models"]) == pytest.approx(1.0)
    assert first["models"][0]["name"] == "one" and first["models"][0]["detectable"] is not None
    assert misfit_of({**first, "fit": "base", "values": START})["adequate"] is False


def test_what_fine_runs_add_is_taken_off_the_observation(make: Make) -> None:
    experiment = make(discretisation=4.0)
    diagnosis = diagnose(experiment, START, effects=False)
    noise = diagnosis.evidence.noise
    added = experiment.patterns["fine"][noise.mask] @ noise.basis
    # Only pictures are corrected: the last scores are the force's.
    wanted, found = (scores[: -experiment.layout.shape[0]] for scores in (added, noise.correction))
    assert wanted @ found > 0.8 * np.linalg.norm(wanted) * np.linalg.norm(found)
    assert 0.5 < np.linalg.norm(found) / np.linalg.norm(wanted) < 1.2
    # Predictions have it, so that little of it is left in what is checked.
    pictures = noise.mask & experiment.layout.placed
    fine, left = (table[pictures] for table in (experiment.patterns["fine"], diagnosis.residuals[""]))
    assert abs(left @ fine) < 0.5 * fine @ fine


def test_what_is_set_aside_is_the_last_camera_and_the_last_stage(make: Make) -> None:
    layout = make().layout
    held_out, what = held_out_mask(make())
    assert what == "camera right and the withdrawal"
    right = np.array([s.channel == "right" for s in layout.sites])
    assert held_out[:, right].all() and held_out[4:].all() and not held_out[:4, ~right].any()


def test_what_is_set_aside_has_no_say_in_the_models_that_it_judges(make: Make) -> None:
    """The angle is 8 degrees higher there alone: of that, models fitted to the rest miss all."""
    experiment = make(discretisation=0.0)
    held_out, _ = held_out_mask(experiment)
    shift = np.where(held_out, 8.0 * experiment.slopes["friction_angle"], 0.0)
    found = diagnose(replace(experiment, observed=experiment.observed + shift, candidates=()), START)
    scored = held_out & found.mask & experiment.layout.common[None]
    (held_out,) = found.held_out
    assert held_out.error == pytest.approx(np.sqrt(np.mean(shift[scored] ** 2)), rel=0.2)
    assert held_out.noise == pytest.approx(np.hypot(1.0, 0.5), rel=0.25), "of chance and of the sensor"


def test_the_noise_holds_what_seeds_scatter_by(make: Make) -> None:
    """Of chance of unit size in every feature and of sensors of half of it, in scores of unit directions."""
    ratios, sizes = [], []
    for seed in SEEDS:
        experiment = make(discretisation=0.0, seed=seed)
        found = diagnose(experiment, START, effects=False, seed=seed)
        noise = found.evidence.noise
        drawn = noise.scores(np.array([experiment.predict(Run(START, seed=k)) for k in range(5000, 5200)]))
        ratios.append(np.median((drawn.var(axis=0) + 0.25) / np.diag(noise.fixed)))
        sizes.append(np.sqrt(found.expected[found.mask].mean()))
    # three pairs along two directions: what they differ by scatters
    assert np.median(sizes) == pytest.approx(np.hypot(1.0, 0.5), rel=0.1)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_checks_expect_what_nobody_knows_of_the_soil(make: Make) -> None:
    """A draw of the albedo that is 3 grey levels off, one of two, adds half of its square to what is expected."""
    experiment = make(discretisation=0.0)
    patterns = {**experiment.albedo_patterns, "guess 1": 10.0 * experiment.albedo_patterns["guess 1"]}
    before, after = (
        diagnose(e, START, effects=False) for e in (experiment, replace(experiment, albedo_patterns=patterns))
    )
    added = 0.5 * (patterns["guess 1"] ** 2 - experiment.albedo_patterns["guess 1"] ** 2)
    pictures = before.mask & experiment.layout.placed
    np.testing.assert_allclose((after.expected - before.expected)[pictures], added[pictures], atol=1e-6)


@pytest.mark.parametrize(
    ("probability", "fits", "verdict", "members"),
    [
        ({"": 0.6, "something else": 0.1, "a": 0.3}, True, "adequate", ("a",)),
        ({"": 0.6, "something else": 0.1, "a": 0.3}, False, "something else", ("a",)),
        ({"": 0.02, "something else": 0.03, "a": 0.95}, True, "missing", ("a",)),
        ({"": 0.02, "something else": 0.03, "a": 0.95}, False, "something else", ("a",)),
        ({"": 0.02, "something else": 0.03, "a": 0.55, "b": 0.4}, True, "one of", ("a", "b")),
        ({"": 0.04, "something else": 0.95, "a": 0.01}, True, "something else", ()),
        ({"": 0.05, "something else": 0.15, "a": 0.8}, True, "undecided", ("a",)),
        ({"": 0.4, "something else": 0.2, "a": 0.4}, True, "adequate", ("a",)),
    ],
)
def test_verdicts(probability: dict[str, float], fits: bool, verdict: str, members: tuple[str, ...]) -> None:
    assert verdict_of(probability, fits=fits) == (verdict, members)
