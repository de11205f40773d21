"""Projection, rays and undistortion against OpenCV's and kornia's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import kornia
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from splatsoil.errors import MeasurementError
from splatsoil.measurement import Camera, Frame
from splatsoil.measurement.fields import Fields
from splatsoil.measurement.frames import read_camera

POINTS = np.array([[0.1, -0.2, 1.0], [0.5, 0.4, 1.5], [-0.7, 0.3, 2.0], [0.0, 0.0, 1.0], [1.2, -0.9, 1.6]])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# cv2.projectPoints and cv2.fisheye.projectPoints of OpenCV 5.0.0 for POINTS in the camera's frame, fx 343, fy 350,
# cx 171.5, cy 110.25, with (k1, k2, p1, p2, k3) and (k1, k2, k3, k4) as in the cameras below.
OPENCV_PIXELS = [
    [205.52682193750002, 40.74625625],
    [283.21379141187015, 201.63243843145864],
    [53.10393482034377, 162.0325048890625],
    [171.5, 110.25],
    [407.3486776570231, -70.43869772460309],
]
FISHEYE_PIXELS = [
    [205.2765429562099, 41.318279681204274],
    [279.8776860394807, 198.72158044039242],
    [56.516021878794504, 160.53453853697033],
    [171.5, 110.25],
    [379.7807198481054, -49.148510087835774],
]
SIZE = {"width": 320, "height": 240, "fx": 343.0, "fy": 350.0, "cx": 171.5, "cy": 110.25}
BENT = {"k1": -0.12, "k2": 0.034, "p1": 0.0011, "p2": -0.0023, "k3": 0.005}
WIDE = {"k1": 0.02, "k2": -0.013, "k3": 0.004, "k4": -0.0007, "model": "OPENCV_FISHEYE"}


def pose() -> np.ndarray:
    """Some rigid motion."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    out[:3, 3] = [0.3, -0.8, 1.9]
    return out


def pixel_grid(camera: Camera) -> np.ndarray:
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(("options", "expected"), [(BENT, OPENCV_PIXELS), (WIDE, FISHEYE_PIXELS)])
def test_projection_is_opencvs(options: dict, expected: list) -> None:
    """In the camera's own frame, and moved with the camera."""
    camera = Camera(**SIZE, camera_to_world=FLIP, **options)
    pixels, depth = camera.project(POINTS)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(depth, POINTS[:, 2], atol=1e-12)
    moved = replace(camera, camera_to_world=pose() @ FLIP)
    world = POINTS @ pose()[:3, :3].T + pose()[:3, 3]
    pixels, depth = moved.project(world)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(depth, POINTS[:, 2], atol=1e-12)


def test_projection_is_kornias() -> None:
    """Without distortion kornia's pinhole, with it kornia's distortion model; axes and pose by our own conversion."""
    camera = Camera(**SIZE, camera_to_world=pose(), **BENT)
    world = np.random.default_rng(0).uniform(-0.4, 0.4, (200, 3)) + camera.position - 1.5 * pose()[:3, 2]
    k = torch.from_numpy(camera.intrinsics)
    extrinsics = torch.from_numpy(camera.world_to_camera)[None]
    big = torch.eye(4, dtype=torch.float64)[None].clone()
    big[0, :3, :3] = k
    height, width = torch.tensor([240.0]), torch.tensor([320.0])
    pinhole = kornia.geometry.PinholeCamera(big, extrinsics, height, width).project(torch.from_numpy(world))
    np.testing.assert_allclose(camera.undistorted().project(world)[0], pinhole.numpy(), atol=1e-8)
    coefficients = torch.tensor([[BENT[c] for c in ("k1", "k2", "p1", "p2", "k3")]], dtype=torch.float64)
    bent = kornia.geometry.calibration.distort_points(pinhole[None], k[None], coefficients)[0]
    np.testing.assert_allclose(camera.project(world)[0], bent.numpy(), atol=1e-8)


@pytest.mark.parametrize("options", [{}, BENT, WIDE, {"k1": 0.3, "k4": 0.02}], ids=["pinhole", "bent", "wide", "k4"])
def test_rays_go_back_through_their_pixels(options: dict) -> None:
    camera = Camera(**SIZE, camera_to_world=pose(), **options)
    pixels = pixel_grid(camera)[::7]
    origins, directions = camera.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(origins, np.broadcast_to(camera.position, origins.shape))
    there, depth = camera.project(origins + 0.7 * directions)
    np.testing.assert_allclose(there, pixels, atol=1e-6)
    assert (depth > 0.0).all()


def test_looking_down_the_axes() -> None:
    """By hand: the camera 2 m above the origin looks down; image right is +x, image up is +y."""
    matrix = np.eye(4)
    matrix[2, 3] = 2.0
    camera = Camera(100, 80, 50.0, 50.0, 50.0, 40.0, matrix)
    pixels, depth = camera.project([[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0], [0, 0, 1]])
    np.testing.assert_allclose(pixels, [[50, 40], [60, 40], [50, 30], [50, 40]])
    np.testing.assert_allclose(depth, [2, 2, 2, 1])
    np.testing.assert_allclose(camera.world_to_camera, [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])


