"""Fits whose estimate means nothing: said first, by an exit code of its own, and never as an answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.errors import NoAnswer
from splatsoil.report.text import no_answer

COMMANDS = ["fit", "run", "compare", "diagnose", "add", "report"]
Words = Callable[..., list[str]]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        # as plow-dry gave it with views turned by half a turn, or with a black video; or at the end of its range
        ({"loss": 1.29, "best": {"loss": 1.28}}, "no better than soil that never moves (loss 1.29; such soil has 1)"),
        ({"loss": 10.0, "best": {"loss": 10.0}}, "(loss 10; such soil has 1)"),
        ({}, "no answer: the friction angle ends at the upper bound of its range (50°)"),
    ],
)
@pytest.mark.parametrize("command", [*COMMANDS, "posterior"])
def test_no_command_tells_an_estimate_that_means_nothing(
    run: RunFolder,
    results: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
    words: Words,
    change: dict[str, Any],
    says: str,
    command: str,
) -> None:
    fit = results["run_fit"]
    fit |= change
    if not change:
        fit["parameters"]["friction_angle"] |= {"at_bound": "upper", "bounds": [20.0, 50.0]}
    run.write_fit("base", fit)
    for in_json in (False, True):
        assert cli.main(words(command, run, *["--json"] * in_json)) == NoAnswer.code == 3
        out, err = capsys.readouterr()
        printed = json.loads(out) if in_json else {"ok": False, "error": out.splitlines()[0]}
        assert printed["ok"] is False and printed["error"].startswith("no answer: ") and says in printed["error"]
        assert "Traceback" not in err
        assert not {"35", "35.1", "35.0"} & set(out.replace("°", " ").replace(",", " ").split()), out
        assert not in_json or (printed["run"], printed["set"]) == (str(run.path), str(run.path.parent / "my set"))


def test_what_is_an_answer(fit_of: Callable[..., dict[str, Any]]) -> None:
    fit = fit_of(["cohesion"], cohesion=0.0)
    assert no_answer(fit) == ""
    assert no_answer(fit | {"loss": 0.99}) == "" and no_answer(fit | {"loss": 1.0}) != ""
    # of an effect off is where it isn't there, and its other bound is one
    fit["parameters"]["cohesion"] |= {"bounds": [0.0, 1500.0], "off": 0.0, "at_bound": "lower", "unit": "Pa"}
    assert no_answer(fit) == ""
    fit["parameters"]["cohesion"]["at_bound"] = "upper"
    assert "the cohesion ends at the upper bound of its range (1500 Pa)" in no_answer(fit)
    # where forces lead away from what the pictures say
    assert "where all instruments together put it" in no_answer(fit | {"loss": 1.2, "best": {"loss": 0.9}})


@pytest.mark.parametrize("command", COMMANDS)
def test_json_names_run_and_set(
    run: RunFolder, results: dict[str, Any], capsys: pytest.CaptureFixture[str], words: Words, command: str
) -> None:
    """Their folders; ``fit.json`` has something else under "run"."""
    results["run_fit"]["run"] = {"measurement": {"name": "plow"}}
    run.write_fit("base", results["run_fit"])
    assert cli.main(words(command, run, "--json")) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["run"], printed["set"]) == (str(run.path), run.description["measurement"]["folder"])


@pytest.mark.parametrize(
    ("verdict", "named", "follows"),
    [("adequate", [], "report"), ("one of", ["cohesion", "tilt"], "add"), ("undecided", [], "design")],
)
def test_a_diagnosis_and_an_addition_name_the_next_command(
    run: RunFolder,
    results: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
    words: Words,
    verdict: str,
    named: list[str],
    follows: str,
) -> None:
    run.write_fit("base", results["run_fit"])
    results["run_diagnosis"] |= {"verdict": verdict, "class": named}
    assert cli.main(words("diagnose", run)) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.endswith(" ".join([f"splatsoil {follows} '{run.path}'", *named[:1]]))
    assert cli.main(words("add", run)) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(f"splatsoil diagnose '{run.path}'")
