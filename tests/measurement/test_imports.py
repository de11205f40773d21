"""COLMAP models and Blender camera files as frames."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from splatsoil.errors import MeasurementError
from splatsoil.measurement import read_blender, read_colmap

# Model name, COLMAP's number for it, parameters, and what they mean.
MODELS = [
    ("SIMPLE_PINHOLE", 0, (50.0, 16.0, 12.0), {"fx": 50.0, "fy": 50.0, "cx": 16.0}),
    ("PINHOLE", 1, (50.0, 51.0, 16.0, 12.5), {"fy": 51.0, "cy": 12.5}),
    ("SIMPLE_RADIAL", 2, (50.0, 16.0, 12.0, -0.1), {"fy": 50.0, "k1": -0.1, "k2": 0.0}),
    ("RADIAL", 3, (50.0, 16.0, 12.0, -0.1, 0.02), {"k1": -0.1, "k2": 0.02}),
    ("OPENCV", 4, (50.0, 51.0, 16.0, 12.0, -0.1, 0.02, 1e-3, 2e-3), {"k2": 0.02, "p1": 1e-3, "p2": 2e-3}),
    ("OPENCV_FISHEYE", 5, (50.0, 51.0, 16.0, 12.0, 0.1, 0.2, 0.3, 0.4), {"k3": 0.3, "k4": 0.4}),
]


def colmap_text(folder: Path, model: str, parameters: tuple[float, ...], poses: list[tuple]) -> None:
    """A text model as COLMAP writes it: comments, and a line of 2-D points (once empty) after each image."""
    words = " ".join(str(p) for p in parameters)
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {model} 32 24 {words}\n")
    lines = ["# Image list", "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for i, (quaternion, translation, name) in enumerate(poses):
        lines.append(f"{i + 1} {' '.join(repr(float(v)) for v in (*quaternion, *translation))} 7 {name}")
        lines.append("" if i == 0 else "3.5 4.5 -1 7.0 8.0 12")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def colmap_binary(folder: Path, number: int, parameters: tuple[float, ...], poses: list[tuple]) -> None:
    """The same as a binary model: little-endian, 64-bit counts, 32-bit ids, names that end in a zero byte."""
    cameras = struct.pack("<QIiQQ", 1, 7, number, 32, 24) + struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(cameras)
    raw = struct.pack("<Q", len(poses))
    for i, (quaternion, translation, name) in enumerate(poses):
        raw += struct.pack("<I7dI", i + 1, *quaternion, *translation, 7) + name.encode() + b"\0"
        points = [] if i == 0 else [(3.5, 4.5, 2**64 - 1), (7.0, 8.0, 12)]
        raw += struct.pack("<Q", len(points)) + b"".join(struct.pack("<ddQ", *point) for point in points)
    (folder / "images.bin").write_bytes(raw)


@pytest.fixture
def poses(tmp_path: Path) -> list[tuple]:
    """World to camera in OpenCV axes, with images of 32 x 24 pixels, not in the order of their names."""
    (tmp_path / "images" / "sub folder").mkdir(parents=True)
    out = []
    for name in ("sub folder/b 2.png", "a.png", "c.png"):
        Image.new("RGB", (32, 24)).save(tmp_path / "images" / name)
        rotation = Rotation.random(rng=len(out))
        out.append((tuple(rotation.as_quat()[[3, 0, 1, 2]]), (0.1 * len(out), -0.2, 1.5), name))
    return out


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize(("model", "number", "parameters", "means"), MODELS, ids=[m[0] for m in MODELS])
def test_colmap_models(
    model: str, number: int, parameters: tuple, means: dict, binary: bool, poses: list[tuple], tmp_path: Path
) -> None:
    if binary:
        colmap_binary(tmp_path, number, parameters, poses)
    else:
        colmap_text(tmp_path, model, parameters, poses)
    frames = read_colmap(tmp_path, tmp_path / "images")
    assert [f.path.name for f in frames] == ["a.png", "c.png", "b 2.png"]
    by_name = {f.path.relative_to(tmp_path / "images").as_posix(): f.camera for f in frames}
    for quaternion, translation, name in poses:
        camera = by_name[name]
        assert {key: getattr(camera, key) for key in means} == means
        rotation = Rotation.from_quat(np.array(quaternion)[[1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(camera.world_to_camera[:3, :3], rotation, atol=1e-12)
        np.testing.assert_allclose(camera.world_to_camera[:3, 3], translation, atol=1e-12)


def test_colmap_world_to_metres(poses: list[tuple], tmp_path: Path) -> None:
    """A similarity applied to cameras and points alike leaves the pixels where they are and scales the depths."""
    colmap_text(tmp_path, "OPENCV", MODELS[4][2], poses)
    turn = Rotation.from_rotvec([1.0, 0.5, -0.3]).as_matrix()
    similarity = np.eye(4)
    similarity[:3, :3], similarity[:3, 3] = 2.5 * turn, [1.0, 2.0, 3.0]
    plain = read_colmap(tmp_path, tmp_path / "images")
    metric = read_colmap(tmp_path, tmp_path / "images", similarity=similarity)
    for before, after in zip(plain, metric, strict=True):
        points = np.linalg.inv(before.camera.world_to_camera) @ [0.1, 0.2, 2.0, 1.0]
        pixels, depth = before.camera.project(points[None, :3])
        there, further = after.camera.project((similarity @ points)[None, :3])
        np.testing.assert_allclose(there, pixels, atol=1e-9)
        np.testing.assert_allclose(further, 2.5 * depth)


def test_real_photographs_of_a_boulder(measured_data: Path) -> None:
    """Apollo 17: the model's 3-D points have the colours that the photographs show where we project them."""
    folder = measured_data / "apollo17_boulder"
    frames = read_colmap(folder / "sparse", folder / "images")
    assert len(frames) == 13
    assert {f.camera.k1 for f in frames} == {0.0024595805674985862, -0.00081833161437641329}
    ids = [line.split() for line in (folder / "sparse/images.txt").read_text().splitlines() if line.endswith(".jpg")]
    number = {words[9]: int(words[0]) for words in ids}
    grey, tracks, points = [], [], []
    for line in (folder / "sparse/points3D.txt").read_text().splitlines():
        if not line.startswith("#"):
            words = line.split()
            points.append([float(v) for v in words[1:4]])
            grey.append(np.mean([float(v) for v in words[4:7]]) / 255.0)
            tracks.append({int(v) for v in words[8::2]})
    for frame in frames[::4]:
        name = frame.path.relative_to(folder / "images").as_posix()
        seen = np.array([number[name] in track for track in tracks])
        pixels, depth = frame.camera.project(np.array(points)[seen])
        size = [frame.camera.width, frame.camera.height]
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < size).all()
        image = frame.image().mean(axis=2)
        x, y = pixels.astype(int).T

        def likeness(
            dx: int, image: np.ndarray = image, x: np.ndarray = x, y: np.ndarray = y, s: object = seen
        ) -> float:
            column = np.clip(x + dx, 0, image.shape[1] - 1)
            return float(np.corrcoef(image[y, column], np.array(grey)[s])[0, 1])

        assert likeness(0) > 0.85
        assert likeness(0) > max(likeness(4), likeness(-4)) + 0.1, "four pixels off, the colours no longer fit"


