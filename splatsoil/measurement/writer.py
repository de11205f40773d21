"""Writing a measurement set: all of it or nothing."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatsoil.errors import MeasurementError
from splatsoil.files import check_paths
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.frames import Frame
from splatsoil.measurement.heights import HeightMaps
from splatsoil.measurement.measurement import EXPERIMENT, FORMAT, Bed, Measurement
from splatsoil.measurement.motion import MOTION_COLUMNS
from splatsoil.measurement.tool import FORCE_COLUMNS, Tool


@dataclass(frozen=True, eq=False)
class Picture:
    """An image to be written, with its camera.

    Attributes:
        camera: calibration and pose; its ``name`` is the video camera's name.
        image: (height, width, 3) sRGB, float in [0, 1] or uint8.
        frame: number on the tool motion's clock, for video.
        time: seconds on that clock, for video.
        depth: (height, width) depth along the camera's axis in m, 0 where unknown; or None.
    """

    camera: Camera
    image: npt.NDArray[Any]
    frame: int | None = None
    time: float | None = None
    depth: npt.NDArray[np.floating] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Contents:
    """What a set is to hold.

    Attributes:
        name, bed, tool, frame_rate, gravity: as in Measurement.
        views, video: pictures to encode, or frames of another set, whose files are copied as they are.
        heights: grids of heights; beside them views and video may be empty, and are left out then.
    """

    name: str
    bed: Bed
    tool: Tool
    frame_rate: float
    gravity: npt.ArrayLike = (0.0, 0.0, -9.81)
    views: Sequence[Picture | Frame] = ()
    video: Sequence[Picture | Frame] = ()
    heights: HeightMaps | None = None


def write_measurement(
    folder: str | Path,
    contents: Contents,
    *,
    suffix: str = ".jpg",
    quality: int = 95,
    truth: Mapping[str, Any] | None = None,
    beside: Callable[[Path], object] | None = None,
) -> Measurement:
    """Write a set that ``Measurement.load`` accepts, and load it.

    The set is put together in a temporary folder beside its place, loaded, and only then moved there: a fault, or an
    interruption, leaves nothing behind.

    Args:
        folder: where to; must not exist, or be an empty folder.
        contents: of the set.
        suffix: file type of encoded pictures, ``.jpg`` or ``.png``.
        quality: JPEG quality (no chroma subsampling).
        truth: content of ``truth.json``, for synthetic sets.
        beside: writes further files into the folder that it is given.

    Raises:
        MeasurementError: the place is taken or can't be written, or the set breaks the format's rules.
    """
    bed, tool, heights = contents.bed, contents.tool, contents.heights
    with whole_folder(Path(folder)) as root:
        tool.mesh.export(root / "tool.stl")
        write_table(root / "tool_motion.csv", MOTION_COLUMNS, tool.motion.table)
        if tool.force is not None:
            write_table(root / "tool_force.csv", FORCE_COLUMNS, tool.force)
        pictures = {"views": contents.views, "video": contents.video}
        if heights is not None:
            pictures = {kind: frames for kind, frames in pictures.items() if frames}
        for kind, frames in pictures.items():
            write_frames(root / kind, frames, video=kind == "video", suffix=suffix, quality=quality)
        if heights is not None:
            write_heights(root / "heights", heights)
        experiment = {
            "format": FORMAT,
            "name": contents.name,
            "up": "z",
            "gravity": np.asarray(contents.gravity, dtype=np.float64).tolist(),
            "frame_rate": contents.frame_rate,
            "bed": {
                "lower": bed.lower.tolist(),
                "upper": bed.upper.tolist(),
                "density": bed.density,
                "wall_friction": bed.wall_friction,
                "floor_friction": bed.floor_friction,
                **({} if bed.container is None else {"container": bed.container}),
            },
            "tool": {
                "mesh": "tool.stl",
                "motion": "tool_motion.csv",
                "friction": tool.friction,
                **({} if tool.force is None else {"force": "tool_force.csv"}),
            },
            **{kind: f"{kind}/transforms.json" for kind in pictures},
            **({} if heights is None else {"heights": "heights/heights.json"}),
        }
        write_json(root / EXPERIMENT, experiment)
        if truth is not None:
            write_json(root / "truth.json", dict(truth))
        if beside is not None:
            beside(root)
        Measurement.load(root)
    return Measurement.load(folder)


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """A folder beside ``target`` to fill; in the end it takes its place, or disappears with what was made for it.

    Raises:
        MeasurementError: the place is taken or can't be written.
    """
    check_paths([target])
    try:
        target.lstat()
        taken = not target.is_dir() or any(target.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        taken = False
    if taken:
        raise MeasurementError("already there and not an empty folder; nothing is overwritten", file=target)
    root = target
    new = [p for p in target.absolute().parents if not p.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as temporary:
            root = Path(temporary) / target.name
            root.mkdir()
            yield root
            if target.exists():
                target.rmdir()
            root.rename(target)
    except BaseException as error:
        for folder in new:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, MeasurementError):  # it lies at its own place for a reader
            error.args = (str(error).replace(str(root.absolute()), str(target)),)
        if not isinstance(error, OSError):
            raise
        message = f"cannot be written ({error.strerror}); choose another place"
        raise MeasurementError(message, file=target) from error


def transforms(camera: Camera) -> dict[str, Any]:
    """nerfstudio's fields for a camera, its pose included."""
    return {
        "camera_model": camera.model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        **dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), camera.distortion, strict=True)),
        "transform_matrix": camera.camera_to_world.tolist(),
    }


