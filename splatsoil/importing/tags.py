"""AprilTags (E. Olson 2011, ICRA) of the family 36h11: the scale from photographs, the tool's motion from video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.importing.similarity import Marked, Marks, intersected
from splatsoil.importing.video import Video
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.fields import read_labelled
from splatsoil.measurement.frames import Frame
from splatsoil.measurement.motion import ToolMotion

FAMILY = "tag36h11"
ALIKE = 0.1
"""Edges that differ by more of their mean are of tags of two sizes, or of two tags with one number."""
CORNERS = ("lower left", "lower right", "upper right", "upper left")
"""Of a tag that is printed upright, in the detector's order."""
UNIT_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners in the detector's frame of a tag: x to the right, y down, for an edge of 1."""
SIGNIFICANCE = 0.01
"""Of the test that the tool has moved."""


def _detector(option: str) -> Any:
    try:
        from pupil_apriltags import Detector
    except ImportError as error:
        raise ParameterError(f"{option}: needs pupil-apriltags; pip install 'splatsoil[tags]'") from error
    return Detector(families=FAMILY)


def tag_scale(frames: Sequence[Frame], edge: float) -> tuple[float, Marked]:
    """Metres for each unit of the photographs' world, and the tags' corners in it.

    Args:
        frames: posed photographs; each number of a tag is there once.
        edge: of a tag's black square, m.

    Raises:
        ParameterError: pupil-apriltags isn't installed.
        MeasurementError: no tag is seen in two photographs from different places, or tags differ in size.
    """
    detector = _detector("--tags")
    marks: Marks = {}
    for frame in frames:
        grey = np.rint(255.0 * frame.image().mean(axis=2)).astype(np.uint8)
        for tag in detector.detect(grey):
            for k, pixel in enumerate(tag.corners):
                marks.setdefault(f"tag {tag.tag_id}, corner {k}", []).append((frame, np.asarray(pixel)))
    several = {name: seen for name, seen in marks.items() if len(seen) > 1}
    if not several:
        raise MeasurementError(f"--tags: no tag of the family {FAMILY} is seen in two photographs")
    marked = intersected(several)
    tags = sorted({name.split(",")[0] for name in marked.places})
    corners = np.array([[marked.places[f"{tag}, corner {k}"] for k in range(4)] for tag in tags])
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    mean = float(edges.mean())
    if edges.max() - edges.min() > ALIKE * mean:
        raise MeasurementError(
            f"--tags: edges of the tags {', '.join(tag.removeprefix('tag ') for tag in tags)} differ by"
            f" {100.0 * (edges.max() - edges.min()) / mean:.0f} %; print each number once, all of one size"
        )
    return edge / mean, marked


@dataclass(frozen=True, eq=False)
class TagMotion:
    """The tool's motion as its tags show it.

    Attributes:
        motion: of the tool's frame, at the frames that show a tag, on the video's clock.
        error: root mean square of the corners' distance from their pixels, px.
    """

    motion: ToolMotion
    error: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """One tag in one picture: its corners (4, 2) in px and (4, 3) in the tool's frame, in m, and the pose (6,) of the
    tool's frame that the tag alone gives: rotation vector, position in m."""

    camera: Camera
    pixels: FloatArray
    corners: FloatArray
    start: FloatArray

    def residuals(self, pose: FloatArray) -> FloatArray:
        """(8,) px."""
        points = Rotation.from_rotvec(pose[:3]).apply(self.corners) + pose[3:]
        return np.asarray((self.camera.project(points)[0] - self.pixels).ravel())


def read_tool_tags(file: Path) -> dict[int, FloatArray]:
    """Corners (4, 3) of the tool's tags in the tool's frame, m, in the order of `CORNERS`, by the tag's number.

    Args:
        file: CSV of ``tag,corner,x,y,z``.

    Raises:
        MeasurementError: naming file and what is wrong.
    """
    names, places = read_labelled(file, ("tag", "corner"), ("x", "y", "z"))
    given = {(tag.strip(), corner.strip()): place for (tag, corner), place in zip(names, places, strict=True)}
    tags = sorted({tag for tag, _ in given})
    faulty = [tag for tag in tags if not tag.isdecimal()]
    if faulty:
        raise MeasurementError(f"{faulty[0]!r} is no number of a tag", file=file, field="tag")
    wanted = {(tag, corner) for tag in tags for corner in CORNERS}
    if len(given) < len(names) or given.keys() != wanted:
        raise MeasurementError(f"each tag needs one row for each of {', '.join(CORNERS)}", file=file, field="corner")
    out = {int(tag): np.array([given[tag, corner] for corner in CORNERS]) for tag in tags}
    for tag, corners in out.items():
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        if not edges.min() > (1.0 - ALIKE) * edges.max():
            raise MeasurementError(f"the edges of tag {tag} have different lengths; it is a square", file=file)
    return out


