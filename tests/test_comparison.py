"""Losses and block residuals of pictures made from the measured ones, so that the right answer is known."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatsoil.comparison import PATCH, Comparator
from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement
from splatsoil.reconstruction import HeightField

FOLDER = Path(os.environ.get("SPLATSOIL_EXAMPLES", Path(__file__).parents[1] / "examples")) / "plow-dry"
FRAMES = (0, 50, 100)


@pytest.fixture(scope="module")
def level():
    bed = Measurement.load(FOLDER).bed
    return HeightField.over(bed.lower, bed.upper, PATCH, 0.12)


@pytest.fixture(scope="module")
def comparator(level):
    return Comparator(Measurement.load(FOLDER), surface=level, frames=FRAMES)


@pytest.fixture
def seen(comparator):
    """What a perfect model would predict but for noise: the frames, and before anything moved their mean."""
    images = {key: image.copy() for key, image in comparator.observed.items()}
    for camera in comparator.cameras:
        images[camera, 0] = comparator.before[camera].astype(np.float32)
    return images


def patch_of(comparator, camera, x, y):
    """Pixels of the bed near a place."""
    return np.linalg.norm(comparator.ground[camera] - [x, y], axis=-1) < 0.06


def test_perfect_prediction_leaves_nothing(comparator, seen):
    found = comparator.compare(seen)
    assert found.loss == pytest.approx(0.0, abs=1e-9)
    assert found.rgb == 0.0
    assert np.allclose(found.blocks, 0.0, atol=1e-4)
    assert set(found.losses) == {(c, f) for c in ("left", "right") for f in (50, 100)}
    assert len(found.labels) == len(found.blocks) > 200


def test_pictures_can_stand_in_for_the_photographs(comparator, seen):
    rng = np.random.default_rng(0)
    world = {
        key: np.clip(image + 0.1 * rng.uniform(size=(1, 1, 3)).astype(np.float32), 0, 1) for key, image in seen.items()
    }
    control = comparator.against(world)
    assert control.compare(world).loss == pytest.approx(0.0, abs=1e-9)
    assert control.compare(world).rgb == 0.0 and control.noise is None and control.block_noise() == 0.0
    # The photographs are as they were: each comparison knows its own world.
    assert comparator.compare(seen).loss == pytest.approx(0.0, abs=1e-9)
    assert comparator.compare(world).rgb == pytest.approx(control.compare(seen).rgb, rel=1e-2)
    assert comparator.compare(world).rgb > 1e-4


def test_no_motion_scores_about_one_and_motion_matters_more_than_noise(comparator, seen):
    still = {}
    for camera, frame in seen:  # no motion of the soil; the tool, which the unit leaves out, must not stay where it was
        tool = comparator._shows_tool(camera, 0, seen[camera, 0])[..., None]
        still[camera, frame] = seen[camera, 0] if frame == 0 else np.where(tool, seen[camera, frame], seen[camera, 0])
    assert comparator.compare(still).loss == pytest.approx(1.0, abs=0.15)
    assert 0.0 < comparator.noise < 0.02


def test_a_bias_that_was_there_before_anything_moved_cancels(comparator, seen):
    stripes = 0.05 * np.sin(np.arange(320) / 7.0)[None, :, None].astype(np.float32)
    found = comparator.compare({key: image + stripes for key, image in seen.items()})
    # it does not cancel where the tool stood at frame 0
    assert found.loss < 0.1
    assert found.rgb == pytest.approx(0.05**2 / 2, rel=0.1)


def test_blocks_answer_linearly_and_where_the_change_is(comparator, seen):
    place = patch_of(comparator, "left", 0.5, 0.12)

    def blocks(amount):
        images = {key: image.copy() for key, image in seen.items()}
        images["left", 100][place] -= amount
        return comparator.compare(images)

    one, two = blocks(0.02), blocks(0.04)
    assert np.allclose(two.blocks, 2.0 * one.blocks, atol=1e-3)
    largest = one.labels[int(np.argmax(np.abs(one.blocks)))]
    assert (largest.camera, largest.frame) == ("left", 100)
    assert np.hypot(largest.x - 0.5, largest.y - 0.12) < 0.05
    # a block that lies within the change shows all of it: 0.02 of 255 grey levels, observed minus predicted
    assert one.blocks.max() == pytest.approx(0.02 * 255, rel=1e-3)
    assert two.loss > one.loss > 0.0
    assert [k for k, v in one.losses.items() if v > 1e-9] == [("left", 100)]


def test_small_differences_count_by_their_square_and_large_ones_by_their_size(comparator, seen):
    place = patch_of(comparator, "right", 0.5, 0.3)

    def loss(amount):
        images = {key: image.copy() for key, image in seen.items()}
        images["right", 50][place] = images["right", 50][place] - amount
        return comparator.compare(images).losses["right", 50]

    assert loss(0.004) / loss(0.002) == pytest.approx(4.0, rel=0.02)
    assert loss(1.0) / loss(0.5) < 2.3


def test_fine_noise_is_averaged_out_that_rgb_error_counts(comparator, seen):
    generator = np.random.default_rng(0)
    noisy = {k: v + (0.05 * generator.normal(size=v.shape)).astype(np.float32) * (k[1] > 0) for k, v in seen.items()}
    found = comparator.compare(noisy)
    assert found.rgb == pytest.approx(0.05**2, rel=0.05)
    assert found.loss < 0.1


def test_the_tool_is_left_out(comparator, seen):
    painted = {key: image.copy() for key, image in seen.items()}
    image = painted["left", 100]
    blue = (image[..., 2] > 1.5 * image[..., 0]) & comparator.interior["left"]
    assert blue.sum() > 300
    image[blue] = image[blue] * 0.8
    assert comparator.compare(painted).loss == pytest.approx(0.0, abs=1e-4)


def test_walls_and_ground_are_left_out(comparator, seen):
    outside = {key: np.where(comparator.interior[key[0]][..., None], image, 0.0) for key, image in seen.items()}
    assert comparator.compare(outside).rgb == 0.0


def test_a_difference_is_grey_where_pictures_are_equal(comparator, seen):
    shown = comparator.pictures(seen, "left", 100)
    assert [picture.shape for picture in shown.values()] == [(240, 320, 3)] * 3
    assert np.allclose(shown["difference"], 0.5)
    brighter = comparator.pictures({key: image + 0.01 for key, image in seen.items()}, "left", 100)
    assert np.allclose(brighter["difference"], 0.46, atol=1e-6)


def test_the_same_pictures_give_the_same_bits(comparator, seen):
    images = {key: np.roll(image, 3, axis=1) for key, image in seen.items()}
    first, second = comparator.compare(images), comparator.compare(images)
    assert first.loss == second.loss
    assert np.array_equal(first.blocks, second.blocks) and np.array_equal(first.blocks, comparator.blocks(images))


def test_noise_of_still_frames_is_their_spread(comparator):
    """A later frame's, and that of the mean of five; each still one is told against the other four."""
    still = comparator.still_blocks()
    assert {camera: rows.shape[0] for camera, rows in still.items()} == {"left": 5, "right": 5}
    variance = [np.var(0.8 * rows, axis=0, ddof=1).mean() * (1.0 + 1.0 / 5.0) for rows in still.values()]
    assert comparator.block_noise() == pytest.approx(np.sqrt(np.mean(variance)), rel=1e-6)
    assert 0.01 < comparator.block_noise() < 1.0
    assert all(np.abs(rows.sum(axis=0)).max() < 1e-3 for rows in still.values())


