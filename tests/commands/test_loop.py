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


def said(verdict: str, nearest: str = "", explained: float = 0.0) -> dict[str, Any]:
    return {"verdict": verdict, "class": [nearest] if nearest else [], "explained": explained}


@pytest.mark.parametrize(
    ("diagnoses", "most", "added", "reason"),
    [
        ([said("adequate")], 2, [], "nothing stands"),
        ([said("missing", "cohesion", 0.9), said("adequate")], 2, ["cohesion"], "nothing stands"),
        ([said("missing", "cohesion", 0.9)] * 2, 1, ["cohesion"], "the limit"),
        ([said("outside the library")], 2, [], "no effect of the library explains all"),
        ([said("outside the library", "tilt", 0.2)], 2, [], "no effect of the library explains all"),
        (
            [said("outside the library", "cohesion", 0.6), said("outside the library", "tilt", 0.1)],
            2,
            ["cohesion"],
            "no effect of the library explains all",
        ),
    ],
)
def test_the_loop_adds_what_is_missing_or_nearest_and_says_why_it_stops(
    monkeypatch: pytest.MonkeyPatch, diagnoses: list[dict[str, Any]], most: int, added: list[str], reason: str
) -> None:
    left, done = list(diagnoses), []
    monkeypatch.setattr(_criticism, "diagnosed", lambda *_: left.pop(0))
    monkeypatch.setattr(add, "added", lambda folder, model, name, *_: done.append(name))
    folder: Any = SimpleNamespace(path="run", fit=lambda: {"setup": {"effects": done}})
    model: Any = SimpleNamespace(variant=lambda effects: model)
    last, why = loop(folder, model, most, lambda _: lambda what, share: None)
    assert done == added and reason in why and last is diagnoses[len(added)]


def stand_in(monkeypatch: pytest.MonkeyPatch, place: Path, adequate: bool) -> None:
    """All of the stages but the loop."""
    comparison = {"loss": "robust", "total": {}, "noise": {}}
    (place / "comparison.json").write_text(json.dumps(comparison))
    folder = SimpleNamespace(path=place, comparison=place, fit=lambda: {"name": "last"})
    monkeypatch.setattr(_stages, "prepare", lambda config: (None, folder))
    for name, found in (("reconstructed", None), ("model_on", None), ("fitted", {}), ("compared", comparison)):
        monkeypatch.setattr(_stages, name, lambda *_, found=found: found)
    told = {"adequate": adequate, "misfit": {}, "whole": {}, "estimates": {}, "blocks": [], "floor": {}}
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
def test_run_looks_for_what_is_missing_where_the_floor_says_that_something_is(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    flags: dict[str, bool],
    adequate: bool,
    looks: bool,
) -> None:
    stand_in(monkeypatch, tmp_path, adequate)
    parts = ("verdict", "class", "sentences", "misfit", "whole", "whole_after", "effects", "estimates", "simulations")
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
