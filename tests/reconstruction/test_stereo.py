"""What stereo finds in ray-cast photographs, and its parts against geometry done by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatsoil.measurement import Camera
from splatsoil.reconstruction import PRESETS, HeightField
from splatsoil.reconstruction.initial import seed_far, seed_rim
from splatsoil.reconstruction.stereo import Smoothness, visibility
from splatsoil.reconstruction.surface import Geometry, find_geometry, with_rim, without_backdrop
from splatsoil.reconstruction.views import Views, silhouettes


def as_views(cameras: list[Camera], images: list[np.ndarray]) -> Views:
    return Views.of(cameras, images, [np.ones(image.shape[:2], dtype=bool) for image in images], "x" * len(images))


def photographed(scene, count: int) -> Views:
    cameras = scene.cameras(count, 128, 96)
    return as_views(cameras, [scene.render(camera, seed=k) for k, camera in enumerate(cameras)])


def geometry_of(scene, views: Views) -> Geometry:
    hidden = silhouettes(views, scene.tool().placed(0.0))
    return find_geometry(views, scene.bed, hidden, PRESETS["tiny"], lambda what, share: None)


@pytest.fixture(scope="module")
def views(scene) -> Views:
    return photographed(scene, 14)


@pytest.fixture(scope="module")
def geometry(scene, views) -> Geometry:
    return geometry_of(scene, views)


def test_the_surface_is_found_to_a_fraction_of_a_pixel(scene, views, geometry):
    """A pixel is 8 mm on the bed here. The tool hides parts of it in every view, the walls in some."""
    exact = scene.surface(geometry.surface)
    assert geometry.surface.rmse(exact) < 2.5e-3
    assert abs(geometry.surface.bias(exact)) < 0.7e-3
    flat = replace(exact, height=np.full_like(exact.height, scene.level))
    assert flat.rmse(exact) > 3 * geometry.surface.rmse(
        exact
    )  # the check can fail: the waves are larger than the bound


def test_the_ground_under_a_bin_and_around_a_field(scene, geometry):
    assert geometry.ground == pytest.approx(float(scene.bed.lower[2]))
    field = replace(scene, wall=0.0)
    found = geometry_of(field, photographed(field, 10))
    assert found.ground == pytest.approx(field.level, abs=0.5 * field.wave)


def test_silhouettes_cover_the_tool_and_little_else(scene, views):
    drawn = silhouettes(views, scene.tool().placed(0.0), margin=1).numpy() > 0
    for k, camera in enumerate(views.cameras):
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        origin, ray = camera.rays(np.stack([columns.ravel(), rows.ravel()], 1))
        exact = scene._meets_tool(origin, ray)[0].reshape(camera.height, camera.width)
        assert not np.any(exact & ~drawn[k])
        grown = exact.copy()
        for _ in range(3):
            grown = grown | np.roll(grown, 1, 0) | np.roll(grown, -1, 0)
            grown = grown | np.roll(grown, 1, 1) | np.roll(grown, -1, 1)
        assert not np.any(drawn[k] & ~grown)


def test_a_wall_hides_what_lies_in_its_shadow():
    """A wall 0.2 m high, seen from 45°: points within 0.2 m behind it are hidden, those farther off are not."""
    x = 0.005 + 0.01 * np.arange(100)
    ground = HeightField(x, x, np.where((x > 0.5) & (x < 0.55), 0.2, 0.0) * np.ones((100, 1)))
    pose = np.eye(4)
    pose[:3, 3] = [0.55 + 100.0, 0.5, 100.0 + 0.2]
    camera = Camera(8, 8, 10.0, 10.0, 4.0, 4.0, pose)
    views = as_views([camera], [np.zeros((8, 8, 3), np.float32)])
    distance = np.array([0.02, 0.1, 0.18, 0.22, 0.3])
    points = np.stack([0.5 - distance, np.full(5, 0.5), np.zeros(5)], 1)
    # The ray from a point at distance d behind the wall's near face reaches 0.2 m at 0.2 m: the far edge decides.
    seen = visibility(views, points, ground, clearance=0.005, steps=64)[0].numpy()
    np.testing.assert_array_equal(seen, [0, 0, 0, 1, 1])
    beyond = np.array([[0.6, 0.5, 0.0], [0.52, 0.5, 0.2]])
    np.testing.assert_array_equal(visibility(views, beyond, ground, clearance=0.005)[0].numpy(), [1, 1])


def test_the_rim_is_as_high_as_the_soil_beside_it(scene, geometry):
    rim = with_rim(geometry.surface, scene.bed, 0.03)
    lower = scene.bed.lower
    edge = geometry.surface.sample(np.array([[lower[0], lower[1] + 0.2]]))
    assert rim.sample(np.array([[lower[0] - 0.015, lower[1] + 0.2]])) == pytest.approx(edge, abs=5e-3)
    assert rim.height.min() < lower[2] - 1.0, "nothing beyond it hides anything"


def test_discs_cover_the_border_around_the_bed(scene, geometry):
    """As many as fit on its top, on its outer side down to the ground, and on its inner one down to the soil; none
    leaves a gap."""
    spacing, rim, lower, upper = 0.01, geometry.rim, scene.bed.lower[:2], scene.bed.upper[:2]
    seeds = seed_rim(geometry, scene.bed, spacing)
    flat = seeds.normals[:, 2] == 1.0
    top, side = seeds.points[flat], seeds.points[~flat]
    grid = np.random.default_rng(0).uniform(lower - rim, upper + rim, (2000, 2))
    beyond = np.maximum(lower - grid, grid - upper).max(axis=1)
    assert cKDTree(top[:, :2]).query(grid[beyond > 0.0])[0].max() < spacing
    area = np.prod(upper - lower + 2.0 * rim) - np.prod(upper - lower)
    assert len(top) * spacing**2 == pytest.approx(area, rel=0.1)
    away = np.maximum(lower - side[:, :2], side[:, :2] - upper).max(axis=1)
    outer = np.isclose(away, rim)
    assert away[~outer] == pytest.approx(0.0, abs=1e-9)
    height = top[:, 2].mean() - geometry.ground
    assert outer.sum() * spacing**2 == pytest.approx(2.0 * (upper - lower + 2.0 * rim).sum() * height, rel=0.1)
    high = replace(geometry, wall=float(geometry.surface.height.max()) + 0.1)
    inner = seed_rim(high, scene.bed, spacing).points
    inner = inner[np.isclose(np.maximum(lower - inner[:, :2], inner[:, :2] - upper).max(axis=1), 0.0)]
    edge = np.concatenate([geometry.surface.height[[0, -1]].ravel(), geometry.surface.height[:, [0, -1]].ravel()])
    assert len(inner) * spacing**2 == pytest.approx(2.0 * (upper - lower).sum() * (high.wall - edge.mean()), rel=0.1)


def test_first_discs_far_away_lie_on_the_ground_and_on_a_sphere_around_all_cameras(scene, geometry):
    """Six times as far from the bed as the farthest camera; nothing within the bed and its border."""
    cameras = scene.cameras(6, 64, 48, rise=(5.0, 40.0))
    views = as_views(cameras, [np.zeros((48, 64, 3), np.float32)] * 6)
    seeds = seed_far(views, scene.bed, geometry)
    centre = np.array([*(scene.bed.lower + scene.bed.upper)[:2] / 2, geometry.ground])
    radius = 6.0 * max(np.linalg.norm(camera.position - centre) for camera in views.cameras)
    up = seeds.normals[:, 2] == 1.0
    assert up.any() and not up.all() and np.allclose(seeds.points[up, 2], geometry.ground)
    away = np.linalg.norm(seeds.points - centre, axis=1)
    assert (away[up] < radius).all() and away[~up] == pytest.approx(radius)
    lower, upper = scene.bed.lower[:2] - geometry.rim, scene.bed.upper[:2] + geometry.rim
    assert not np.all((seeds.points[:, :2] > lower) & (seeds.points[:, :2] < upper), axis=1).any()


def test_a_plate_bends_no_plane():
    x, y = np.meshgrid(np.arange(20.0), np.arange(14.0))
    plane = 0.2 * x - 0.1 * y
    known = np.zeros_like(plane)
    known[3::5, ::3] = 1.0
    filled = Smoothness(plane.shape).plate(known, plane * known, 100.0, 0.0)
    np.testing.assert_allclose(filled, plane, atol=1e-5)


def test_a_spire_at_a_corner_is_cut_off_and_a_hole_inside_is_left_to_the_prior() -> None:
    rows, columns = np.mgrid[:20, :30]
    plane = 0.1 + 0.001 * rows
    height, deviation = plane.copy(), np.full(plane.shape, 2e-4)
    corner = (rows >= 16) & (columns >= 25)
    # sure of itself in places, but never as sure as sand
    height[corner] += 0.08
    deviation[corner] = np.where((rows + columns)[corner] % 2 == 0, 1e-3, 1.0)
    deviation[5:8, 10:14] = 1.0
    found, known = without_backdrop(height, deviation, 0.5)
    assert np.array_equal(found[~corner], plane[~corner])
    assert np.abs(found - plane).max() < 0.005
    assert (known[corner] == 0.5).all()
    assert np.array_equal(known[~corner], deviation[~corner])
