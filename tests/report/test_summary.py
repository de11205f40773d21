"""The last lines of `splatsoil run`: one answer, true to the run folder's files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splatsoil.commands._output import print_rows
from splatsoil.files import write_json
from splatsoil.report.data import load
from splatsoil.report.summary import headline, rows


def test_an_adequate_model_has_one_answer_and_the_truth(run: Path, misfit: dict[str, Any]) -> None:
    write_json(run / "comparison" / "misfit.json", misfit)
    (run / "set").mkdir()
    write_json(run / "set" / "truth.json", {"phi": 36.0})
    data = load(run)
    assert headline(data) == "plow: ADEQUATE. A sentence that says why."
    told = dict(rows(data))
    assert told["friction angle"] == "33.2 ± 1.6°", "averaged over models"
    assert told["probability"] == "model as it is 97 %, against something else"
    assert told["truth.json says"] == "friction angle 36.0° (this set is simulated)"
    assert told["misfit"].endswith("largest: berm during push, left camera, 2.3 ×")


def test_a_rejected_model_has_its_number_marked(run: Path, diagnosis: dict[str, Any]) -> None:
    write_json(run / "diagnoses" / "base.json", diagnosis)
    data = load(run)
    assert headline(data) == "plow: NOT EXPLAINED. Missing: effect 2. A sentence that says why."
    told = dict(rows(data))
    assert told["friction angle"] == "(33.2 ± 1.6°, rejected)"
    assert told["probability"] == "effect 2 97 %; as it is 2.2 %" and "would have shown" not in told
    write_json(run / "diagnoses" / "base.json", {**diagnosis, "verdict": "adequate", "class": []})
    told = dict(rows(load(run)))
    assert told["would have shown"] == "effect 2 ≥ 120 Pa, tilt ≥ 0.54° (80 % power)"


def test_what_was_not_tested_and_what_was_added_are_named(added: Path, misfit: dict[str, Any]) -> None:
    told = {**misfit, "fit": "effect_2", "values": {"friction_angle": 35.62, "effect_2": 7.0}}
    write_json(added / "comparison" / "misfit.json", told)
    assert headline(load(added)).startswith("plow: ADEQUATE WITH EFFECT 2. ")
    (added / "comparison" / "misfit.json").unlink()
    assert headline(load(added)) == "plow: NOT TESTED. Whether the model is adequate is not known."


def test_lines_keep_to_the_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    print_rows([("probability", "cohesion 97 %; " * 9), ("misfit", "0.9")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 60 and len(lines) > 4
    assert lines[-1].split() == ["misfit", "0.9"] and lines[1].startswith(" " * 22)