def test_colmap_without_lines_of_points(poses: list[tuple], tmp_path: Path) -> None:
    """All images are read, whether each one's points have a line, an empty line or none; some names are awkward."""
    (tmp_path / "images" / "1 2 3.png").symlink_to(tmp_path / "images" / "a.png")
    (tmp_path / "images" / "4.png").symlink_to(tmp_path / "images" / "a.png")
    poses = [*poses, (*poses[0][:2], "1 2 3.png"), (*poses[1][:2], "4.png")]
    colmap_text(tmp_path, "PINHOLE", MODELS[1][2], poses)
    whole = read_colmap(tmp_path, tmp_path / "images")
    assert [f.path.name for f in whole] == ["1 2 3.png", "4.png", "a.png", "c.png", "b 2.png"]
    lines = (tmp_path / "images.txt").read_text().splitlines()
    bare = [line for line in lines if line.startswith("#") or line.endswith(".png")]
    for kept in (bare, lines[:3] + lines[4:], [*bare[:4], "1.0 2.0 -1", *bare[4:]]):
        (tmp_path / "images.txt").write_text("\n".join(kept))
        frames = read_colmap(tmp_path, tmp_path / "images")
        assert [f.path for f in frames] == [f.path for f in whole]
        for frame, same in zip(frames, whole, strict=True):
            np.testing.assert_array_equal(frame.camera.camera_to_world, same.camera.camera_to_world)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_a_colmap_camera_that_no_image_uses_may_be_of_any_model(
    binary: bool, poses: list[tuple], tmp_path: Path
) -> None:
    if binary:
        colmap_binary(tmp_path, 1, MODELS[1][2], poses)
        raw = (tmp_path / "cameras.bin").read_bytes()
        other = struct.pack("<IiQQ12d", 3, 6, 32, 24, *(1.0,) * 12)
        (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 2) + other + raw[8:])
    else:
        colmap_text(tmp_path, "PINHOLE", MODELS[1][2], poses)
        text = (tmp_path / "cameras.txt").read_text()
        (tmp_path / "cameras.txt").write_text("3 FULL_OPENCV 32 24" + " 1.0" * 12 + "\n" + text)
    assert {f.camera.fy for f in read_colmap(tmp_path, tmp_path / "images")} == {51.0}


