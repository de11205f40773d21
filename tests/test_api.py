"""`import splatsoil as ss`: the commands as functions."""

from __future__ import annotations

import inspect
import json
import pydoc
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import splatsoil as ss
from splatsoil import cli
from splatsoil.errors import MeasurementError, ParameterError, RunError
from splatsoil.files import write_json

FUNCTIONS = [name for name in ss.__all__ if name not in ("Run", "Estimate", "__version__")]


@pytest.fixture
def fitted(run: Any) -> Path:
    """A run whose fit says 35 ± 0.8° and whose comparison says 36.5 ± 2°, and adequate."""
    said = {"format": "splatsoil-misfit/3", "fit": "base", "values": {"friction_angle": 35.0}, "adequate": True}
    better = {"friction_angle": {"value": 36.5, "std": 2.0, "determined": True}}
    write_json(run.comparison / "misfit.json", {**said, "estimates": better})
    return Path(run.path)


def test_importing_it_loads_nothing_heavy() -> None:
    code = (
        "import sys, splatsoil as ss; names = dir(ss)\n"
        "print('fit' in names, callable(ss.fit), sorted({'torch', 'warp', 'arviz', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "True True []\n"


def test_help_leads_to_every_function_and_all_are_typed() -> None:
    text = pydoc.plain(pydoc.render_doc(ss))
    for name in FUNCTIONS:
        signature = inspect.signature(getattr(ss, name))
        assert re.search(rf"^    {name}\(", text, flags=re.MULTILINE), name
        assert signature.return_annotation is not inspect.Signature.empty
        assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values())
        assert inspect.getdoc(getattr(ss, name))


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) & set(cli.commands())))
def test_a_functions_options_are_its_commands_with_the_same_defaults(name: str) -> None:
    config = cli.commands()[name].Config
    theirs = inspect.signature(config).parameters
    mine = {k: p for k, p in inspect.signature(getattr(ss, name)).parameters.items() if p.default is not p.empty}
    for option, parameter in mine.items():
        usual = theirs[option].default
        # A set is small by default; "values" are words on the command line.
        assert parameter.default == usual or option in ("values",) or (name, option) == ("simulate", "preset"), option


def test_a_run_is_what_its_files_say(fitted: Path) -> None:
    run = ss.open_run(fitted)
    angle = run.estimates["friction_angle"]
    assert (angle.value, angle.std, angle.unit, angle.determined) == (36.5, 2.0, "deg", True)
    assert run.adequate is True
    with pytest.raises(RunError, match=r"diagnose\(\)"):
        _ = run.probabilities
    with pytest.raises(RunError, match=r"sample\(\)"):
        _ = run.posterior
    with pytest.raises(RunError, match=r"compare\(\)"):
        run.picture("left", 50, "observed")
    (fitted / "comparison" / "misfit.json").unlink()
    assert run.adequate is None and run.estimates["friction_angle"].value == 35.0
    told = {"format": "splatsoil-comparison/1", "fit": "base", "parameters": {"friction_angle": 35.0}}
    write_json(fitted / "comparison" / "comparison.json", told)
    Image.new("RGB", (8, 6), (10, 20, 30)).save(fitted / "comparison" / "left_0050_observed.jpg")
    assert np.allclose(run.picture("left", 50, "observed"), (10, 20, 30), atol=3)
    picture = fitted / "comparison" / "left_0050_observed.jpg"
    picture.write_bytes(picture.read_bytes()[:-40])
    with pytest.raises(RunError, match=r"left_0050_observed\.jpg: is no whole"):
        run.picture("left", 50, "observed")
    models = [{"name": "", "probability": 0.9}, {"name": "tilt", "probability": 0.1}]
    found = {"format": "splatsoil-diagnosis/3", "fit": "base", "values": {"friction_angle": 35.0}, "model": []}
    write_json(fitted / "diagnoses" / "base.json", {**found, "models": models})
    assert run.probabilities == {"": 0.9, "tilt": 0.1}


def test_tables_are_xarray(fitted: Path) -> None:
    run = ss.open_run(fitted)
    table = run.evaluations
    assert table["friction_angle"].attrs == {"units": "deg"} and list(table["seed"].values) == [7, 7, 7]
    assert float(table["loss"].sel(step=1)) == 20.0 and np.isnan(table["loss"].sel(step=2))
    with pytest.raises(RunError, match=r"compare\(\)"):
        _ = run.force
    with pytest.raises(RunError, match=r"fit\(\)"):
        _ = run.surface
    channels = [{"channel": "push", "measured": [1.0, None], "predicted": [2.0, 3.0]}]
    force = {"unit": "N", "frames": [10, 20], "channels": channels}
    told = {"format": "splatsoil-comparison/1", "fit": "base", "parameters": {"friction_angle": 35.0}, "force": force}
    write_json(fitted / "comparison" / "comparison.json", told)
    pushed = run.force.sel(channel="push")
    assert float(pushed["predicted"].sel(frame=20)) == 3.0 and np.isnan(pushed["measured"].sel(frame=20))
    (fitted / "reconstruction").mkdir()
    height = np.arange(6.0).reshape(2, 3)
    np.savez(fitted / "reconstruction" / "surface.npz", x=[0.1, 0.2, 0.3], y=[0.5, 0.6], height=height)
    assert float(run.surface.sel(x=0.2, y=0.6)) == 4.0


def test_mistakes_are_one_sentence(
    tmp_path: Path, fitted: Path, plow_dry: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match=r"run\.json"):
        ss.open_run(tmp_path)
    with pytest.raises(MeasurementError, match="nowhere"):
        ss.fit("nowhere")
    with pytest.raises(ParameterError, match="did you mean cohesion"):
        ss.fit(plow_dry, effects=["cohesiom"])
    with pytest.raises(TypeError):
        ss.open_run(fitted).compare(quik=True)
    assert {path.name for path in tmp_path.iterdir()} == {fitted.name}


def test_a_set_is_read_and_checked(small_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ss.load(small_set).name == "plow-dry"
    assert cli.main(["check", str(small_set), "--json"]) == 0
    assert [r.about for r in ss.check(small_set)] == [
        r["about"] for r in json.loads(capsys.readouterr().out)["remarks"]
    ]


@pytest.mark.slow
def test_the_quick_start_runs(repository: Path, tmp_path: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (repository / "docs" / "api.md").read_text(), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("12 photographs; remarks: ")
    assert re.search(r"^[\d.]+ ± [\d.]+ deg; true: 34\.0$", done.stdout, flags=re.MULTILINE)
    assert "predicted picture (120, 160, 3)" in done.stdout
    assert (tmp_path / "sand-run" / "report.html").is_file()
