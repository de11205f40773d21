from __future__ import annotations

import math

import pytest

from splatsoil.report import text as words


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
    assert words.amount(553.73, 160.7, "Pa") == words.estimate(553.73, 160.7, "Pa") == "550 ± 160 Pa"
    assert words.amount(37.19, 2.53, "deg") == "37.2 ± 2.5°"
    assert words.amount(33.2, 0.0, "Pa") == words.amount(33.2, math.inf, "Pa") == "33.2 Pa"
    assert words.estimate(33.2, None, "Pa") == "33.2 Pa" and words.estimate(None, None, "Pa") == "–"


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "< 0.5 %"), (0.0049, "< 0.5 %"), (0.012, "1.2 %"), (0.873, "87 %"), (0.994, "99 %"), (0.9999, "> 99.5 %")],
)
def test_a_probability_claims_no_more_than_is_known(share: float, text: str) -> None:
    assert words.probability(share) == text


@pytest.mark.parametrize(
    ("verdict", "names", "text"),
    [
        ("adequate", [], "The model is adequate."),
        ("adequate", ["cohesion"], "The model is adequate."),
        ("missing", ["tool_friction"], "Missing: tool friction."),
        ("one of", ["cohesion", "tool_adhesion"], "Missing: cohesion or tool adhesion."),
        ("one of", ["cohesion", "tool_adhesion", "tilt"], "Missing: cohesion, tool adhesion or tilt."),
        ("something else", [], "Something is missing that the library does not have."),
        ("undecided", ["cohesion"], "Undecided: the data do not discriminate between the models."),
    ],
)
def test_a_verdict_is_one_line(verdict: str, names: list[str], text: str) -> None:
    assert words.verdict({"verdict": verdict, "class": names}) == text


def test_a_block_begins_to_fail_at_its_first_row_beyond_two_standard_deviations(diagnosis: dict) -> None:
    push = {"stage": "push", "region": "berm", "channel": "left"}
    # Of the most probable model, effect 2: a row's root mean square over the berm's three squares.
    rows = {1: [0.5, -0.5, 2.0], 2: [2.5, 3.0, -2.0]}
    for row, values in rows.items():
        diagnosis["maps"]["effect_2"][row][3:6] = values
    assert words.begins(diagnosis, push) == "It begins at frame 30."
    assert words.worst_row(diagnosis, push) == (2, dict(zip((3, 4, 5), rows[2], strict=True)))
    diagnosis["maps"]["effect_2"][2][3:6] = [2.0, 2.0, None]
    assert words.begins(diagnosis, push) == "No frame by itself is beyond 2 expected standard deviations."
    diagnosis["maps"]["effect_2"][1][3:6] = [None, None, -2.1]
    assert words.begins(diagnosis, push) == "It begins at frame 20."


def test_the_misfit_is_that_of_the_most_probable_model(diagnosis: dict) -> None:
    diagnosis["maps"]["effect_2"] = [[None, 3.0], [-4.0, None]]
    largest = "largest: berm during push, left camera, 2.3 ×."
    assert words.misfit_sentence(diagnosis) == f"Misfit 3.54 × the expected standard deviation; {largest}"
    assert words.block({"stage": "pushing", "region": "tool", "channel": "force up"}) == "tool while pushing, force up"


def test_names_in_sentences() -> None:
    assert words.title("tool_friction") == "Tool friction"
    assert [words.listed(list("abc"[:n])) for n in (1, 2, 3)] == ["a", "a and b", "a, b and c"]
    assert [words.model_label(name) for name in ("", "tool_friction")] == ["as it is", "tool friction"]


def comparison(total: float, noise: float | None) -> dict:
    return {"loss": "robust", "total": {"robust": total}, "noise": {} if noise is None else {"robust": noise}}