@pytest.mark.parametrize(
    ("gives", "fx", "fy", "cx", "k1"),
    [
        ({"camera_angle_x": 0.6911112070083618}, 1111.1110311937682, 1111.1110311937682, 400.0, 0.0),
        ({"camera_angle_x": 0.6911112070083618, "camera_angle_y": 0.6}, 1111.1110311937682, 969.818, 400.0, 0.0),
        ({"fl_x": 900.0, "cx": 390.0, "k1": 0.1}, 900.0, 900.0, 390.0, 0.1),
        ({"camera_angle_x": 0.6911112, "fl_x": 1111.1, "fl_y": 1100.0, "cx": 1.0}, 1111.1, 1100.0, 1.0, 0.0),
    ],
)
def test_what_blender_files_say_of_the_lens(
    gives: dict, fx: float, fy: float, cx: float, k1: float, tmp_path: Path
) -> None:
    """Nothing of it is left out: 800 x 600 pixels, so that half of 600 by tan 0.3 are 969.8."""
    Image.effect_noise((800, 600), 60).save(tmp_path / "a.png")
    entry = {"file_path": "./a", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({**gives, "frames": [entry]}))
    (frame,) = read_blender(tmp_path / "t.json")
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.k1) == pytest.approx((fx, fy, cx, k1), abs=1e-3)
    assert camera.cy == 300.0 and camera.has_distortion == (k1 != 0.0)


def test_blender_files(tmp_path: Path) -> None:
    """NeRF-synthetic's own numbers: 800 pixels and camera_angle_x 0.6911 make a focal length of 1111.1."""
    (tmp_path / "train").mkdir()
    pixels = np.zeros((800, 800, 4), dtype=np.uint8)
    pixels[100:200, :, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "train" / "r_0.png")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("x", 60, degrees=True).as_matrix()
    matrix[:3, 3] = [0, -3.5, 2.0]
    data = {
        "camera_angle_x": 0.6911112070083618,
        "frames": [{"file_path": "./train/r_0", "rotation": 0.0126, "transform_matrix": matrix.tolist()}],
    }
    file = tmp_path / "transforms_train.json"
    file.write_text(json.dumps(data))
    (frame,) = read_blender(file)
    assert frame.camera.fx == pytest.approx(1111.1110311937682)
    assert (frame.camera.fy, frame.camera.cx, frame.camera.cy) == (frame.camera.fx, 400.0, 400.0)
    np.testing.assert_allclose(frame.camera.project([[0, 0, 0]])[0][0, 0], 400.0)
    mask = frame.mask()
    assert mask is not None and mask[150].all() and not mask[250].any()


def test_faulty_imports_are_named(poses: list[tuple], tmp_path: Path) -> None:
    def complaint(field: str | None = None) -> str:
        with pytest.raises(MeasurementError) as caught:
            read_colmap(tmp_path, tmp_path / "images")
        if field is not None:
            assert caught.value.field == field
        return str(caught.value)

    assert "cameras.txt: no such file" in complaint()
    colmap_text(tmp_path, "FULL_OPENCV", (50.0,) * 12, poses)
    assert "FULL_OPENCV" in complaint("camera 7, MODEL")
    colmap_text(tmp_path, "PINHOLE", (50.0, 50.0), poses)
    assert "4 finite parameters" in complaint("PARAMS")
    colmap_text(tmp_path, "PINHOLE", MODELS[1][2], [((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "a.png")])
    assert "no rigid motion" in complaint("a.png")
    colmap_text(tmp_path, "PINHOLE", MODELS[1][2], [((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "../cameras.txt")])
    assert "leaves" in complaint("NAME")
    colmap_text(tmp_path, "PINHOLE", MODELS[1][2], [])
    assert "no registered image" in complaint()
    (tmp_path / "images.txt").write_text("1 1 0 0\n\n")
    assert "expected IMAGE_ID" in complaint()
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 nan a.png\n\n")
    assert "whole numbers, found 'nan'" in complaint("a.png")
    (tmp_path / "cameras.txt").write_text("7 PINHOLE inf 24 50 50 16 12\n")
    assert "whole numbers, found '7 inf 24'" in complaint()
    colmap_binary(tmp_path, 1, MODELS[1][2], poses)
    raw = (tmp_path / "images.bin").read_bytes()
    for length in (4, 40, len(raw) - 3):
        (tmp_path / "images.bin").write_bytes(raw[:length])
        assert "truncated" in complaint(f"byte {length}")
    colmap_binary(tmp_path, 6, (50.0,) * 12, poses)
    assert "FULL_OPENCV" in complaint("camera 7, MODEL")
    colmap_binary(tmp_path, 77, (50.0,) * 12, poses)
    assert "unknown model 77" in complaint("camera 7, MODEL")

    file = tmp_path / "transforms_train.json"
    sized = {"file_path": "images/a", "transform_matrix": np.eye(4).tolist()}
    for data, says in (
        ({"frames": []}, "camera_angle_x: missing"),
        ({"camera_angle_x": 40.0, "frames": [{"file_path": "images/a"}]}, "radians"),
        ({"camera_angle_x": 0.7, "frames": [{"file_path": "x"}]}, "no such image"),
        ({"camera_angle_x": 0.7, "fl_x": 30.0, "frames": [{"file_path": "images/a"}]}, "contradict camera_angle_x"),
        ({"camera_angle_x": 0.7, "w": 64, "frames": [sized]}, "32 x 24 pixels where w and h"),
        ({"camera_angle_x": 0.7, "frames": [{"file_path": "images/a", "transform_matrix": [[2.0] * 4] * 4}]}, "rigid"),
    ):
        file.write_text(json.dumps(data))
        with pytest.raises(MeasurementError, match=says):
            read_blender(file)
