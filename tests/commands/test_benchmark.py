"""``splatsoil benchmark``: whatever module stands in the package can be listed and run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatsoil import cli


def test_listed_are_the_modules_of_the_folder(repository: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["benchmarks"]
    modules = {p.stem.replace("_", "-") for p in (repository / "benchmarks").glob("[!_]*.py")}
    assert set(listed) == modules and {"bo-vs-mcmc", "information", "paper-table", "solvers"} <= modules
    assert all(listed.values())


@pytest.mark.parametrize("name", ["bo-vs-mcmc", "information", "paper-table", "speed"])
def test_options_behind_the_name_are_the_benchmarks_own(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", name, "--help"]) == 0
    assert f"usage: splatsoil benchmark {name}" in capsys.readouterr().out
    assert cli.main(["benchmark", name, "--no-such-option"]) == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("solvers --sets examples/plow-dry --seeds 0", "--seeds: 0: give 1 or more"),
        ("hidden-worlds --count -2", "--count: -2: give 1 or more"),
        ("hidden-worlds --count few", "--count: invalid number value: 'few'"),
        ("validate --device cuda:99", "there is no device 'cuda:99' here"),
        ("speed --device gpu", "there is no device 'gpu' here"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_the_work(
    words: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["benchmark", *words.split()]) == 2
    assert says in capsys.readouterr().err
