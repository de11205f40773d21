"""Effects that act otherwise than at the defaults of what shapes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated, fitted
from splatsoil.inverse.criticism import diagnosis
from splatsoil.inverse.criticism.diagnosis import Diagnosis, Options, diagnose
from splatsoil.inverse.criticism.evidence import gather, switched_on
from splatsoil.inverse.criticism.looks import look
from splatsoil.inverse.criticism.refits import starts_of
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import ParameterError
from splatsoil.experiment.emulated import EmulatedExperiment, FloatArray
from splatsoil.parameters import Parameter
from splatsoil.soil.library import find_effects

SHAPE = Parameter("shape", "1", 0.02, 20.0, 0.3, meaningful=0.1, log=True)
IDLE = tuple(Parameter(name, "1", 0.0, 1.0, 0.5, meaningful=0.1) for name in ("idle", "idler"))
TURN = math.radians(70.0)
"""By how much ten times the shape turns the effect."""
ANGLE, SIZE = 1.0, 12.0
WORLD = 77
HALO = """
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect

class Halo(Effect):
    name = "halo"
    parameters = (Parameter("halo", "1", 0.0, 1.0, 0.0, off=0.0), Parameter("halo_width", "px", 1.0, 9.0, 3.0))
    def observe(self, observation, values):
        return observation
"""


class Turning(EmulatedExperiment):
    """What the second effect does turns with its shape, from one pattern towards another; idle shapes do nothing."""

    def expected(self, values: Mapping[str, float], numerics: str = "") -> FloatArray:
        """(t, s) features without chance."""
        mine = {"effect 2", SHAPE.name, *(p.name for p in IDLE)}
        rest = super().expected({name: v for name, v in values.items() if name not in mine}, numerics)
        turn = TURN * math.log10(values.get(SHAPE.name, SHAPE.default) / SHAPE.default)
        pattern = math.cos(turn) * self.slopes["effect 2"] + math.sin(turn) * self.slopes[SHAPE.name]
        return rest + values.get("effect 2", 0.0) * pattern


def turning(world: int, shapes: tuple[Parameter, ...] = ()) -> Turning:
    """A world in which some parameters of the second effect's shape can be free."""
    plain = emulated(world)
    candidates = tuple(replace(c, shapes=shapes if c.name == "effect 2" else ()) for c in plain.candidates)
    slopes = {**plain.slopes, SHAPE.name: emulated(world + 1).slopes["effect 2"]}
    return Turning(**{**plain.__dict__, "candidates": candidates, "slopes": slopes})


def hiding(made: Turning, shape: float, world: int = WORLD) -> Turning:
    """The second effect hidden in a shape."""
    truth = {"angle": ANGLE, "effect 2": SIZE, SHAPE.name: shape}
    return replace(made, observed=made.measured(truth, [world, 99]))


@cache
def judged(world: int, hidden: float, shapes: tuple[Parameter, ...]) -> Diagnosis:
    """A diagnosis of soil with the second effect in a hidden shape."""
    experiment = hiding(turning(world, shapes), hidden, world)
    assert experiment.chance
    return diagnose(experiment, {"angle": fitted(experiment)})


WORLDS = pytest.mark.parametrize(("world", "hidden"), [(77, 3.0), (2, 0.04)])


@WORLDS
def test_without_its_shape_the_missing_effect_explains_too_little(world: int, hidden: float) -> None:
    found = judged(world, hidden, ())
    assert found.verdict == "outside the library"
    bare, before = found.confirmations["effect 2"], found.confirmations[""]
    assert SHAPE.name not in bare.values
    assert bare.fall < 0.55 * before.chi2
    assert bare.held_out > 2.0 * bare.floor


@WORLDS
@pytest.mark.parametrize("idle", [(), IDLE], ids=["all-simulations", "derivatives"])
def test_an_effect_is_named_in_the_shape_that_it_has(world: int, hidden: float, idle: tuple[Parameter, ...]) -> None:
    found, bare = judged(world, hidden, (SHAPE, *idle)), judged(world, hidden, ()).confirmations["effect 2"]
    assert found.verdict == "missing"
    assert found.members == ("effect 2",)
    assert found.effects["effect 2"] == "missing"
    best = found.confirmations["effect 2"]
    for values in (best.values, best.fit.values):
        assert values[SHAPE.name] == pytest.approx(hidden, rel=0.35)
        assert values["effect 2"] == pytest.approx(SIZE, rel=0.25)
    assert abs(best.values[SHAPE.name] - hidden) < 2.5 * best.stds[SHAPE.name]
    assert best.stds[SHAPE.name] < 0.35 * hidden
    assert best.held_out < 1.2 * best.floor
    assert best.held_out < 0.6 * bare.held_out
    assert bare.fall < 0.6 * best.fall


