"""What cameras report, against closed forms."""

import math

import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from scipy.special import erf

from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.observation import CameraShift, Observation
from splatsoil.soil.library import library

EFFECTS = ("blur", "camera_pose", "exposure", "light", "time_offset", "tool_pose")
FOCAL = 400.0


def camera(position=(0.0, -2.0, 0.0)):
    """Looks along +y: right is +x, up is +z."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pose[:3, 3] = position
    return Camera(640, 480, FOCAL, FOCAL, 320.0, 240.0, pose, model="PINHOLE")


def seen(shift, points, index=0, cameras=1):
    others = [CameraShift()] * cameras
    others[index] = shift
    pixels, _ = Observation(cameras=tuple(others)).camera(camera(), index).project(points)
    return pixels


def values_of(effect, **changes):
    return {**{p.name: p.off for p in effect.parameters}, **changes}


@pytest.mark.parametrize("name", EFFECTS)
def test_off_is_no_observation_at_all(name):
    effect = library()[name]
    assert effect.observe(Observation(), values_of(effect)) == Observation(
        cameras=(CameraShift(),) if name == "camera_pose" else ()
    )
    for p in effect.parameters:
        assert p.lower <= p.off <= p.upper and p.meaningful > 0.0 and p.default == p.off
        assert (p.sign == 1) == (p.lower == p.off)
        assert effect.observe(Observation(), values_of(effect, **{p.name: p.upper})) != Observation()


def test_a_point_on_the_axis_moves_by_the_tangent_of_a_turn():
    for angle in (0.3, 2.0):
        away = FOCAL * math.tan(math.radians(angle))
        assert np.allclose(seen(CameraShift(pan=angle), [[0.0, 0.0, 0.0]]), [[320.0 - away, 240.0]])
        assert np.allclose(seen(CameraShift(tilt=angle), [[0.0, 0.0, 0.0]]), [[320.0, 240.0 + away]])


def test_a_turn_does_not_care_for_distance_and_a_shift_does():
    near, far = [[0.1, 0.0, 0.1], [0.2, 2.0, 0.2]]
    turned = seen(CameraShift(pan=1.0, tilt=-0.5, roll=2.0), [near, far])
    assert np.allclose(turned[0], turned[1])
    shifted = seen(CameraShift(right=0.01, up=0.02), [near, far]) - seen(CameraShift(), [near, far])
    assert np.allclose(shifted, [[-FOCAL * 0.01 / 2.0, FOCAL * 0.02 / 2.0], [-FOCAL * 0.01 / 4.0, FOCAL * 0.02 / 4.0]])


def test_rolling_clockwise_turns_the_picture_counterclockwise():
    (pixel,) = seen(CameraShift(roll=90.0), [[0.1, 0.0, 0.0]])
    # What lay right of the middle lies above it now (rows count downwards).
    assert np.allclose(pixel, [320.0, 240.0 - FOCAL * 0.1 / 2.0])


def test_moving_forward_enlarges():
    (pixel,) = seen(CameraShift(forward=0.5), [[0.1, 0.0, 0.0]])
    assert np.allclose(pixel, [320.0 + FOCAL * 0.1 / 1.5, 240.0])


def test_only_the_bumped_camera_moves():
    observation = Observation(cameras=(CameraShift(), CameraShift(pan=1.0)))
    still = camera()
    assert observation.camera(still, 0) is still and observation.camera(still, 2) is still
    assert observation.camera(still, 1) is not still


def test_exposure_acts_on_linear_colour():
    srgb = torch.rand(1, 3, 4, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    colour = rgb_to_linear_rgb(srgb)

    def as_image(values):
        return linear_rgb_to_rgb(values.clamp(0.0, 1.0))[0].permute(1, 2, 0).numpy()

    image = srgb[0].permute(1, 2, 0).numpy().astype(np.float32)
    assert np.allclose(Observation(gain=1.5).image(image, 7.0), as_image(1.5 * colour), atol=1e-5)
    drifted = Observation(drift=math.log(2.0) / 4.0, offset=0.01).image(image, 4.0)
    assert np.allclose(drifted, as_image(2.0 * colour + 0.01), atol=1e-5)
    assert np.array_equal(Observation(drift=0.1).image(image, 0.0), image)


@pytest.mark.parametrize("sigma", [0.4, 1.0, 3.0])
def test_blur_widens_an_edge_by_its_sigma(sigma):
    image = np.zeros((5, 80, 3), dtype=np.float32)
    image[:, 40:] = 1.0
    row = Observation(blur=sigma).image(image, 0.0)[2, :, 0].astype(np.float64)
    colour = np.where(row <= 0.04045, row / 12.92, ((row + 0.055) / 1.055) ** 2.4)
    step = np.diff(colour)
    place = np.arange(79) + 1.0
    middle = float((step * place).sum())
    assert math.isclose(step.sum(), 1.0, abs_tol=1e-5) and math.isclose(middle, 40.0, abs_tol=1e-3)
    assert math.isclose(math.sqrt(float((step * (place - middle) ** 2).sum())), sigma, rel_tol=2e-3)
    if sigma == 3.0:
        edge = 0.5 * (1.0 + erf((np.arange(80) + 0.5 - 40.0) / (sigma * math.sqrt(2.0))))
        # An edge of pixels is a box of one pixel wider than a sharp one: by 1/12 of the variance.
        assert np.abs(colour - edge).max() < 4e-3


def test_blurs_add_their_variances():
    blur = library()["blur"]
    twice = blur.observe(blur.observe(Observation(), {"blur": 3.0}), {"blur": 4.0})
    assert math.isclose(twice.blur, 5.0)


def test_the_drawn_tool_turns_about_its_own_origin():
    observation = Observation(tool_shift=(0.01, 0.0, -0.02), tool_turn=90.0)
    rotation, position = observation.tool((np.eye(3), np.array([1.0, 2.0, 3.0])))
    assert np.allclose(position, [1.01, 2.0, 2.98])
    assert np.allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


def test_nonsense_is_refused():
    with pytest.raises(ParameterError, match="gain"):
        Observation(gain=0.0)
    with pytest.raises(ParameterError, match="blur"):
        Observation(blur=-1.0)
