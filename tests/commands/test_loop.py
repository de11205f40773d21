"""When `run` looks for what is missing, when it goes on and when it stops."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatsoil.commands import _criticism, _history, _stages, add
from splatsoil.commands import run as command
from splatsoil.commands.run import Config, loop
from splatsoil.errors import ParameterError, SimulationError

LAST = {"name": "last", "loss": 0.5, "best": {"loss": 0.5}, "parameters": {}}


def said(verdict: str, *effects: str) -> dict[str, Any]:
    return {"verdict": verdict, "class": list(effects)}


ENOUGH = "nothing more is needed to explain the data"
NONE = "no single effect is probable enough to be added"
TRY = f"{NONE}; the most probable is buried obstacle: splatsoil add run buried_obstacle tries it"


@pytest.mark.parametrize(
    ("diagnoses", "most", "added", "reason"),
    [
        ([said("adequate")], 2, [], ENOUGH),
        ([said("adequate", "tilt")], 2, [], ENOUGH),
        ([said("missing", "cohesion"), said("adequate")], 2, ["cohesion"], ENOUGH),
        ([said("missing", "cohesion"), said("missing", "tilt"), said("adequate")], 2, ["cohesion", "tilt"], ENOUGH),
        ([said("missing", "cohesion")] * 2, 1, ["cohesion"], "1 effects have been added, which is the limit"),
        ([said("missing", "cohesion")], 0, [], "0 effects have been added, which is the limit"),
        ([said("something else")], 2, [], NONE),
        ([said("undecided")], 2, [], NONE),
        ([said("something else", "buried_obstacle", "tilt")], 2, [], TRY),
        ([said("undecided", "buried_obstacle")], 2, [], TRY),
        ([said("missing", "cohesion"), said("one of", "buried_obstacle", "tilt")], 2, ["cohesion"], TRY),
    ],
)
def test_the_loop_adds_what_is_missing_and_says_why_it_stops(
    monkeypatch: pytest.MonkeyPatch, diagnoses: list[dict[str, Any]], most: int, added: list[str], reason: str
) -> None:
    left, done = list(diagnoses), []
    monkeypatch.setattr(_criticism, "diagnosed", lambda *_: left.pop(0))
    monkeypatch.setattr(add, "added", lambda folder, model, name, *_: done.append(name))
    folder: Any = SimpleNamespace(path="run", fit=lambda: {"setup": {"effects": done}})
    model: Any = SimpleNamespace(variant=lambda effects: model)
    last, why = loop(folder, model, most, lambda _: lambda what, share: None)
    assert done == added and last is diagnoses[len(added)]
    assert why.removesuffix(" (--most-effects)") == reason


def stand_in(monkeypatch: pytest.MonkeyPatch, place: Path, adequate: bool) -> None:
    """All of the stages but the loop."""
    comparison = {"loss": "robust", "total": {}, "noise": {}}
    (place / "comparison.json").write_text(json.dumps(comparison))
    folder = SimpleNamespace(path=place, comparison=place, fit=lambda: LAST)
    monkeypatch.setattr(_stages, "prepare", lambda config: (None, folder))
    for name, found in (("reconstructed", None), ("model_on", None), ("fitted", LAST), ("compared", comparison)):
        monkeypatch.setattr(_stages, name, lambda *_, found=found: found)
    told = {"adequate": adequate, "probability": 0.9, "estimates": {}, "checks": [], "passes": adequate}
    monkeypatch.setattr(_criticism, "misfit", lambda *_: told)
    monkeypatch.setattr(_history, "history", lambda _: [])
    monkeypatch.setattr("splatsoil.report.write_report", lambda path: path)


@pytest.mark.parametrize(
    ("flags", "adequate", "looks"),
    [
        ({}, True, False),
        ({}, False, True),
        ({"criticise": True}, True, True),
        ({"criticise": True}, False, True),
        ({"stop_at_floor": True}, False, False),
    ],
)
def test_run_looks_for_what_is_missing_where_the_model_is_not_adequate(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    flags: dict[str, bool],
    adequate: bool,
    looks: bool,
) -> None:
    stand_in(monkeypatch, tmp_path, adequate)
    parts = ("verdict", "class", "sentences", "models", "checks", "held_out", "estimates", "simulations")
    monkeypatch.setattr(command, "loop", lambda *_: (dict.fromkeys(parts, ""), "enough"))
    assert command.run(Config(set=tmp_path, json=True, **flags)) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said.get("stopped") == "enough") is looks and ("diagnosis" in said) is looks
    assert ("misfit" in said) is not looks


def test_run_cannot_both_look_and_not_look(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="give one of them"):
        command.run(Config(set=tmp_path, criticise=True, stop_at_floor=True))


def test_a_diagnosis_that_fails_costs_no_report_unless_it_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fails(*_: object) -> None:
        raise SimulationError("soil left the bin")

    stand_in(monkeypatch, tmp_path, adequate=False)
    monkeypatch.setattr(command, "loop", fails)
    assert command.run(Config(set=tmp_path, json=True)) == 0
    told = capsys.readouterr()
    assert "what is missing isn't known: soil left the bin" in told.err and json.loads(told.out)["name"] == "last"
    with pytest.raises(SimulationError):
        command.run(Config(set=tmp_path, json=True, criticise=True))


def test_whether_the_model_is_adequate_may_stay_unknown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fails(*_: object) -> None:
        raise SimulationError("soil left the bin")

    stand_in(monkeypatch, tmp_path, adequate=False)
    monkeypatch.setattr(_criticism, "misfit", fails)
    monkeypatch.setattr(command, "loop", lambda *_: pytest.fail("looks for what is missing"))
    assert command.run(Config(set=tmp_path, json=True)) == 0
    told = capsys.readouterr()
    assert "whether the model is adequate isn't known: soil left the bin" in told.err
    page = json.loads(told.out)
    assert page["report"] == str(tmp_path) and "misfit" not in page
