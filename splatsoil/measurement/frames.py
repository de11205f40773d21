"""Photographs with their cameras: nerfstudio's transforms.json, read and checked."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.errors import MeasurementError
from splatsoil.measurement import images
from splatsoil.measurement.camera import FISHEYE, LENSES, Camera
from splatsoil.measurement.fields import Fields, named
from splatsoil.measurement.motion import rigid

FloatImage = npt.NDArray[np.float32]
BoolImage = npt.NDArray[np.bool_]

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
# Fields that are read; nerfstudio and others have more.
LENS_FIELDS = (
    *("camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy", *_COEFFICIENTS),
    *("camera_angle_x", "camera_angle_y"),
)
FRAME_FIELDS = (*LENS_FIELDS, "file_path", "transform_matrix", "mask_path", "depth_file_path", "integer_depth_scale")
VIDEO_FIELDS = ("camera", "frame", "time")
# What describes a lens or a shutter in formats alike: COLMAP's, Metashape's, OpenCV's, nerfstudio's and instant-ngp's.
_LENS_KEY = re.compile(
    r"[kpsb]\d|skew|\w*distortion\w*|dist(_?coeff\w*)?|ftheta\w*|fisheye_crop_radius|rolling_shutter\w*"
    r"|equirectangular|latlong|orthographic",
    re.IGNORECASE,
)
_FOCAL_SLACK = 0.01  # further apart than digits that were cut off explain


@dataclass(frozen=True, eq=False)
class Frame:
    """One photograph.

    Attributes:
        camera: calibration and pose.
        path: the image file.
        camera_name: which camera took it; empty if the set has no name for it.
        frame: its number on the tool motion's clock, negative before the motion (pre-roll), None for views.
        time: seconds on that clock, None for views.
        mask_path: image that is dark where pixels are to be ignored, or None.
        depth_path: image or .npy of the depth along the camera's axis, as ``read_depth`` takes it, or None.
        depth_scale: what one of a depth's whole numbers means, m.
    """

    camera: Camera
    path: Path
    camera_name: str = ""
    frame: int | None = None
    time: float | None = None
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_scale: float = 1e-3

    def image(self) -> FloatImage:
        """The image as stored: (height, width, 3) float32, sRGB in [0, 1]."""
        return images.read_image(self.path)

    def mask(self) -> BoolImage | None:
        """Where the image is to be used, by its mask or its own transparency: (height, width) bool, or None."""
        if self.mask_path is not None:
            return images.read_mask(self.mask_path)
        return images.read_alpha(self.path)

    def depth(self) -> FloatImage | None:
        """Depth along the camera's axis, (height, width) float32 metres, 0 where unknown; None if there is none."""
        return None if self.depth_path is None else images.read_depth(self.depth_path, scale=self.depth_scale)

    def undistorted_image(self) -> FloatImage:
        """The image that ``camera.undistorted()`` would have taken; black where this lens did not see."""
        if not self.camera.has_distortion:
            return self.image()
        return undistorted(self.image(), self.camera)

    def undistorted_mask(self) -> BoolImage:
        """Where ``undistorted_image()`` shows the scene and the mask allows it: (height, width) bool."""
        mask = self.mask()
        if mask is None:
            mask = np.ones((self.camera.height, self.camera.width), dtype=bool)
        if not self.camera.has_distortion:
            return mask
        # A pixel blended from outside the image or from masked pixels is not to be trusted.
        return undistorted(mask[:, :, None].astype(np.float32), self.camera)[:, :, 0] > 0.999


def undistorted(image: FloatImage, camera: Camera) -> FloatImage:
    """Bilinear resampling of (height, width, channels) to the camera without distortion, zero outside the image."""
    import torch
    from kornia.geometry.transform import remap

    # kornia puts pixel centres at whole numbers, we at halves.
    where = np.nan_to_num(camera.undistortion_map() - 0.5, nan=-10.0 * max(camera.width, camera.height))
    grid = torch.from_numpy(where.astype(np.float32))
    pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
    out = remap(pixels, grid[None, :, :, 0], grid[None, :, :, 1], align_corners=True)
    return np.asarray(out[0].permute(1, 2, 0).numpy())


def read_transforms(file: Path, root: Path, *, video: bool) -> tuple[Frame, ...]:
    """Read a nerfstudio transforms.json and check every image it names.

    Args:
        file: the transforms.json; images are relative to its folder.
        root: the measurement set's folder, which no path may leave.
        video: require ``camera``, ``frame`` and ``time`` on each frame, and cameras that stay where they are.

    Raises:
        MeasurementError: naming file and field.
    """
    fields = Fields.read(file)
    fields.check_names((*LENS_FIELDS, "frames"))
    frames = tuple(_read_frame(item, root, video=video) for item in fields.children("frames"))
    _check_unique(frames, file, video=video)
    if video:
        _check_cameras(frames, file)
    told = f"w and h of {file.name}"
    for i, frame in enumerate(frames):
        size = (frame.camera.width, frame.camera.height)
        key = f"frames[{i}].file_path" if frame.mask_path is None else f"frames[{i}].mask_path"
        images.check_photograph(frame.path, size, sizes_from=told, field=f"frames[{i}].file_path")
        if frame.mask_path is None:
            mask = frame.mask()
        else:
            images.check_image(frame.mask_path, size, sizes_from=told, field=key)
            mask = images.read_mask(frame.mask_path, key)
        if mask is not None and not mask.any():
            raise MeasurementError(
                "nothing of the photograph is left: all of it is masked or transparent",
                file=frame.mask_path or frame.path,
                field=key,
            )
        if frame.depth_path is not None:
            _check_depth(frame.depth_path, size, told, f"frames[{i}].depth_file_path")
    return frames


