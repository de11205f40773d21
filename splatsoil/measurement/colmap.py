"""Import of COLMAP's sparse models, text or binary.

The formats are those of COLMAP's documentation (https://colmap.github.io/format.html) and of its
src/colmap/sensor/models.h: world to camera, OpenCV axes, Hamilton quaternions wxyz. A model's scale and orientation are
arbitrary unless it was geo-registered; ``similarity`` brings it into metres with z up.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.measurement.camera import LENSES, Camera
from splatsoil.measurement.fields import inside, read_text
from splatsoil.measurement.frames import Frame
from splatsoil.measurement.images import check_image

Number = TypeVar("Number", int, float)

# COLMAP's models by number, and how many parameters each has: what is not read is skipped where no image uses it.
_MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8)),
    *(("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)

_Calibration = tuple[str, int, int, tuple[float, ...]]  # model, width, height, parameters
_Pose = tuple[int, str, FloatArray, FloatArray]  # camera id, image name, quaternion (4,), translation (3,)


def read_colmap(model: str | Path, images: str | Path, *, similarity: npt.ArrayLike | None = None) -> tuple[Frame, ...]:
    """Frames of a COLMAP sparse model, ordered by image name.

    Args:
        model: folder with cameras and images, ``.bin`` or ``.txt`` (``sparse/0``).
        images: folder that the image names are relative to.
        similarity: (4, 4) matrix (uniform scale, rotation, translation) from the model's world to metres with z up.

    Raises:
        MeasurementError: naming file and field.
    """
    folder, root = Path(model), Path(images)
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    cameras, source = (folder / f"{name}.{'bin' if binary else 'txt'}" for name in ("cameras", "images"))
    calibrations = _read_cameras_bin(cameras) if binary else _read_cameras_txt(cameras)
    poses = _read_images_bin(source) if binary else _read_images_txt(source)
    if not poses:
        raise MeasurementError("the model has no registered image", file=source)
    frames = []
    for camera_id, name, quaternion, translation in sorted(poses, key=lambda pose: pose[1]):
        if camera_id not in calibrations:
            raise MeasurementError(f"camera {camera_id} is not among the model's cameras", file=source, field=name)
        path = inside(name, root, root, source, "NAME")
        pose = _camera_to_world(quaternion, translation, source, name)
        camera = _camera(calibrations[camera_id], pose, cameras, camera_id)
        if similarity is not None:
            camera = camera.moved(np.asarray(similarity, dtype=np.float64))
        check_image(path, (camera.width, camera.height), sizes_from=f"WIDTH and HEIGHT of camera {camera_id}")
        frames.append(Frame(camera, path))
    return tuple(frames)


def _camera(calibration: _Calibration, pose: FloatArray, file: Path, identity: int) -> Camera:
    name, width, height, values = calibration
    if name not in LENSES:
        raise MeasurementError(
            f"camera model {name!r} cannot be imported, only {', '.join(LENSES)}; undistort with COLMAP first",
            file=file,
            field=f"camera {identity}, MODEL",
        )
    model, keys = LENSES[name]
    if len(values) != len(keys) or not np.isfinite(values).all():
        raise MeasurementError(f"{name} has {len(keys)} finite parameters, not {values}", file=file, field="PARAMS")
    given: dict[str, Any] = dict(zip(keys, values, strict=True))
    if "f" in given:
        given["fx"] = given["fy"] = given.pop("f")
    return Camera(width=width, height=height, camera_to_world=pose, **given, model=model)


def _camera_to_world(quaternion: FloatArray, translation: FloatArray, file: Path, name: str) -> FloatArray:
    norm = float(np.linalg.norm(quaternion))
    if not np.isfinite(translation).all() or not 0.5 < norm < 2.0:
        raise MeasurementError("the pose is no rigid motion", file=file, field=name)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    out = np.eye(4)
    out[:3, :3] = rotation.T @ np.diag([1.0, -1.0, -1.0])  # OpenCV to OpenGL camera axes
    out[:3, 3] = -rotation.T @ translation
    return out


def _lines(file: Path) -> list[str]:
    return [line.strip() for line in read_text(file).splitlines() if not line.startswith("#")]


def _numbers(words: Sequence[str], file: Path, field: str, kind: Callable[[str], Number]) -> tuple[Number, ...]:
    try:
        return tuple(kind(word) for word in words)
    except ValueError as error:
        what = f"expected {'whole ' if kind is int else ''}numbers, found {' '.join(words)[:60]!r}"
        raise MeasurementError(what, file=file, field=field) from error


def _read_cameras_txt(file: Path) -> dict[int, _Calibration]:
    out: dict[int, _Calibration] = {}
    for line in filter(None, _lines(file)):
        words = line.split()
        if len(words) < 5:
            raise MeasurementError("expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", file=file, field=line[:40])
        identity, width, height = _numbers([words[0], *words[2:4]], file, line[:40], int)
        out[identity] = words[1], width, height, _numbers(words[4:], file, f"camera {identity}, PARAMS", float)
    return out


def _read_images_txt(file: Path) -> list[_Pose]:
    out: list[_Pose] = []
    for line in filter(None, _lines(file)):
        words = line.split(maxsplit=9)
        # The line of 2-D points after an image's own may be empty, or left out: it is known by what it holds.
        if _are_points(line.split()):
            continue
        if len(words) != 10:
            raise MeasurementError(
                "expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", file=file, field=line[:40]
            )
        values, (camera,) = (
            np.array(_numbers(words[1:8], file, words[9], float)),
            _numbers(words[8:9], file, words[9], int),
        )
        out.append((camera, words[9], values[:4], values[4:]))
    return out


def _are_points(words: list[str]) -> bool:
    """Whether a line is one of 2-D points: triples of numbers, where an image's line ends in the name of a file."""
    try:
        return len(words) % 3 == 0 and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


