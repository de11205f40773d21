"""Posed photographs as others keep them: nerfstudio, instant-ngp, Blender, COLMAP; or photographs to be posed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatsoil.errors import MeasurementError
from splatsoil.importing.sfm import posed
from splatsoil.measurement.colmap import read_colmap
from splatsoil.measurement.fields import Fields
from splatsoil.measurement.frames import Frame, read_blender, read_transforms

CAMERA_FILES = ("transforms.json", "transforms_train.json")
MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
IMAGE_FOLDERS = ("images", "../images", "../../images", "../../../images")


@dataclass(frozen=True)
class Source:
    """What a reconstruction of others holds.

    Attributes:
        frames: photographs with cameras, in the source's own world and unit.
        kind: which of the formats it is, for people.
        has_up: whether z is up in the format.
    """

    frames: tuple[Frame, ...]
    kind: str
    has_up: bool


def read_source(path: Path, images: Path | None = None, *, sfm: bool = False) -> Source:
    """Read posed photographs, or pose them.

    Args:
        path: a transforms.json (nerfstudio, instant-ngp, Blender), a COLMAP model's folder, or a folder that has one of
            these at the usual place.
        images: of a COLMAP model, the folder that its images' names are relative to; looked for beside it by default.
        sfm: whether the path is a folder of photographs without poses.

    Raises:
        MeasurementError: nothing of the kind is there, or it is faulty; names file and field.
    """
    if sfm:
        return Source(posed(path), "pycolmap", has_up=False)
    if path.is_file():
        return _read_json(path)
    if not path.is_dir():
        raise MeasurementError("no such file or folder; give a transforms.json or a COLMAP model", file=path)
    for name in CAMERA_FILES:
        if (path / name).is_file():
            return _read_json(path / name)
    for name in MODEL_FOLDERS:
        model = path / name
        if (model / "cameras.bin").is_file() or (model / "cameras.txt").is_file():
            return Source(read_colmap(model, images or _images_of(model)), "COLMAP", has_up=False)
    raise MeasurementError(
        "holds no transforms.json, transforms_train.json, or COLMAP model (cameras.bin or cameras.txt)", file=path
    )


def _read_json(file: Path) -> Source:
    fields = Fields.read(file)
    first = next(fields.children("frames"))
    # Blender's files leave the size to the images.
    if first.has("w") and first.has("h"):
        kind = "instant-ngp" if fields.has("aabb_scale") else "nerfstudio"
        return Source(read_transforms(file, file.parent, video=False), kind, has_up=True)
    return Source(read_blender(file), "Blender", has_up=True)


def _images_of(model: Path) -> Path:
    for name in IMAGE_FOLDERS:
        if (model / name).is_dir():
            return model / name
    raise MeasurementError("no folder images beside the model; give their folder by --images", file=model)


def find_image(frames: Sequence[Frame], name: str) -> Frame:
    """The photograph of a name, or of the end of its path.

    Raises:
        MeasurementError: there is none, or there are several.
    """
    parts = Path(name).parts
    found = [frame for frame in frames if parts and frame.path.parts[-len(parts) :] == parts]
    if len(found) != 1:
        problem = "no posed photograph" if not found else f"{len(found)} posed photographs"
        raise MeasurementError(f"{problem} of the name {name!r}")
    return found[0]
