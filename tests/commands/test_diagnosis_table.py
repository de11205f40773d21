"""A diagnosis on a narrow terminal: names and numbers can be read."""

from __future__ import annotations

from typing import Any

import pytest

from splatsoil.commands._diagnosis_table import show
from splatsoil.soil.library import library


def model(name: str) -> dict[str, Any]:
    return {"name": name, "probability": 0.0312, "unit": "Pa", "estimate": -25400.0, "std": 1900.0, "detectable": 31400}


def test_a_model_has_one_line_with_its_whole_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    names = [*library(), "something else"]
    told = {
        "fit": "base",
        "verdict": "adequate",
        "class": [],
        "estimates": {"friction_angle": {"value": 34.9, "std": 1.7, "unit": "deg", "determined": True}},
        "sentences": [],
        "notes": [],
    }
    show({**told, "models": [model(n) for n in names], "simulations": 3, "simulated_now": 0, "seconds": 1.0})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    for name in names:
        (line,) = (line for line in lines if line.strip().startswith(f"{name.replace('_', ' ')}  "))
        assert "3.1 %" in line and "-25400 ± 1900 Pa" in line and "31400 Pa" in line