def test_the_verdict_follows_the_ratio_to_the_noise() -> None:
    assert "nothing more to explain" in words.residual_sentence(comparison(0.011, 0.01))
    far = words.residual_sentence(comparison(0.038, 0.01))
    assert "3.8 ×" in far and "not been estimated yet" in far
    assert "unknown: the set has no pre-roll" in words.residual_sentence(comparison(0.038, None))
    none = words.residual_sentence(comparison(0.038, 0.0))
    assert "unknown: the frames before the tool moves are equal to the last bit" in none and "0.05 grey levels" in none
    assert "160 ×" in words.residual_sentence(comparison(1.6, 0.01))
    with_unit = comparison(0.073, 0.01) | {"motionless": {"robust": 1.0}}
    assert "7.3 % of that of soil at rest, 7.3 × the instruments' noise" in words.residual_sentence(with_unit)
    assert "not been compared" in words.residual_sentence(None)


def test_a_residual_far_above_the_cameras_noise_is_no_fault_of_an_adequate_model() -> None:
    said = words.residual_sentence(comparison(0.52, 0.01), True)
    assert "52 ×" in said and "discretisation error together are as large" in said
    short = words.residual_sentence(comparison(0.52, 0.01), False)
    assert "52 ×" in short and "discretisation" not in short
    # nor does little noise of the cameras hide what fails
    assert "nothing more" not in words.residual_sentence(comparison(0.011, 0.01), False)


@pytest.mark.parametrize(
    ("determined", "at_bound", "state"),
    [(True, None, "determined"), (True, "upper", "bound"), (False, "upper", "open")],
)
def test_an_answer_that_is_none_says_so(determined: bool, at_bound: str | None, state: str) -> None:
    entry = {"estimate": 36.0, "std": 1.0, "unit": "deg", "at_bound": at_bound, "determined": determined}
    (answer,) = words.answers({"estimated_from": "loss", "parameters": {"friction_angle": entry}})
    assert answer.state == state
    assert bool(answer.remark) == (state != "determined")


@pytest.mark.parametrize(("seconds", "text"), [(48.2, "48 s"), (200.0, "3 min 20 s"), (7500.0, "2 h 5 min")])
def test_durations(seconds: float, text: str) -> None:
    assert words.duration(seconds) == text


ENTRY = {"estimate": 36.0, "std": 0.5, "unit": "deg", "at_bound": None, "determined": True}
AVERAGED = {"friction_angle": {"value": 37.1, "std": 3.2, "determined": True}}


@pytest.mark.parametrize(
    "judged",
    [
        {"fit": "base", "verdict": "adequate"},
        {"fit": "base", "verdict": "missing"},
        {"fit": "base", "verdict": "undecided"},
        {"fit": "base", "adequate": True},
        {"fit": "base", "adequate": False},
    ],
)
def test_the_answer_is_averaged_over_models_whatever_the_verdict(judged: dict) -> None:
    entry = {**ENTRY, "determined": False}
    fit = {"name": "base", "estimated_from": "loss", "parameters": {"friction_angle": entry}}
    judged = {**judged, "estimates": AVERAGED}
    (answer,) = words.answers(fit, judged)
    assert (answer.number, answer.state, answer.remark) == ("37 ± 3°", "determined", "")
    assert "averaged over models" in words.fitted_sentence(fit, judged)
    adequate = judged.get("adequate", judged.get("verdict") == "adequate")
    assert words.called_adequate(fit, judged) is adequate
    judged["estimates"] = {"friction_angle": {**AVERAGED["friction_angle"], "determined": False}}
    (wide,) = words.answers(fit, judged)
    assert wide.state == "open" and "do not determine the friction angle" in wide.remark


@pytest.mark.parametrize("judged", [None, {"fit": "tilt", "verdict": "adequate", "estimates": AVERAGED}])
@pytest.mark.parametrize(("source", "said"), [("loss", "10 evaluations"), ("comparison", "discretisation error")])
def test_without_a_judgement_of_this_fit_the_answer_is_its_own(judged: dict | None, source: str, said: str) -> None:
    fit = {"name": "base", "estimated_from": source, "evaluations": 10, "parameters": {"friction_angle": ENTRY}}
    (answer,) = words.answers(fit, judged)
    assert answer.number == "36.0 ± 0.5°"
    assert said in words.fitted_sentence(fit, judged) and words.called_adequate(fit, judged) is None


def test_a_comparison_is_told_in_one_line() -> None:
    assert words.misfit_verdict({"adequate": True}) == "The model is adequate."
    assert "not adequate" in words.misfit_verdict({"adequate": False})
