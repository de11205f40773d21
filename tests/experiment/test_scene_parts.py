"""Where the tool went into the soil, against outlines of its section and rays of the cameras."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatsoil.experiment import plow
from splatsoil.experiment.features import Site
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.experiment.scene_parts import entered
from splatsoil.measurement import Measurement
from splatsoil.measurement.motion import ToolMotion
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField

LEVEL, SIDES, LAST = 0.12, np.array([0.05, 0.04]), 199
LOWERED = 25
"""Frames in which the examples' tool is lowered."""
REACH = 0.02
"""A sixth of its width."""


@pytest.fixture(scope="module")
def dry(plow_dry: Path) -> Measurement:
    return Measurement.load(plow_dry)


def moved(measurement: Measurement, *ways: tuple[float, float, float]) -> Measurement:
    """A tool that goes these ways (x, y, z) in m, in 25 frames each, from where it starts."""
    start = measurement.tool.motion
    stops = np.cumsum([start.positions[0], *ways], axis=0)
    count = 25 * len(ways) + 1
    positions = np.stack([np.interp(np.arange(count) / 25.0, np.arange(len(stops)), axis) for axis in stops.T], axis=1)
    turns = np.repeat(start.quaternions[:1], count, axis=0)
    motion = ToolMotion(np.arange(count), np.arange(count) / measurement.frame_rate, positions, turns)
    return replace(measurement, tool=replace(measurement.tool, motion=motion))


def in_soil(measurement: Measurement, frames: range) -> cKDTree:
    """Places of many points of the tool that are below the surface."""
    dense, found = measurement.tool.mesh.sample(20_000, seed=1), []
    for frame in frames:
        rotation, position = measurement.tool.motion.pose(frame / measurement.frame_rate)
        at = dense @ np.asarray(rotation).T + position
        found.append(np.unique(np.round(at[at[:, 2] < LEVEL][:, :2], 3), axis=0))
    return cKDTree(np.unique(np.concatenate(found), axis=0))


def nearest(measurement: Measurement, site: Site, way: cKDTree, opened: cKDTree, reach: float) -> float:
    """How near to the way a site's camera looks through its square, down to the deepest edge through opened soil."""
    eye = measurement.cameras[site.channel].position
    edge = np.linspace(-0.5, 0.5, 11)
    xy = np.stack(np.meshgrid(site.x + edge * SIDES[0], site.y + edge * SIDES[1]), axis=-1).reshape(-1, 2)
    square = np.column_stack([xy, np.full(len(xy), LEVEL)])
    rotation, position = measurement.tool.motion.pose(LOWERED / measurement.frame_rate)
    lowest = (measurement.tool.mesh.vertices @ np.asarray(rotation).T + position)[:, 2].min()
    best, open_so_far = way.query(xy)[0].min(), np.ones(len(xy), dtype=bool)
    for depth in np.linspace(LEVEL, lowest, 30):
        at = (eye + (depth - eye[2]) / (LEVEL - eye[2]) * (square - eye))[:, :2]
        open_so_far &= opened.query(at)[0] <= reach
        if open_so_far.any():
            best = min(best, way.query(at[open_so_far])[0].min())
    return float(best)


def test_squares_that_show_where_the_tool_went_in_are_those_whose_rays_pass_there(dry: Measurement) -> None:
    xs, ys = np.arange(0.03, 0.78, 0.05), np.arange(0.03, 0.48, 0.04)
    sites = [Site(camera, float(x), float(y)) for camera in dry.cameras for x in xs for y in ys]
    found = entered(dry, LEVEL, LAST, sites, SIDES)
    way, opened = in_soil(dry, range(1, LOWERED + 1)), in_soil(dry, range(1, LAST + 1))
    # a little more or less in reach is left open
    surely = np.array([nearest(dry, site, way, opened, REACH - 0.004) < REACH - 0.004 for site in sites])
    perhaps = np.array([nearest(dry, site, way, opened, REACH + 0.004) < REACH + 0.004 for site in sites])
    assert found[surely].all() and not found[~perhaps].any()
    assert (perhaps & ~surely).mean() < 0.08
    above = np.array([way.query([site.x, site.y])[0] for site in sites]) > np.hypot(*SIDES) / 2 + REACH
    assert found[above].any(), "rays into the open trench end at the wall"
    assert 10 < found.sum() < 0.25 * len(sites)


