"""When `run` looks for what is missing, when it goes on and when it stops."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatsoil import cli
from splatsoil.commands import _folder, _model, _stages, add, run
from splatsoil.errors import SimulationError

LAST = {"name": "last", "loss": 0.5, "best": {"loss": 0.5}, "parameters": {}}
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
def stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """Results of all stages; an error is raised."""
    comparison = {"loss": "robust", "total": {}, "noise": {}}
    (tmp_path / "comparison.json").write_text(json.dumps(comparison))
    folder = SimpleNamespace(path=tmp_path, comparison=tmp_path, fit=lambda: LAST)
    results: dict[str, Any] = {
        "misfit": dict.fromkeys(("probability", "estimates", "checks", "passes"), 0) | {"adequate": True},
        "missing": (dict.fromkeys(run.DIAGNOSIS, ""), "enough"),
    }

    def result(name: str) -> Any:
        if isinstance(results[name], Exception):
            raise results[name]
        return results[name]

    for place, name, found in (
        (_stages, "prepare", lambda *_: (None, folder)),
        (_model, "reconstructed", lambda *_: None),
        (_model, "model_on", lambda *_: None),
        (_stages, "run_fit", lambda *_: LAST),
        (_stages, "draw_comparison", lambda *_: comparison),
        (_stages, "check_adequacy", lambda *_: result("misfit")),
        (run, "add_missing", lambda *_: result("missing")),
        (_folder, "history", lambda _: []),
    ):
        monkeypatch.setattr(place, name, found)
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: path)
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
    stand_in: dict[str, Any], capsys: pytest.CaptureFixture[str], flags: list[str], adequate: bool, looks: bool
) -> None:
    stand_in["misfit"]["adequate"] = adequate
    assert cli.main(["run", "set", "--json", *flags]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told.get("stopped") == "enough") is looks and ("diagnosis" in told) is looks
    assert ("misfit" in told) is not looks


def test_run_cannot_both_look_and_not_look(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "set", "--criticise", "--stop-at-floor"]) == 2
    assert "give one of them" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fails", "says"),
    [("missing", "what is missing isn't known"), ("misfit", "whether the model is adequate isn't known")],
)
def test_what_fails_after_the_fit_costs_no_report_unless_it_was_asked_for(
    stand_in: dict[str, Any], capsys: pytest.CaptureFixture[str], fails: str, says: str
) -> None:
    stand_in["misfit"]["adequate"] = False
    stand_in[fails] = SimulationError("soil left the bin")
    assert cli.main(["run", "set", "--json"]) == 0
    out, err = capsys.readouterr()
    assert f"{says}: soil left the bin" in err and json.loads(out)["name"] == "last"
    assert ("misfit" in json.loads(out)) is (fails == "missing") and "diagnosis" not in json.loads(out)
    if fails == "missing":
        assert cli.main(["run", "set", "--criticise"]) == 2
