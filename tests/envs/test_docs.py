"""docs/environment.md against the code."""

from __future__ import annotations

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.synthetic import SyntheticProblem


def test_the_example_runs(repository: Path) -> None:
    text = (repository / "docs" / "environment.md").read_text()
    example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    done = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.count("friction_angle") == 5 and "the truth was" in done.stdout


def test_the_readmes_example_runs_and_comes_nearest_where_the_truth_is(repository: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(), re.DOTALL)
    done = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True, timeout=300, check=True)
    found = re.findall(r"'friction_angle': ([\d.]+)\} loss ([\d.]+)", done.stdout)
    (truth,) = re.findall(r"the truth was \{'friction_angle': ([\d.]+)", done.stdout)
    angles, losses = zip(*((float(a), float(b)) for a, b in found), strict=True)
    assert angles == pytest.approx((23.0, 35.0, 47.0))
    assert losses.index(min(losses)) == min(range(3), key=lambda k: abs(angles[k] - float(truth)))


def test_the_recording_example_runs(repository: Path, tmp_path: Path) -> None:
    pytest.importorskip("minari")
    text = (repository / "docs" / "environment.md").read_text()
    example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[1]
    environment = os.environ | {"MINARI_DATASETS_PATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", example], capture_output=True, text=True, timeout=300, check=True, env=environment
    )
    assert "friction_angle" in done.stdout
    assert (tmp_path / "plow-sand" / "random-v0" / "data" / "main_data.hdf5").is_file()


def test_the_page_names_every_option_and_key(repository: Path) -> None:
    text = (repository / "docs" / "environment.md").read_text()
    options = set(inspect.signature(PlowSandEnv).parameters) - {"problem"}
    assert options == set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    env = PlowSandEnv(problem=SyntheticProblem())
    for key in env.observation_space.spaces:  # type: ignore[attr-defined]
        assert f"`{key}`" in text
