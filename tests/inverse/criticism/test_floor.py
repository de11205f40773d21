"""The floor against the noise that its evidence was drawn with, and what must not raise it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from splatsoil.inverse.criticism.evidence import Evidence, other_numerics
from splatsoil.inverse.criticism.floor import floor_of

from splatsoil.errors import SimulationError
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter

SITES = tuple(Site(f"c{c}", 0.1 * i, 0.1 * j) for c in range(2) for i in range(4) for j in range(4))
LAYOUT = Layout(
    tuple(float(t) for t in range(10)),
    SITES,
    "frame",
    "grey levels",
    ("push",) * 10,
    np.full((10, len(SITES)), "bed"),
)
SENSOR, ERROR = 0.1, 0.8


def looked(observed: np.ndarray, quiet: np.ndarray) -> Any:
    """An experiment that nobody simulates: its evidence is made up."""
    seen, sensor = np.ones(LAYOUT.shape, dtype=bool), np.full(LAYOUT.shape, SENSOR)
    told = {
        "layout": LAYOUT,
        "sensor": sensor,
        "sensor_memory": 0.0,
        "systematic": np.zeros((0, *LAYOUT.shape)),
        "parameters": (),
        "candidates": (),
        "chance": True,
    }
    return SimpleNamespace(observed=observed, quiet=quiet, seen=seen, **told)


def evidence(generator: np.random.Generator, patterns: dict[str, np.ndarray]) -> Evidence:
    repeats = 0.3 * generator.standard_normal((4, *LAYOUT.shape))
    nothing: dict[str, Any] = {
        "slopes": {},
        "curves": {},
        "widths": {},
        "directions": {},
        "steps": {},
        "failed": {},
        "visits": (),
    }
    flat = np.zeros(LAYOUT.shape)
    none = np.zeros((0, *LAYOUT.shape))
    return Evidence(values={}, prediction=flat, **nothing, mean=flat, repeats=repeats, numerics=patterns, guesses=none)


def floor_with(moved: float = 0.0, wild: float = 1.0) -> tuple[float, float]:
    """Root mean squares of the errors of reconstruction and of numerics that are found, with some soil that moved in
    quiet places, and one numerics pattern that is so many times as large."""
    generator = np.random.default_rng(3)
    quiet = np.zeros(LAYOUT.shape, dtype=bool)
    quiet[:, :20] = True
    observed = ERROR * generator.standard_normal(LAYOUT.shape)
    observed[4:, :2] += moved
    patterns = {name: generator.standard_normal(LAYOUT.shape) for name in ("stiffness", "step", "grid")}
    patterns["grid"] = wild * patterns["grid"]
    parts = floor_of(looked(observed, quiet), evidence(generator, patterns)).parts
    return tuple(float(np.sqrt(np.mean(parts[n].scale ** 2))) for n in ("reconstruction", "numerics"))  # type: ignore[return-value]


def test_errors_of_pictures_are_as_large_as_they_were_made() -> None:
    # What is left beside chance (five quarters of its variance) and the sensor's.
    assert floor_with()[0] == pytest.approx(np.sqrt(ERROR**2 - 1.25 * 0.3**2 - SENSOR**2), rel=0.12)


def test_soil_that_moved_where_none_was_expected_is_no_fault_of_the_pictures() -> None:
    assert floor_with(moved=40.0)[0] < 1.8 * floor_with()[0]


@pytest.mark.parametrize(
    ("error", "moved", "turned", "cameras", "told"),
    [
        (ERROR, 0.0, 0.0, True, ERROR),
        (0.5 * ERROR, 0.0, 0.0, True, ERROR),
        (3.0 * ERROR, 0.0, 0.0, True, 3.0 * ERROR),
        (ERROR, 20.0, 0.0, True, 1.1 * ERROR),
        (ERROR, 0.0, 5.0, True, ERROR),
        (ERROR, 0.0, 5.0, False, ERROR),
    ],
)
def test_a_control_tells_errors_of_pictures_and_the_bed_only_what_is_worse_all_over_it(
    error: float, moved: float, turned: float, cameras: bool, told: float
) -> None:
    """Beside the tool's way, in two squares of five, soil may move that a model without the right effect lets lie. What
    a turned camera does is an effect's, and where that isn't at hand a frame may be brighter as a whole."""
    generator = np.random.default_rng(2)
    base = evidence(generator, {})

    def pictures(size: float, count: int) -> np.ndarray:
        chance = 0.3 * generator.standard_normal((count, 2, *LAYOUT.shape))
        left = size * generator.standard_normal((count, *LAYOUT.shape))
        return left + chance[:, 0] - chance[:, 1] + SENSOR * generator.standard_normal(left.shape)

    quiet = np.ones(LAYOUT.shape, dtype=bool)
    quiet[:, :6] = False
    (observed,) = pictures(error, 1)
    observed[:, [6, 7, 8, 9, 10, 22, 23, 24, 25, 26]] += moved
    shift = generator.standard_normal(LAYOUT.shape) if cameras else np.ones(LAYOUT.shape)
    experiment = looked(observed + turned * shift, quiet)
    if cameras:
        experiment.candidates = (SimpleNamespace(name="pose", kind="observation"),)
        base = replace(base, directions={"pose": shift[None]})
    found = floor_of(experiment, replace(base, replays=pictures(ERROR, 3)))
    assert np.sqrt(np.mean(found.parts["reconstruction"].scale ** 2)) == pytest.approx(told, rel=0.12)


def test_what_a_control_does_not_show_is_as_uncertain_as_what_lies_around() -> None:
    """Its own heaps hide other squares: that these come out right there is nothing that anybody has seen."""
    generator = np.random.default_rng(3)
    base = evidence(generator, {})
    quiet = np.ones(LAYOUT.shape, dtype=bool)
    quiet[:, :6] = False
    experiment = looked(ERROR * generator.standard_normal(LAYOUT.shape), quiet)
    control = 2.0 * ERROR * generator.standard_normal((1, *LAYOUT.shape))
    hidden = np.zeros(LAYOUT.shape, dtype=bool)
    hidden[:, [2, 3, 12, 27]] = True

    def scale(replays: np.ndarray) -> np.ndarray:
        return floor_of(experiment, replace(base, replays=replays)).parts["reconstruction"].scale

    whole, partial = scale(control), scale(np.where(hidden, np.nan, control))
    assert np.mean(partial[hidden] ** 2) == pytest.approx(np.mean(whole**2), rel=0.4)
    np.testing.assert_allclose(partial[~hidden], whole[~hidden], rtol=0.3)


def test_a_wild_numerics_pattern_does_not_stand_for_those_not_tried() -> None:
    assert floor_with(wild=30.0)[1] < 1.3 * floor_with()[1]
    assert floor_with(wild=30.0)[1] > 0.5


def test_other_numerics_that_alone_act_as_an_effect_does_count_in_full_along_it() -> None:
    """Each is of its own kind; of six guesses that are alike one such would be another kind of thing."""
    generator = np.random.default_rng(6)
    trace = generator.standard_normal(LAYOUT.shape)
    patterns = {name: generator.standard_normal(LAYOUT.shape) for name in ("stiffness", "step", "grid", "rounding")}
    told = replace(evidence(generator, {**patterns, "contact": trace}), directions={"effect": trace[None]})
    experiment = looked(generator.standard_normal(LAYOUT.shape), np.zeros(LAYOUT.shape, dtype=bool))
    # Along the trace it has the variance of all its features, and the four others hardly more than one's.
    assert floor_of(experiment, told).parts["numerics"].on_directions > 0.1 * trace.size


def test_numerics_and_parameters_that_change_nothing_are_no_trouble() -> None:
    generator = np.random.default_rng(4)
    nothing = np.zeros(LAYOUT.shape)
    patterns = {"step": generator.standard_normal(LAYOUT.shape), "grid": generator.standard_normal(LAYOUT.shape)}
    experiment = looked(generator.standard_normal(LAYOUT.shape), np.zeros(LAYOUT.shape, dtype=bool))
    experiment.parameters = (Parameter("shape", "", 0.0, 1.0, 0.5),)
    told = evidence(generator, {**patterns, "contact": nothing})
    told = replace(
        told, values={"shape": 0.5}, slopes={"shape": nothing}, repeats=told.repeats * [[[1.0]], *3 * [[[0.0]]]]
    )
    found = floor_of(experiment, told)
    assert np.isfinite(found.noise.covariance).all()
    assert found.parts["numerics"].scale.max() > 0.1


@pytest.mark.parametrize("true", [0.0, 1.0])
def test_chance_in_what_other_numerics_change_is_not_counted_again(true: float) -> None:
    """Differences of two seeds each, whose chance is twice as large as what repeats show; more of it than of numerics
    proper, or nothing else."""
    generator = np.random.default_rng(5)
    names = ("stiffness", "step", "grid", "contact")
    chances = {name: 0.9 * generator.standard_normal((2, *LAYOUT.shape)) for name in names}
    means = {name: true * generator.standard_normal(LAYOUT.shape) + chances[name].mean(axis=0) for name in names}
    doubts = {name: 0.5 * (first - second) for name, (first, second) in chances.items()}
    told = evidence(generator, means)
    experiment = looked(generator.standard_normal(LAYOUT.shape), np.zeros(LAYOUT.shape, dtype=bool))
    size = [
        float(np.sqrt(np.mean(floor_of(experiment, each).parts["numerics"].scale ** 2)))
        for each in (told, replace(told, numerics_doubts=doubts))
    ]
    assert size[0] == pytest.approx(np.hypot(true, 0.9 / np.sqrt(2.0)), rel=0.1)
    assert size[1] == pytest.approx(true, rel=0.1, abs=0.2)


def test_other_numerics_are_told_by_two_seeds_and_other_drawings_by_the_one_at_hand() -> None:
    """By name and seed: a table is its number, and every asked one is noted."""
    tables = {("", 0): 1.0, ("", 5): 2.0, ("drawn", 0): 4.0, ("grid", 0): 11.0, ("grid", 5): 18.0}
    asked: list[tuple[str, int]] = []

    def ask(name: str, seed: int) -> np.ndarray:
        asked.append((name, seed))
        if name == "broken":
            raise SimulationError("soil left the bin")
        return np.array(tables[name, seed])

    told: Any = SimpleNamespace(numerics=("grid", "broken", "drawn"), redrawn=("drawn",))
    means, doubts = other_numerics(told, ask, (0, 5))
    assert means == {"drawn": 3.0, "grid": 13.0} and doubts == {"grid": -3.0}
    assert asked.index(("drawn", 0)) < asked.index(("", 5)) and ("drawn", 5) not in asked
    assert other_numerics(told, ask, (0,)) == ({"drawn": 3.0, "grid": 10.0}, {})
