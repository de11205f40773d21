"""Fits whose estimate means nothing: said first, by an exit code of its own, and never as an answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import _answer, _criticism, _experiments, _history, _stages
from splatsoil.commands import add as adding
from splatsoil.errors import NoAnswer, RunError

FitOf = Callable[..., dict[str, Any]]
MISFIT = {
    "adequate": True,
    "probability": 0.9,
    "passes": True,
    "checks": [],
    "sentences": [],
    "estimates": {"friction_angle": {"value": 35.1, "std": 2.8, "unit": "deg", "determined": True}},
}
DIAGNOSIS = {
    **MISFIT,
    "fit": "base",
    "verdict": "adequate",
    "class": [],
    "models": [],
    "notes": [],
    "held_out": [{"model": ""}],
    "simulations": 1,
    "simulated_now": 0,
    "seconds": 1.0,
}
COMPARISON = {"loss": "robust", "total": {"robust": 1.29, "rgb": 1.0}, "motionless": {"robust": 1.0}, "noise": {}}


def spoilt(fit: dict[str, Any], name: str) -> dict[str, Any]:
    """As plow-dry gave it with views turned by half a turn, or with a black video; or at the end of its range."""
    if name == "bound":
        fit["parameters"]["friction_angle"] |= {"at_bound": "upper", "bounds": [20.0, 50.0], "unit": "deg"}
        return fit
    return fit | (
        {"loss": 1.29, "best": {"loss": 1.28}} if name == "turned" else {"loss": 10.0, "best": {"loss": 10.0}}
    )


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("turned", "no better than soil that never moves (loss 1.29; such soil has 1); photographs, poses"),
        ("cap", "(loss 10; such soil has 1)"),
        ("bound", "no answer: the friction angle ends at the upper bound of its range (50°)"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("command", ["fit", "run", "compare", "diagnose", "add", "posterior", "report"])
@pytest.mark.parametrize("in_json", [False, True])
def test_no_command_tells_an_estimate_that_means_nothing(
    run: RunFolder,
    fit_of: FitOf,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    says: str,
    command: str,
    in_json: bool,
) -> None:
    fit = spoilt(fit_of(), name)
    run.write_fit("base", fit)
    comparison = {**COMPARISON, "cameras": [], "frames": []}
    for place, what, found in (
        (_stages, "prepare", (None, run)),
        (_stages, "reconstructed", None),
        (_stages, "model_on", None),
        (_stages, "fitted", fit),
        (_stages, "compared", comparison),
        (_experiments, "model_of", SimpleNamespace(law=None)),
        (_criticism, "misfit", dict(MISFIT)),
        (_criticism, "diagnosed", dict(DIAGNOSIS)),
        (adding, "added", {}),
        (_history, "history", []),
    ):
        monkeypatch.setattr(place, what, lambda *_, found=found, **__: found)
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: path / "report.html")
    monkeypatch.setattr("splatsoil.commands._crew.Crew", lambda *_: _NoCrew())
    words = [command, str(run.path), *(["cohesion"] if command == "add" else []), *(["--json"] if in_json else [])]
    assert cli.main(words) == NoAnswer.code == 3
    out, err = capsys.readouterr()
    if in_json:
        told = json.loads(out)
        assert told["ok"] is False and says in told["error"]
    else:
        assert out.startswith("no answer: ") and says in out.splitlines()[0] and "Traceback" not in err
    assert not {"35", "35.1", "35.0"} & set(out.replace("°", " ").replace(",", " ").split()), out


class _NoCrew:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        return None


def test_what_is_an_answer(fit_of: FitOf) -> None:
    fit = fit_of(["cohesion"], cohesion=0.0)
    assert _answer.why_none(fit) == ""
    assert _answer.why_none(fit | {"loss": 0.99}) == "" and _answer.why_none(fit | {"loss": 1.0}) != ""
    # of an effect off is where it isn't there, and its other bound is one
    fit["parameters"]["cohesion"] |= {"bounds": [0.0, 1500.0], "off": 0.0, "at_bound": "lower", "unit": "Pa"}
    assert _answer.why_none(fit) == ""
    fit["parameters"]["cohesion"]["at_bound"] = "upper"
    assert "the cohesion ends at the upper bound of its range (1500 Pa)" in _answer.why_none(fit)
    # where forces lead away from what the pictures say
    assert "where pictures and force together put it" in _answer.why_none(fit | {"loss": 1.2, "best": {"loss": 0.9}})


def test_a_fit_that_lacks_its_loss_is_damaged(fit_of: FitOf) -> None:
    fit = fit_of()
    del fit["best"]
    with pytest.raises(RunError, match="damaged"):
        _answer.why_none(fit)


@pytest.mark.parametrize("command", ["fit", "run"])
def test_json_has_the_run_folder_under_run(
    run: RunFolder, fit_of: FitOf, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """Not the set, which ``fit.json`` has there."""
    fit = {**fit_of(), "run": {"measurement": {"name": "plow"}}}
    run.write_fit("base", fit)
    for what, found in (
        ("prepare", (None, run)),
        ("reconstructed", None),
        ("model_on", None),
        ("fitted", fit),
        ("compared", {**COMPARISON, "cameras": [], "frames": []}),
    ):
        monkeypatch.setattr(_stages, what, lambda *_, found=found, **__: found)
    monkeypatch.setattr(_criticism, "misfit", lambda *_: dict(MISFIT))
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: Path(path) / "report.html")
    assert cli.main([command, "set", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["run"] == str(run.path)
