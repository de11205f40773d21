"""Pictures whose light is known in closed form."""

from __future__ import annotations

import math

import kornia
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.synthetic import Body, Light, Stage, photograph
from splatsoil.synthetic.setups import look_at

FAR_AWAY = Body.flat(trimesh.creation.box(bounds=[[90.0, 90.0, 0.0], [91.0, 91.0, 1.0]]), 0.5)
SUN, SKY, ALBEDO = np.array([0.9, 0.8, 0.7]), np.array([0.2, 0.3, 0.4]), np.array([0.5, 0.4, 0.3])


def from_above(height: float = 2.0, size: int = 64, focal: float = 100.0) -> Camera:
    """Looks straight down on the origin; +x to the right, +y up."""
    matrix = np.eye(4)
    matrix[2, 3] = height
    return Camera(size, size, focal, focal, size / 2, size / 2, matrix)


def ground_points(camera: Camera) -> np.ndarray:
    """Where the pixels' centres see the ground: (h, w, 2)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    origins, directions = camera.rays(np.stack([x.ravel(), y.ravel()], axis=1))
    points = origins - directions * (origins[:, 2] / directions[:, 2])[:, None]
    return points[:, :2].reshape(camera.height, camera.width, 2)


@pytest.mark.parametrize("elevation", [20.0, 45.0, 90.0])
def test_level_ground_is_lamberts(elevation: float) -> None:
    stage = Stage([FAR_AWAY], Light.from_angles(30.0, elevation, SUN, SKY, softness=0.0), ground_colour=ALBEDO)
    expected = ALBEDO * (SUN * math.sin(math.radians(elevation)) + SKY)
    np.testing.assert_allclose(stage.radiance(from_above(), side=2), np.broadcast_to(expected, (64, 64, 3)), rtol=2e-4)


def test_a_tilted_plane_sees_part_of_the_sky() -> None:
    """E = sun n·l + sky (1 + cos tilt) / 2 over black ground."""
    tilt = math.radians(50.0)
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    plate = trimesh.creation.box((1.0, 1.0, 1e-3))
    plate.apply_transform(trimesh.transformations.rotation_matrix(tilt, [0.0, 1.0, 0.0]))
    plate.apply_translation([0.0, 0.0, 1.0])
    light = Light.from_angles(-40.0, 35.0, SUN, SKY, softness=0.0)
    stage = Stage([Body.flat(plate, ALBEDO)], light, ground_colour=(0.0, 0.0, 0.0))
    eye = np.array([0.0, 0.0, 1.0]) + 0.8 * normal
    camera = Camera(24, 24, 60.0, 60.0, 12.0, 12.0, look_at(eye, (0.0, 0.0, 1.0)))
    seen = stage.radiance(camera, side=8).mean(axis=(0, 1))
    expected = ALBEDO * (SUN * float(normal @ light.direction) + SKY * (1.0 + math.cos(tilt)) / 2.0)
    np.testing.assert_allclose(seen, expected, rtol=5e-3)


def test_the_shadow_of_a_box_lies_where_geometry_says() -> None:
    low, high = np.array([-0.15, -0.1, 0.0]), np.array([0.1, 0.12, 0.25])
    azimuth, elevation = math.radians(25.0), math.radians(40.0)
    light = Light.from_angles(25.0, 40.0, SUN, 0.0, softness=0.0)
    stage = Stage([Body.flat(trimesh.creation.box(bounds=[low, high]), ALBEDO)], light, ground_colour=(0.5, 0.5, 0.5))
    camera = from_above(height=3.0, size=120, focal=240.0)
    image = stage.radiance(camera, side=1)
    points = ground_points(camera)
    base = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    reach = high[2] / math.tan(elevation)
    shifted = base - reach * np.array([math.cos(azimuth), math.sin(azimuth)])
    shadow = ConvexHull(np.concatenate([base, shifted])).equations
    beyond_shadow = (points @ shadow[:, :2].T + shadow[:, 2]).max(axis=2)
    # Seen from above in perspective, the box hides the ground that its enlarged top covers.
    enlarged = np.concatenate([base, base * 3.0 / (3.0 - high[2])])
    hull = ConvexHull(enlarged).equations
    beyond_box = (points @ hull[:, :2].T + hull[:, 2]).max(axis=2)
    pixel = 3.0 / 240.0
    dark = (beyond_shadow < -pixel) & (beyond_box > pixel)
    bright = (beyond_shadow > pixel) & (beyond_box > pixel)
    assert dark.sum() > 200 and bright.sum() > 2000
    bounced = 0.5 * ALBEDO * SUN  # a dark pixel sees no sun and no sky, only the box's and the ground's light
    assert (image[dark] <= 0.5 * bounced).all() and np.median(image[dark]) < 0.01
    lit = 0.5 * SUN * math.sin(elevation)
    assert (image[bright] >= 0.999 * lit).all()
    np.testing.assert_allclose(np.median(image[bright], axis=0), lit, rtol=1e-3)


def test_the_edge_of_a_shadow_is_as_wide_as_the_sun() -> None:
    """A wall's edge 1 m up, under a sun 0.1 wide overhead to either side: the ground's light rises over 0.2 m."""
    wall = trimesh.creation.box(bounds=[[-50.0, -50.0, 1.0], [0.0, 50.0, 1.01]])
    light = Light.from_angles(0.0, 90.0, 1.0, 0.0, softness=0.1)
    stage = Stage([Body.flat(wall, 0.0)], light, ground_colour=(1.0, 1.0, 1.0))
    x = np.linspace(-0.15, 0.15, 31)
    values = []
    for place in x:
        matrix = look_at((place + 0.3, 0.0, 0.5), (place, 0.0, 0.0))
        values.append(float(stage.radiance(Camera(6, 6, 5000.0, 5000.0, 3.0, 3.0, matrix), side=12).mean()))
    # Share of a disc of radius 0.1 beyond a chord at distance -x.
    t = np.clip(-x / 0.1, -1.0, 1.0)
    share = (np.arccos(t) - t * np.sqrt(1.0 - t**2)) / math.pi
    np.testing.assert_allclose(values, share, atol=0.03)


def test_nothing_gives_more_light_than_it_gets() -> None:
    """White walls and ground under a white sky: everything is as bright as the sky, less the paths that are cut off."""
    corner = trimesh.creation.box(bounds=[[0.0, -2.0, 0.0], [0.1, 2.0, 1.0]])
    stage = Stage([Body.flat(corner, 1.0)], Light.from_angles(0.0, 90.0, 0.0, 1.0), ground_colour=(1.0, 1.0, 1.0))
    camera = Camera(48, 36, 60.0, 60.0, 24.0, 18.0, look_at((-1.5, 0.4, 0.8), (0.0, 0.0, 0.2)))
    image = stage.radiance(camera, side=6)
    assert image.max() <= 1.0 + 1e-5
    blocks = image.reshape(9, 4, 12, 4, 3).mean(axis=(1, 3))
    assert blocks.min() > 0.8 and image.mean() > 0.9


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_things_appear_where_the_lens_puts_them(model: str) -> None:
    centre = np.array([0.35, -0.2, 0.4])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    ball.apply_translation(centre)
    light = Light.from_angles(0.0, 90.0, 0.0, 1.0)
    stage = Stage([Body.flat(ball, 0.9)], light, ground_colour=(0.0, 0.0, 0.0))
    pose = look_at((0.3, -0.9, 1.6), (-0.15, -0.45, 0.3))
    camera = Camera(120, 90, 110.0, 105.0, 55.0, 48.0, pose, k1=-0.2, k2=0.05, p1=0.002, model=model)
    image = stage.radiance(camera, side=4).sum(axis=2)
    image[image < 0.05 * image.max()] = 0.0
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    weight = (image > 0.3 * image.max()).astype(float)
    found = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    expected, _ = camera.project(centre[None])
    np.testing.assert_allclose(found, expected[0], atol=0.4)
    straight, _ = camera.undistorted().project(centre[None])
    assert np.abs(straight[0] - expected[0]).max() > 1.5, "the lens bends too little to be tested"


def test_same_seed_same_bits_on_any_number_of_threads() -> None:
    light = Light.from_angles(10.0, 50.0, SUN, SKY)
    body = Body.flat(trimesh.creation.icosphere(radius=0.3), ALBEDO, grain=0.2)
    stage = Stage([body], light, ground_grain=0.1)
    camera = from_above(size=96)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = stage.radiance(camera, seed=5)
        torch.set_num_threads(3)
        three = stage.radiance(camera, seed=5)
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(one, three)
    assert (stage.radiance(camera, seed=6) != one).any()


def test_the_sensor_encodes_as_kornia_does_and_is_as_noisy_as_it_says() -> None:
    light = np.linspace(0.0, 1.2, 300, dtype=np.float32)
    image = np.broadcast_to(light[None, :, None], (200, 300, 3))
    wanted = kornia.color.linear_rgb_to_rgb(torch.tensor(np.clip(light, 0.0, 1.0)).expand(1, 3, 1, 300))[0, 0, 0]
    clean = photograph(image, 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(clean[0, :, 0] / 255.0, wanted.numpy(), atol=0.5 / 255.0 + 1e-5)
    noisy = photograph(np.full((200, 300, 3), 0.2, dtype=np.float32), 1.5 / 255.0, np.random.default_rng(0))
    assert math.sqrt(1.5**2 + 1.0 / 12.0) == pytest.approx(noisy.std(), rel=0.02)


def test_a_sun_below_the_horizon_is_refused() -> None:
    with pytest.raises(ParameterError, match="horizon"):
        Light.from_angles(0.0, -5.0, 1.0, 1.0)
