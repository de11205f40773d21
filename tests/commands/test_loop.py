"""When `run --criticise` goes on and when it stops, by what each diagnosis says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from splatsoil.commands import _criticism, add
from splatsoil.commands.run import loop


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
