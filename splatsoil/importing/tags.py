"""AprilTags (E. Olson 2011, ICRA) of the family 36h11: the scale from photographs, the tool's motion from video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.importing.similarity import Marks, by_scale, intersected
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
MOMENTS = 60
"""Of the video, at most, that the scale is estimated from."""


def _detector(option: str) -> Any:
    try:
        from pupil_apriltags import Detector
    except ImportError as error:
        raise ParameterError(f"{option}: needs pupil-apriltags; pip install 'splatsoil[tags]'") from error
    detector = Detector(families=FAMILY)
    # It would free the families before the detector, which reads them then (pupil-labs/apriltags, pull request 65).
    detector.tag_families = {}
    return detector


def _grey(frame: Frame) -> npt.NDArray[np.uint8]:
    return np.rint(255.0 * frame.image().mean(axis=2)).astype(np.uint8)


def tag_scale(frames: Sequence[Frame], edge: float) -> tuple[float, float]:
    """Metres for each unit of the photographs' world, and the corners' root mean square distance from their pixels.

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
        for tag in detector.detect(_grey(frame)):
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
    return edge / mean, marked.error


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
    """One tag in one picture: its corners (4, 2) in px and (4, 3) in the tool's frame, in m, and the pose (4, 4) of the
    tool in the camera's frame that the tag alone gives, in m."""

    camera: Camera
    pixels: FloatArray
    corners: FloatArray
    to_camera: FloatArray

    def start(self) -> FloatArray:
        """The pose (6,) of the tool's frame that the tag alone gives: rotation vector, position in m."""
        pose = np.linalg.inv(self.camera.world_to_camera) @ self.to_camera
        return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])

    def residuals(self, pose: FloatArray) -> FloatArray:
        """(8,) px."""
        points = Rotation.from_rotvec(pose[:3]).apply(self.corners) + pose[3:]
        return np.asarray((self.camera.project(points)[0] - self.pixels).ravel())

    def moved(self, similarity: FloatArray) -> _Seen:
        return replace(self, camera=self.camera.moved(similarity))


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


@dataclass(frozen=True, eq=False)
class ToolTags:
    """Tags of the tool, as the photographs' and the video's cameras saw them in the source's world.

    Attributes:
        rate: frames of the video a second.
        filmed: by the video's frame.
        photographed: in the photographs; the tool rests there.
    """

    rate: float
    filmed: Mapping[int, Sequence[_Seen]]
    photographed: Sequence[_Seen]

    def scale(self) -> tuple[float, float]:
        """Metres for each unit of the source's world, and the corners' root mean square distance from their pixels.

        Least squares of the reprojection errors, with the scale and a pose of the tool at each moment free (bundle
        adjustment, B. Triggs et al. 2000, LNCS 1883:298). The poses are eliminated at each scale (variable projection,
        G. Golub & V. Pereyra 1973, SIAM J. Numer. Anal. 10:413). Where one camera alone sees the tool, its distance
        determines no scale, so moments with one are left out.

        Raises:
            MeasurementError: no two cameras in different places see the tool's tags at one moment.
        """
        filmed = [seen for seen in self.filmed.values() if len(_places(seen)) > 1]
        spread = np.unique(np.linspace(0, len(filmed) - 1, MOMENTS).astype(int)) if filmed else ()
        moments = [filmed[k] for k in spread]
        moments += [self.photographed] if len(_places(self.photographed)) > 1 else []
        # Of two cameras: how far apart the tool's tags put them, m, over how far apart they are.
        ratios = [
            np.linalg.norm(_seen_from(one) - _seen_from(other)) / np.linalg.norm(apart)
            for seen in moments
            for one, other in combinations(seen, 2)
            if (apart := one.camera.position - other.camera.position).any()
        ]
        if not ratios:
            raise MeasurementError(
                "--motion-tags: a scale needs two cameras that see the tool's tags at one moment; give another scale"
            )

        def cost(logarithm: float) -> float:
            similarity = by_scale(float(np.exp(logarithm)))
            return sum(_fitted([one.moved(similarity) for one in seen])[1] for seen in moments)

        start = float(np.log(np.median(ratios)))
        found = minimize_scalar(cost, bracket=(start, start + 0.01), tol=1e-5)
        return float(np.exp(found.x)), float(np.sqrt(found.fun / sum(4 * len(seen) for seen in moments)))

    def motion(self, similarity: FloatArray) -> TagMotion:
        """The tool's poses in the set's world: least squares of the reprojection errors, by all cameras together.

        Frames at either end whose corners do not contradict one pose (F-test) share it: the tool rests there.

        Raises:
            MeasurementError: fewer than two frames show a tag.
        """
        if len(self.filmed) < 2:
            raise MeasurementError(
                f"--motion-tags: the video shows the tool's tags in {len(self.filmed)} frames; two are needed"
            )
        numbers = sorted(self.filmed)
        observed = [[one.moved(similarity) for one in self.filmed[number]] for number in numbers]
        fits = [_fitted(one) for one in observed]
        poses = np.array([pose for pose, _ in fits])
        for order in (range(len(numbers)), range(len(numbers))[::-1]):
            resting, pose = _resting([observed[k] for k in order], [fits[k][1] for k in order])
            poses[list(order)[:resting]] = pose
        error = np.sqrt(sum(cost for _, cost in fits) / sum(4 * len(one) for one in observed))
        turns = Rotation.from_rotvec(poses[:, :3]).as_quat(scalar_first=True)
        frames = np.array(numbers)
        return TagMotion(ToolMotion(frames, frames / self.rate, poses[:, 3:], turns), float(error))


