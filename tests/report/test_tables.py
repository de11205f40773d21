"""What the terminal says of a diagnosis and of a comparison."""

from __future__ import annotations

from typing import Any

import pytest

from splatsoil.commands._diagnosis_table import show
from splatsoil.commands.compare import show_misfit


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_every_model_has_its_line(diagnosis: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    show(diagnosis)
    text = said(capsys)
    for line in (
        "effect 2 97 % 550 ± 160 Pa 120 Pa",
        "as it is 2.2 % – –",
        "something else < 0.5 % – –",
        "tilt < 0.5 % 0.31 ± 0.22° 0.54°",
    ):
        assert line in text, line
    assert "Missing: effect 2." in text
    assert "averaged over models. A sentence that says why. note One thing to know." in text
    assert text.endswith("57 simulations, 12 of them new, 81 s")


@pytest.mark.parametrize(
    ("adequate", "verdict", "asks"),
    [
        (True, "adequate: the model as it is has a probability of 97 %", "Could these data show a missing effect?"),
        (False, "not adequate: the model as it is has a probability of 2 %", "Which effect is missing?"),
    ],
)
def test_a_comparison_says_what_fails_and_what_to_ask_next(
    adequate: bool, verdict: str, asks: str, misfit: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    show_misfit({**misfit, "adequate": adequate, "probability": 0.971 if adequate else 0.02}, "runs/x")
    text = said(capsys)
    assert "push │ berm │ left │ 2.31 │ 0.003" in text
    assert f"{verdict} against something else; 1 of 2 checks fail" in text
    assert ("not adequate" in text) is not adequate
    assert "A sentence that says why." in text and text.endswith(f"{asks} splatsoil diagnose runs/x")
