"""Particles against the analytic volume and surface of a wavy bed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from splatsoil.errors import ParameterError
from splatsoil.measurement import Bed
from splatsoil.reconstruction import HeightField, fill, soil_mesh, volume

BED = Bed(np.array([-0.2, 1.0, 0.05]), np.array([0.6, 1.5, 0.32]), 1600.0)
AMPLITUDE, LENGTH = 0.025, 0.16  # five waves along x: their mean over the bed is zero
MEAN = 0.113


def height(x):
    return BED.lower[2] + MEAN + AMPLITUDE * np.sin(2 * np.pi * (x - BED.lower[0]) / LENGTH)


@pytest.fixture(scope="module")
def waves() -> HeightField:
    field = HeightField.over(BED.lower, BED.upper, 0.005)
    return HeightField(field.x, field.y, height(np.meshgrid(field.x, field.y)[0]))


EXACT = 0.8 * 0.5 * MEAN


@pytest.mark.parametrize("spacing", [0.02, 0.01, 0.0073])
@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_the_particles_hold_the_soils_volume(waves, spacing, jitter):
    particles = fill(waves, BED, spacing, seed=1, jitter=jitter)
    assert len(particles) * spacing**3 == pytest.approx(EXACT, rel=1e-3)
    assert volume(waves, BED) == pytest.approx(EXACT, rel=1e-3)


@pytest.mark.parametrize("jitter", [0.0, 0.5, 1.0])
def test_particles_stay_in_the_soil(waves, jitter):
    particles = fill(waves, BED, 0.01, seed=2, jitter=jitter)
    assert np.all(particles > BED.lower) and np.all(particles[:, :2] < BED.upper[:2])
    # The spline through 5 mm cells is not the sine itself.
    assert np.all(particles[:, 2] < height(particles[:, 0]) + 2e-4)


def test_mass_stands_where_the_soil_is(waves):
    """Slabs across the waves: mass in proportion to depth, its centre at half of it; no slab is favoured."""
    spacing = 0.01
    particles = fill(waves, BED, spacing, seed=3, jitter=0.5)
    edges = np.linspace(BED.lower[0], BED.upper[0], 21)
    for low, high in pairwise(edges):
        inside = particles[(particles[:, 0] >= low) & (particles[:, 0] < high)]
        x = np.linspace(low, high, 201)
        depth = height(x) - BED.lower[2]
        exact = np.trapezoid(depth, x) * 0.5
        assert len(inside) * spacing**3 == pytest.approx(exact, rel=0.012)
        middle = np.trapezoid(depth**2 / 2, x) / np.trapezoid(depth, x)
        assert (inside[:, 2] - BED.lower[2]).mean() == pytest.approx(middle, rel=0.012)


def test_the_top_layer_has_no_bias_and_no_steps(waves):
    """The uppermost particle of a column lies half its share of the depth below, on crests and in troughs."""
    spacing = 0.01
    particles = fill(waves, BED, spacing, seed=4, jitter=0.0)
    column = np.unique(np.round(particles[:, :2], 9), axis=0, return_inverse=True)[1].ravel()
    top = np.full(column.max() + 1, -np.inf)
    np.maximum.at(top, column, particles[:, 2])
    first = np.unique(column, return_index=True)[1]
    below = height(particles[first, 0]) - top
    assert abs(below.mean() - spacing / 2) < 1e-4
    assert below.std() < 0.05 * spacing


def test_a_spacing_from_single_precision_makes_the_same_columns(waves):
    """0.5 m is 12.5 spacings of 4 cm."""
    exact, single = (fill(waves, BED, spacing, jitter=0.0) for spacing in (0.04, float(np.float32(0.04))))
    np.testing.assert_array_equal(exact[:, :2], single[:, :2])


def test_seeds_repeat_and_differ(waves):
    one, same, other = (fill(waves, BED, 0.02, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(one, same)
    assert one.shape != other.shape or not np.array_equal(one, other)


@pytest.mark.parametrize(("spacing", "jitter"), [(0.0, 0.5), (-1.0, 0.5), (0.5, 0.5), (float("nan"), 0.5), (0.01, 1.5)])
def test_senseless_numbers_are_refused(waves, spacing, jitter):
    with pytest.raises(ParameterError):
        fill(waves, BED, spacing, jitter=jitter)


def test_the_solid_is_closed_and_has_the_soils_volume(waves):
    solid = soil_mesh(waves, BED)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(EXACT, rel=2e-3)
    np.testing.assert_allclose(solid.bounds[:, :2], [BED.lower[:2], BED.upper[:2]])
    assert solid.bounds[0, 2] == pytest.approx(BED.lower[2])


def test_open_ground_goes_on_beyond_the_box(waves):
    """Around the box lies soil as high as at its border, as much as a tenth of its narrower side twice over."""
    bed, spacing = replace(BED, container="open"), 0.01
    particles = fill(waves, bed, spacing, seed=1)
    inside = np.all((particles[:, :2] > BED.lower[:2]) & (particles[:, :2] < BED.upper[:2]), axis=1)
    assert inside.sum() * spacing**3 == pytest.approx(EXACT, rel=5e-3)
    beyond = particles[~inside]
    assert beyond[:, 0].min() < -0.29 and beyond[:, 1].max() > 1.59
    # Beside the box's long sides the waves go on, before and behind it their ends do.
    ends = 0.1 * (0.8 + 0.2) * 2 * MEAN + 0.1 * 0.5 * (height(-0.2) + height(0.6) - 2 * BED.lower[2])
    assert len(beyond) * spacing**3 == pytest.approx(ends, rel=0.02)


def test_a_heap_is_filled_alone():
    """A cone of half a radian: its volume, and nothing on the floor around it."""
    field = HeightField.over(BED.lower, BED.upper, 0.005)
    x, y = np.meshgrid(field.x, field.y)
    away = np.hypot(x - 0.2, y - 1.25)
    cone = HeightField(field.x, field.y, BED.lower[2] + np.maximum(0.1 - 0.5 * away, 0.0))
    particles = fill(cone, replace(BED, container="heap"), 0.01, seed=1)
    assert len(particles) * 0.01**3 == pytest.approx(np.pi * 0.2**2 * 0.1 / 3.0, rel=0.01)
    assert np.hypot(particles[:, 0] - 0.2, particles[:, 1] - 1.25).max() < 0.21