def read_blender(file: str | Path) -> tuple[Frame, ...]:
    """Frames of a Blender or NeRF-synthetic ``transforms_train.json``, ordered by image name.

    Most give one horizontal field of view (``camera_angle_x``): the principal point is in the middle then, pixels are
    square, and nothing bends the image. What else of a lens a file gives is read as in nerfstudio's. File paths may
    lack their suffix; times, if any, are left out.

    Raises:
        MeasurementError: naming file and field.
    """
    path = Path(file)
    fields = Fields.read(path)
    if not fields.has("fl_x"):
        fields.raw("camera_angle_x")
    frames = []
    for item in fields.children("frames"):
        image = named(item.text("file_path"), path.parent, path, item.path_of("file_path"))
        if not image.is_file():
            raise MeasurementError(f"no such image, though {path.name} names it", file=image)
        camera = read_camera(item, "", images.image_size(image))
        sizes_from = f"w and h of {path.name}" if item.has("w") or item.has("h") else "its own header"
        images.check_image(image, (camera.width, camera.height), sizes_from=sizes_from)
        frames.append(Frame(camera, image))
    return tuple(sorted(frames, key=lambda frame: frame.path))


def read_camera(fields: Fields, name: str, size: tuple[int, int] | None = None) -> Camera:
    """A camera from one frame's fields (those the frame lacks come from the top of the file).

    Args:
        fields: the frame's.
        name: what the camera is called.
        size: (width, height) of the image where the file may leave size, principal point (the centre, then) and all
            but one focal length out, as Blender's files do.

    Raises:
        MeasurementError: naming the field.
    """
    lens = fields.text("camera_model") if fields.has("camera_model") else "OPENCV"
    if fields.has("is_fisheye"):
        fisheye = fields.flag("is_fisheye")
        if fisheye and not fields.has("camera_model"):
            lens = FISHEYE
        elif fisheye != (LENSES.get(lens, ("",))[0] == FISHEYE):
            fields.fail("is_fisheye", f"{fisheye} contradicts the model {lens}; give one of both")
    if lens not in LENSES:
        fields.fail("camera_model", f"unknown camera model {lens!r}; known are {', '.join(LENSES)}")
    model, parameters = LENSES[lens]
    # nerfstudio's OPENCV has four radial coefficients, where COLMAP's has two.
    known = _COEFFICIENTS if lens == "OPENCV" else parameters
    for key in fields.names():
        unused = key == "fisheye_crop_radius" and model != FISHEYE
        if _LENS_KEY.fullmatch(key) and key not in known and not unused and _acts(fields.raw(key)):
            advice = "undistort the images first" if model == FISHEYE or key not in _COEFFICIENTS else "say OPENCV"
            fields.fail(key, f"the model {lens} has no {key}, and this one is not 0; {advice}")
    bend = {key: fields.number(key, default=0.0) for key in _COEFFICIENTS if key in known}
    width, height = (
        fields.integer(key, 1, 100_000) if size is None or fields.has(key) else size[axis]
        for axis, key in enumerate("wh")
    )
    fx = _read_focal(fields, "x", width)
    alike = not (fields.has("fl_y") or fields.has("camera_angle_y")) and ("f" in parameters or size is not None)
    fy = fx if alike else _read_focal(fields, "y", height)
    if "f" in parameters and abs(fx - fy) > _FOCAL_SLACK * fx:
        fields.fail("fl_y", f"the model {lens} has one focal length, but fl_x = {fx:g} and fl_y = {fy:g}")
    middle = (None, None) if size is None else (0.5 * width, 0.5 * height)
    camera = Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=fields.number("cx", -10.0 * width, 11.0 * width, default=middle[0]),
        cy=fields.number("cy", -10.0 * height, 11.0 * height, default=middle[1]),
        camera_to_world=_read_pose(fields),
        **bend,
        name=name,
        model=model,
    )
    if not np.isfinite(camera.rays([[camera.cx, camera.cy]])[1]).all():
        fields.fail("k1", "no ray is distorted to the principal point; check the coefficients")
    return camera


def _acts(value: object) -> bool:
    """Whether a lens's numbers or switch, or one of a list of them, are not 0."""
    if isinstance(value, list):
        return any(map(_acts, value))
    return isinstance(value, int | float) and value != 0


