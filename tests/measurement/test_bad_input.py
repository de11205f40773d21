"""Each way a measurement set can be wrong: one clear error that names file and field, exit code 2, nothing written."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from splatsoil.cli import main
from splatsoil.errors import MeasurementError
from splatsoil.measurement import Measurement


@dataclass(frozen=True)
class Case:
    """A fault: what spoils a good set, and what the error must say."""

    name: str
    spoil: Callable[[Path], object]
    file: str
    field: str | None
    says: str


def edit(file: str, *keys: str | int, to: Any = None, drop: bool = False) -> Callable[[Path], None]:
    """Set, or drop, a value inside a JSON file."""

    def spoil(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        place = data
        for key in keys[:-1]:
            place = place[key]
        if drop:
            del place[keys[-1]]
        else:
            place[keys[-1]] = to
        (folder / file).write_text(json.dumps(data))

    return spoil


def renamed(file: str, *keys: str, to: str) -> Callable[[Path], None]:
    """Another name for a field of a JSON file."""

    def spoil(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        place = data
        for key in keys[:-1]:
            place = place[key]
        place[to] = place.pop(keys[-1])
        (folder / file).write_text(json.dumps(data))

    return spoil


def replace(file: str, content: str | bytes) -> Callable[[Path], None]:
    """Replace a file's content."""
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / file).write_bytes(raw) and None


def cell(row: int, column: int, value: str, file: str = "tool_motion.csv") -> Callable[[Path], None]:
    """Replace a cell of a CSV file; row 0 is the header."""

    def spoil(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / file).read_text().splitlines()]
        rows[row][column] = value
        (folder / file).write_text("\n".join(",".join(r) for r in rows))

    return spoil


def numbers(change: Callable[[np.ndarray], np.ndarray], name: str = "tool_motion.csv") -> Callable[[Path], None]:
    """Change the numbers of a CSV file as a whole."""

    def spoil(folder: Path) -> None:
        file = folder / name
        head, *rows = file.read_text().splitlines()
        table = change(np.array([[float(v) for v in row.split(",")] for row in rows]))
        file.write_text("\n".join([head, *(",".join(f"{v:.12g}" for v in row) for row in table)]))

    return spoil


def truncate(file: str, keep: float) -> Callable[[Path], None]:
    """Cut a file off after a fraction of its bytes."""

    def spoil(folder: Path) -> None:
        raw = (folder / file).read_bytes()
        (folder / file).write_bytes(raw[: int(keep * len(raw))])

    return spoil


def mesh(build: Callable[[], trimesh.Trimesh]) -> Callable[[Path], None]:
    """Another mesh for the tool."""
    return lambda folder: build().export(folder / "tool.stl") and None


def scale_cameras(factor: float) -> Callable[[Path], None]:
    """Multiply the views' positions."""

    def spoil(folder: Path) -> None:
        file = folder / VIEWS
        data = json.loads(file.read_text())
        for frame in data["frames"]:
            for row in range(3):
                frame["transform_matrix"][row][3] *= factor
        file.write_text(json.dumps(data))

    return spoil


