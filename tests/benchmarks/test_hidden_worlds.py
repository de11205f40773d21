"""``splatsoil benchmark hidden-worlds``: sealed truths, the soil that they make, and how a verdict is scored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks import hidden_worlds
from splatsoil.benchmarks._hidden import FIELD, KINDS, NOTHING, OUTSIDE, draw
from splatsoil.benchmarks._scenes import ANGLES, Scene
from splatsoil.benchmarks.hidden_worlds import ELSE, main, score, table

from splatsoil.errors import ParameterError
from splatsoil.mpm.simulate import base_settings
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.settings import FRICTION_ANGLE


@pytest.mark.parametrize("kind", KINDS)
def test_a_truth_is_drawn_by_seed_and_is_an_effect_of_the_library(kind: str) -> None:
    hidden, again, other = draw(kind, 0, 1), draw(kind, 0, 1), draw(kind, 1, 1)
    assert hidden == again and hidden.angle != other.angle
    assert ANGLES[0] <= hidden.angle <= ANGLES[1]
    assert kind in library() or kind in (NOTHING, *OUTSIDE)
    assert (hidden.observation() != draw(NOTHING, 0, 1).observation()) == (kind in ("exposure", "time_offset"))
    if kind in library():
        law = Law(find_effects([kind]))
        for number in range(5):
            law.require_on(draw(kind, number, 1, (15.0, 16.0)).values)  # refuses what the model does not take


@pytest.mark.parametrize("kind", ["layering", FIELD])
def test_no_part_of_the_soil_is_outside_of_what_the_model_takes(kind: str) -> None:
    low, high = FRICTION_ANGLE.limits or (FRICTION_ANGLE.lower, FRICTION_ANGLE.upper)
    for number in range(30):
        hidden = draw(kind, number, 1)
        angles = np.asarray(hidden.soil(hidden.scene.setup(), 0.04).angle)
        assert low <= angles.min() < angles.max() <= high


def test_no_photograph_shows_a_stone_and_no_tool_meets_one() -> None:
    """In beds that slope away from it, too; some lie beside the tool's way, others under it."""
    under = []
    for number in range(16):
        hidden = draw("buried_obstacle", number, 3)
        x, y, z, radius = hidden.soil(hidden.scene.setup(), 0.04).obstacle
        over = [x, y] + radius * np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 2), axis=-1).reshape(-1, 2)
        setup = hidden.scene.setup()
        assert setup.surface.sample(over).min() - (z + radius) > 0.014
        lowest = min(setup.tool.bounds(time)[0][2] for time in np.arange(0.0, 4.0, 0.1))
        beside = abs(y - 0.25) - radius >= 0.5 * hidden.scene.width + 0.01 - 1e-9
        under.append(not beside)
        assert beside or z + radius < lowest
    assert 0 < sum(under) < len(under)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in (NOTHING, *OUTSIDE)])
