"""What the terminal says of progress, a diagnosis, a comparison and a fit."""

from __future__ import annotations

from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands._output import stages
from splatsoil.commands.compare import show_misfit
from splatsoil.commands.diagnose import show
from splatsoil.soil.library import library

ANGLE = {"friction_angle": {"value": 34.9, "std": 1.7, "unit": "deg", "determined": True}}
SIZE = {"unit": "Pa", "estimate": -25400.0, "std": 1900.0, "detectable": 31400}
DIAGNOSIS = {
    "fit": "base",
    "verdict": "missing",
    "class": ["tilt"],
    "estimates": ANGLE,
    "sentences": ["A sentence that says why."],
    "notes": ["One thing to know."],
    "simulations": 57,
    "simulated_now": 12,
    "seconds": 81.2,
}
MISFIT = {
    "checks": [
        {"stage": "push", "region": "berm", "channel": "left", "ratio": 2.31, "p": 0.003},
        {"stage": "push", "region": "track", "channel": "left", "ratio": 1.12, "p": 0.6},
    ],
    "estimates": ANGLE,
    "sentences": ["A sentence that says why."],
}


def text_of(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_a_model_has_one_line_with_its_whole_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a narrow terminal, too."""
    monkeypatch.setenv("COLUMNS", "80")
    names = [*library(), "something else"]
    show({**DIAGNOSIS, "models": [{"name": name, "probability": 0.0312, **SIZE} for name in names]})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    for name in names:
        (line,) = (line for line in lines if line.strip().startswith(f"{name.replace('_', ' ')}  "))
        assert "3.1 %" in line and "-25400 ± 1900 Pa" in line and "31400 Pa" in line


def test_a_diagnosis_says_its_verdict_and_why(capsys: pytest.CaptureFixture[str]) -> None:
    none = {"unit": "1", "estimate": None, "std": None, "detectable": None}
    show({**DIAGNOSIS, "models": [{"name": "", "probability": 0.004, **none}]})
    text = text_of(capsys)
    assert "as it is < 0.5 % – –" in text and "Missing: tilt." in text
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
    adequate: bool, verdict: str, asks: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "70")
    folder = "runs/of the year/with a long name, which no terminal of this width holds"
    show_misfit({**MISFIT, "adequate": adequate, "probability": 0.971 if adequate else 0.02}, folder)
    out = capsys.readouterr().out
    assert out.endswith(f"{asks} splatsoil diagnose '{folder}'\n"), "it can be pasted"
    text = " ".join(out.split())
    assert "push berm left 2.31 0.003" in text and "A sentence that says why." in text
    assert f"{verdict} against something else; 1 of 2 checks fail" in text
    assert ("not adequate" in text) is not adequate


def test_the_hint_after_a_fit_can_be_pasted(
    run: RunFolder, results: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    results["run_fit"]["notes"] = ["[red]one[/red]"]
    assert cli.main(["fit", "set"]) == 0
    text = text_of(capsys)
    assert "friction_angle 35.0 ± 0.8° 33.4 to 36.5° note [red]one[/red] loss 0.123 ± 0.01" in text
    assert text.endswith(f"and where does it fail? splatsoil compare '{run.path}'")


def progress(quiet: bool = False) -> None:
    with stages(quiet=quiet) as begin:
        report = begin("fit")
        for share in (0.01, 0.05, 0.1, 0.15, 0.3, 0.35):
            report(f"[at] {share}", share)
        begin("report")


def test_progress_goes_to_stderr(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    progress()
    log = ["fit", "fit: 10 %, [at] 0.1", "fit: 30 %, [at] 0.3", "report"]
    out, err = capsys.readouterr()
    assert (out, err.splitlines()) == ("", log), "a line a stage, and a line a tenth"
    progress(quiet=True)
    assert capsys.readouterr() == ("", "")
    for variable, value in (("FORCE_COLOR", "1"), ("TERM", "xterm"), ("COLUMNS", "120")):
        monkeypatch.setenv(variable, value)
    progress()
    err = capsys.readouterr().err
    assert "fit" in err and "100 %" in err and "left" in err, "a terminal gets bars with the time left"
