"""Where the tool went into the soil, against outlines of its section and rays of the cameras."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from splatsoil.experiment.features import Site
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.experiment.scene_parts import entered
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField

LEVEL, SIDE, REACH = 0.12, 0.05, 0.02
LOWERED = 25
"""Frames in which the examples' tool is lowered."""


@pytest.fixture(scope="module")
def dry() -> Measurement:
    return Measurement.load(Path("examples/plow-dry"))


def level(measurement: Measurement, height: float = LEVEL) -> HeightField:
    return HeightField.over(measurement.bed.lower, measurement.bed.upper, 0.02, height)


def sections(measurement: Measurement) -> np.ndarray:
    """Outlines (n, 2) of what is below the surface of the tool, closely spaced, as it is lowered."""
    out = []
    mesh = measurement.tool.mesh
    dense = np.concatenate([mesh.vertices, mesh.sample(20_000, seed=1)])
    for frame in range(1, LOWERED + 1):
        rotation, position = measurement.tool.motion.pose(frame / measurement.frame_rate)
        at = dense @ np.asarray(rotation).T + position
        below = at[at[:, 2] < LEVEL][:, :2]
        if len(below) > 2:
            hull = below[ConvexHull(below).vertices]
            share = np.linspace(0.0, 1.0, 40)[:, None, None]
            out.append(((1.0 - share) * hull + share * np.roll(hull, -1, axis=0)).reshape(-1, 2))
    everything = np.concatenate(out)
    return np.unique(np.round(everything, 3), axis=0)


def looked_at(measurement: Measurement, site: Site) -> np.ndarray:
    """(n, 2) places under rays of a site's camera through its square, from the surface to the deepest edge."""
    eye = measurement.cameras[site.channel].position
    edge = np.linspace(-0.5, 0.5, 11) * SIDE
    square = np.stack([*np.meshgrid(site.x + edge, site.y + edge), np.full((11, 11), LEVEL)], axis=-1).reshape(-1, 3)
    rotation, position = measurement.tool.motion.pose(LOWERED / measurement.frame_rate)
    lowest = (measurement.tool.mesh.vertices @ np.asarray(rotation).T + position)[:, 2].min()
    depths = np.linspace(LEVEL, lowest, 15)
    along = (depths - eye[2]) / (LEVEL - eye[2])
    return np.concatenate([(eye + t * (square - eye))[:, :2] for t in along])


def test_squares_that_show_where_the_tool_went_in_are_those_whose_rays_pass_there(dry: Measurement) -> None:
    xs, ys = np.arange(0.03, 0.78, SIDE), np.arange(0.03, 0.48, SIDE)
    sites = [Site(camera, float(x), float(y)) for camera in dry.cameras for x in xs for y in ys]
    found = entered(dry, level(dry), 199.0, sites, SIDE, REACH)
    outlines = cKDTree(sections(dry))
    nearest = np.array([outlines.query(looked_at(dry, site))[0].min() for site in sites])
    # the tool's points are 8 mm apart
    unsure = np.abs(nearest - REACH) < 0.008
    assert np.array_equal(found[~unsure], (nearest < REACH)[~unsure])
    assert unsure.mean() < 0.1
    assert 10 < found.sum() < 0.3 * len(sites)
    # of two squares as far from there, the one before the wall shows it
    by_camera = {camera: found[[s.channel == camera for s in sites]] for camera in dry.cameras}
    assert not np.array_equal(*by_camera.values())


def test_nothing_is_left_out_of_a_bed_in_which_the_tool_is_only_lowered(dry: Measurement) -> None:
    site = Site(next(iter(dry.cameras)), 0.2, 0.25)
    assert entered(dry, level(dry), 199.0, [site], SIDE, REACH).all()
    assert not entered(dry, level(dry), float(LOWERED), [site], SIDE, REACH).any()


def test_a_tool_that_stays_above_the_soil_goes_in_nowhere(dry: Measurement) -> None:
    site = Site(next(iter(dry.cameras)), 0.2, 0.25)
    assert not entered(dry, level(dry, 0.02), 199.0, [site], SIDE, REACH).any()


def test_no_feature_is_made_of_where_the_tool_went_in(dry: Measurement) -> None:
    surface = level(dry)

    def seen(cell: float) -> tuple[PlowExperiment, np.ndarray]:
        model = Model(dry, cast(Any, SimpleNamespace(surface=surface)), preset="tiny")
        model.resolution = replace(model.resolution, cell=cell)
        experiment = PlowExperiment(model)
        return experiment, experiment.seen[:, experiment.layout.common]

    experiment, fine = seen(0.01)
    coarse = seen(0.04)[1]
    sites = [site for site, placed in zip(experiment.layout.sites, experiment.layout.common, strict=True) if placed]
    there = entered(dry, surface, 199.0, sites, experiment.comparator.patch, 0.01)
    assert there.any() and not fine[:, there].any()
    assert fine[:, ~there].mean() > 0.8, "the tool alone hides others"
    assert (coarse <= fine).all() and coarse.sum() < fine.sum(), "coarser cells tell less"
