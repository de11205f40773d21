"""What Ctrl-C says can be pasted: it parses to the very options that were given."""

from __future__ import annotations

import dataclasses
import importlib
import shlex

import pytest
import tyro

GIVEN = {
    "reconstruct": "'my set' --out a/b --preset tiny --seed 3 --device cpu --holdout 0",
    "simulate": "out --friction-angle 31.5 --with cohesion tilt --set cohesion=300 tilt_x=-2 --scene plow --depth 0.09 "
    "--preset tiny --seed 4 --particle-seed 5 --views 12 --picture-scale 0.5 --device cuda:0 --like 'a set'",
    "posterior": "runs/a --design 7 --repeats 2 --checks 0 --executor processes:2 --device cpu --seed 1",
    "fit": "nowhere --parameters friction_angle --with cohesion --budget 9 --coarse tiny --preset fine --device cpu "
    "--seed 2 --run 'a run'",
    "run": "nowhere --parameters friction_angle --with cohesion --budget 9 --coarse tiny --preset fine --device cpu "
    "--seed 2 --run 'a run' --criticise --most-effects 3",
}


@pytest.mark.parametrize("command", GIVEN)
@pytest.mark.parametrize("how", ["everything", "nothing"])
def test_the_hint_is_the_command_that_was_given(command: str, how: str) -> None:
    module = importlib.import_module(f"splatsoil.commands.{command}")
    words = shlex.split(GIVEN[command])
    config = tyro.cli(module.Config, args=words if how == "everything" else words[:1])
    assert how == "nothing" or {f.name for f in dataclasses.fields(config) if _usual(config, f)} <= {
        "json",
        "search",
        "scene",
        "stop_at_floor",
    }
    hint = module.interrupted(config)
    again = shlex.split(hint[hint.index("splatsoil ") :])
    assert again[:2] == ["splatsoil", command]
    assert tyro.cli(module.Config, args=again[2:]) == config


def _usual(config: object, field: dataclasses.Field) -> bool:
    return getattr(config, field.name) == field.default
