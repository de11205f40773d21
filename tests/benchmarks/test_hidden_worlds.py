"""Hidden worlds: sealed truths, the soil that they make, and how a verdict is scored."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks import hidden_worlds
from splatsoil.benchmarks._newton import Numerics, World
from splatsoil.benchmarks._truths import ANGLES, FIELD, KINDS, NOTHING, OBSERVATION, draw
from splatsoil.benchmarks.hidden_worlds import main, ploughed_by_us, score, soil_of, table

from splatsoil.errors import ParameterError, RunError
from splatsoil.mpm.simulate import base_settings
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.synthetic import plow


@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_is_drawn_by_seed_and_is_an_effect_of_the_library(kind: str) -> None:
    hidden, again, other = draw(kind, 0, 1), draw(kind, 0, 1), draw(kind, 1, 1)
    assert hidden == again and hidden.angle != other.angle
    assert ANGLES[0] <= hidden.angle <= ANGLES[1]
    assert kind in library() or kind in (NOTHING, FIELD)
    assert (hidden.observation() != draw(NOTHING, 0, 1).observation()) == (kind in OBSERVATION)


def test_a_layer_lies_below_its_depth_and_a_stone_holds_no_sand() -> None:
    setup = plow(3)
    layered = soil_of(replace(draw("layering", 0, 1), soil={"layer": (-8.0, 0.05)}), setup, 0.01)
    weak = np.asarray(layered.angle) < draw("layering", 0, 1).angle - 7.9
    top = float(setup.surface.height.max())
    assert weak[layered.particles[:, 2] < 0.02].all(), "the soil is 8 cm deep and more"
    assert not weak[layered.particles[:, 2] > top - 0.05].any()
    stone = draw("buried_obstacle", 0, 1)
    x, y, z, radius = stone.soil["obstacle"]
    assert np.linalg.norm(soil_of(stone, setup, 0.01).particles - [x, y, z], axis=1).min() > radius


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in (NOTHING, FIELD)])
def test_both_solvers_are_told_the_same(kind: str) -> None:
    """Our library's settings against what the other solver is given."""
    hidden, setup = draw(kind, 0, 1), plow(3)
    experiment = setup.experiment()
    law = Law(effect.for_measurement(experiment) for effect in find_effects([kind]))
    values = law.require_on(hidden.values)
    settings = law.settings(base_settings(experiment), values)
    told = soil_of(hidden, setup, 0.01)
    expected = experiment.gravity if hidden.gravity is None else hidden.gravity
    assert settings.gravity == pytest.approx(tuple(expected), abs=1e-9)
    friction = setup.tool.friction if told.tool_friction is None else told.tool_friction
    assert settings.tool_friction == pytest.approx(friction)
    for name in ("cohesion", "viscosity", "tool_adhesion"):
        assert values.get(name, 0.0) == pytest.approx(getattr(told, name))
    assert values.get("dilatancy_angle", 0.0) == pytest.approx(told.dilatancy * hidden.angle)
    if kind == "layering":
        weaker = np.asarray(told.angle) < hidden.angle
        deep = setup.surface.sample(told.particles[:, :2]) - told.particles[:, 2] > values["layer_depth"]
        assert np.array_equal(weaker, deep)
        assert np.asarray(told.angle).min() - hidden.angle == pytest.approx(values["layer_friction"])
    if kind == "buried_obstacle":
        middle = setup.bed.lower + 0.5 * setup.bed.extents
        place = [values["obstacle_x"] + middle[0], values["obstacle_y"] + middle[1], values["obstacle_height"]]
        assert told.obstacle == pytest.approx((*place, values["obstacle_radius"]))


def test_our_solver_ploughs_a_truth_of_its_own() -> None:
    setup = plow(3)
    dry, damp = (
        ploughed_by_us(replace(draw(kind, 0, 1), angle=33.0, seed=2000), setup, [0, 2], "tiny", "cpu")
        for kind in (NOTHING, "cohesion")
    )
    assert dry.frames == damp.frames == (0, 2)
    assert np.array_equal(dry.positions[0], damp.positions[0])
    assert not np.array_equal(dry.positions[1], damp.positions[1])


def test_what_our_library_lacks_our_solver_cannot_plough(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="friction_field"):
        main(["--solver", "small", "--kinds", FIELD, "--out", str(tmp_path / "worlds")])
    assert not (tmp_path / "worlds").exists()


@pytest.mark.parametrize("wrong", [["--voxel", "0"], ["--voxel", "-0.02"], ["--iterations", "0"]])
def test_numerics_that_are_none_are_refused(tmp_path: Path, wrong: list[str]) -> None:
    with pytest.raises(ParameterError, match="--voxel"):
        main(["--kinds", NOTHING, "--out", str(tmp_path / "worlds"), *wrong])
    assert not (tmp_path / "worlds").exists()