def test_what_no_ray_reaches_is_nan() -> None:
    matrix = np.eye(4)
    camera = Camera(**SIZE, camera_to_world=matrix)
    pixels, depth = camera.project([[0, 0, 1.0], [0, 0, 0.0]])  # behind, and in the camera's plane
    assert np.isnan(pixels).all() and (depth <= 0.0).all()
    # r (1 - 0.2 r²) turns back at r = sqrt(1 / 0.6) = 1.29.
    barrel = Camera(**SIZE, camera_to_world=matrix, k1=-0.2)
    pixels, _ = barrel.project([[1.28, 0, -1.0], [1.30, 0, -1.0], [3.0, 0, -1.0]])
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1:]).all()
    furthest = 1.29099 * (1.0 - 0.2 * 1.29099**2)
    reached = barrel.cx + barrel.fx * (furthest - 1e-4)
    beyond = barrel.cx + barrel.fx * (furthest + 1e-3)
    directions = barrel.rays([[reached, barrel.cy], [beyond, barrel.cy]])[1]
    assert np.isfinite(directions[0]).all() and np.isnan(directions[1]).all()


def test_fisheye_sees_behind_itself() -> None:
    camera = Camera(**SIZE, camera_to_world=FLIP, model="OPENCV_FISHEYE")
    pixels, depth = camera.project([[1.0, 0.0, -0.2], [0.0, 0.0, 1.0]])
    angle = np.pi / 2 + np.arctan(0.2)
    np.testing.assert_allclose(pixels[0], [171.5 + 343.0 * angle, 110.25])
    np.testing.assert_allclose(pixels[1], [171.5, 110.25])
    assert depth[0] == -0.2


def test_scaling_and_cropping_move_pixels_as_the_image_does() -> None:
    camera = Camera(**SIZE, camera_to_world=FLIP, **BENT)
    pixels, _ = camera.project(POINTS)
    half = camera.scaled(0.5)
    assert (half.width, half.height) == (160, 120)
    np.testing.assert_allclose(half.project(POINTS)[0], 0.5 * pixels)
    odd = camera.scaled(0.3)  # 96 x 72: the ratio of whole sizes counts
    np.testing.assert_allclose(odd.project(POINTS)[0], pixels * [96 / 320, 72 / 240])
    part = camera.cropped(30, 20, 100, 90)
    assert (part.width, part.height) == (100, 90)
    np.testing.assert_allclose(part.project(POINTS)[0], pixels - [30, 20])


@pytest.mark.parametrize("options", [BENT, WIDE], ids=["bent", "fisheye"])
def test_undistorted_images_show_what_the_pinhole_would(options: dict, tmp_path: Path) -> None:
    """A wall with a smooth picture, photographed by the bent lens and by the pinhole: both computed ray by ray."""
    camera = Camera(**SIZE, camera_to_world=FLIP, **options)

    def photograph(lens: Camera) -> np.ndarray:
        _, d = lens.rays(pixel_grid(lens))
        x, y = d[:, 0] / d[:, 2], d[:, 1] / d[:, 2]
        picture = 0.5 + 0.4 * np.stack([np.sin(9.0 * x), np.cos(7.0 * y), np.sin(5.0 * (x + y))], axis=1)
        return np.round(255.0 * picture.reshape(lens.height, lens.width, 3)).astype(np.uint8)

    Image.fromarray(photograph(camera)).save(tmp_path / "bent.png")
    frame = Frame(camera, tmp_path / "bent.png")
    straight, wanted = frame.undistorted_image(), photograph(camera.undistorted()) / 255.0
    seen = frame.undistorted_mask()
    assert straight.shape == (240, 320, 3) and straight.dtype == np.float32
    assert seen.mean() > 0.9
    assert np.abs(straight - wanted)[seen].max() < 0.012, "8-bit rounding, twice, and bilinear blending"
    shifted = np.roll(straight, 1, axis=1)  # half a pixel of misplaced centres would be found
    assert np.abs(0.5 * (straight + shifted) - wanted)[seen][:, 0].max() > 0.012


def test_an_image_without_distortion_is_left_alone(plow_dry: Path) -> None:
    path = plow_dry / "views" / "images" / "000.jpg"
    frame = Frame(Camera(**SIZE, camera_to_world=FLIP), path)
    expected = np.asarray(Image.open(path), dtype=np.float32) / np.float32(255.0)
    np.testing.assert_array_equal(frame.image(), expected)
    np.testing.assert_array_equal(frame.undistorted_image(), expected)
    assert frame.undistorted_mask().all() and frame.mask() is None and frame.depth() is None


