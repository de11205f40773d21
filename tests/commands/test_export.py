"""``splatsoil export``: what it refuses, which model it takes, and all of it once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands import export
from splatsoil.errors import NoAnswer, RunError
from splatsoil.files import read_json, write_json


def model_with(*effects: str) -> Any:
    """A model as far as a choice needs it."""
    names = {"": ["friction_angle"], "cohesion": ["friction_angle", "cohesion"]}
    return SimpleNamespace(
        effects=tuple(SimpleNamespace(name=name) for name in effects),
        parameters=tuple(SimpleNamespace(name=name) for name in names["+".join(effects)]),
        variant=lambda effects: model_with(*effects),
    )


def diagnosis(fit: dict[str, Any], best: str) -> dict[str, Any]:
    chances = {"else": 0.5, best: 0.3, "tilt": 0.1}
    kinds = {"else": "discrepancy", "": "base"}
    values = {"friction_angle": 31.0, **({"cohesion": 250.0} if best else {})}
    models = [
        {"name": name, "kind": kinds.get(name, "physics"), "probability": chance, "values": values}
        for name, chance in chances.items()
    ]
    estimates = {name: entry["estimate"] for name, entry in fit["parameters"].items()}
    return {"format": "splatsoil-diagnosis/3", "fit": fit["name"], "values": estimates, "model": [], "models": models}


@pytest.mark.parametrize("best", ["", "cohesion"])
def test_the_most_probable_model_of_the_diagnosis(
    best: str, run: RunFolder, fit_of: Callable[..., dict[str, Any]]
) -> None:
    config = export.Config(run.path, model="diagnosis")
    with pytest.raises(RunError, match="splatsoil diagnose makes one"):
        export._chosen(config, run, model_with())
    write_json(run.path / "diagnoses" / "base.json", diagnosis(fit_of(), best))
    model, values = export._chosen(config, run, model_with())
    assert [effect.name for effect in model.effects] == ([best] if best else [])
    assert values == {"friction_angle": 31.0, **({"cohesion": 250.0} if best else {})}
    assert export._chosen(export.Config(run.path), run, model_with())[1] == {"friction_angle": 35.0}


@pytest.mark.slow
def test_a_fitted_run_is_exported_and_replaced(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    fit = ["fit", str(small_set), "--preset", "tiny", "--budget", "2", "--run", "run", "--device", "cpu", "--json"]
    assert cli.main(fit) == NoAnswer.code, "one frame after the first says nothing; the fit is kept"
    capsys.readouterr()
    estimate = read_json(tmp_path / "run" / "fit.json")["parameters"]["friction_angle"]["estimate"]
    assert cli.main(["export", "run", "--to", "csv", "ply", "--device", "cpu", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] is True and said["parameters"] == {"friction_angle": estimate} and said["frames"] == [0, 10]
    folder = tmp_path / "run" / "export"
    wanted = {"csv": ["force.csv", "surface.csv"], "ply": ["splats_000000.ply", "splats_000010.ply"]}
    assert said["files"] == wanted
    assert {name: sorted(p.name for p in (folder / name).iterdir()) for name in wanted} == wanted
    assert json.loads((folder / "export.json").read_text())["preset"] == "tiny"
    assert cli.main(["export", "run", "--to", "csv", "--every", "5", "--device", "cpu"]) == 0
    assert sorted(p.name for p in folder.iterdir()) == ["csv", "export.json"], "the older one is gone"
    header = (folder / "csv" / "surface.csv").read_text().splitlines()[0]
    assert header == "x,y,reconstructed,frame_0,frame_5,frame_10"
    assert not [p for p in (tmp_path / "run").iterdir() if p.name.startswith(".")]
