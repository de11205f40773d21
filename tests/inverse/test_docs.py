"""docs/fit.md against the code."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from types import ModuleType

import tyro
from splatsoil.inverse.fitting import fit

from splatsoil import cli


def test_the_commands_of_the_page_parse(repository: Path) -> None:
    text = (repository / "docs" / "fit.md").read_text()
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [shlex.split(line, comments=True) for line in block.splitlines()]
    assert len(lines) == 5
    known = cli.commands()
    for program, name, *words in lines:
        assert program == "splatsoil"
        tyro.cli(known[name].config, args=words)


def test_the_page_names_what_fit_json_has(repository: Path, analytic: ModuleType, tmp_path: Path) -> None:
    text = (repository / "docs" / "fit.md").read_text()
    described = text[text.index("`fit.json` has") :]
    result = fit(analytic.AnalyticProblem(), analytic.prepare(tmp_path), analytic.SETUP, budget=4)
    named = set(re.findall(r"`(\w+)`", described))
    assert named <= result.keys()
    (inner,) = re.findall(r"parameters\.NAME\.\{(.*?)\}", described, re.DOTALL)
    assert set(re.findall(r"\w+", inner)) <= result["parameters"]["friction_angle"].keys()