def test_what_is_missing_is_named(comparator, seen, level):
    del seen["right", 50]
    with pytest.raises(ParameterError, match="'right' at frame 50"):
        comparator.compare(seen)
    for frames, says in (((0, 33), "no frame 33"), ((0,), "nothing to compare")):
        with pytest.raises(ParameterError, match=says):
            Comparator(comparator.measurement, surface=level, frames=frames)
    seen["right", 50] = np.zeros((10, 10, 3), dtype=np.float32)
    with pytest.raises(ParameterError, match="frame 50"):
        comparator.compare(seen)


def test_a_blocks_outline_goes_around_its_pixels(comparator):
    for camera in comparator.cameras:
        patches, outlines = comparator.patches[camera], comparator.outlines(camera)
        assert outlines.shape == (patches.max() + 1, 4, 2)
        height, width = patches.shape
        y, x = np.mgrid[:height, :width] + 0.5
        for block, corners in enumerate(outlines * (width, height)):
            a, b = corners, np.roll(corners, -1, axis=0)
            mine = np.stack([x[patches == block], y[patches == block]], axis=1)[:, None]
            (u, v), (p, q) = (b - a).T, np.moveaxis(mine - a, -1, 0)
            side = np.sign(u * q - v * p)
            # At the picture's edges, and past crests, a block shows only in part.
            assert np.mean(np.abs(side.sum(axis=1)) == 4) > 0.6, (camera, block)


def test_pixels_look_at_the_surface(comparator):
    """A slope: where rays meet it, by hand; cells that nobody knows are as the ones beside them."""
    measurement = comparator.measurement
    bed, (x, y, rise) = measurement.bed, (0.1, -0.05, 0.1)
    slope = HeightField.over(bed.lower, bed.upper, 0.005)
    slope = replace(slope, height=rise + x * slope.points[..., 0] + y * slope.points[..., 1])
    torn = slope.height.copy()
    torn[40:43, 60:63] = np.nan
    for surface, off in ((slope, 5e-4), (replace(slope, height=torn), 5e-3)):
        found = Comparator(measurement, surface=surface, frames=(0, 50))
        for name in found.cameras:
            view = measurement.cameras[name].undistorted()
            v, u = np.nonzero(found.bed[name])
            origins, directions = view.rays(np.stack([u, v], axis=1) + 0.5)
            normal = np.array([-x, -y, 1.0])
            reach = (rise - origins @ normal) / (directions @ normal)
            expected = (origins + reach[:, None] * directions)[:, :2]
            assert len(u) > 5000
            assert np.abs(found.ground[name][v, u] - expected).max() < off
            assert np.all(found.interior[name][v, u])
