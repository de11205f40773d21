"""Scale from AprilTags (E. Olson 2011, ICRA) of the family 36h11 that photographs show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.importing.similarity import Marked, Marks, intersected
from splatsoil.measurement.frames import Frame

FAMILY = "tag36h11"
ALIKE = 0.1
"""Edges that differ by more of their mean are of tags of two sizes, or of two tags with one number."""


def tag_scale(frames: Sequence[Frame], edge: float) -> tuple[float, Marked]:
    """Metres for each unit of the photographs' world, and the tags' corners in it.

    Args:
        frames: posed photographs; each number of a tag is there once.
        edge: of a tag's black square, m.

    Raises:
        ParameterError: pupil-apriltags isn't installed.
        MeasurementError: no tag is seen in two photographs from different places, or tags differ in size.
    """
    try:
        from pupil_apriltags import Detector
    except ImportError as error:
        raise ParameterError("--tags: needs pupil-apriltags; pip install 'splatsoil[tags]'") from error
    detector = Detector(families=FAMILY)
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