def to_opencv(folder: Path) -> None:
    """The views' matrices with OpenCV's axes by mistake: y and z of the camera turned round."""
    file = folder / VIEWS
    data = json.loads(file.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
    file.write_text(json.dumps(data))


def outside(name: str) -> Callable[[Path], None]:
    """A good image outside of the folder, reached by ``name``."""

    def spoil(folder: Path) -> None:
        target = folder.parent / "stranger.jpg"
        target.write_bytes((folder / "views/images/001.jpg").read_bytes())
        if name == "link":
            (folder / "views/images/link.jpg").symlink_to(target)
        path = {"absolute": str(target), "dots": "../../stranger.jpg", "link": "images/link.jpg"}[name]
        edit(VIEWS, "frames", 1, "file_path", to=path)(folder)

    return spoil


def wrong_size(folder: Path) -> None:
    Image.new("RGB", (319, 240)).save(folder / "views/images/002.jpg")


def renamed_png(folder: Path) -> None:
    Image.new("RGB", (320, 240)).save(folder / "views/images/002.jpg", format="PNG")


def wrong_mask(folder: Path) -> None:
    Image.new("L", (3, 4)).save(folder / "views/mask.png")
    edit(VIEWS, "frames", 1, "mask_path", to="mask.png")(folder)


def photograph(make: Callable[[], Image.Image], name: str = "002.png") -> Callable[[Path], None]:
    """Another image, of another type perhaps, for the third view."""

    def spoil(folder: Path) -> None:
        make().save(folder / "views/images" / name)
        edit(VIEWS, "frames", 2, "file_path", to=f"images/{name}")(folder)

    return spoil


def even(level: int, noise: float = 0.0) -> Image.Image:
    """One grey throughout but for a sensor's noise."""
    values = level + noise * np.random.default_rng(0).normal(size=(240, 320, 3))
    return Image.fromarray(np.clip(values.round(), 0, 255).astype(np.uint8))


def ramp(high: float) -> Image.Image:
    """A floating-point image from 0 to ``high``."""
    return Image.fromarray(np.linspace(0.0, high, 240 * 320, dtype=np.float32).reshape(240, 320))


def transparent() -> Image.Image:
    image = Image.effect_noise((320, 240), 60).convert("RGBA")
    image.putalpha(3)
    return image


def turned_by_exif(folder: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.effect_noise((240, 320), 60).save(folder / "views/images/002.jpg", exif=exif)


def black_mask(folder: Path) -> None:
    Image.new("L", (320, 240)).save(folder / "views/mask.png")
    edit(VIEWS, "frames", 1, "mask_path", to="mask.png")(folder)


def masks_round_the_soil(folder: Path) -> None:
    """All views' masks the wrong way round: they keep what isn't soil, here the uppermost line."""
    mask = np.zeros((240, 320), dtype=np.uint8)
    mask[0] = 255
    Image.fromarray(mask).save(folder / "views/mask.png")
    edit(VIEWS, "mask_path", to="mask.png")(folder)


def depth(name: str, values: np.ndarray) -> Callable[[Path], None]:
    """Depth of the second view."""

    def spoil(folder: Path) -> None:
        if name.endswith(".npy"):
            np.save(folder / "views" / name, values)
        else:
            Image.fromarray(values).save(folder / "views" / name)
        edit(VIEWS, "frames", 1, "depth_file_path", to=name)(folder)

    return spoil


def unknown_mesh(folder: Path) -> None:
    (folder / "tool.stl").rename(folder / "tool.dat")
    edit(SET, "tool", "mesh", to="tool.dat")(folder)


def short_row(folder: Path) -> None:
    with (folder / "tool_motion.csv").open("a") as file:
        file.write("99,9.9\n")


def duplicate_video_frame(folder: Path) -> None:
    data = json.loads((folder / VIDEO).read_text())
    extra = dict(data["frames"][0], file_path=data["frames"][2]["file_path"])
    data["frames"][2] = extra
    (folder / VIDEO).write_text(json.dumps(data))


def flat_plate() -> trimesh.Trimesh:
    return trimesh.Trimesh([[0, -0.06, -0.06], [0, 0.06, -0.06], [0, 0.06, 0.06]], [[0, 1, 2]])


def open_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((0.01, 0.1, 0.1))
    return trimesh.Trimesh(box.vertices, box.faces[2:])


def big_box() -> trimesh.Trimesh:
    return trimesh.creation.box((12.0, 120.0, 120.0))


def tool_scaled(factor: float, lift: float = 0.0) -> Callable[[Path], None]:
    """The tool's mesh in another unit, about its middle or, lifted, about a point below."""

    def spoil(folder: Path) -> None:
        tool = trimesh.load_mesh(folder / "tool.stl")
        tool.apply_translation([0.0, 0.0, lift])
        tool.apply_scale(factor)
        tool.apply_translation([0.0, 0.0, -lift])
        tool.export(folder / "tool.stl")

    return spoil


def video_times(change: Callable[[float], float]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        data = json.loads((folder / VIDEO).read_text())
        for frame in data["frames"]:
            frame["time"] = change(frame["time"])
        (folder / VIDEO).write_text(json.dumps(data))

    return spoil


def both(*faults: Callable[[Path], object]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        for fault in faults:
            fault(folder)

    return spoil


def times(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Another clock for the tool's motion."""
    return numbers(lambda table: np.column_stack([table[:, 0], change(table[:, 1]), table[:, 2:]]))


LAST = "time, frame 40"
UNIX = 1.7e9
FIRST = "frames[1].file_path"
SECOND = "frames[2].file_path"
DEPTH = "frames[1].depth_file_path"
LEAVES = "leaves the measurement set"
MATRIX = "frames[1].transform_matrix"
VIEWS, VIDEO, SET = "views/transforms.json", "video/transforms.json", "experiment.json"
POSE = ("frames", 1, "transform_matrix")
DOUBLED = [[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 1], [0, 0, 0, 1]]
MIRROR = [[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
SHEARED = [[1.0, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
PROJECTIVE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]

CASES = [
    # images
    Case("image-missing", lambda f: (f / "views/images/001.jpg").unlink(), "views/images/001.jpg", FIRST,
         "no such file"),
    Case("image-truncated", truncate("views/images/001.jpg", 0.6), "views/images/001.jpg", FIRST, "truncated"),
    Case("image-empty", replace("views/images/001.jpg", b""), "views/images/001.jpg", FIRST, "not an image"),
    Case("image-of-another-size", wrong_size, "views/images/002.jpg", SECOND, "319 x 240"),
    Case("image-is-png-named-jpg", renamed_png, "views/images/002.jpg", SECOND, "PNG"),
    Case("image-is-a-folder", edit(VIEWS, "frames", 1, "file_path", to="images"), VIEWS, FIRST, "not a file"),
    Case("image-listed-twice", edit(VIEWS, "frames", 1, "file_path", to="images/000.jpg"), VIEWS, FIRST,
         "twice"),
    Case("image-copied", lambda f: shutil.copy(f / "views/images/000.jpg", f / "views/images/001.jpg"), VIEWS, FIRST,
         "the same as that of frames[0]"),
    Case("mask-of-another-size", wrong_mask, "views/mask.png", "frames[1].mask_path", "3 x 4"),
    Case("image-turned-by-exif", turned_by_exif, "views/images/002.jpg", SECOND, "EXIF"),
    Case("image-black", photograph(lambda: even(0), "b.jpg"), "views/images/b.jpg", SECOND, "one even grey, 0 of 255"),
    Case("image-grey", photograph(lambda: even(127, 3.0)), "views/images/002.png", SECOND, "one even grey, 127"),
    Case("image-of-floats-to-255", photograph(lambda: ramp(255.0), "f.tif"), "views/images/f.tif", SECOND,
         "lie in [0, 1]"),
    Case("image-transparent", photograph(transparent), "views/images/002.png", SECOND, "masked or transparent"),
    Case("image-heic",
         lambda f: ((f / "views/images/a.heic").write_bytes(b"ftypheic"),
                    edit(VIEWS, "frames", 2, "file_path", to="images/a.heic")(f)),
         "views/images/a.heic", SECOND, "convert it to JPEG or PNG"),
    Case("mask-black", black_mask, "views/mask.png", "frames[1].mask_path", "masked or transparent"),
    Case("masks-the-wrong-way-round", masks_round_the_soil, VIEWS, "frames[0].transform_matrix", "masks are black"),
    Case("depth-of-8-bits", depth("d.png", np.full((240, 320), 150, np.uint8)), "views/d.png", DEPTH, "8 bits"),
    Case("depth-float-millimetres", depth("d.npy", np.full((240, 320), 900.0)), "views/d.npy", DEPTH, "metres"),
    Case("depth-whole-metres", depth("d.npy", np.full((240, 320), 1)), "views/d.npy", DEPTH, "millimetres"),
    Case("depth-unknown", depth("d.npy", np.full((240, 320), math.nan)), "views/d.npy", DEPTH, "no depth is known"),
    Case("depth-of-another-size", depth("d.npy", np.ones((320, 240))), "views/d.npy", DEPTH, "(240, 320)"),
    # paths
    Case("path-absolute", outside("absolute"), VIEWS, FIRST, LEAVES),
    Case("path-through-link", outside("link"), VIEWS, FIRST, LEAVES),
    Case("path-of-mesh-leaves", edit(SET, "tool", "mesh", to="../tool.stl"), SET, "tool.mesh", LEAVES),
    Case("path-endless", edit(VIEWS, "frames", 1, "file_path", to="a" * 5000), VIEWS, FIRST,
         "no usable path"),
    Case("path-is-a-number", edit(VIEWS, "frames", 1, "file_path", to=7), VIEWS, FIRST, "expected text"),
    Case("path-with-backslashes-leaves", edit(VIEWS, "frames", 1, "file_path", to="..\\..\\..\\x.jpg"), VIEWS, FIRST,
         LEAVES),
    Case("path-without-suffix-of-two", both(photograph(lambda: even(9), "001.png"),
         edit(VIEWS, "frames", 1, "file_path", to="./images/001")), VIEWS, FIRST, "001.jpg, 001.png"),
    # matrices
    Case("matrix-scales", edit(VIEWS, *POSE, to=DOUBLED), VIEWS, MATRIX, "it scales by 2"),
    Case("matrix-mirrors", edit(VIEWS, *POSE, to=MIRROR), VIEWS, MATRIX, "mirrors"),
    Case("matrix-shears", edit(VIEWS, *POSE, to=SHEARED), VIEWS, MATRIX, "not a rotation"),
    Case("matrix-last-row", edit(VIEWS, *POSE, to=PROJECTIVE), VIEWS, MATRIX, "last row"),
    Case("matrix-3x4", edit(VIEWS, *POSE, to=MIRROR[:3]), VIEWS, MATRIX, "4 x 4"),
    Case("matrix-nan", edit(VIEWS, *POSE, 2, 3, to=math.nan), VIEWS, MATRIX + "[2][3]", "not a finite number"),
    Case("matrix-missing", edit(VIEWS, *POSE, drop=True), VIEWS, MATRIX, "missing"),
    Case("matrices-in-opencv-axes", to_opencv, VIEWS, "frames[0].transform_matrix", "no camera looks at"),
    # cameras
    Case("camera-model-unknown", edit(VIEWS, "camera_model", to="EQUIRECTANGULAR"), VIEWS, "camera_model",
         "EQUIRECTANGULAR"),
    Case("pinhole-with-distortion",
         lambda f: (edit(VIEWS, "camera_model", to="PINHOLE")(f), edit(VIEWS, "k1", to=0.1)(f)), VIEWS, "k1", "OPENCV"),
    Case("focal-length-of-a-frame-negative", edit(VIEWS, "frames", 2, "fl_x", to=-300.0), VIEWS, "frames[2].fl_x",
         "outside"),
    Case("focal-length-in-metres", edit(VIEWS, "fl_x", to=0.035), VIEWS, "fl_x", "pixels"),
    Case("principal-point-missing", edit(VIEWS, "cx", drop=True), VIEWS, "frames[0].cx", "missing"),
    Case("width-not-whole", edit(VIEWS, "w", to=320.5), VIEWS, "w", "whole number"),
    Case("views-without-frames", edit(VIEWS, "frames", to=[]), VIEWS, "frames", "empty"),
    Case("views-frames-not-a-list", edit(VIEWS, "frames", to={"a": 1}), VIEWS, "frames", "expected a list"),
    Case("cameras-in-millimetres", scale_cameras(1000.0), VIEWS, "frames[0].transform_matrix",
         "positions are in metres"),
    # video
    Case("video-frame-twice", duplicate_video_frame, VIDEO, "frames[2].frame", "given twice"),
    Case("video-time-backwards", edit(VIDEO, "frames", 6, "time", to=-5.0), VIDEO, "frames[6].time", "runs backwards"),
    Case("video-without-camera", edit(VIDEO, "frames", 0, "camera", drop=True), VIDEO, "frames[0].camera", "missing"),
    Case("video-camera-with-dots", edit(VIDEO, "frames", 0, "camera", to="../left"), VIDEO, "frames[0].camera",
         "names files"),
    Case("video-camera-moves", edit(VIDEO, "frames", 6, "transform_matrix", 0, 3, to=-0.2), VIDEO,
         "frames[6].transform_matrix", "moves"),
    Case("video-camera-zooms", edit(VIDEO, "frames", 6, "fl_x", to=350.0), VIDEO, "frames[6]", "another calibration"),
    # experiment.json
    Case("set-missing", lambda f: (f / SET).unlink(), SET, None, "no experiment.json"),
    Case("set-not-json", replace(SET, "format: splatsoil"), SET, None, "not JSON"),
    Case("set-with-a-comment", replace(SET, '{\n "name": "a", // mine\n "up": "z"}'), SET, None,
         "comments, but there is one in line 2, column 15"),
    Case("set-with-a-trailing-comma", replace(SET, '{"name": "a",\n "up": "z",\n}'), SET, None, "omma"),
    Case("set-with-a-key-twice", replace(SET, '{"bed": {"density": 1, "density": 2}}'), SET, None,
         "'density' is given twice"),
    Case("key-misspelt", renamed(SET, "gravity", to="gravty"), SET, "gravty", "did you mean 'gravity'?"),
    Case("key-with-a-hyphen", renamed(SET, "frame_rate", to="frame-rate"), SET, "frame-rate", "'frame_rate'?"),
    Case("key-misspelt-of-a-frame", edit(VIEWS, "frames", 1, "mask_pth", to="m.png"), VIEWS, "frames[1].mask_pth",
         "'mask_path'?"),
    Case("set-is-binary", replace(SET, b"\x89PNG\xff\xfe"), SET, None, "not a text file"),
    Case("set-is-a-list", replace(SET, "[1, 2]"), SET, None, "expected a JSON object"),
    Case("set-nested-endlessly", replace(SET, "[" * 100_000), SET, None, "not usable JSON"),
    Case("format-of-another-version", edit(SET, "format", to="splatsoil-measurement/2"), SET, "format",
         "another version"),
    Case("up-is-y", edit(SET, "up", to="y"), SET, "up", "z"),
    Case("bed-800-m-long", edit(SET, "bed", "upper", 0, to=800.0), SET, "bed.upper[0]", "800 m along x"),
    Case("bed-upside-down", edit(SET, "bed", "upper", 2, to=-1.0), SET, "bed.upper[2]", "not above"),
    Case("bed-with-two-numbers", edit(SET, "bed", "lower", to=[0, 0]), SET, "bed.lower", "list of 3"),
    Case("bed-huge-number", edit(SET, "bed", "density", to=10**400), SET, "bed.density", "not a finite number"),
    Case("density-in-g-per-cm3", edit(SET, "bed", "density", to=1.6), SET, "bed.density", "kg/m³"),
    Case("gravity-upwards", edit(SET, "gravity", to=[0, 0, 9.81]), SET, "gravity", "does not point down"),
    Case("gravity-in-mm", edit(SET, "gravity", to=[0, 0, -9810.0]), SET, "gravity", "m/s²"),
    Case("frame-rate-zero", edit(SET, "frame_rate", to=0), SET, "frame_rate", "outside"),
    Case("friction-is-an-angle", edit(SET, "tool", "friction", to=17.0), SET, "tool.friction", "not an angle"),
    Case("container-unknown", edit(SET, "bed", "container", to="glas"), SET, "bed.container",
         "'glas' is unknown; known are bin, transparent, open, heap"),
    Case("name-of-two-lines", edit(SET, "name", to="a\nb"), SET, "name", "unprintable"),
    Case("name-endless", edit(SET, "name", to="a" * 300), SET, "name", "at most 60"),
    Case("give", edit(SET, "tool", "give", to=0.0), SET, "tool.give", "remove this field"),
    Case("video-file-missing", lambda f: (f / VIDEO).unlink(), VIDEO, "video", "no such file"),
    # the tool's mesh
    Case("mesh-missing", lambda f: (f / "tool.stl").unlink(), "tool.stl", "tool.mesh", "no such file"),
    Case("mesh-without-volume", mesh(flat_plate), "tool.stl", "faces", "no volume"),
    Case("mesh-open", mesh(open_box), "tool.stl", "faces", "holes"),
    Case("mesh-in-millimetres", mesh(big_box), "tool.stl", "vertices", "metres"),
    Case("mesh-is-text", replace("tool.stl", "this is no mesh"), "tool.stl", None, "what its name says"),
    Case("mesh-of-no-known-type", unknown_mesh, "tool.dat", None,
         "what its name says"),
    # the tool's motion and force
    Case("motion-missing", lambda f: (f / "tool_motion.csv").unlink(), "tool_motion.csv", "tool.motion",
         "no such file"),
    Case("motion-header", cell(0, 5, "qx"), "tool_motion.csv", "line 1", "expected the header"),
    Case("motion-in-other-units-by-its-header", cell(0, 2, "x [mm]"), "tool_motion.csv", "line 1", "; x must be there"),
    Case("motion-with-decimal-commas-and-no-other-mark",
         replace("tool_motion.csv", "frame,time,x,y,z,qw,qx,qy,qz\n0,0,0,2,0,25,0,21,1,0,0,0\n"), "tool_motion.csv",
         "line 2", "12 values where the header has 9"),
    Case("motion-with-thousands", replace("tool_motion.csv", "frame;time;x;y;z;qw;qx;qy;qz\n0;0;1.000,2;0;0;1;0;0;0\n"),
         "tool_motion.csv", "x, line 2", "'1.000.2' is not a number"),
    Case("motion-without-rows", replace("tool_motion.csv", "frame,time,x,y,z,qw,qx,qy,qz\n"), "tool_motion.csv", None,
         "no rows"),
    Case("motion-of-one-row", replace("tool_motion.csv", "frame,time,x,y,z,qw,qx,qy,qz\n0,0,0.2,0.25,0.21,1,0,0,0\n"),
         "tool_motion.csv", None, "two rows at least"),
    Case("motion-time-backwards", cell(10, 1, "0.1"), "tool_motion.csv", "time, row 10", "runs backwards"),
    Case("motion-frame-twice", cell(10, 0, "8"), "tool_motion.csv", "frame, row 10", "stands still"),
    Case("motion-frame-not-whole", cell(10, 0, "8.5"), "tool_motion.csv", "frame, row 10", "no frame number"),
    Case("motion-one-endless-line", replace("tool_motion.csv", "frame," * 30_000 + "x" * 200_000), "tool_motion.csv",
         None, "not a CSV table"),
    Case("motion-nan", cell(10, 3, "nan"), "tool_motion.csv", "y, line 11", "not a finite number"),
    Case("motion-short-row", short_row, "tool_motion.csv", "line 43",
         "2 values"),
    Case("motion-quaternion-zero", numbers(lambda t: t * [1, 1, 1, 1, 1, 0, 0, 0, 0]), "tool_motion.csv",
         "qw,qx,qy,qz, frame 0", "length 0"),
    Case("motion-quaternion-long", numbers(lambda t: t * [1, 1, 1, 1, 1, 2, 2, 2, 2]), "tool_motion.csv",
         "qw,qx,qy,qz, frame 0", "instead of 1"),
    Case("motion-outside-of-bed", numbers(lambda t: t + np.eye(9)[4] * 3.0), "tool_motion.csv", "x,y,z",
         "never touches"),
    Case("motion-at-half-its-times", times(lambda t: 0.5 * t), "tool_motion.csv", LAST, "is at 0.4 s"),
    Case("motion-in-unix-time", times(lambda t: UNIX + t), "tool_motion.csv", "time, frame 0", "is at 1700000000 s"),
    Case("video-in-milliseconds", video_times(lambda t: 1000.0 * t), VIDEO, "frames[6].time", "is at 200 s"),
    Case("all-in-unix-time", both(times(lambda t: UNIX + t), video_times(lambda t: UNIX + t)), SET, "frame_rate",
         "0 at frame 0"),
    Case("frame-rate-of-50-000", edit(SET, "frame_rate", to=50_000), SET, "frame_rate", "where 50000 frames a second"),
    Case("all-a-thousand-times-as-fast",
         both(edit(SET, "frame_rate", to=50_000), times(lambda t: 1e-3 * t), video_times(lambda t: 1e-3 * t)),
         "tool_motion.csv", "time", "faster than sound"),
    Case("motion-too-deep", numbers(lambda t: t - np.eye(9)[4] * 0.2), "tool_motion.csv", "x,y,z",
         "passes the bed's floor"),
    Case("tool-ten-times-as-large", tool_scaled(10.0), "tool.stl", "vertices", "1.2 m long"),
    Case("tool-in-inches", tool_scaled(39.37), "tool.stl", "vertices", "meshes and motions are in metres"),
    Case("tool-by-inches-too-small", tool_scaled(1 / 39.37), "tool.stl", "vertices", "meshes are in metres"),
    Case("force-on-the-soil", numbers(lambda t: t * [1, 1, -1, -1, -1], "tool_force.csv"), "tool_force.csv",
         "fx,fy,fz", "J of work on the tool"),
]  # fmt: skip


def everything_under(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_fault_gets_one_clear_error(
    case: Case, small_set: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case.spoil(small_set)
    with pytest.raises(MeasurementError) as caught:
        Measurement.load(small_set)
    assert caught.value.file == small_set / case.file
    assert caught.value.field == case.field
    assert case.says in str(caught.value)

    before = everything_under(small_set.parent)
    monkeypatch.chdir(small_set.parent)
    assert main(["check", str(small_set)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, "one line"
    assert case.says in err and case.file in err and (case.field or "") in err
    assert everything_under(small_set.parent) == before, "nothing written"


def test_good_set_passes(small_set: Path) -> None:
    """The set that all the cases spoil is itself in order: each error is the fault's own."""
    assert Measurement.load(small_set).frames == (0, 10)


def test_a_set_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["check", str(tmp_path / "file")]) == 2
    assert "not a folder" in capsys.readouterr().err


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
    edit(VIEWS, "frames", 1, "file_path", to="images/link.jpg")(small_set)
    assert len(Measurement.load(small_set).views) == 4


@pytest.mark.parametrize("name", ["images\\001.jpg", "./images/001", ".\\images\\001", "./images/001.jpg"])
def test_paths_as_windows_and_blender_write_them(name: str, small_set: Path) -> None:
    edit(VIEWS, "frames", 1, "file_path", to=name)(small_set)
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