def _read_focal(fields: Fields, axis: str, length: int) -> float:
    """The focal length along an axis in pixels, by ``fl_x`` or by ``camera_angle_x``, which must agree."""
    key, angle_key = f"fl_{axis}", f"camera_angle_{axis}"
    if fields.has(key) or not fields.has(angle_key):
        focal = fields.number(key, 0.05 * length, 1000.0 * length, hint="focal lengths are given in pixels")
    if not fields.has(angle_key):
        return focal
    hint = f"it is the field of view along {axis} in radians"
    by_angle = 0.5 * length / math.tan(0.5 * fields.number(angle_key, 1e-3, math.pi - 1e-3, hint=hint))
    if fields.has(key) and abs(focal - by_angle) > _FOCAL_SLACK * focal:
        fields.fail(key, f"{focal:g} pixels contradict {angle_key}, by which they are {by_angle:g}; give one of both")
    return focal if fields.has(key) else by_angle


def _read_pose(fields: Fields) -> npt.NDArray[np.float64]:
    try:
        return rigid(fields.matrix("transform_matrix", 4, 4))
    except ValueError as error:
        fields.fail("transform_matrix", str(error))


def _read_frame(fields: Fields, root: Path, *, video: bool) -> Frame:
    base = fields.file.parent
    fields.check_names((*FRAME_FIELDS, *VIDEO_FIELDS) if video else FRAME_FIELDS)
    name = fields.name("camera") if video or fields.has("camera") else ""
    mask, depth = (
        fields.path(key, root, base) if fields.has(key) else None for key in ("mask_path", "depth_file_path")
    )
    return Frame(
        frame=fields.integer("frame", -(10**9), 10**9) if video else None,
        time=fields.number("time") if video else None,
        camera=read_camera(fields, name),
        path=fields.path("file_path", root, base),
        camera_name=name,
        mask_path=mask,
        depth_path=depth,
        depth_scale=fields.number("integer_depth_scale", 1e-7, 1.0, default=1e-3, hint="it is in metres"),
    )


def _check_unique(frames: tuple[Frame, ...], file: Path, *, video: bool) -> None:
    """No image, and no camera's frame, is given twice, nor a photograph, each of which has its own noise, under two
    names: one of the poses would be wrong."""
    seen: dict[object, int] = {}
    for i, frame in enumerate(frames):
        image, twice = f"the image {frame.path.name}", "is given twice, first in"
        keys: list[tuple[object, str, str, str]] = [(frame.path, "file_path", f"{image} {twice}", "")]
        if video:
            what = f"frame {frame.frame} of camera {frame.camera_name!r}"
            keys.append(((frame.camera_name, frame.frame), "frame", f"{what} {twice}", ""))
        else:
            content = hashlib.sha256(frame.path.read_bytes()).digest()
            keys.append((content, "file_path", f"{image} is the same as that of", ", bit by bit"))
        for key, field, fault, how in keys:
            first = seen.setdefault(key, i)
            if first < i:
                raise MeasurementError(f"{fault} frames[{first}]{how}", file=file, field=f"frames[{i}].{field}")


def _check_cameras(frames: tuple[Frame, ...], file: Path) -> None:
    """Each camera of a video stands still, keeps its calibration, and its clock goes on."""
    for name in dict.fromkeys(frame.camera_name for frame in frames):
        own = [(i, frame) for i, frame in enumerate(frames) if frame.camera_name == name]
        start, first = own[0]
        for i, frame in own:
            field, fault = f"frames[{i}]", ""
            if np.abs(frame.camera.camera_to_world - first.camera.camera_to_world).max() > 1e-4:
                field, fault = f"{field}.transform_matrix", "moves; the video's cameras must stand still"
            elif _calibration(frame.camera) != _calibration(first.camera):
                fault = f"has another calibration than in frames[{start}]"
            if fault:
                raise MeasurementError(f"camera {name!r} {fault}", file=file, field=field)
        for (_, before), (i, after) in pairwise(sorted(own, key=lambda pair: pair[1].frame or 0)):
            assert before.time is not None and after.time is not None
            if after.time <= before.time:
                raise MeasurementError(
                    f"time runs backwards: camera {name!r} has frame {before.frame} at {before.time:g} s, "
                    f"frame {after.frame} at {after.time:g} s",
                    file=file,
                    field=f"frames[{i}].time",
                )


def _calibration(camera: Camera) -> tuple[object, ...]:
    return camera.model, camera.width, camera.height, *camera.intrinsics.ravel(), *camera.distortion


def _check_depth(path: Path, size: tuple[int, int], told: str, field: str) -> None:
    depth = images.read_depth(path, field)
    if depth.shape != size[::-1]:
        raise MeasurementError(f"the depth is {depth.shape[::-1]} where {told} say {size}", file=path, field=field)
    if not depth.any():
        raise MeasurementError("no depth is known: none is positive", file=path, field=field)