DOWN, UP, ON, OVER = (0.0, 0.0, -0.1), (0.0, 0.0, 0.1), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)


@pytest.mark.parametrize(
    ("ways", "left_out"),
    [
        ((DOWN, ON), True),
        ((DOWN, ON, UP, OVER, DOWN), True),
        ((DOWN,), False),
        ((DOWN, UP), False),
        ((DOWN, UP, ON), False),
        ((ON, (-0.1, 0.0, 0.0), DOWN, UP), False),
        (((0.0, 0.0, 0.0), ON), False),
    ],
)
def test_it_is_left_out_where_the_tool_is_pushed_on_through_the_soil(
    dry: Measurement, ways: tuple[tuple[float, float, float], ...], left_out: bool
) -> None:
    site = Site(next(iter(dry.cameras)), 0.2, 0.25)
    measurement = moved(dry, *ways)
    assert entered(measurement, LEVEL, 25 * len(ways), [site], SIDES).all() == left_out


def test_each_way_into_the_soil_from_which_it_is_pushed_on_is_left_out(dry: Measurement) -> None:
    camera = next(iter(dry.cameras))
    sites = [Site(camera, 0.2, 0.25), Site(camera, 0.5, 0.25)]
    away = (0.3, 0.0, 0.0)
    assert entered(moved(dry, DOWN, UP, away, DOWN, ON), LEVEL, 125, sites, SIDES).tolist() == [False, True]
    assert entered(moved(dry, DOWN, ON, UP, (0.2, 0.0, 0.0), DOWN, ON), LEVEL, 150, sites, SIDES).all()
    assert entered(moved(dry, DOWN, ON, UP, away, DOWN), LEVEL, 125, sites, SIDES).tolist() == [True, False]


def test_a_tool_that_stays_above_the_soil_goes_in_nowhere(dry: Measurement) -> None:
    site = Site(next(iter(dry.cameras)), 0.2, 0.25)
    assert entered(dry, LEVEL, LAST, [site], SIDES).all()
    assert not entered(dry, 0.02, LAST, [site], SIDES).any()


def test_no_feature_is_made_of_where_the_tool_went_in_unless_there_is_no_other(
    dry: Measurement, monkeypatch: pytest.MonkeyPatch
) -> None:
    surface = HeightField.over(dry.bed.lower, dry.bed.upper, 0.02, LEVEL)
    model = Model(dry, cast(Any, SimpleNamespace(surface=surface)), preset="tiny")

    def seen() -> tuple[list[Site], np.ndarray]:
        experiment = PlowExperiment(model)
        placed = experiment.layout.placed
        return [s for s, there in zip(experiment.layout.sites, placed, strict=True) if there], experiment.seen[
            :, placed
        ]

    sites, without = seen()
    there = ~without.any(axis=0)
    assert 0.08 < there.mean() < 0.2
    middle = np.array([[site.x, site.y] for site in sites])[there].mean(axis=0)
    assert np.allclose(middle, [0.2, 0.25], atol=0.06)
    monkeypatch.setattr(plow, "entered", lambda *_: np.zeros(len(sites), dtype=bool))
    everything = seen()[1]
    assert np.array_equal(everything[:, ~there], without[:, ~there]) and everything[:, there].any(axis=0).all()
    monkeypatch.setattr(plow, "entered", lambda *_: np.ones(len(sites), dtype=bool))
    assert np.array_equal(seen()[1], everything), "nothing would be left to compare"
