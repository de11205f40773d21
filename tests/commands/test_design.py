"""``design`` as a user meets it: what it refuses, says and writes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import _control
from splatsoil.commands.design import sentence, show
from splatsoil.files import read_json, write_json
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.report.data import estimates

from .test_criticism import command, cut

KINDS = {"": "base", "something else": "discrepancy", "light": "observation"}


def diagnose(run: RunFolder, **changes: Any) -> None:
    """A diagnosis of the latest fit by the code as it is."""
    fit = run.fit()
    probability = changes.pop("probability", {"": 0.5, "cohesion": 0.5})
    data = {
        "format": "splatsoil-diagnosis/2",
        "fit": fit["name"],
        "values": estimates(fit),
        "model": [],
        "models": [{"name": n, "kind": KINDS.get(n, "physics"), "probability": p} for n, p in probability.items()],
        "draws": {},
        "candidates": [],
        "judged_by": _control.judged_by(),
        "code": _control.code_of(fit["setup"]["effects"]),
        **changes,
    }
    write_json(run.path / "diagnosis.json", data)


def refusal(run: RunFolder, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(["design", str(run.path), *words, "--json"]) == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert not (run.path / "design").exists()
    return str(json.loads(said.out)["error"])


@pytest.mark.usefixtures("no_work")
def test_what_there_is_nothing_to_design_from_is_refused(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    made = f"make one first: splatsoil diagnose '{run.path}'"
    assert refusal(run, capsys).endswith(f"has no diagnosis; {made}")
    for changes in ({"values": {"friction_angle": 1.0}}, {"judged_by": "other code"}, {"code": "other code"}):
        diagnose(run, **changes)
        assert refusal(run, capsys).endswith(f"its diagnosis is of another fit, or by other code; {made}")
    for probability in ({"": 0.97, "cohesion": 0.03}, {"something else": 0.6, "light": 0.3, "": 0.1}):
        diagnose(run, probability=probability)
        assert "there are no two that a stroke could tell apart" in refusal(run, capsys)
    diagnose(run)
    assert "--draws: between 3 and 32 simulations, not 2" in refusal(run, capsys, "--draws", "2")


def test_no_run_and_no_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["design", str(tmp_path)]) == 2
    assert "run.json" in capsys.readouterr().err


@pytest.fixture
def result() -> Callable[..., dict[str, Any]]:
    def make(**less: bool) -> dict[str, Any]:
        bits = {"half as fast": 0.8, "as measured": 0.7, "half as deep": 0.1}
        strokes = [
            {"name": n, "bits": b, "std": 0.05, "told_apart": [], "less_than_best": less.get(n.replace(" ", "_"), True)}
            for n, b in bits.items()
        ]
        strokes[0]["told_apart"], strokes[0]["less_than_best"] = [["", "tool_adhesion"]], False
        return {
            "models": {"": 0.6, "tool_adhesion": 0.4},
            "most": 0.97,
            "strokes": strokes,
            "notes": ["twice as fast: could not be simulated (no step is short enough)"],
            "simulated_now": 3,
            "seconds": 4.0,
        }

    return make


def test_a_stroke_is_called_better_only_beyond_the_error(result: Callable[..., dict[str, Any]]) -> None:
    assert sentence(result()) == (
        "Most is expected of the stroke half as fast: 0.80 ± 0.05 bits, more than of any other."
    )
    assert sentence(result(as_measured=False)).endswith("; by these simulations it is not better than as measured.")


def test_the_table_says_what_is_expected_and_told_apart(
    result: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    show(result())
    said = capsys.readouterr().out
    assert "models: as it is (60 %) and tool adhesion (40 %); to be told at most: 0.97 bits" in said
    row = next(line for line in said.splitlines() if line.strip().startswith("half as fast"))
    assert "0.80 ± 0.05 bits" in row and "as it is from tool adhesion" in row
    assert "could not be simulated" in said


@pytest.mark.slow
def test_a_diagnosed_run_gets_its_next_stroke(plow_damp: Path, tmp_path: Path) -> None:
    """On a cut set, coarsely: what is proposed means nothing, that it is kept, resumed and can be made does."""
    cut(plow_damp, tmp_path / "set")
    command("fit", "set", "--preset", "tiny", "--budget", "3", "--run", "run", cwd=tmp_path)
    command("diagnose", "run", "--effects", "cohesion", cwd=tmp_path)
    run = tmp_path / "run"
    # Probable ones, whatever these few frames say.
    data = read_json(run / "diagnosis.json")
    for model in data["models"]:
        model["probability"] = {"": 0.5, "cohesion": 0.4}.get(model["name"], 0.1)
    data["draws"].setdefault("cohesion", [{**draw, "cohesion": 400.0} for draw in data["draws"][""]])
    write_json(run / "diagnosis.json", data)
    first = command("design", "run", "--draws", "3", cwd=tmp_path)
    assert first["simulated_now"] > 0
    again = command("design", "run", "--draws", "3", cwd=tmp_path)
    assert again["simulated_now"] == 0, "everything was kept"
    assert again["strokes"] == first["strokes"]
    kept = read_json(run / "design" / "design.json")
    assert kept["format"] == "splatsoil-design/1" and kept["strokes"] == first["strokes"]
    assert first["stroke"] == first["strokes"][0]["name"]
    assert [s["bits"] for s in first["strokes"]] == sorted((s["bits"] for s in first["strokes"]), reverse=True)
    assert all(0.0 <= s["bits"] <= first["most"] + 1e-9 for s in first["strokes"])
    motion = ToolMotion.read(run / "design" / "tool_motion.csv")
    rate = Measurement.load(plow_damp).frame_rate
    assert (abs(motion.times - motion.frames / rate) < 1e-9).all()
    # A set with this motion is one; its force is still to be measured.
    shutil.copytree(tmp_path / "set", tmp_path / "next")
    shutil.copy(run / "design" / "tool_motion.csv", tmp_path / "next")
    experiment = read_json(tmp_path / "next" / "experiment.json")
    del experiment["tool"]["force"]
    write_json(tmp_path / "next" / "experiment.json", experiment)
    assert Measurement.load(tmp_path / "next").tool.motion.times[-1] == motion.times[-1]