def test_masks_transparency_and_depth(tmp_path: Path) -> None:
    camera = Camera(4, 2, 4.0, 4.0, 2.0, 1.0, FLIP)
    alpha = np.array([[255, 255, 0, 9], [0, 1, 255, 255]], dtype=np.uint8)
    Image.fromarray(np.dstack([np.full((2, 4, 3), 77, np.uint8), alpha])).save(tmp_path / "rgba.png")
    Image.fromarray(np.array([[0, 255, 255, 255], [255, 255, 255, 0]], dtype=np.uint8)).save(tmp_path / "mask.png")
    Image.fromarray(np.array([[0, 1500, 65535, 7], [1, 2, 3, 4]], dtype=np.uint16)).save(tmp_path / "depth.png")
    np.save(tmp_path / "depth.npy", np.full((2, 4), 1.25))
    by_alpha, by_mask = Frame(camera, tmp_path / "rgba.png"), Frame(
        camera, tmp_path / "rgba.png", mask_path=tmp_path / "mask.png", depth_path=tmp_path / "depth.png"
    )  # fmt: skip
    np.testing.assert_array_equal(by_alpha.mask(), alpha > 127)
    np.testing.assert_array_equal(by_mask.mask(), [[False, True, True, True], [True, True, True, False]])
    np.testing.assert_allclose(by_mask.depth(), [[0, 1.5, 65.535, 0.007], [0.001, 0.002, 0.003, 0.004]], rtol=1e-6)
    np.testing.assert_allclose(replace(by_mask, depth_path=tmp_path / "depth.npy").depth(), 1.25)
    assert by_alpha.image().shape == (2, 4, 3)


RADIAL = {"k1": 0.05, "k2": 0.01}
LENS = {"w": 320, "h": 240, "fl_x": 300.0, "fl_y": 310.0, "cx": 160.0, "cy": 120.0}
ONE = {key: value for key, value in LENS.items() if key != "fl_y"}
POSED = {"transform_matrix": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("gives", "means"),
    [
        ({**ONE, "camera_model": "SIMPLE_PINHOLE"}, {"fy": 300.0, "model": "PINHOLE"}),
        ({**ONE, "camera_model": "SIMPLE_RADIAL", "k1": 0.1}, {"fy": 300.0, "k1": 0.1, "model": "OPENCV"}),
        ({**ONE, "fl_y": 300.0, "camera_model": "RADIAL", **RADIAL}, {"k1": 0.05, "k2": 0.01, "model": "OPENCV"}),
        ({**LENS, "is_fisheye": True, **RADIAL}, {"k2": 0.01, "model": "OPENCV_FISHEYE"}),
        ({**LENS, "is_fisheye": False, **RADIAL}, {"k2": 0.01, "model": "OPENCV"}),
        ({**LENS, "k3": 0.3, "k4": 0.4, "k5": 0, "k6": 0.0}, {"k3": 0.3, "k4": 0.4, "model": "OPENCV"}),
        ({**LENS, "camera_angle_x": 2 * math.atan(160 / 300.0)}, {"fx": 300.0, "fy": 310.0}),
        ({**LENS, "fl_x": None, "camera_angle_x": 2 * math.atan(160 / 250.0)}, {"fx": 250.0, "fy": 310.0}),
    ],
)
def test_lenses_as_nerfstudio_and_instant_ngp_name_them(gives: dict, means: dict) -> None:
    camera = read_camera(Fields({**gives, **POSED}, Path("t.json")), "")
    assert {key: pytest.approx(getattr(camera, key)) if key != "model" else camera.model for key in means} == means


@pytest.mark.parametrize(
    ("gives", "field", "says"),
    [
        ({"k5": 0.2}, "k5", "has no k5"),
        ({"k6": -0.2, "is_fisheye": True}, "k6", "OPENCV_FISHEYE has no k6"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 1e-3}, "p1", "has no p1"),
        ({"camera_model": "SIMPLE_RADIAL", "fl_y": 300.0, "k2": 1e-3}, "k2", "has no k2"),
        ({"distortion_params": [0.1, 0.0]}, "distortion_params", "has no distortion_params"),
        ({"camera_model": "SIMPLE_PINHOLE"}, "fl_y", "one focal length"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye", "contradicts"),
        ({"camera_model": "OPENCV_FISHEYE", "is_fisheye": False}, "is_fisheye", "contradicts"),
        ({"is_fisheye": 1}, "is_fisheye", "true or false"),
        ({"camera_angle_y": 1.0}, "fl_y", "contradict camera_angle_y"),
    ],
)
def test_what_of_a_lens_is_not_understood_is_refused(gives: dict, field: str, says: str) -> None:
    with pytest.raises(MeasurementError, match=says) as caught:
        read_camera(Fields({**LENS, **gives, **POSED}, Path("t.json")), "")
    assert caught.value.field == field


def test_wrong_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="FULL_OPENCV"):
        Camera(**SIZE, camera_to_world=FLIP, model="FULL_OPENCV")
    with pytest.raises(ValueError, match="camera_to_world"):
        Camera(**SIZE, camera_to_world=np.eye(3))
    with pytest.raises(ValueError, match="at least one pixel"):
        Camera(**SIZE, camera_to_world=FLIP).cropped(0, 0, 0, 5)
