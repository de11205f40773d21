from __future__ import annotations

import math

import pytest
from splatsoil.inverse.criticism.words import amount

from splatsoil.report import words


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (35.6321, 0.8123, ("35.6", "0.8")),
        (35.6321, 1.26, ("35.6", "1.3")),
        (35.6321, 0.0261, ("35.632", "0.026")),
        (35.6321, 3.2, ("36", "3")),
        (298.4, 48.9, ("300", "50")),
        (298.4, 0.0, ("298.4", "0")),
        (35.6321, 0.0996, ("35.63", "0.10")),
        (12345.0, 1234.0, ("12300", "1200")),
        (-1.1e-5, 5.1e-4, ("0.0000", "0.0005")),
    ],
)
def test_a_value_is_quoted_to_the_digits_its_std_allows(value: float, std: float, expected: tuple[str, str]) -> None:
    assert words.with_std(value, std) == expected


def test_amounts_have_as_many_digits_as_are_known() -> None:
    assert amount(553.73, 160.7, "Pa") == "550 ± 160 Pa"
    assert amount(37.19, 2.53, "deg") == "37.2 ± 2.5°"
    assert amount(33.2, 0.0, "Pa") == amount(33.2, math.inf, "Pa") == "33.2 Pa"


def comparison(total: float, noise: float | None) -> dict:
    return {"loss": "robust", "total": {"robust": total}, "noise": {} if noise is None else {"robust": noise}}


def test_the_verdict_follows_the_ratio_to_the_noise() -> None:
    assert "nothing more to explain" in words.residual_sentence(comparison(0.011, 0.01))
    far = words.residual_sentence(comparison(0.038, 0.01))
    assert "3.8 ×" in far and "cannot tell which" in far
    assert "unknown" in words.residual_sentence(comparison(0.038, None))
    assert "160 ×" in words.residual_sentence(comparison(1.6, 0.01))
    with_unit = comparison(0.073, 0.01) | {"motionless": {"robust": 1.0}}
    assert "leaves 7.3 % of the misfit that soil at rest would leave" in words.residual_sentence(with_unit)
    assert "not been compared" in words.residual_sentence(None)


def test_a_residual_far_above_the_cameras_noise_is_no_fault_of_an_adequate_model() -> None:
    said = words.residual_sentence(comparison(0.52, 0.01), True)
    assert "52 ×" in said and "don't stand above" in said
    short = words.residual_sentence(comparison(0.52, 0.01), False)
    assert "52 ×" in short and "numerics" not in short
    # nor does little noise hide what stands above the floor
    assert "nothing more" not in words.residual_sentence(comparison(0.011, 0.01), False)


@pytest.mark.parametrize(
    ("determined", "at_bound", "state"),
    [(True, None, "determined"), (True, "upper", "bound"), (False, "upper", "open")],
)
def test_an_answer_that_is_none_says_so(determined: bool, at_bound: str | None, state: str) -> None:
    entry = {"estimate": 36.0, "std": 1.0, "unit": "deg", "at_bound": at_bound, "determined": determined}
    (answer,) = words.answers({"parameters": {"friction_angle": entry}})
    assert answer.state == state
    assert bool(answer.remark) == (state != "determined")


@pytest.mark.parametrize(("seconds", "text"), [(48.2, "48 s"), (200.0, "3 min 20 s"), (7500.0, "2 h 5 min")])
def test_durations(seconds: float, text: str) -> None:
    assert words.duration(seconds) == text


def test_a_force_that_counts_is_told_with_what_pictures_say_alone() -> None:
    fit = {"parameters": {"friction_angle": {"unit": "deg"}, "cohesion": {"unit": "Pa"}}, "force": None}
    assert words.force_sentence(fit) == "" == words.force_sentence({"parameters": {}})
    alone = {
        "friction_angle": {"estimate": 38.21, "std": 0.94, "determined": True},
        "cohesion": {"estimate": 700.0, "std": 433.0, "determined": False},
    }
    told = words.force_sentence({**fit, "force": {"counted": True, "pictures_alone": alone}})
    assert "38.2 ± 0.9° for the friction angle and anything for the cohesion" in told
    assert "isn't counted" in words.force_sentence({**fit, "force": {"counted": False, "pictures_alone": alone}})


def test_an_adequate_fit_is_quoted_as_a_comparison_with_the_floor_weighs_it() -> None:
    entry = {"estimate": 36.0, "std": 0.5, "unit": "deg", "at_bound": None, "determined": True}
    fit = {"name": "base", "parameters": {"friction_angle": entry}}
    misfit = {"adequate": True, "fit": "base", "estimates": {"friction_angle": {"value": 37.1, "std": 3.2}}}
    for judged, quoted in ((misfit, "37"), ({**misfit, "adequate": False, "estimates": {}}, "36.0"), (None, "36.0")):
        assert words.answers(fit, judged)[0].value == quoted
    assert "missing" in words.misfit_verdict({"adequate": False}) and "missing" not in words.misfit_verdict(misfit)


@pytest.mark.parametrize(("of", "quoted"), [("base", "37"), ("base+tilt", "36.0")])
def test_an_adequate_fit_is_quoted_as_its_own_diagnosis_weighs_it(of: str, quoted: str) -> None:
    entry = {"estimate": 36.0, "std": 0.5, "unit": "deg", "at_bound": None, "determined": True}
    fit = {"name": "base", "parameters": {"friction_angle": entry}}
    diagnosis = {"verdict": "adequate", "fit": of, "estimates": {"friction_angle": {"value": 37.1, "std": 3.2}}}
    (answer,) = words.answers(fit, diagnosis)
    assert answer.value == quoted
    assert ("36.0 ± 0.5°" in words.fitted_sentence(fit, diagnosis)) is (quoted == "37")
    (short,) = words.answers(fit, {**diagnosis, "verdict": "missing"})
    assert short.value == "36.0" and ("lacks something" in short.remark) is (quoted == "37")
    told = {"friction_angle": {"value": 37.1, "std": 8.2, "determined": False}}
    (wide,) = words.answers(fit, {**diagnosis, "estimates": told})
    assert (wide.state == "open") is (quoted == "37") and ("its bounds" in wide.remark) is (quoted == "37")
    (known,) = words.answers(
        {**fit, "parameters": {"friction_angle": {**entry, "determined": False}}},
        {**diagnosis, "estimates": {"friction_angle": {"value": 37.1, "std": 3.2, "determined": True}}},
    )
    assert (known.state == "determined") is (quoted == "37")
