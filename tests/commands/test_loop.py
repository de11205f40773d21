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


@pytest.mark.parametrize(("flags", "looks"), [([], True), (["--no-effects"], False)])
def test_run_compares_all_effects_unless_told_to_stop(
    missing: dict[str, Any], capsys: pytest.CaptureFixture[str], flags: list[str], looks: bool
) -> None:
    assert cli.main(["run", "set", "--json", *flags]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed.get("stopped") == "enough") is looks and ("diagnosis" in printed) is looks
    assert ("misfit" in printed) is not looks


@pytest.mark.parametrize(("fails", "flags"), [("add_missing", []), ("check_adequacy", ["--no-effects"])])
def test_what_fails_after_the_fit_costs_no_report(
    missing: dict[str, Any], capsys: pytest.CaptureFixture[str], fails: str, flags: list[str]
) -> None:
    missing[fails] = SimulationError("soil left the bin")
    assert cli.main(["run", "set", "--json", *flags]) == 0
    out, err = capsys.readouterr()
    assert "whether the model is adequate isn't known: soil left the bin" in err
    printed = json.loads(out)
    assert printed["name"] == "base" and "misfit" not in printed and "diagnosis" not in printed
