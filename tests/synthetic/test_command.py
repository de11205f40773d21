"""``splatsoil simulate``."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatsoil import cli
from splatsoil.commands.simulate import parse_values
from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement

SMALL = ("--preset", "tiny", "--picture-scale", "0.15", "--views", "2")


def test_like_another_set_with_an_effect(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new"
    words = ["simulate", str(out), "--like", str(small_set), *SMALL, "--friction-angle", "38", "--seed", "2", "--json"]
    acting = ["--with", "cohesion", "tool_friction", "--set", "cohesion=400", "tool_friction_change=0.2"]
    assert cli.main([*words, *acting]) == 0
    said = json.loads(capsys.readouterr().out)
    wanted = {"friction_angle": 38.0, "cohesion": 400.0, "tool_friction_change": 0.2}
    assert said["ok"] is True and said["parameters"] == wanted
    assert said["effects"] == ["cohesion", "tool_friction"] and said["seed"] == 2
    made, source = Measurement.load(out), Measurement.load(small_set)
    assert made.hash == said["hash"] != source.hash
    np.testing.assert_allclose(made.tool.motion.positions, source.tool.motion.positions)
    np.testing.assert_allclose(made.tool.mesh.volume, source.tool.mesh.volume, rtol=1e-5)
    assert made.frames == source.frames and len(made.views) == 2
    assert {f.frame for f in made.pre_roll} == {f.frame for f in source.pre_roll}
    for name, camera in made.cameras.items():
        np.testing.assert_allclose(camera.camera_to_world, source.cameras[name].camera_to_world, atol=1e-9)
        assert (camera.width, camera.height) == (48, 36)
    truth = json.loads((out / "truth.json").read_text())
    assert truth["settings"]["tool_friction"] == pytest.approx(0.5)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "small-set"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--with", "witchcraft"], "witchcraft"),
        (["--with", "cohesion"], "--set cohesion="),
        (["--set", "cohesion=100"], "unknown parameter cohesion"),
        (["--set", "cohesion"], "NAME=VALUE"),
        (["--set", "cohesion=much"], "NAME=VALUE"),
        (["--set", "friction_angle=30"], "--friction-angle"),
        (["--friction-angle", "80"], "friction_angle"),
        (["--views", "0"], "--views 0"),
        (["--seed", "-3"], "-3"),
        (["--picture-scale", "0"], "larger factor"),
        (["--picture-scale", "nan"], "larger factor"),
        (["--picture-scale", "1e9"], "smaller factor"),
        (["--depth", "0.3"], "--depth"),
        (["--depth", "-1"], "--depth"),
        (["--device", "abacus"], "abacus"),
        (["--scene", "paper", "--depth", "0.2"], "--depth"),
        (["--like", "nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["simulate", "new", *words]) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("splatsoil: ")]
    assert len(lines) == 1 and said in lines[0] and "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert cli.main(["simulate", str(tmp_path)]) == 2
    assert "nothing is overwritten" in capsys.readouterr().err
    assert cli.main(["simulate", str(tmp_path / "mine.txt")]) == 2
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(("place", "says"), [("/proc/set", "cannot be written"), ("mine.txt/set", "is a file")])
def test_where_no_folder_can_be_made_nothing_is_begun(
    place: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert cli.main(["simulate", str(tmp_path / place)]) == 2
    assert says in capsys.readouterr().err


def test_values_are_numbers_by_name() -> None:
    assert parse_values(["a=1", "b=-2.5e3"]) == {"a": 1.0, "b": -2500.0}
    with pytest.raises(ParameterError, match="twice"):
        parse_values(["a=1", "a=2"])


def test_the_page_names_every_option(repository: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (repository / "docs" / "simulate.md").read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        cli.main(["simulate", "--help"])
    known = set(re.findall(r"--[a-z][a-z-]+", capsys.readouterr().out)) - {"--help"}
    told = set(re.findall(r"`(--[a-z][a-z-]+)", page))
    assert told == known


def test_the_python_example_runs(repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "simulate.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "{'friction_angle': 33.0} 12 6000"
