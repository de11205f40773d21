"""docs/criticism.md against the code."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import tyro

from splatsoil import cli


def test_the_commands_of_the_page_parse(repository: Path) -> None:
    text = (repository / "docs" / "criticism.md").read_text()
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [shlex.split(line, comments=True) for line in block.splitlines()]
    assert len(lines) == 5
    known = cli.commands()
    for program, name, *words in lines:
        assert program == "splatsoil"
        tyro.cli(known[name].config, args=words)


def test_the_example_of_the_page_runs(repository: Path, tmp_path: Path) -> None:
    text = (repository / "docs" / "criticism.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "missing ('dilatancy',)"