class _Bytes:
    """Little-endian values from a binary file, with MeasurementError at its end."""

    def __init__(self, file: Path) -> None:
        self.file, self.data, self.at = file, file.read_bytes(), 0

    def skip(self, count: int) -> int:
        """Move on by so many bytes; returns the position before."""
        if self.at + count > len(self.data):
            raise MeasurementError("the file is truncated", file=self.file, field=f"byte {len(self.data)}")
        self.at += count
        return self.at - count

    def take(self, form: str) -> tuple[float, ...]:
        return struct.unpack_from("<" + form, self.data, self.skip(struct.calcsize("<" + form)))

    def word(self) -> str:
        end = self.data.find(b"\0", self.at)
        begin = self.skip(end + 1 - self.at if end >= 0 else len(self.data) + 1)
        try:
            return self.data[begin:end].decode()
        except UnicodeDecodeError as error:
            raise MeasurementError("not a COLMAP file", file=self.file, field=f"byte {begin}") from error


def _read_cameras_bin(file: Path) -> dict[int, _Calibration]:
    data = _Bytes(file)
    out: dict[int, _Calibration] = {}
    for _ in range(int(data.take("Q")[0])):
        identity, number, width, height = (int(v) for v in data.take("IiQQ"))
        if not 0 <= number < len(_MODELS):
            raise MeasurementError(f"unknown model {number}", file=file, field=f"camera {identity}, MODEL")
        model, count = _MODELS[number]
        out[identity] = model, width, height, data.take(f"{count}d")
    return out


def _read_images_bin(file: Path) -> list[_Pose]:
    data = _Bytes(file)
    out: list[_Pose] = []
    for _ in range(int(data.take("Q")[0])):
        values = data.take("I7dI")
        name = data.word()
        data.skip(24 * int(data.take("Q")[0]))  # x, y, POINT3D_ID of each 2-D point
        out.append((int(values[8]), name, np.array(values[1:5]), np.array(values[5:8])))
    return out
