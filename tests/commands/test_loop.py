"""When `run` looks for what is missing, when it goes on and when it stops."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from splatsoil import cli
from splatsoil.commands import _stages, add, run
from splatsoil.errors import SimulationError

ENOUGH = "nothing more is needed to explain the data"
NONE = "no single effect is probable enough to be added"
TRY = f"{NONE}; the most probable is buried obstacle: splatsoil add 'my run' buried_obstacle tries it"


def said(verdict: str, *effects: str) -> dict[str, Any]:
    return {"verdict": verdict, "class": list(effects)}


@pytest.mark.parametrize(
    ("diagnoses", "most", "added", "reason"),
    [
        ([said("adequate")], 2, [], ENOUGH),
        ([said("adequate", "tilt")], 2, [], ENOUGH),
        ([said("missing", "cohesion"), said("missing", "tilt"), said("adequate")], 2, ["cohesion", "tilt"], ENOUGH),
        ([said("missing", "cohesion")] * 2, 1, ["cohesion"], "1 effects have been added, which is the limit"),
        ([said("missing", "cohesion")], 0, [], "0 effects have been added, which is the limit"),
        ([said("something else")], 2, [], NONE),
        ([said("undecided", "buried_obstacle")], 2, [], TRY),
        ([said("missing", "cohesion"), said("one of", "buried_obstacle", "tilt")], 2, ["cohesion"], TRY),
    ],
)
def test_the_loop_adds_what_is_missing_and_says_why_it_stops(
    monkeypatch: pytest.MonkeyPatch, diagnoses: list[dict[str, Any]], most: int, added: list[str], reason: str
) -> None:
    left, done = list(diagnoses), list[str]()
    monkeypatch.setattr(_stages, "run_diagnosis", lambda *_: left.pop(0))
    monkeypatch.setattr(add, "add_effect", lambda folder, model, name, *_: done.append(name))
    folder, model = SimpleNamespace(path="my run"), SimpleNamespace()
    last, why = run.add_missing(folder, model, most, lambda _: lambda what, share: None)  # type: ignore[arg-type]
    assert done == added and last is diagnoses[len(added)]
    assert why.removesuffix(" (--most-effects)") == reason


@pytest.fixture
def missing(results: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Stages that aren't run, and the search for what is missing."""
    results["add_missing"] = (dict.fromkeys(run.DIAGNOSIS, ""), "enough")

    def add_missing(*_: object) -> Any:
        if isinstance(results["add_missing"], Exception):
            raise results["add_missing"]
        return results["add_missing"]

    monkeypatch.setattr(run, "add_missing", add_missing)
    return results


@pytest.mark.parametrize(
    ("flags", "adequate", "looks"),
    [
        ([], True, False),
        ([], False, True),
        (["--criticise"], True, True),
        (["--criticise"], False, True),
        (["--stop-at-floor"], False, False),
    ],
)
def test_run_looks_for_what_is_missing_where_the_model_is_not_adequate(
    missing: dict[str, Any], capsys: pytest.CaptureFixture[str], flags: list[str], adequate: bool, looks: bool
) -> None:
    missing["check_adequacy"]["adequate"] = adequate
    assert cli.main(["run", "set", "--json", *flags]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told.get("stopped") == "enough") is looks and ("diagnosis" in told) is looks
    assert ("misfit" in told) is not looks


def test_run_cannot_both_look_and_not_look(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "set", "--criticise", "--stop-at-floor"]) == 2
    assert "give one of them" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fails", "says"),
    [
        ("add_missing", "what is missing isn't known"),
        ("check_adequacy", "whether the model is adequate isn't known"),
    ],
)
def test_what_fails_after_the_fit_costs_no_report_unless_it_was_asked_for(
    missing: dict[str, Any], capsys: pytest.CaptureFixture[str], fails: str, says: str
) -> None:
    missing["check_adequacy"]["adequate"] = False
    missing[fails] = SimulationError("soil left the bin")
    assert cli.main(["run", "set", "--json"]) == 0
    out, err = capsys.readouterr()
    assert f"{says}: soil left the bin" in err and json.loads(out)["name"] == "base"
    assert ("misfit" in json.loads(out)) is (fails == "add_missing") and "diagnosis" not in json.loads(out)
    if fails == "add_missing":
        assert cli.main(["run", "set", "--criticise"]) == 2
