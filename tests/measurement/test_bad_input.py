"""Each way a measurement set can be wrong: one clear error that names file and field, exit code 2, nothing written."""

from __future__ import annotations

import json
import math
import shutil
import struct
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from splatsoil.cli import main
from splatsoil.errors import MeasurementError
from splatsoil.measurement import Measurement, remarks

Spoil = Callable[[Path], object]
VIEWS, VIDEO, SET = "views/transforms.json", "video/transforms.json", "experiment.json"
MESH, MOTION, FORCE = "tool.stl", "tool_motion.csv", "tool_force.csv"
ONE, TWO = "views/images/001.jpg", "views/images/002.jpg"


def in_json(file: str, change: Callable[[Any], object]) -> Spoil:
    """Change what a JSON file holds."""

    def spoil(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        change(data)
        (folder / file).write_text(json.dumps(data))

    return spoil


def inside(data: Any, keys: tuple[str | int, ...]) -> Any:
    for key in keys[:-1]:
        data = data[key]
    return data


def edit(file: str, *keys: str | int, to: Any) -> Spoil:
    """Set a value inside a JSON file."""
    return in_json(file, lambda data: inside(data, keys).__setitem__(keys[-1], to))


def view(number: int, key: str, value: Any) -> Spoil:
    return edit(VIEWS, "frames", number, key, to=value)


def shot(number: int, key: str, value: Any) -> Spoil:
    return edit(VIDEO, "frames", number, key, to=value)


def drop(file: str, *keys: str | int) -> Spoil:
    return in_json(file, lambda data: inside(data, keys).pop(keys[-1]))


def renamed(file: str, key: str, to: str) -> Spoil:
    return in_json(file, lambda data: data.update({to: data.pop(key)}))


def of_frames(file: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Spoil:
    """Other values in each frame of a transforms.json."""
    return in_json(file, lambda data: [frame.update(change(frame)) for frame in data["frames"]])


def millimetres(frame: dict[str, Any]) -> dict[str, Any]:
    pose = np.array(frame["transform_matrix"])
    pose[:3, 3] *= 1000.0
    return {"transform_matrix": pose.tolist()}


def opencv_axes(frame: dict[str, Any]) -> dict[str, Any]:
    """By mistake: y and z of the camera turned round."""
    return {"transform_matrix": (np.array(frame["transform_matrix"]) * [1, -1, -1, 1]).tolist()}


def replace(file: str, content: str | bytes) -> Spoil:
    """Replace a file's content."""
    return lambda folder: (folder / file).write_bytes(content.encode() if isinstance(content, str) else content)


def gone(file: str) -> Spoil:
    return lambda folder: (folder / file).unlink()


def truncate(file: str, keep: float) -> Spoil:
    """Cut a file off after a fraction of its bytes."""
    return lambda folder: (folder / file).write_bytes((raw := (folder / file).read_bytes())[: int(keep * len(raw))])


def cell(row: int, column: int, value: str) -> Spoil:
    """Replace a cell of the motion; row 0 is the header."""

    def spoil(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / MOTION).read_text().splitlines()]
        rows[row][column] = value
        (folder / MOTION).write_text("\n".join(",".join(r) for r in rows))

    return spoil


def cells(old: str, mark: str, *changes: tuple[int, int, str]) -> Spoil:
    """Another mark between the motion's cells, and other cells, by row and column."""

    def spoil(folder: Path) -> None:
        rows = [line.split(old) for line in (folder / MOTION).read_text().splitlines()]
        for row, column, value in changes:
            rows[row][column] = value
        (folder / MOTION).write_text("\n".join(mark.join(row) for row in rows))

    return spoil


def numbers(change: Callable[[np.ndarray], np.ndarray], name: str = MOTION) -> Spoil:
    """Change the numbers of a CSV file as a whole."""

    def spoil(folder: Path) -> None:
        file = folder / name
        head, *rows = file.read_text().splitlines()
        table = change(np.array([[float(v) for v in row.split(",")] for row in rows]))
        file.write_text("\n".join([head, *(",".join(f"{v:.12g}" for v in row) for row in table)]))

    return spoil


def times(factor: float, shift: float = 0.0) -> Spoil:
    """Another clock for the tool's motion."""
    return numbers(lambda t: np.column_stack([t[:, 0], factor * t[:, 1] + shift, t[:, 2:]]))


def video_times(factor: float, shift: float = 0.0) -> Spoil:
    return of_frames(VIDEO, lambda frame: {"time": factor * frame["time"] + shift})


def both(*faults: Spoil) -> Spoil:
    return lambda folder: [fault(folder) for fault in faults]


def outside(name: str) -> Spoil:
    """A good image outside of the folder, reached by ``name``."""

    def spoil(folder: Path) -> None:
        target = folder.parent / "stranger.jpg"
        target.write_bytes((folder / ONE).read_bytes())
        if name == "link":
            (folder / "views/images/link.jpg").symlink_to(target)
        image_path({"absolute": str(target), "link": "images/link.jpg"}[name])(folder)

    return spoil


def image_path(name: object) -> Spoil:
    """Another path for the second view."""
    return view(1, "file_path", name)


def photograph(image: Image.Image, name: str = "002.png", **options: Any) -> Spoil:
    """Another image, of another type perhaps, for the third view."""
    return both(
        lambda folder: image.save(folder / "views/images" / name, **options),
        view(2, "file_path", f"images/{name}"),
    )


def even(level: int, noise: float = 0.0) -> Image.Image:
    """One grey throughout but for a sensor's noise."""
    values = level + noise * np.random.default_rng(0).normal(size=(240, 320, 3))
    return Image.fromarray(np.clip(values.round(), 0, 255).astype(np.uint8))


RAMP = Image.fromarray(np.linspace(0.0, 255.0, 240 * 320, dtype=np.float32).reshape(240, 320))
NOISE = Image.effect_noise((320, 240), 60)
TRANSPARENT = NOISE.convert("RGBA")
TRANSPARENT.putalpha(3)
FLOAT_COLOURS = (
    b"II*\0\x08\0\0\0\x09\0"
    + b"".join(
        struct.pack("<HHII", tag, kind, 1, value)
        for tag, kind, value in [
            *((256, 3, 2), (257, 3, 2), (258, 3, 32), (259, 3, 1), (262, 3, 2), (273, 4, 122), (277, 3, 3)),
            *((279, 4, 48), (339, 3, 3)),
        ]
    )
    + bytes(52)
)
"""A TIFF of 2 x 2 pixels with three colours of 32 bits, which Pillow doesn't read."""
TURNED = Image.Exif()
TURNED[0x0112] = 6


def mask(values: np.ndarray, *where: str | int) -> Spoil:
    """A mask for the second view, or for all."""
    return both(
        lambda folder: Image.fromarray(values.astype(np.uint8)).save(folder / "views/mask.png"),
        edit(VIEWS, *(where or ("frames", 1, "mask_path")), to="mask.png"),
    )


def depth(name: str, values: np.ndarray) -> Spoil:
    """Depth of the second view."""

    def save(folder: Path) -> None:
        if name.endswith(".npy"):
            np.save(folder / "views" / name, values)
        else:
            Image.fromarray(values).save(folder / "views" / name)

    return both(save, view(1, "depth_file_path", name))


def duplicated(data: dict[str, Any]) -> None:
    """Of the video's frames the third has the first one's number, and an image of its own."""
    data["frames"][2] |= {key: data["frames"][0][key] for key in ("camera", "frame", "time")}


def mesh(made: trimesh.Trimesh) -> Spoil:
    """Another mesh for the tool."""
    return lambda folder: made.export(folder / MESH)


BOX = trimesh.creation.box((0.01, 0.1, 0.1))


def tool_scaled(factor: float) -> Spoil:
    """The tool's mesh in another unit, about its middle."""
    return lambda folder: trimesh.load_mesh(folder / MESH).apply_scale(factor).export(folder / MESH)


LAST = "time, frame 40"
UNIX = 1.7e9
HEADER = "frame,time,x,y,z,qw,qx,qy,qz\n"
POSES = "frames[0].transform_matrix"
ROUND = np.where(np.arange(240)[:, None] == 0, 255, np.zeros((240, 320)))
"""A mask the wrong way round: it keeps what isn't soil, here the uppermost line."""
FIRST = "frames[1].file_path"
SECOND = "frames[2].file_path"
DEPTH = "frames[1].depth_file_path"
LEAVES = "leaves the measurement set"
MATRIX = "frames[1].transform_matrix"
POSE = ("frames", 1, "transform_matrix")
DOUBLED = [[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 1], [0, 0, 0, 1]]
MIRROR = [[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
SHEARED = [[1.0, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
PROJECTIVE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]

CASES: dict[str, tuple[Spoil, str, str | None, str]] = {
    # images
    "image-missing": (gone(ONE), ONE, FIRST, "no such file"),
    "image-truncated": (truncate(ONE, 0.6), ONE, FIRST, "truncated"),
    "image-empty": (replace(ONE, b""), ONE, FIRST, "not an image"),
    "image-of-another-size": (photograph(even(9).crop((1, 0, 320, 240)), "002.jpg"), TWO, SECOND, "319 x 240"),
    "image-is-png-named-jpg": (lambda f: NOISE.save(f / TWO, format="PNG"), TWO, SECOND, "PNG"),
    "image-is-a-folder": (image_path("images"), VIEWS, FIRST, "not a file"),
    "image-listed-twice": (image_path("images/000.jpg"), VIEWS, FIRST, "twice"),
    "image-copied": (lambda f: shutil.copy(f / "views/images/000.jpg", f / ONE), VIEWS, FIRST,
        "the same as that of frames[0]"),
    "mask-of-another-size": (mask(np.zeros((4, 3))), "views/mask.png", "frames[1].mask_path", "3 x 4"),
    "image-turned-by-exif": (photograph(NOISE.transpose(Image.Transpose.ROTATE_90), "002.jpg", exif=TURNED), TWO,
        SECOND, "EXIF"),
    "image-black": (photograph(even(0), "b.jpg"), "views/images/b.jpg", SECOND, "one even grey, 0 of 255"),
    "image-grey": (photograph(even(127, 3.0)), "views/images/002.png", SECOND, "one even grey, 127"),
    "image-of-floats-to-255": (photograph(RAMP, "f.tif"), "views/images/f.tif", SECOND, "lie in [0, 1]"),
    "image-transparent": (photograph(TRANSPARENT), "views/images/002.png", SECOND, "masked or transparent"),
    "image-heic": (both(replace("views/images/a.heic", b"ftypheic"), view(2, "file_path", "images/a.heic")),
        "views/images/a.heic", SECOND, "convert it to JPEG or PNG"),
    "mask-black": (mask(np.zeros((240, 320))), "views/mask.png", "frames[1].mask_path", "masked or transparent"),
    "masks-the-wrong-way-round": (mask(ROUND, "mask_path"), VIEWS, POSES, "masks are black"),
    "depth-of-8-bits": (depth("d.png", np.full((240, 320), 150, np.uint8)), "views/d.png", DEPTH, "8 bits"),
    "depth-float-millimetres": (depth("d.npy", np.full((240, 320), 900.0)), "views/d.npy", DEPTH, "metres"),
    "depth-whole-metres": (depth("d.npy", np.full((240, 320), 1)), "views/d.npy", DEPTH, "millimetres"),
    "depth-unknown": (depth("d.npy", np.full((240, 320), math.nan)), "views/d.npy", DEPTH, "no depth is known"),
    "depth-of-another-size": (depth("d.npy", np.ones((320, 240))), "views/d.npy", DEPTH, "(240, 320)"),
    "depth-of-a-tenth-of-a-millimetre": (depth("d.png", np.full((240, 320), 9000, np.uint16)), "views/d.png", DEPTH,
        "one of the bed"),
    "depth-scale-not-in-metres": (both(depth("d.png", np.full((240, 320), 900, np.uint16)),
        view(1, "integer_depth_scale", 1000.0)), VIEWS, "frames[1].integer_depth_scale", "it is in metres"),
    "depth-of-no-type": (both(replace("views/d.exr", b"v/1\x01"), view(1, "depth_file_path", "d.exr")), "views/d.exr",
        DEPTH, "save a .npy or a TIFF"),
    "mask-of-floats": (both(lambda f: RAMP.save(f / "views/m.tif"), view(1, "mask_path", "m.tif")), "views/m.tif",
        "frames[1].mask_path", "lie in [0, 1]"),
    "image-of-floating-colours": (both(replace("views/images/c.tif", FLOAT_COLOURS), view(2, "file_path",
        "images/c.tif")), "views/images/c.tif", SECOND, "floating-point colours"),
    "view-of-the-moving-tool": (edit(SET, "views", to=VIDEO), VIDEO, "frames[6].file_path",
        "it is frame 10 of the video"),
    # paths
    "path-absolute": (outside("absolute"), VIEWS, FIRST, LEAVES),
    "path-through-link": (outside("link"), VIEWS, FIRST, LEAVES),
    "path-of-mesh-leaves": (edit(SET, "tool", "mesh", to="../tool.stl"), SET, "tool.mesh", LEAVES),
    "path-endless": (image_path("a" * 5000), VIEWS, FIRST, "no usable path"),
    "path-is-a-number": (image_path(7), VIEWS, FIRST, "expected text"),
    "path-with-backslashes-leaves": (image_path("..\\..\\..\\x.jpg"), VIEWS, FIRST, LEAVES),
    "path-without-suffix-of-two": (both(photograph(even(9), "001.png"), image_path("./images/001")), VIEWS, FIRST,
        "001.jpg, 001.png"),
    # matrices
    "matrix-scales": (edit(VIEWS, *POSE, to=DOUBLED), VIEWS, MATRIX, "it scales by 2"),
    "matrix-mirrors": (edit(VIEWS, *POSE, to=MIRROR), VIEWS, MATRIX, "mirrors"),
    "matrix-shears": (edit(VIEWS, *POSE, to=SHEARED), VIEWS, MATRIX, "not a rotation"),
    "matrix-last-row": (edit(VIEWS, *POSE, to=PROJECTIVE), VIEWS, MATRIX, "last row"),
    "matrix-3x4": (edit(VIEWS, *POSE, to=MIRROR[:3]), VIEWS, MATRIX, "4 x 4"),
    "matrix-nan": (edit(VIEWS, *POSE, 2, 3, to=math.nan), VIEWS, MATRIX + "[2][3]", "not a finite number"),
    "matrix-missing": (drop(VIEWS, *POSE), VIEWS, MATRIX, "missing"),
    "matrices-in-opencv-axes": (of_frames(VIEWS, opencv_axes), VIEWS, POSES, "no camera looks at"),
    # cameras
    "camera-model-unknown": (edit(VIEWS, "camera_model", to="EQUIRECTANGULAR"), VIEWS, "camera_model",
        "EQUIRECTANGULAR"),
    "pinhole-with-distortion": (both(edit(VIEWS, "camera_model", to="PINHOLE"), edit(VIEWS, "k1", to=0.1)), VIEWS,
        "k1", "OPENCV"),
    "focal-length-of-a-frame-negative": (view(2, "fl_x", -300.0), VIEWS, "frames[2].fl_x", "outside"),
    "focal-length-in-metres": (edit(VIEWS, "fl_x", to=0.035), VIEWS, "fl_x", "pixels"),
    "principal-point-missing": (drop(VIEWS, "cx"), VIEWS, "frames[0].cx", "missing"),
    "width-not-whole": (edit(VIEWS, "w", to=320.5), VIEWS, "w", "whole number"),
    "views-without-frames": (edit(VIEWS, "frames", to=[]), VIEWS, "frames", "empty"),
    "views-frames-not-a-list": (edit(VIEWS, "frames", to={"a": 1}), VIEWS, "frames", "expected a list"),
    "cameras-in-millimetres": (of_frames(VIEWS, millimetres), VIEWS, POSES, "positions are in metres"),
    "distortion-by-a-list": (edit(VIEWS, "distortion", to=[0.1, 0.0]), VIEWS, "distortion", "has no distortion"),
    "distortion-by-opencvs-name": (view(1, "dist_coeffs", [[0.1, 0.0]]), VIEWS, "frames[1].dist_coeffs", "undistort"),
    "affinity-by-metashape": (edit(VIEWS, "b1", to=1.5), VIEWS, "b1", "undistort"),
    "lens-of-instant-ngp": (edit(VIEWS, "ftheta_p1", to=1e-3), VIEWS, "ftheta_p1", "undistort"),
    "panorama": (edit(VIEWS, "equirectangular", to=True), VIEWS, "equirectangular", "undistort"),
    "rolling-shutter": (edit(VIEWS, "rolling_shutter", to=[0, 0, 0.03, 0]), VIEWS, "rolling_shutter", "has no"),
    "fisheye-cropped": (both(edit(VIEWS, "camera_model", to="OPENCV_FISHEYE"), edit(VIEWS, "fisheye_crop_radius",
        to=100)), VIEWS, "fisheye_crop_radius", "has no"),
    # video
    "video-frame-twice": (in_json(VIDEO, duplicated), VIDEO, "frames[2].frame", "given twice"),
    "video-time-backwards": (shot(6, "time", -5.0), VIDEO, "frames[6].time", "runs backwards"),
    "video-without-camera": (drop(VIDEO, "frames", 0, "camera"), VIDEO, "frames[0].camera", "missing"),
    "video-camera-with-dots": (shot(0, "camera", "../left"), VIDEO, "frames[0].camera", "names files"),
    "video-camera-moves": (edit(VIDEO, "frames", 6, "transform_matrix", 0, 3, to=-0.2), VIDEO,
        "frames[6].transform_matrix", "moves"),
    "video-camera-zooms": (shot(6, "fl_x", 350.0), VIDEO, "frames[6]", "another calibration"),
    # experiment.json
    "set-missing": (gone(SET), SET, None, "no experiment.json"),
    "set-not-json": (replace(SET, "format: splatsoil"), SET, None, "not JSON"),
    "set-with-a-comment": (replace(SET, '{\n "name": "a", // mine\n "up": "z"}'), SET, None,
        "comments, but there is one in line 2, column 15"),
    "set-with-a-trailing-comma": (replace(SET, '{"name": "a",\n "up": "z",\n}'), SET, None, "omma"),
    "set-with-a-key-twice": (replace(SET, '{"bed": {"density": 1, "density": 2}}'), SET, None,
        "'density' is given twice"),
    "key-misspelt": (renamed(SET, "gravity", to="gravty"), SET, "gravty", "did you mean 'gravity'?"),
    "key-with-a-hyphen": (renamed(SET, "frame_rate", to="frame-rate"), SET, "frame-rate", "'frame_rate'?"),
    "key-misspelt-of-a-frame": (view(1, "mask_pth", "m.png"), VIEWS, "frames[1].mask_pth", "'mask_path'?"),
    "set-is-binary": (replace(SET, b"\x89PNG\xff\xfe"), SET, None, "not a text file"),
    "set-is-a-list": (replace(SET, "[1, 2]"), SET, None, "expected a JSON object"),
    "set-nested-endlessly": (replace(SET, "[" * 100_000), SET, None, "not usable JSON"),
    "format-of-another-version": (edit(SET, "format", to="splatsoil-measurement/2"), SET, "format", "another version"),
    "up-is-y": (edit(SET, "up", to="y"), SET, "up", "z"),
    "bed-800-m-long": (edit(SET, "bed", "upper", 0, to=800.0), SET, "bed.upper[0]", "800 m along x"),
    "bed-upside-down": (edit(SET, "bed", "upper", 2, to=-1.0), SET, "bed.upper[2]", "not above"),
    "bed-with-two-numbers": (edit(SET, "bed", "lower", to=[0, 0]), SET, "bed.lower", "list of 3"),
    "bed-huge-number": (edit(SET, "bed", "density", to=10**400), SET, "bed.density", "not a finite number"),
    "density-in-g-per-cm3": (edit(SET, "bed", "density", to=1.6), SET, "bed.density", "kg/m³"),
    "gravity-upwards": (edit(SET, "gravity", to=[0, 0, 9.81]), SET, "gravity", "does not point down"),
    "gravity-in-mm": (edit(SET, "gravity", to=[0, 0, -9810.0]), SET, "gravity", "m/s²"),
    "frame-rate-zero": (edit(SET, "frame_rate", to=0), SET, "frame_rate", "outside"),
    "friction-is-an-angle": (edit(SET, "tool", "friction", to=17.0), SET, "tool.friction", "not an angle"),
    "container-unknown": (edit(SET, "bed", "container", to="glas"), SET, "bed.container",
        "'glas' is unknown; known are bin, transparent, open, heap"),
    "name-of-two-lines": (edit(SET, "name", to="a\nb"), SET, "name", "unprintable"),
    "name-endless": (edit(SET, "name", to="a" * 300), SET, "name", "at most 60"),
    "give": (edit(SET, "tool", "give", to=0.0), SET, "tool.give", "remove this field"),
    "video-file-missing": (gone(VIDEO), VIDEO, "video", "no such file"),
    # the tool's mesh
    "mesh-missing": (gone(MESH), MESH, "tool.mesh", "no such file"),
    "mesh-without-volume": (mesh(trimesh.Trimesh(0.1 * np.eye(3), [[0, 1, 2]])), MESH, "faces", "no volume"),
    "mesh-open": (mesh(trimesh.Trimesh(BOX.vertices, BOX.faces[2:])), MESH, "faces", "holes"),
    "mesh-in-millimetres": (mesh(BOX.copy().apply_scale(1200.0)), MESH, "vertices", "metres"),
    "mesh-is-text": (replace(MESH, "this is no mesh"), MESH, None, "what its name says"),
    "mesh-of-no-known-type": (both(lambda f: (f / MESH).rename(f / "tool.dat"), edit(SET, "tool", "mesh",
        to="tool.dat")), "tool.dat", None, "what its name says"),
    # the tool's motion and force
    "motion-missing": (gone(MOTION), MOTION, "tool.motion", "no such file"),
    "motion-header": (cell(0, 5, "qx"), MOTION, "line 1", "expected the header"),
    "motion-in-other-units-by-its-header": (cell(0, 2, "x [mm]"), MOTION, "line 1", "; x must be there"),
    "motion-with-decimal-commas-and-no-other-mark": (replace(MOTION, HEADER + "0,0,0,2,0,25,0,21,1,0,0,0\n"), MOTION,
        "line 2", "12 values where the header has 9"),
    "motion-with-thousands": (replace(MOTION, "frame;time;x;y;z;qw;qx;qy;qz\n0;0;1.000,2;0;0;1;0;0;0\n"), MOTION,
        "line 2", "decimal points and commas"),
    "motion-with-thousands-of-one-number": (cells(",", "\t", (9, 2, "1,234")), MOTION, "line 10",
        "decimal points and commas"),
    "motion-beyond-single-precision": (cell(10, 3, "1e39"), MOTION, "y, line 11", "single precision"),
    "motion-without-rows": (replace(MOTION, HEADER), MOTION, None, "no rows"),
    "motion-of-one-row": (replace(MOTION, HEADER + "0,0,0.2,0.25,0.21,1,0,0,0\n"), MOTION, None, "two rows at least"),
    "motion-time-backwards": (cell(10, 1, "0.1"), MOTION, "time, row 10", "runs backwards"),
    "motion-frame-twice": (cell(10, 0, "8"), MOTION, "frame, row 10", "stands still"),
    "motion-frame-not-whole": (cell(10, 0, "8.5"), MOTION, "frame, row 10", "no frame number"),
    "motion-one-endless-line": (replace(MOTION, "frame," * 30_000 + "x" * 200_000), MOTION, None, "not a CSV table"),
    "motion-nan": (cell(10, 3, "nan"), MOTION, "y, line 11", "not a finite number"),
    "motion-short-row": (lambda f: (f / MOTION).open("a").write("99,9.9\n"), MOTION, "line 43", "2 values"),
    "motion-quaternion-zero": (numbers(lambda t: t * [1, 1, 1, 1, 1, 0, 0, 0, 0]), MOTION, "qw,qx,qy,qz, frame 0",
        "length 0"),
    "motion-quaternion-long": (numbers(lambda t: t * [1, 1, 1, 1, 1, 2, 2, 2, 2]), MOTION, "qw,qx,qy,qz, frame 0",
        "instead of 1"),
    "motion-outside-of-bed": (numbers(lambda t: t + np.eye(9)[4] * 3.0), MOTION, "x,y,z", "never touches"),
    "motion-at-half-its-times": (times(0.5), MOTION, LAST, "is at 0.4 s"),
    "motion-in-unix-time": (times(1.0, UNIX), MOTION, "time, frame 0", "is at 1700000000 s"),
    "video-in-milliseconds": (video_times(1e3), VIDEO, "frames[6].time", "is at 200 s"),
    "all-in-unix-time": (both(times(1.0, UNIX), video_times(1.0, UNIX)), SET, "frame_rate", "0 at frame 0"),
    "frame-rate-of-50-000": (edit(SET, "frame_rate", to=50_000), SET, "frame_rate", "where 50000 frames a second"),
    "all-a-thousand-times-as-fast": (both(edit(SET, "frame_rate", to=50_000), times(1e-3), video_times(1e-3)), MOTION,
        "time", "faster than sound"),
    "motion-at-rest": (numbers(lambda t: np.column_stack([t[:, :2], t[:1, 2:].repeat(len(t), 0)])), MOTION, "x,y,z",
        "never moves"),
    "motion-too-deep": (numbers(lambda t: t - np.eye(9)[4] * 0.2), MOTION, "x,y,z", "passes the bed's floor"),
    "tool-ten-times-as-large": (tool_scaled(10.0), MESH, "vertices", "1.2 m long"),
    "tool-in-inches": (tool_scaled(39.37), MESH, "vertices", "meshes and motions are in metres"),
    "tool-by-inches-too-small": (tool_scaled(1 / 39.37), MESH, "vertices", "meshes are in metres"),
    "force-on-the-soil": (numbers(lambda t: t * [1, 1, -1, -1, -1], FORCE), FORCE, "fx,fy,fz", "J of work on the tool"),
}  # fmt: skip


def everything_under(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("case", CASES)
def test_a_fault_gets_one_clear_error(
    case: str, small_set: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, file, field, says = CASES[case]
    spoil(small_set)
    with pytest.raises(MeasurementError) as caught:
        Measurement.load(small_set)
    assert (caught.value.file, caught.value.field) == (small_set / file, field)
    assert says in str(caught.value)

    before = everything_under(small_set.parent)
    monkeypatch.chdir(small_set.parent)
    assert main(["check", str(small_set)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, "one line"
    assert says in err and file in err and (field or "") in err
    assert everything_under(small_set.parent) == before, "nothing written"


def test_good_set_passes(small_set: Path) -> None:
    """The set that all the cases spoil is itself in order: each error is the fault's own."""
    assert Measurement.load(small_set).frames == (0, 10)


def test_a_set_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
    (tmp_path / "video.MOV").write_text("")
    for name, fault in (("video.MOV", "not a folder"), (".", "no experiment.json")):
        assert main(["check", str(tmp_path / name)]) == 2
        told = capsys.readouterr().err
        assert fault in told and "splatsoil import makes one of photographs and videos" in told


@pytest.mark.parametrize("name", ["a\0b", "a" * 5000])
def test_a_name_that_no_folder_can_have(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", name]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_name_in_another_of_unicodes_normal_forms(small_set: Path) -> None:
    """As disks of Macs have it, where JSON files have the other one."""
    (small_set / ONE).rename(small_set / "views" / "images" / unicodedata.normalize("NFD", "für.jpg"))
    image_path("images/" + unicodedata.normalize("NFC", "für.jpg"))(small_set)
    assert len(Measurement.load(small_set).views) == 4


def test_what_pillow_remarks_on_a_file_is_not_printed(small_set: Path, recwarn: pytest.WarningsRecorder) -> None:
    photograph(NOISE, "e.jpg", exif=b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + bytes(30))(small_set)
    remarks(Measurement.load(small_set))
    assert not recwarn.list


def test_an_error_as_json(small_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Machines get the error as the one object on stdout."""
    edit(SET, "bed", "upper", 0, to=800.0)(small_set)
    assert main(["check", str(small_set), "--json"]) == 2
    out, err = capsys.readouterr()
    data = json.loads(out)
    assert data["ok"] is False and "bed.upper[0]" in data["error"]
    assert "bed.upper[0]" in err


def test_a_camera_in_the_middle_of_the_bed_has_no_depth_to_be_wrong(small_set: Path) -> None:
    bed = Measurement.load(small_set).bed
    for row in range(3):
        edit(VIEWS, "frames", 1, "transform_matrix", row, 3, to=float((bed.lower + bed.upper)[row] / 2))(small_set)
    assert len(Measurement.load(small_set).views) == 4


def test_links_inside_the_folder_are_allowed(small_set: Path) -> None:
    (small_set / "views/images/link.jpg").symlink_to(small_set / "views/images/001.jpg")
    image_path("images/link.jpg")(small_set)
    assert len(Measurement.load(small_set).views) == 4


@pytest.mark.parametrize("name", ["images\\001.jpg", "./images/001", ".\\images\\001", "./images/001.jpg"])
def test_paths_as_windows_and_blender_write_them(name: str, small_set: Path) -> None:
    image_path(name)(small_set)
    assert Measurement.load(small_set).views[1].path.samefile(small_set / "views/images/001.jpg")


def test_what_others_write_into_transforms_files_is_no_misspelling(small_set: Path) -> None:
    """Fields of nerfstudio's, instant-ngp's, Polycam's and Record3D's files that are none of ours."""
    file = small_set / VIEWS
    top = ("aabb_scale", "scale", "offset", "applied_transform", "applied_scale", "ply_file_path", "train_filenames",
           "orientation_override", "fisheye_crop_radius", "near", "far", "sharpness", "integer_depth_scale",
           "camera_convention", "up", "version")  # fmt: skip
    own = ("sharpness", "colmap_im_id", "rotation", "timestamp", "blur_score", "semantic_path", "normal_file_path")
    data = json.loads(file.read_text())
    data |= dict.fromkeys(top, 1)
    for frame in data["frames"]:
        frame |= dict.fromkeys(own, 1)
    file.write_text(json.dumps(data))
    assert len(Measurement.load(small_set).views) == 4


def test_the_folder_itself_may_be_a_link(small_set: Path) -> None:
    link = small_set.parent / "link"
    link.symlink_to(small_set)
    assert Measurement.load(link).hash == Measurement.load(small_set).hash
