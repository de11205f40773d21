"""docs/environment.md against the code."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.synthetic import SyntheticProblem


def test_the_example_runs(repository: Path) -> None:
    text = (repository / "docs" / "environment.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.count("friction_angle") == 5 and "the truth was" in done.stdout


def test_the_page_names_every_option_and_key(repository: Path) -> None:
    text = (repository / "docs" / "environment.md").read_text()
    options = set(inspect.signature(PlowSandEnv).parameters) - {"problem"}
    assert options == set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    env = PlowSandEnv(problem=SyntheticProblem())
    for key in env.observation_space.spaces:  # type: ignore[attr-defined]
        assert f"`{key}`" in text