def test_both_solvers_are_told_the_same(kind: str) -> None:
    """Our library's settings against what the other solver is given."""
    hidden = draw(kind, 0, 1)
    setup = hidden.scene.setup()
    experiment = setup.experiment()
    law = Law(effect.for_measurement(experiment) for effect in find_effects([kind]))
    values = law.require_on(hidden.values)
    settings = law.settings(base_settings(experiment), values)
    told = hidden.soil(setup, 0.01)
    weight = told.weight / (experiment.bed.density * told.spacing**3)
    assert settings.gravity == pytest.approx(tuple(weight), abs=1e-5)
    friction = setup.tool.friction if told.tool_friction is None else told.tool_friction
    assert settings.tool_friction == pytest.approx(friction)
    for name in ("cohesion", "viscosity", "tool_adhesion"):
        assert values.get(name, 0.0) == pytest.approx(getattr(told, name))
    assert values.get("dilatancy_angle", 0.0) == pytest.approx(told.dilatancy * hidden.angle)
    if kind == "layering":
        other = np.asarray(told.angle) != hidden.angle
        deep = setup.surface.sample(told.particles[:, :2]) - told.particles[:, 2] > values["layer_depth"]
        assert np.array_equal(other, deep)
        assert np.asarray(told.angle)[deep] - hidden.angle == pytest.approx(values["layer_friction"])
    if kind == "buried_obstacle":
        middle = setup.bed.lower + 0.5 * setup.bed.extents
        place = [values["obstacle_x"] + middle[0], values["obstacle_y"] + middle[1], values["obstacle_height"]]
        assert told.obstacle == pytest.approx((*place, values["obstacle_radius"]))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        *((["--times", *pair], "--times") for pair in (("0", "2"), ("3", "2"), ("1", "inf"), ("nan", "2"))),
        (["--solver", "tiny", "--kinds", FIELD], "friction_field: outside of our library"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, words: list[str], says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        main(["--kinds", NOTHING, "--out", str(tmp_path / "out"), *words])
    assert not (tmp_path / "out").exists()


def test_an_experiment_that_newton_fails_on_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of its group are simulated alone."""
    asked, done = [], []

    def by_newton(_: Any, group: Any) -> None:
        asked.append([hidden.name for hidden in group])
        if "tilt-0" in asked[-1]:
            raise ValueError("array shapes")

    monkeypatch.setattr(hidden_worlds.Study, "by_newton", by_newton)
    monkeypatch.setattr(hidden_worlds.Study, "judge", lambda _, hidden: done.append(hidden.name))
    kinds = ("gravity", "tilt", "cohesion", "viscosity")
    assert main(["--kinds", *kinds, "--simulated-side-by-side", "3", "--out", str(tmp_path / "out")]) == 1
    assert asked == [["gravity-0", "tilt-0", "cohesion-0"], ["viscosity-0"], ["gravity-0"], ["tilt-0"], ["cohesion-0"]]
    assert sorted(done) == ["cohesion-0", "gravity-0", "viscosity-0"]


def judged(kind: str, verdict: str, members: list[str], sure: float = 0.95) -> dict[str, Any]:
    """An experiment at 32°, a tilt of 4° if that is hidden, of which one model has a probability; read as 31 ± 1.25°
    and 5 ± 0.5°."""
    best = {"adequate": "", ELSE: ELSE}.get(verdict, (*members, "")[0])
    others = [name for name in ("", "tilt", "gravity", ELSE) if name != best]
    chances = {best: sure, **dict.fromkeys(others, (1.0 - sure) / 3)}
    size = {"parameter": "tilt_x", "off": 0.0, "meaningful": 1.0, "estimate": 5.0, "std": 0.5, "detectable": 2.0}
    told = {
        "verdict": verdict,
        "class": members,
        "models": [{"name": name, "probability": chance, **size} for name, chance in chances.items()],
        "estimates": {"friction_angle": {"value": 31.0, "std": 1.25}},
        "seconds": 60.0,
    }
    hidden = replace(draw(kind, 0, 1), scene=Scene(seed=3, angle=32.0))
    return score(replace(hidden, values={"tilt_x": 4.0} if kind == "tilt" else {}), {"seconds": 30.0}, told)


@pytest.mark.parametrize(
    ("kind", "verdict", "members", "right"),
    [
        (NOTHING, "adequate", [], True),
        (NOTHING, "missing", ["tilt"], False),
        ("tilt", "one of", ["gravity", "tilt"], True),
        ("tilt", "undecided", ["tilt"], False),  # what may be missing is not named
        ("tilt", "adequate", [], False),
        *((kind, ELSE, ["tilt"], True) for kind in OUTSIDE),
        *((kind, "missing", ["tilt"], False) for kind in OUTSIDE),
    ],
)
def test_right_is_what_claims_the_truth(kind: str, verdict: str, members: list[str], right: bool) -> None:
    assert judged(kind, verdict, members)["right"] is right


def test_names_are_counted_against_what_is_hidden() -> None:
    rows = [
        judged(NOTHING, "adequate", []),
        judged(NOTHING, "one of", ["tilt", "gravity"]),
        judged("tilt", "missing", ["tilt"]),
        judged("tilt", "one of", ["gravity", "tilt"]),
        judged("tilt", "missing", ["gravity"]),
        judged("tilt", "undecided", []),
        *(judged(kind, verdict, ["gravity"]) for kind, verdict in zip(OUTSIDE, ("undecided", "missing"), strict=True)),
    ]
    told = table(rows)
    assert "nothing hidden: some effect named: 1 of 2 (9–91 %)" in told
    assert "an effect hidden: it alone named: 1 of 4" in told
    assert "at least as large as stated detectable: 1 of 4" in told
    assert "an effect hidden: named, or in the set: 2 of 4" in told
    assert "outside the library: something else, or undecided: 1 of 2" in told
    assert "named wrongly, of all with something hidden: 2 of 6" in told
    first = [line.split(" | ")[0] for line in told.splitlines() if line.startswith("| ")][1:]
    assert len(first) == len(rows) and first[-3:] == [f"| {NOTHING}", "| tilt", "| tilt"], "what is missed is first"


def test_estimates_are_held_against_the_truth() -> None:
    found, other = judged("tilt", "missing", ["tilt"]), judged("tilt", "missing", ["gravity"])
    assert found["z"] == pytest.approx(-0.8) and found["size_error"] == pytest.approx(0.25)
    assert "size_found" not in other, "only the most probable model's size is told"
    told = table([found, other])
    assert "| 4 (4.0) | missing | tilt | 0.95, 0.02 | 32.0°; 31.0 ± 1.2° (-0.8) | 5 ± 0.5 | 30, 60 s |" in told
    assert "an effect hidden: error of the angle, degrees, root mean square of 2: 1.00" in told
    assert "an effect hidden: error of the angle over its ±, root mean square of 2: 0.80" in told
    assert "relative error of the size, root mean square of 1: 0.25" in told


def test_probabilities_are_held_against_how_often_they_are_right() -> None:
    right, wrong = judged("tilt", "missing", ["tilt"], 0.97), judged("tilt", "missing", ["gravity"], 0.91)
    told = table([right, wrong, judged(NOTHING, "adequate", [], 0.94)])
    assert "effects named, of probability 0.94 on average: right: 1 of 2" in told
    assert "the most probable model, of probability 0.94 on average: right: 2 of 3" in told
    assert f"log score of the true model, mean: {np.log([0.97, 0.03, 0.94]).mean():.2f}" in told
    not_compared = judged("cohesion", "missing", ["tilt"])
    assert "mean: -13.82" in table([not_compared]), "as improbable as it counts at most"
