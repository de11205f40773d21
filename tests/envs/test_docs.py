"""docs/environment.md against the code."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.synthetic import SyntheticProblem


def run(page: Path, number: int) -> str:
    """What an example of a page prints."""
    example = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)[number]
    words = [sys.executable, "-c", example]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=True).stdout


def test_the_example_runs(repository: Path) -> None:
    said = run(repository / "docs" / "environment.md", 0)
    assert said.count("friction_angle") == 5 and "the truth was" in said


def test_the_readmes_example_runs_and_comes_nearest_where_the_truth_is(repository: Path) -> None:
    said = run(repository / "README.md", 0)
    found = re.findall(r"'friction_angle': ([\d.]+)\} loss ([\d.]+)", said)
    (truth,) = re.findall(r"the truth was \{'friction_angle': ([\d.]+)", said)
    angles, losses = zip(*((float(a), float(b)) for a, b in found), strict=True)
    assert angles == pytest.approx((23.0, 35.0, 47.0))
    assert losses.index(min(losses)) == min(range(3), key=lambda k: abs(angles[k] - float(truth)))


def test_the_recording_example_runs(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("jax")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert "friction_angle" in run(repository / "docs" / "environment.md", 1)
    assert (tmp_path / "plow-sand" / "random-v0" / "data" / "main_data.hdf5").is_file()


def test_the_page_names_every_option_and_key(repository: Path) -> None:
    text = (repository / "docs" / "environment.md").read_text()
    options = set(inspect.signature(PlowSandEnv).parameters) - {"problem"}
    assert options == set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    env = PlowSandEnv(problem=SyntheticProblem())
    for key in env.observation_space.spaces:  # type: ignore[attr-defined]
        assert f"`{key}`" in text
