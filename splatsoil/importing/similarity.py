"""From a reconstruction's own world to metres with z up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.importing.source import find_image
from splatsoil.measurement.fields import read_labelled, read_text
from splatsoil.measurement.frames import Frame

Marks = dict[str, list[tuple[Frame, FloatArray]]]
"""Photographs, and pixels (2,) in them, by point."""

_PARALLEL = 1e-4  # squared sine of the angle between rays that meet nowhere in particular
_UNLIKE = 0.1  # of known points' spread about their middle: what no survey is off by
_FLAT = 1e-3  # of known points' spread along one line, across it: they determine no rotation about it


@dataclass(frozen=True)
class Marked:
    """Points in the reconstruction's world.

    Attributes:
        places: (3,) by name.
        error: root mean square of the distance from where they were marked, px; 0 where places were given.
    """

    places: Mapping[str, FloatArray]
    error: float = 0.0


def read_points(file: Path) -> dict[str, FloatArray]:
    """Points (3,) by name, from a CSV file of ``point,x,y,z``.

    Raises:
        MeasurementError: naming file and line.
    """
    names, places = read_labelled(file, ("point",), ("x", "y", "z"))
    points = {name: place for (name,), place in zip(names, places, strict=True)}
    if len(points) < len(names):
        raise MeasurementError("a point is given twice", file=file, field="point")
    return points


def read_marked(file: Path, frames: Sequence[Frame]) -> Marked:
    """Points in the reconstruction's world, from ``point,x,y,z``, or ``point,image,u,v``: pixels of photographs, from
    the image's left and top edge, at least two of each point.

    Raises:
        MeasurementError: naming file and what is wrong.
    """
    header = read_text(file).split("\n", 1)[0].lower()
    if "image" not in header:
        return Marked(read_points(file))
    marks: Marks = {}
    try:
        for (name, image), pixel in zip(*read_labelled(file, ("point", "image"), ("u", "v")), strict=True):
            marks.setdefault(name, []).append((find_image(frames, image), pixel))
        return intersected(marks)
    except MeasurementError as error:
        raise MeasurementError(str(error), file=file) from error


def intersected(marks: Marks) -> Marked:
    """Points where the rays through their pixels meet.

    Raises:
        MeasurementError: one is marked in fewer than two photographs from different places.
    """
    places = {name: _triangulated(name, seen) for name, seen in marks.items()}
    errors = [
        frame.camera.project(places[name][None])[0][0] - pixel for name, seen in marks.items() for frame, pixel in seen
    ]
    return Marked(places, float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))))


def _triangulated(name: str, marks: Sequence[tuple[Frame, FloatArray]]) -> FloatArray:
    """The point nearest to all rays, in least squares."""
    rays = [frame.camera.rays(pixel[None]) for frame, pixel in marks]
    origins, ways = (np.concatenate([ray[k] for ray in rays]) for k in (0, 1))
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    if not np.isfinite(across).all():
        raise MeasurementError(f"point {name!r} is marked where its photograph shows nothing")
    if len(marks) < 2 or np.linalg.eigvalsh(across.sum(axis=0))[0] < _PARALLEL:
        raise MeasurementError(f"point {name!r} needs marks in two photographs from different places")
    return np.asarray(np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, origins)))


def by_known_points(marked: Mapping[str, FloatArray], known: Mapping[str, FloatArray]) -> tuple[FloatArray, float]:
    """The similarity (4, 4) that takes marked points to known places, and the root mean square of what is left, m.

    Least squares of S. Umeyama (1991), IEEE PAMI 13:376.

    Raises:
        MeasurementError: fewer than three points have both, or they lie on a line.
    """
    names = sorted(marked.keys() & known.keys())
    if len(names) < 3:
        raise MeasurementError(f"a scale and a turn need three known points that are marked, not {len(names)}")
    x, y = (np.stack([places[name] for name in names]) for places in (marked, known))
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    for spread, what in ((dx, "marked"), (dy, "known")):
        sizes = np.linalg.svd(spread, compute_uv=False)
        if sizes[1] <= _FLAT * sizes[0]:
            raise MeasurementError(f"the {what} points lie on one line; take one that doesn't")
    turn = Rotation.align_vectors(dy, dx)[0]
    out = np.eye(4)
    out[:3, :3] = np.sum(dy * turn.apply(dx)) / np.sum(dx**2) * turn.as_matrix()
    out[:3, 3] = y.mean(axis=0) - out[:3, :3] @ x.mean(axis=0)
    left = float(np.linalg.norm(x @ out[:3, :3].T + out[:3, 3] - y))
    if left > _UNLIKE * float(np.linalg.norm(dy)):
        raise MeasurementError(
            f"the known points are {left / np.sqrt(len(x)):.2g} m off the marked ones (root mean square); are names"
            " exchanged, or an axis mirrored?"
        )
    return out, left / float(np.sqrt(len(x)))


def by_scale(scale: float, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """The similarity (4, 4) of a scale, in m, and the smallest turn that takes the direction ``up`` to +z.

    Raises:
        MeasurementError: a scale that isn't positive, or no direction.
    """
    if not (np.isfinite(scale) and scale > 0.0):
        raise MeasurementError(f"a scale is a positive number of metres, not {scale:g}")
    way = np.asarray(up, dtype=np.float64)
    length = float(np.linalg.norm(way))
    if not (np.isfinite(length) and length > 0.0):
        raise MeasurementError("up is a direction: three numbers that are not all 0")
    out = np.eye(4)
    out[:3, :3] = scale * Rotation.align_vectors([[0.0, 0.0, 1.0]], [way / length])[0].as_matrix()
    return out


def distance_scale(marked: Mapping[str, FloatArray], first: str, second: str, metres: float) -> float:
    """Metres for each unit of the reconstruction's world, by the distance between two marked points.

    Raises:
        MeasurementError: one isn't marked, or there is no distance between them.
    """
    missing = [name for name in (first, second) if name not in marked]
    if missing:
        raise MeasurementError(f"point {missing[0]!r} is not marked; marked are {', '.join(marked)}")
    apart = float(np.linalg.norm(marked[first] - marked[second]))
    if not apart > 0.0:
        raise MeasurementError(f"points {first!r} and {second!r} are in one place")
    return metres / apart


def moved(frame: Frame, similarity: FloatArray) -> Frame:
    """A photograph in the new world. Its depth, whose unit was the old one's, is left out where the scale changes."""
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    depth = frame.depth_path if abs(scale - 1.0) < 1e-3 else None
    return replace(frame, camera=frame.camera.moved(similarity), depth_path=depth)