def test_the_other_solver_gets_the_numerics_that_are_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[tuple[Any, ...]] = []

    class Ploughed(Exception):
        """Far enough."""

    def plough(_: object, worlds: Sequence[World], numerics: Numerics, *__: object, **___: object) -> None:
        asked.append((numerics.voxel, numerics.iterations, {world.spacing for world in worlds}))
        raise Ploughed

    monkeypatch.setattr(hidden_worlds, "plough", plough)
    for name, words in (("usual", []), ("coarse", ["--voxel", "0.04", "--iterations", "60"])):
        with pytest.raises(Ploughed):
            main(["--kinds", "cohesion", "--out", str(tmp_path / name), *words])
    assert asked == [(0.02, 120, {0.01}), (0.04, 60, {0.02})]


def judged(kind: str, verdict: str, members: list[str]) -> dict[str, object]:
    """A world of 32°; a tilt of 4°, if that is hidden."""
    refit: dict[str, object] = {"values": {"friction_angle": 34.0, "tilt_x": 1.0}}
    refit |= {"stds": {"friction_angle": 0.5, "tilt_x": 2.0}, "held_out": 2.0, "floor": 2.5}
    refits = {"as it is": refit | {"held_out": 6.0, "floor": 2.0}, **dict.fromkeys(members, refit)} if members else {}
    told = {"refits": refits, "verdict": verdict, "class": members, "explained": 0.5}
    told |= {"effects": [{"name": "tilt", "parameter": "tilt_x", "z": 3.0}], "seconds": 1.0}
    told |= {"whole": {"ratio": 2.5}, "whole_after": {"ratio": 1.1 if "tilt" in members[:1] else 1.3}}
    told["estimates"] = {"friction_angle": {"value": 31.0, "std": 1.2}}
    fit = {"parameters": {"friction_angle": {"estimate": 35.0, "std": 0.5}}, "seconds": 1.0}
    return score(replace(draw(kind, 0, 1), angle=32.0, size=4.0), fit, told)


def test_right_is_what_names_the_truth_or_nothing_where_nothing_is() -> None:
    assert judged(NOTHING, "adequate", [])["right"]
    assert not judged(NOTHING, "missing", ["tilt"])["right"]
    assert judged("tilt", "missing", ["gravity", "tilt"])["right"]
    nearest = judged("tilt", "outside the library", ["tilt"])
    assert nearest["nearest"] and not nearest["right"]
    assert judged(FIELD, "outside the library", ["tilt"])["right"]
    rows = [judged("tilt", "missing", ["gravity"]), judged(NOTHING, "adequate", [])]
    assert "another effect named: 1 of 1" in table(rows)


def test_what_is_stated_is_held_against_the_truth() -> None:
    """The angle that a diagnosis weighs where nothing is named, what a refit says where it is of the right effect."""
    assert judged(NOTHING, "adequate", [])["off"] == pytest.approx([-1.0 / 1.2])
    assert judged("tilt", "missing", ["tilt"])["off"] == pytest.approx([4.0, -1.5])
    assert judged("tilt", "missing", ["gravity"])["off"] == pytest.approx([4.0])
    rows = [
        judged("tilt", "missing", ["gravity"]),
        judged(NOTHING, "adequate", []),
        judged("tilt", "missing", ["tilt"]),
    ]
    refitted_in_vain = judged(NOTHING, "adequate", []) | {"before": [30.0, 0.5]}
    assert "32.0°; 35.0, 31.0 ± 1.2°" in table([refitted_in_vain])
    assert "32.0°; 35.0, 34.0 → 34.0 ± 0.5°" in table(rows)
    assert "| 3.00 → 0.80 |" in table(rows), "each model is held against its own floor"
    assert "the whole ends within 1.2 × noise: 1 of 1" in table(rows)
    not_all = judged("tilt", "outside the library", ["tilt"]) | {"whole": [2.5, 1.3]}
    assert "the whole ends within 1.2 × noise: 1 of 2" in table([*rows, not_all])
    assert "within 1 × their ±: 1 of 3" in table(rows) and "within 2 × their ±: 2 of 3" in table(rows)


def test_a_missing_renderer_is_said_before_anything_is_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(RunError, match="independent"):
        main(["--renderer", "mitsuba", "--kinds", NOTHING, "--out", str(tmp_path / "worlds")])
    assert not (tmp_path / "worlds").exists()


def test_a_folder_keeps_one_renderer_and_one_solver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Worlds that the path tracer photographed aren't told as Mitsuba's."""
    monkeypatch.setattr(hidden_worlds, "make_worlds", lambda *_: None)
    monkeypatch.setattr(hidden_worlds, "load_mitsuba", lambda: None)
    own = ["--kinds", NOTHING, "--worlds-only", "--out", str(tmp_path)]
    assert main(own) == 0 and main(own) == 0
    for other in (["--renderer", "mitsuba"], ["--solver", "small"], ["--voxel", "0.015"], ["--iterations", "240"]):
        with pytest.raises(ParameterError, match="another --out"):
            main([*own, *other])