def tag_motion(videos: Mapping[str, tuple[Video, Camera]], tags: Mapping[int, FloatArray]) -> TagMotion:
    """The tool's poses: least squares of the corners' reprojection errors, by all cameras together.

    Frames at either end whose corners do not contradict one pose (F-test) share it: the tool rests there.

    Args:
        videos: files on one clock, and their cameras.
        tags: corners (4, 3) in the tool's frame, m, by number.

    Raises:
        ParameterError: pupil-apriltags isn't installed.
        MeasurementError: fewer than two frames show a tag.
    """
    detector = _detector("--motion-tags")
    seen: dict[int, list[_Seen]] = {}
    for video, camera in videos.values():
        for number, picture in video.pictures(set(video.numbers)):
            found = _seen(detector, np.rint(picture.mean(axis=2)).astype(np.uint8), camera, tags)
            if found:
                seen.setdefault(number, []).extend(found)
    if len(seen) < 2:
        raise MeasurementError(f"--motion-tags: the video shows the tool's tags in {len(seen)} frames; two are needed")
    rate = next(iter(videos.values()))[0].rate
    numbers = sorted(seen)
    observed = [seen[number] for number in numbers]
    fits = [_fitted(one) for one in observed]
    poses = np.array([pose for pose, _ in fits])
    for order in (range(len(numbers)), range(len(numbers))[::-1]):
        resting, pose = _resting([observed[k] for k in order], [fits[k][1] for k in order])
        poses[list(order)[:resting]] = pose
    error = np.sqrt(sum(cost for _, cost in fits) / sum(4 * len(one) for one in observed))
    turns = Rotation.from_rotvec(poses[:, :3]).as_quat(scalar_first=True)
    frames = np.array(numbers)
    return TagMotion(ToolMotion(frames, frames / rate, poses[:, 3:], turns), float(error))


def _seen(detector: Any, grey: npt.NDArray[np.uint8], camera: Camera, tags: Mapping[int, FloatArray]) -> list[_Seen]:
    out = []
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    for tag in detector.detect(grey, estimate_tag_pose=True, camera_params=lens, tag_size=1.0):
        if tag.tag_id not in tags:
            continue
        corners = tags[tag.tag_id]
        edge = float(np.linalg.norm(corners[1] - corners[0]))
        turn = Rotation.align_vectors(UNIT_SQUARE, corners - corners.mean(axis=0))[0]
        to_camera = Rotation.from_matrix(tag.pose_R) * turn
        to_world = np.linalg.inv(camera.world_to_camera)
        pose = Rotation.from_matrix(to_world[:3, :3]) * to_camera
        middle = to_world[:3, :3] @ (edge * tag.pose_t.ravel()) + to_world[:3, 3]
        start = np.concatenate([pose.as_rotvec(), middle - pose.apply(corners.mean(axis=0))])
        out.append(_Seen(camera, np.asarray(tag.corners), corners, start))
    return out


def _fitted(seen: Sequence[_Seen]) -> tuple[FloatArray, float]:
    """The pose (6,) and the sum of squares, px²: the best from each tag's own."""

    def residuals(pose: FloatArray) -> FloatArray:
        return np.concatenate([one.residuals(pose) for one in seen])

    found = [least_squares(residuals, one.start, method="lm", x_scale="jac") for one in seen]
    best = min(found, key=lambda result: float(result.cost))
    return np.asarray(best.x), 2.0 * float(best.cost)


def _resting(observed: Sequence[Sequence[_Seen]], costs: Sequence[float]) -> tuple[int, FloatArray]:
    """How many first frames one pose (6,) explains as well as a pose for each does, and that pose."""
    count, (pose, _) = 1, _fitted(observed[0])
    for n in range(2, len(observed) + 1):
        pooled, cost = _fitted([one for frame in observed[:n] for one in frame])
        apart, more = sum(costs[:n]), 6 * (n - 1)
        free = 8 * sum(len(frame) for frame in observed[:n]) - 6 * n
        if f_distribution.sf((cost - apart) / more / (apart / free), more, free) < SIGNIFICANCE:
            break
        count, pose = n, pooled
    return count, pose
