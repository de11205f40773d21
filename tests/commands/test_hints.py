"""What Ctrl-C says can be pasted: it parses to the very options that were given."""

from __future__ import annotations

import dataclasses
import importlib
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import tyro

from splatsoil.commands import _criticism, _stages, compare, fit, run

GIVEN = {
    "reconstruct": "'my set' --out a/b --preset tiny --seed 3 --device cpu --holdout 0 --json",
    "simulate": "out --friction-angle 31.5 --with cohesion tilt --set cohesion=300 tilt_x=-2 --scene plow --depth 0.09 "
    "--preset tiny --seed 4 --particle-seed 5 --views 12 --picture-scale 0.5 --device cuda:0 --like 'a set' --json",
    "posterior": "runs/a --set 'a set' --checks 0 --device cpu --seed 1 --json",
    "fit": "nowhere --parameters friction_angle --with cohesion --budget 9 --preset fine --device cpu "
    "--seed 2 --run 'a run' --json",
    "run": "nowhere --parameters friction_angle --with cohesion --budget 9 --preset fine --device cpu "
    "--seed 2 --run 'a run' --criticise --most-effects 3 --json",
    "compare": "'a run' --set 'a set' --quick --device cpu --json",
    "diagnose": "'a run' --set 'a set' --effects cohesion 'my effects/crust.py' --device cpu --json",
    "add": "'a run' --set 'a set' --budget 9 --device cpu --json",
    "report": "'a run' --set 'a set' --json",
    "export": "'a run' --to csv ply --out 'a folder' --model diagnosis --every 5 --device cpu --json",
    "design": "'a run' --set 'a set' --draws 5 --preset small --device cpu --json",
    "element": "--test isotropic --confining 5e4 --friction-angle 30 --with dilatancy 'my effects/crust.py' --set "
    "dilatancy_angle=9 --strain 0.1 --pressure 1e6 --records 20 --void-ratio 0.7 --young 1e7 --poisson 0.3 "
    "--strain-rate 1e-3 --depth 0.1 --matching extension --plot 'a plot.svg' --json",
}
POSITIONAL = {"element": 0}


@pytest.mark.parametrize("command", GIVEN)
@pytest.mark.parametrize("how", ["everything", "nothing"])
def test_the_hint_is_the_command_that_was_given(command: str, how: str) -> None:
    module = importlib.import_module(f"splatsoil.commands.{command}")
    words = shlex.split(GIVEN[command])
    config = parsed(module.Config, words if how == "everything" else words[: POSITIONAL.get(command, 1)])
    assert how == "nothing" or {f.name for f in dataclasses.fields(config) if _usual(config, f)} <= {
        "scene",
        "stop_at_floor",
    }
    hint = module.interrupted(config)
    again = shlex.split(hint[hint.index("splatsoil ") :])
    assert again[:2] == ["splatsoil", command]
    assert parsed(module.Config, again[2:]) == config


def test_effects_that_are_added_are_told_again() -> None:
    module = importlib.import_module("splatsoil.commands.add")
    config = parsed(module.Config, ["a run", "cohesion", "my effects/crust.py"])
    assert module.interrupted(config).endswith(": splatsoil add 'a run' cohesion 'my effects/crust.py'")


def test_the_hints_after_a_fit_and_a_comparison_can_be_pasted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a terminal that is too narrow for them, too."""
    monkeypatch.setenv("COLUMNS", "40")
    folder = "runs/of the year/with a long name"
    told = {
        "checks": [],
        "probability": 0.01,
        "adequate": False,
        "sentences": [],
        "estimates": {"friction_angle": {"value": 34.8, "std": 1.0, "unit": "deg", "determined": True}},
    }
    compare.show_misfit(told, folder)
    assert f"Which effect is missing? splatsoil diagnose '{folder}'\n" in capsys.readouterr().out

    monkeypatch.setattr(_stages, "prepare", lambda config: (None, SimpleNamespace(path=folder)))
    for stage in ("reconstructed", "model_on", "fitted"):
        monkeypatch.setattr(_stages, stage, lambda *_: {"loss": 0.5, "best": {"loss": 0.5}, "parameters": {}})
    monkeypatch.setattr(fit, "show", lambda *_: None)
    assert fit.run(fit.Config(Path("set"))) == 0
    assert f"and where? splatsoil compare '{folder}'\n" in capsys.readouterr().out

    diagnosis = {"verdict": "undecided", "class": ["tilt"]}
    monkeypatch.setattr(_criticism, "diagnosed", lambda *_: diagnosis)
    _, why = run.loop(cast(Any, SimpleNamespace(path=folder)), cast(Any, None), 2, lambda _: lambda what, share: None)
    assert f": splatsoil add '{folder}' tilt tries it" in why


def parsed(config: Any, words: list[str]) -> Any:
    """As the command line parses them."""
    return tyro.cli(config, args=words, config=(tyro.conf.FlagCreatePairsOff,))


def _usual(config: object, field: dataclasses.Field) -> bool:
    return getattr(config, field.name) == field.default