def find_tool_tags(
    photographs: Sequence[Frame], videos: Mapping[str, tuple[Video, Camera]], tags: Mapping[int, FloatArray]
) -> ToolTags:
    """The tool's tags in all pictures.

    Args:
        photographs: that show the tool at rest, or not.
        videos: files on one clock, and their cameras in the photographs' world.
        tags: corners (4, 3) in the tool's frame, m, by number.

    Raises:
        ParameterError: pupil-apriltags isn't installed.
    """
    detector = _detector("--motion-tags")
    filmed: dict[int, list[_Seen]] = {}
    for video, camera in videos.values():
        for number, picture in video.pictures(set(video.numbers)):
            if found := _seen(detector, np.rint(picture.mean(axis=2)).astype(np.uint8), camera, tags):
                filmed.setdefault(number, []).extend(found)
    still = [one for frame in photographs for one in _seen(detector, _grey(frame), frame.camera, tags)]
    return ToolTags(next(iter(videos.values()))[0].rate, filmed, still)


def _places(seen: Sequence[_Seen]) -> set[bytes]:
    """Of the cameras."""
    return {one.camera.position.tobytes() for one in seen}


def _seen_from(one: _Seen) -> FloatArray:
    """Where the camera is in the tool's frame (3,), m, by this tag alone."""
    return np.asarray(np.linalg.inv(one.to_camera)[:3, 3])


def _seen(detector: Any, grey: npt.NDArray[np.uint8], camera: Camera, tags: Mapping[int, FloatArray]) -> list[_Seen]:
    out = []
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    for tag in detector.detect(grey, estimate_tag_pose=True, camera_params=lens, tag_size=1.0):
        if tag.tag_id not in tags:
            continue
        corners = tags[tag.tag_id]
        edge = float(np.linalg.norm(corners[1] - corners[0]))
        turn = Rotation.align_vectors(UNIT_SQUARE, corners - corners.mean(axis=0))[0]
        to_camera = np.eye(4)
        to_camera[:3, :3] = tag.pose_R @ turn.as_matrix()
        to_camera[:3, 3] = edge * tag.pose_t.ravel() - to_camera[:3, :3] @ corners.mean(axis=0)
        out.append(_Seen(camera, np.asarray(tag.corners), corners, to_camera))
    return out


def _fitted(seen: Sequence[_Seen]) -> tuple[FloatArray, float]:
    """The pose (6,) and the sum of squares, px², from that tag's pose on which agrees best with all tags."""

    def residuals(pose: FloatArray) -> FloatArray:
        return np.concatenate([one.residuals(pose) for one in seen])

    start = min((one.start() for one in seen), key=lambda pose: float(np.sum(residuals(pose) ** 2)))
    found = least_squares(residuals, start, method="lm", x_scale="jac")
    return np.asarray(found.x), 2.0 * float(found.cost)


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