@WORLDS
def test_slopes_are_those_of_the_effect_in_the_shape_that_was_found(world: int, hidden: float) -> None:
    fit, made = judged(world, hidden, (SHAPE,)).confirmations["effect 2"].fit, turning(world)
    for k, name in enumerate(("angle", "effect 2", SHAPE.name)):
        step = 1e-4 * fit.values[name]
        ends = [made.expected({**fit.values, name: fit.values[name] + side * step}) for side in (1.0, -1.0)]
        exact = (ends[0] - ends[1]) / (2.0 * step)
        # On times, too, that the refit has not seen.
        for rows in (slice(0, None, 2), slice(1, None, 2)):
            wrong = np.linalg.norm((fit.slopes[..., k] - exact)[rows]) / np.linalg.norm(exact[rows])
            assert wrong < 0.1, (name, rows)


@pytest.mark.parametrize("hidden", [3.0, 0.03, 0.3])
def test_from_the_defaults_an_effect_is_seen_in_the_shape_that_it_has(hidden: float) -> None:
    experiment = hiding(turning(WORLD, (SHAPE,)), hidden)
    simulate = Simulations(experiment)
    looks = look(experiment, gather(experiment, simulate, {"angle": 8.0}), simulate)
    evidence, found = looks.evidence, looks.vantage
    assert found is not None and looks.astray
    assert found.shapes == ({} if hidden == SHAPE.default else {"effect 2": {SHAPE.name: pytest.approx(hidden)}})
    exact = experiment.expected({"angle": 0.0, "effect 2": 1.0, SHAPE.name: hidden}) - experiment.expected(
        {"angle": 0.0}
    )
    (candidate,) = (c for c in experiment.candidates if c.name == "effect 2")
    (start,) = starts_of(experiment, evidence, candidate, found)
    assert start.values == pytest.approx({"angle": 0.0, "effect 2": 0.0, SHAPE.name: hidden})
    (seen,) = found.directions["effect 2"]
    assert np.linalg.norm(seen - exact) < 0.2 * np.linalg.norm(exact)
    # All simulations with the effect are there to be read, those in other shapes, too.
    shapes = {visit.values.get(SHAPE.name, SHAPE.default) for visit in found.visits if visit.effects == ("effect 2",)}
    assert sorted(shapes) == pytest.approx([0.03, 0.3, 3.0])


@pytest.mark.parametrize("hidden", [3.0, 0.03, 0.3])
def test_at_a_fit_near_the_defaults_an_effect_is_seen_in_the_shape_that_it_has(hidden: float) -> None:
    experiment = hiding(turning(WORLD, (SHAPE,)), hidden)
    simulate = Simulations(experiment)
    at_the_fit = gather(experiment, simulate, {"angle": ANGLE})
    switched_on(experiment, simulate, at_the_fit)
    before, looks = simulate.asked, look(experiment, at_the_fit, simulate)
    evidence, found = looks.evidence, looks.vantage
    # The effect, up and down, in two other shapes; the fit itself counts already.
    assert found is not None and simulate.asked - before == len(found.visits) <= 4
    assert found.values == evidence.values
    assert found.shapes == ({} if hidden == SHAPE.default else {"effect 2": {SHAPE.name: pytest.approx(hidden)}})
    starts = {c.name: starts_of(experiment, evidence, c, found) for c in experiment.candidates}
    assert {len(several) for name, several in starts.items() if name != "effect 2"} == {1}
    assert starts["effect 2"][-1].values[SHAPE.name] == pytest.approx(hidden)
    exact = experiment.expected({"angle": ANGLE, "effect 2": 1.0, SHAPE.name: hidden}) - experiment.expected(
        {"angle": ANGLE}
    )
    (seen,) = found.directions["effect 2"]
    assert np.linalg.norm(seen - exact) < 0.2 * np.linalg.norm(exact)


def test_an_effect_that_explains_little_in_its_default_shape_is_tried_in_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three traces that are nearer to it than its own by default promise more by then."""
    monkeypatch.setattr(diagnosis, "MORE", 1)
    made = turning(WORLD, (SHAPE,))
    names = ("effect 1", "effect 3", "effect 4")
    near = {name: 0.3 * made.slopes[name] + 0.7 * made.slopes[SHAPE.name] for name in names}
    made = replace(made, slopes={**made.slopes, **near})
    experiment = hiding(made, 3.0)
    found = diagnose(experiment, {"angle": ANGLE}, options=Options(refits=1))
    assert "effect 2" in found.confirmations
    assert found.members == ("effect 2",)
    bare = replace(experiment, candidates=tuple(replace(c, shapes=()) for c in experiment.candidates))
    assert "effect 2" not in diagnose(bare, {"angle": ANGLE}, options=Options(refits=1)).confirmations


def test_what_cameras_report_has_no_shapes(tmp_path: Path) -> None:
    file = tmp_path / "halo.py"
    file.write_text(HALO)
    assert find_effects([str(file)])[0].observes
    file.write_text(HALO + "    shapes = ('halo_width',)\n")
    with pytest.raises(ParameterError, match=r"effect Halo changes what cameras report: it cannot have shapes"):
        find_effects([str(file)])
