"""A diagnosis on a terminal: whatever its width, names and numbers can be read."""

from __future__ import annotations

from typing import Any

import pytest

from splatsoil.commands._diagnosis_table import show

SIZES = {
    "pressure_dependence": ("", 0.16, 0.05),
    "tool_adhesion": ("Pa", 139.0, 190.0),
    "buried_obstacle": ("m", 0.003, 0.004),
}


def effect(name: str) -> dict[str, Any]:
    unit, estimate, std = SIZES[name]
    told = {
        "verdict": "cannot tell",
        "z": -12.3,
        "p": 1.2e-10,
        "mde": 25400.0,
        "predicted_fall": 153.3,
        "achieved_fall": 360.6,
    }
    return {"name": name, "unit": unit, "estimate": estimate, "std": std, **told}


RESULT = {
    "fit": "base",
    "effects": [effect(name) for name in SIZES],
    "verdict": "adequate",
    "sentences": [],
    "notes": [],
    "simulations": 3,
    "simulated_now": 0,
    "seconds": 1.0,
}


@pytest.mark.parametrize(("width", "all_columns"), [(80, False), (120, True)])
def test_an_effect_has_one_line_with_its_whole_name_at_any_width(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int, all_columns: bool
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    show(RESULT)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    for name in SIZES:
        (line,) = (line for line in lines if name in line)
        assert "cannot tell" in line and "1.2e-10" in line and "±" in line and "25400" in line
        assert ("360.6" in line and "-12.3" in line) is all_columns
