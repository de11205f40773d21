"""Which refitted effects are named."""

from __future__ import annotations

from dataclasses import replace

import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated, one
from splatsoil.inverse.criticism.diagnosis import Diagnosis, Options
from splatsoil.inverse.criticism.naming import members_of, stands

OPTIONS = Options()
WORLD = 77
MEASURE = next(c.measure for c in emulated(WORLD).candidates if c.name == "effect 2")


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    """Five times the smallest detectable size of an effect, which was hidden."""
    size = 5.0 * detectable(WORLD, OPTIONS)["effect 2"]
    return one(WORLD, {"angle": 1.0, "effect 2": size}, None, OPTIONS)


@pytest.mark.parametrize(
    ("error", "off", "p", "left", "unseen", "ratio", "named"),
    [
        (0.7, False, 0.3, 0.97, 9.0, 5.0, False),
        (0.7, False, 0.3, 0.8, 9.0, 5.0, False),
        (0.7, False, 0.001, 0.8, 9.0, 5.0, True),
        (0.7, False, 0.001, 0.97, 9.0, 5.0, False),
        (0.7, True, 0.3, 0.97, 9.0, 5.0, True),
        (1.5, False, 0.3, 0.97, 9.0, 5.0, False),
        (1.5, False, 0.3, 0.8, 9.0, 5.0, True),
        (1.5, False, 0.001, 0.8, 9.0, 1.2, False),
        (1.5, True, 0.3, 0.97, 9.0, 1.2, True),
        (1.5, True, 0.3, 0.97, -1.0, 5.0, False),
    ],
)
def test_nothing_is_missing_where_nothing_is_to_be_explained(
    found: Diagnosis,
    error: float,
    off: bool,
    p: float,
    left: float,
    unseen: float,
    ratio: float,
    named: bool,
) -> None:
    """A refit that explains much; error on hidden times, the whole misfit and the effect's score may be chance before
    it, so much is left, and its size is so many of its standard deviations."""
    confirmed, score = found.confirmations, replace(found.scores["effect 2"], adjusted=p, dispersion=1.0)
    before, after = confirmed[""], confirmed["effect 2"]
    floor = before.held_out / error
    held_out = left * before.held_out
    stds = {"effect 2": abs(after.values["effect 2"]) / ratio}
    after = replace(after, floor=floor, held_out=held_out, unseen=unseen, stds=stds)
    told = {"": replace(before, floor=floor), "effect 2": after}
    assert stands(told, "effect 2", off, score, MEASURE) is named


@pytest.mark.parametrize(("told", "unseen", "named"), [(1e-5, -12.0, True), (1e-5, -20.0, False), (1e-3, -1.0, False)])
def test_what_other_pictures_say_beyond_doubt_the_soil_need_only_not_deny(
    found: Diagnosis, told: float, unseen: float, named: bool
) -> None:
    confirmed, score = found.confirmations, replace(found.scores["effect 2"], adjusted=1.0, dispersion=1.0)
    floor = confirmed[""].held_out / 0.7
    after = replace(confirmed["effect 2"], floor=floor, held_out=confirmed[""].held_out, unseen=unseen, told=told)
    told_of = {"": replace(confirmed[""], floor=floor), "effect 2": after}
    assert stands(told_of, "effect 2", False, score, MEASURE) is named


def test_what_other_pictures_say_beyond_doubt_is_named_before_what_soil_shows(found: Diagnosis) -> None:
    big = found.confirmations["effect 2"]
    told = {"": found.confirmations[""], "effect 2": big, "clock": replace(big, fall=0.5 * big.fall, told=1e-9)}
    scores, measures = {**found.scores, "clock": found.scores["effect 2"]}, dict.fromkeys(told, MEASURE)
    costs = {name: -c.fall for name, c in told.items() if name}
    assert members_of(told, costs, True, scores, measures) == ("clock",)
    doubtful = {**told, "clock": replace(told["clock"], told=0.01)}
    assert members_of(doubtful, costs, True, scores, measures)[0] == "effect 2"
    denied = {**told, "clock": replace(told["clock"], unseen=-50.0)}
    assert members_of(denied, costs, True, scores, measures)[0] == "effect 2"


def test_what_explains_nothing_is_no_equal_however_wide_the_doubt(found: Diagnosis) -> None:
    best = replace(found.confirmations["effect 2"], fall=20.0, chi2=300.0, freedom=100)
    told = {"": found.confirmations[""], "effect 2": best, "little": replace(best, fall=3.0)}
    told["nothing"] = replace(best, fall=0.0)
    scores = dict.fromkeys(told, replace(found.scores["effect 2"], dispersion=1.0))
    # What has fewer parameters costs less.
    costs = {"effect 2": -20.0, "little": -3.0, "nothing": -4.0}
    assert members_of(told, costs, True, scores, dict.fromkeys(told, MEASURE)) == ("effect 2", "little")


def test_what_explains_nothing_that_its_refit_has_not_seen_is_no_equal(found: Diagnosis) -> None:
    best = replace(found.confirmations["effect 2"], fall=100.0, chi2=100.0, freedom=100)
    told = {"": found.confirmations[""], "effect 2": best, "other": replace(best, fall=97.0)}
    scores = dict.fromkeys(told, replace(found.scores["effect 2"], dispersion=1.0))
    costs, measures = {"effect 2": -100.0, "other": -97.0}, dict.fromkeys(told, MEASURE)
    assert members_of(told, costs, True, scores, measures) == ("effect 2", "other")
    told["other"] = replace(told["other"], unseen=-80.0)
    assert members_of(told, costs, True, scores, measures) == ("effect 2",)


@pytest.mark.parametrize(("left", "named"), [(0.5, True), (3.0, True), (3.5, False), (30.0, False)])
def test_of_data_that_nothing_explains_an_effect_must_explain_more(found: Diagnosis, left: float, named: bool) -> None:
    """Soil once leaked out of a made-up box: χ² was 2000 over 120 numbers, and tilt took 49 away."""
    best = replace(found.confirmations["effect 2"], fall=20.0, chi2=100.0 * left, freedom=100)
    told = {"": found.confirmations[""], "effect 2": best}
    scores = dict.fromkeys(told, replace(found.scores["effect 2"], dispersion=1.0))
    assert bool(members_of(told, {"effect 2": -20.0}, True, scores, dict.fromkeys(told, MEASURE))) is named


def test_what_another_effect_left_behind_in_its_first_steps_is_not_named(found: Diagnosis) -> None:
    """Its last simulation may have been a lucky one."""
    lucky = replace(found.confirmations["effect 2"], stopped=True)
    other = replace(lucky, name="effect 1", stopped=False)
    told = {"": found.confirmations[""], "effect 1": other, "effect 2": lucky}
    measures = {"effect 1": MEASURE, "effect 2": MEASURE}
    scores = {name: replace(found.scores["effect 2"], name=name) for name in measures}
    assert members_of(told, {"effect 1": 0.0, "effect 2": -50.0}, True, scores, measures) == ("effect 1",)
    alone = {"": found.confirmations[""], "effect 2": lucky}
    assert members_of(alone, {"effect 2": -50.0}, True, scores, measures) == ()