def write_frames(
    folder: Path, frames: Iterable[Picture | Frame], *, video: bool, suffix: str = ".jpg", quality: int = 95
) -> None:
    """Pictures, masks and ``transforms.json`` of views or of a video.

    Raises:
        MeasurementError: a camera's name cannot be a folder's.
    """
    entries: list[dict[str, Any]] = []
    for i, frame in enumerate(frames):
        camera = frame.camera
        place = camera.name or (frame.camera_name if isinstance(frame, Frame) else "") if video else "images"
        if not place or Path(place).name != place:
            raise MeasurementError(
                f"{place!r} is no name for a camera; it also names a folder", file=folder, field=f"frames[{i}].camera"
            )
        if video and (frame.frame is None or frame.time is None):
            raise MeasurementError("a video frame needs a number and a time", file=folder, field=f"frames[{i}].frame")
        stem = f"{frame.frame:+05d}" if video else f"{i:04d}"
        entry: dict[str, Any] = {}
        if isinstance(frame, Frame):
            entry["file_path"] = _copy(frame.path, folder, f"{place}/{stem}")
            if frame.mask_path is not None:
                entry["mask_path"] = _copy(frame.mask_path, folder, f"masks/{place}/{stem}")
            if frame.depth_path is not None:
                entry["depth_file_path"] = _copy(frame.depth_path, folder, f"depth/{place}/{stem}")
                entry["integer_depth_scale"] = frame.depth_scale
        else:
            entry["file_path"] = f"{place}/{stem}{suffix}"
            _encode(frame, folder / entry["file_path"], quality)
            if frame.depth is not None:
                entry["depth_file_path"] = f"depth/{place}/{stem}.npy"
                _save(folder / entry["depth_file_path"], frame.depth)
        if video:
            entry |= {"camera": place, "frame": frame.frame, "time": frame.time}
        entries.append(entry | transforms(camera))
    folder.mkdir(exist_ok=True)
    write_json(folder / "transforms.json", {"frames": entries})


def write_heights(folder: Path, heights: HeightMaps) -> None:
    """``heights.json`` and its grids."""
    entries = [{"file_path": f"{number:+05d}.npy", "frame": number} for number in heights.grids]
    for entry, grid in zip(entries, heights.grids.values(), strict=True):
        _save(folder / str(entry["file_path"]), grid)
    noise = {} if heights.noise is None else {"noise": heights.noise}
    about = {"corner": np.asarray(heights.corner).tolist(), "cell": heights.cell, **noise}
    write_json(folder / "heights.json", {**about, "frames": entries})


def _save(path: Path, values: npt.NDArray[np.floating]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values.astype(np.float32), allow_pickle=False)


def _encode(picture: Picture, path: Path, quality: int) -> None:
    pixels = np.asarray(picture.image)
    wanted = (picture.camera.height, picture.camera.width, 3)
    if pixels.shape != wanted:
        raise MeasurementError(f"the image is {pixels.shape} where the camera says {wanted}", file=path)
    if pixels.dtype != np.uint8:
        if not np.isfinite(pixels).all():
            raise MeasurementError("the image has values that are not finite numbers", file=path)
        pixels = np.round(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, quality=quality, subsampling=0)


def _copy(source: Path, folder: Path, name: str) -> str:
    target = folder / f"{name}{source.suffix.lower()}"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return target.relative_to(folder).as_posix()


def write_table(path: Path, columns: Sequence[str], table: npt.NDArray[np.float64]) -> None:
    """Rows (n, c) as CSV, the first column as whole numbers."""
    rows = [",".join(columns)]
    rows += [",".join([str(int(row[0])), *(repr(float(v)) for v in row[1:])]) for row in table]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """A file of a set."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
