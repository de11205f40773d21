"""Where pixels look, against rays and surfaces that meet in closed form."""

import numpy as np
import pytest
import torch

from splatsoil.measurement import Camera
from splatsoil.scene import Relief, ground_of_pixels
from splatsoil.splats import Gaussians
from splatsoil.synthetic.setups import look_at

CELL = 0.01
LOWER, UPPER = (0.1, 0.1), (0.9, 0.9)


def relief(formula):
    """Heights of a formula over a square metre."""
    x = (np.arange(100) + 0.5) * CELL
    return Relief.of_heights(torch.tensor(formula(*np.meshgrid(x, x))), (0.5 * CELL, 0.5 * CELL), (CELL, CELL))


def camera(eye, target=(0.5, 0.5, 0.2)):
    return Camera(80, 60, 70.0, 70.0, 40.0, 30.0, look_at(eye, target))


def rays(camera):
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return camera.rays(np.stack([x, y], axis=-1).reshape(-1, 2))


@pytest.mark.parametrize("eye", [(-0.4, -0.3, 0.7), (0.5, 1.6, 0.35), (0.5, 0.501, 1.5)])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.2, -0.1)])
def test_rays_meet_a_plane(eye, slope):
    eye = camera(eye)
    level = 0.2 - 0.5 * sum(slope)
    found = ground_of_pixels(relief(lambda x, y: level + slope[0] * x + slope[1] * y), eye, LOWER, UPPER, 0.05)
    origins, directions = rays(eye)
    normal = np.array([-slope[0], -slope[1], 1.0])
    reach = (level - origins @ normal) / (directions @ normal)
    expected = (origins + reach[:, None] * directions)[:, :2].reshape(*found.shape)
    inside = (reach.reshape(found.shape[:2]) > 0) & np.all((expected > LOWER) & (expected < UPPER), axis=-1)
    # pixels on the border may fall on either side
    edge = np.abs(np.concatenate([expected - LOWER, UPPER - expected], axis=-1)).min(axis=-1) < 1e-3
    assert inside.sum() > 200
    assert np.array_equal(np.isfinite(found[..., 0])[~edge], inside[~edge])
    assert np.allclose(found[inside & ~edge], expected[inside & ~edge], atol=2e-4)


def test_a_crest_counts_as_far_as_heaps_may_rise():
    """A ridge across the view, with nothing behind it but the air."""
    eye = camera((0.5, -0.5, 0.5), (0.5, 0.5, 0.45))

    def ridge(x, y):
        return 0.4 - 0.8 * (y - 0.5) ** 2

    origins, directions = rays(eye)
    y = np.linspace(0.1, 0.9, 4001)
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = origins[:, 2:] + (y - origins[:, 1:2]) / directions[:, 1:2] * directions[:, 2:] - ridge(0.0, y)
        across = origins[:, 0] + (0.5 - origins[:, 1]) / directions[:, 1] * directions[:, 0]
    lowest, where = gap.min(axis=1), y[gap.argmin(axis=1)]
    middle = (across > 0.2) & (across < 0.8)
    for rise in (0.0, 0.03, 0.06):
        found = ground_of_pixels(relief(ridge), eye, LOWER, UPPER, rise).reshape(-1, 2)
        counts = np.isfinite(found[:, 0])
        over = middle & (lowest > 2e-3)
        sure = over & (np.abs(lowest - rise) > 2e-3)
        assert np.array_equal(counts[sure], (lowest < rise)[sure])
        near = over & counts
        assert (near.sum() > 50) == (rise > 0.0)
        assert np.allclose(found[near, 1], where[near], atol=0.03)


def test_soil_seen_through_its_side_has_no_place():
    level = relief(lambda x, y: 0.0 * x + 0.3)
    eye = camera((-0.6, 0.5, 0.32), (0.5, 0.5, 0.1))
    found = ground_of_pixels(level, eye, LOWER, UPPER, 0.05)
    origins, directions = rays(eye)
    entry = (origins[:, 2] + (0.1 - origins[:, 0]) / directions[:, 0] * directions[:, 2]).reshape(found.shape[:2])
    assert (entry < 0.29).sum() > 100
    assert not np.isfinite(found[entry < 0.299]).any()


def test_a_camera_that_looks_away_sees_nothing():
    found = ground_of_pixels(relief(lambda x, y: 0.0 * x), camera((0.5, 0.5, 1.0), (0.5, 0.6, 3.0)), LOWER, UPPER, 0.05)
    assert not np.isfinite(found).any()


def test_soil_outside_the_rectangle_hides_what_is_behind_it():
    def rim(x, y):
        return 0.2 + np.maximum(0.07 - np.abs(y - 0.03), 0.0)

    eye = camera((0.5, -0.6, 0.45))
    origins, directions = rays(eye)
    plain, hidden = (ground_of_pixels(relief(f), eye, LOWER, UPPER) for f in (lambda x, y: 0.2 + 0.0 * x, rim))
    y = np.linspace(0.0, 0.1, 1001)
    gap = origins[:, 2:] + (y - origins[:, 1:2]) / directions[:, 1:2] * directions[:, 2:] - rim(0.0, y)
    seen, over = np.isfinite(plain[..., 0]), gap.min(axis=1).reshape(plain.shape[:2])
    stopped, free = seen & (over < -0.01), seen & (over > 0.01)
    assert stopped.sum() > 50 and free.sum() > 50
    assert not np.isfinite(hidden[stopped]).any()
    assert np.allclose(hidden[free], plain[free], atol=1e-5)


def test_gaussians_before_the_bed_hide_it_and_those_behind_do_not():
    """Upright walls of opaque Gaussians, one before the bed and a higher one behind it."""
    height, spacing, level = 0.3, 0.01, 0.2
    eye = camera((0.5, -0.6, 0.6))

    def wall(y, top):
        x, z = np.meshgrid(np.arange(-0.5, 1.5, spacing), np.arange(0.0, top, spacing) + 0.5 * spacing)
        return np.stack([x, np.full_like(x, y), z], axis=-1).reshape(-1, 3)

    means = torch.tensor(np.concatenate([wall(0.05, height), wall(0.95, 0.6)]), dtype=torch.float32)
    walls = Gaussians.discs(means, spacing, spacing, 0.9, torch.zeros(len(means), 3))
    plain = relief(lambda x, y: level + 0.0 * x)
    bed, found = (ground_of_pixels(plain, eye, LOWER, UPPER, 0.0, around) for around in (None, walls))
    origins, directions = rays(eye)
    over = origins[:, 2] + (0.05 - origins[:, 1]) / directions[:, 1] * directions[:, 2] - height
    seen, over = np.isfinite(bed[..., 0]), over.reshape(bed.shape[:2])
    hidden, clear = seen & (over < 0.0), seen & (over > 3.0 * spacing)
    assert hidden.sum() > 50 and clear.sum() > 50
    assert not np.isfinite(found[hidden]).any()
    assert np.array_equal(found[clear], bed[clear])


def test_a_rough_plain_has_no_crests():
    noise = 0.004 * np.random.default_rng(0).normal(size=(100, 100))
    eye = camera((0.5, -0.6, 0.35))
    rough = relief(lambda x, y: 0.2 + noise + 0.0 * x)
    found, met = (np.isfinite(ground_of_pixels(rough, eye, LOWER, UPPER, rise)[..., 0]) for rise in (0.06, -1.0))
    assert met.sum() > 400
    assert (found & ~met).sum() < 0.03 * met.sum()
