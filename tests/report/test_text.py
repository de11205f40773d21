"""Sentences and numbers of the page and the terminal."""

from __future__ import annotations

import math
from typing import Any

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


@pytest.mark.parametrize(
    ("name", "arguments", "text"),
    [
        ("amount", (553.73, 160.7, "Pa"), "550 ± 160 Pa"),
        ("amount", (37.19, 2.53, "deg"), "37.2 ± 2.5°"),
        ("amount", (33.2, 0.0, "Pa"), "33.2 Pa"),
        ("amount", (33.2, math.inf, "Pa"), "33.2 Pa"),
        ("estimate", (553.73, 160.7, "Pa"), "550 ± 160 Pa"),
        ("estimate", (33.2, None, "Pa"), "33.2 Pa"),
        ("estimate", (None, None, "Pa"), "–"),
        ("probability", (0.0,), "< 0.5 %"),
        ("probability", (0.0049,), "< 0.5 %"),
        ("probability", (0.012,), "1.2 %"),
        ("probability", (0.873,), "87 %"),
        ("probability", (0.994,), "99 %"),
        ("probability", (0.9999,), "> 99.5 %"),
        ("duration", (48.2,), "48 s"),
        ("duration", (200.0,), "3 min 20 s"),
        ("duration", (7500.0,), "2 h 5 min"),
        ("title", ("tool_friction",), "Tool friction"),
        ("listed", (["a"],), "a"),
        ("listed", (["a", "b"],), "a and b"),
        ("listed", (["a", "b", "c"], "or"), "a, b or c"),
        ("model_label", ("",), "as it is"),
        ("model_label", ("tool_friction",), "tool friction"),
        ("block", ({"stage": "pushing", "region": "tool", "channel": "force up"},), "tool while pushing, force up"),
        ("misfit_verdict", ({"adequate": True},), "The model is adequate."),
        ("misfit_verdict", ({"adequate": False},), "The model is not adequate: something may be missing."),
    ],
)
def test_what_a_reader_reads(name: str, arguments: tuple[Any, ...], text: str) -> None:
    assert getattr(words, name)(*arguments) == text


@pytest.mark.parametrize(
    ("verdict", "names", "text"),
    [
        ("adequate", "", "The model is adequate."),
        ("adequate", "cohesion", "The model is adequate."),
        ("missing", "tool_friction", "Missing: tool friction."),
        ("one of", "cohesion tool_adhesion", "Missing: cohesion or tool adhesion."),
        ("something else", "", "Something is missing that the library does not have."),
        ("undecided", "cohesion", "Undecided: the data do not discriminate between the models."),
    ],
)
def test_a_verdict_is_one_line(verdict: str, names: str, text: str) -> None:
    assert words.verdict({"verdict": verdict, "class": names.split()}) == text


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


@pytest.mark.parametrize(
    ("total", "noise", "adequate", "says", "says_not"),
    [
        (0.011, 0.01, None, "nothing more to explain", "of that of soil at rest"),
        (0.038, 0.01, None, "3.8 × the instruments' noise. Part of the rest is seed-to-seed scatter", "nothing more"),
        (0.073, 0.01, None, "7.3 % of that of soil at rest, 7.3 × the instruments' noise", "nothing more"),
        (1.6, 0.01, None, "160 × the instruments' noise", "nothing more"),
        (0.038, None, None, "unknown: the set has no pre-roll", "equal to the last bit"),
        (
            0.038,
            0.0,
            None,
            "equal to the last bit, so they show no noise; a standard deviation of 0.05 grey",
            "pre-roll",
        ),
        # one far above the cameras' noise is no fault of an adequate model, nor does little noise hide what fails
        (
            0.52,
            0.01,
            True,
            "52 × the instruments' noise. Instruments' noise, seed-to-seed scatter and discretisation",
            "Part of",
        ),
        (0.52, 0.01, False, "52 × the instruments' noise.", "discretisation"),
        (0.011, 0.01, False, "1.1 × the instruments' noise", "nothing more"),
    ],
)
def test_the_verdict_follows_the_ratio_to_the_noise(
    total: float, noise: float | None, adequate: bool | None, says: str, says_not: str
) -> None:
    comparison = {"loss": "robust", "total": {"robust": total}, "motionless": {"robust": 1.0}}
    said = words.residual_sentence({**comparison, "noise": {} if noise is None else {"robust": noise}}, adequate)
    assert says in said and says_not not in said
    assert "not been compared" in words.residual_sentence(None)


ENTRY = {"estimate": 36.0, "std": 0.5, "unit": "deg", "at_bound": None, "determined": True}
AVERAGED = {"value": 37.1, "std": 3.2, "determined": True}


def answer(fit: dict[str, Any], judged: Any = None) -> dict[str, str]:
    (only,) = words.answers(fit, judged)
    return only


@pytest.mark.parametrize(
    ("determined", "at_bound", "state"),
    [(True, None, "determined"), (True, "upper", "bound"), (False, "upper", "open")],
)
def test_an_answer_that_is_none_says_so(determined: bool, at_bound: str | None, state: str) -> None:
    entry = {**ENTRY, "at_bound": at_bound, "determined": determined}
    told = answer({"estimated_from": "loss", "parameters": {"friction_angle": entry}})
    assert told["state"] == state and bool(told["remark"]) == (state != "determined")


@pytest.mark.parametrize(
    ("judgement", "adequate"),
    [
        ({"verdict": "adequate"}, True),
        ({"verdict": "missing"}, False),
        ({"verdict": "undecided"}, False),
        ({"adequate": True}, True),
        ({"adequate": False}, False),
    ],
)
def test_the_answer_is_averaged_over_models_whatever_the_verdict(judgement: dict, adequate: bool) -> None:
    parameters = {"friction_angle": {**ENTRY, "determined": False}}
    fit = {"name": "base", "estimated_from": "loss", "parameters": parameters}
    judged = {"fit": "base", **judgement, "estimates": {"friction_angle": AVERAGED}}
    told = answer(fit, judged)
    assert (told["number"], told["state"], told["remark"]) == ("37 ± 3°", "determined", "")
    assert "averaged over models" in words.fitted_sentence(fit, judged)
    assert words.called_adequate(fit, judged) is adequate
    wide = answer(fit, {**judged, "estimates": {"friction_angle": {**AVERAGED, "determined": False}}})
    assert wide["state"] == "open" and "do not determine the friction angle" in wide["remark"]


@pytest.mark.parametrize("judged", [None, {"fit": "tilt", "verdict": "adequate", "estimates": {}}])
@pytest.mark.parametrize(("source", "said"), [("loss", "10 evaluations"), ("comparison", "discretisation error")])
def test_without_a_judgement_of_this_fit_the_answer_is_its_own(judged: dict | None, source: str, said: str) -> None:
    fit = {"name": "base", "estimated_from": source, "evaluations": 10, "parameters": {"friction_angle": ENTRY}}
    assert answer(fit, judged)["number"] == "36.0 ± 0.5°"
    assert said in words.fitted_sentence(fit, judged) and words.called_adequate(fit, judged) is None
