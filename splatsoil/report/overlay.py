"""The set's geometry drawn over its photographs: wrong poses, scales and clocks are seen at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from splatsoil.arrays import FloatArray
from splatsoil.measurement import Measurement
from splatsoil.measurement.frames import Frame

BED, TOOL, MOTION = (64, 220, 255), (255, 64, 64), (255, 200, 0)
"""Colours (8-bit RGB) of the bed's box, the tool's edges, and the path of the tool's centre."""
SHARP = 0.5
"""Faces of the tool that meet at a larger angle, in rad, have their edge drawn."""
PIECES = 40
"""Of each line, so that it follows the lens."""
TIMES = 3
"""Frames of each camera that are drawn: the first, the last, and what lies between them evenly."""


def overlays(measurement: Measurement) -> Iterator[tuple[str, Image.Image]]:
    """Each view with the bed's box and the tool's path, and frames of each fixed camera with the tool, too.

    Yields:
        A name without suffix, and the picture as its file has it.
    """
    bed, tool, motion = _box(measurement), _edges(measurement.tool.mesh), measurement.tool.motion
    centre = measurement.tool.mesh.bounds.mean(axis=0)
    places = np.array([motion.matrix(float(time))[:3] @ [*centre, 1.0] for time in motion.times])
    path = np.stack([places[:-1], places[1:]], axis=1)
    for k, view in enumerate(measurement.views):
        yield f"view_{k:03d}", _drawn(view, [(bed, BED), (path, MOTION)])
    for name in measurement.cameras:
        filmed = [(f.frame, f) for f in measurement.video if f.camera_name == name and f.frame in measurement.frames]
        for k in np.unique(np.linspace(0, len(filmed) - 1, TIMES).astype(int)) if filmed else ():
            number, frame = filmed[k]
            pose = motion.matrix(number / measurement.frame_rate)
            posed = tool @ pose[:3, :3].T + pose[:3, 3]
            yield f"{name}_{number:04d}", _drawn(frame, [(bed, BED), (path, MOTION), (posed, TOOL)])


def _box(measurement: Measurement) -> FloatArray:
    """The bed's twelve edges (12, 2, 3), m."""
    ends = np.stack([measurement.bed.lower, measurement.bed.upper])
    corners = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    pairs = [(a, b) for a in range(8) for b in range(a) if (a ^ b) in (1, 2, 4)]
    return np.asarray(corners[np.array(pairs)])


def _edges(mesh: trimesh.Trimesh) -> FloatArray:
    """Sharp edges (n, 2, 3) in the tool's frame, m; of a mesh without any, all."""
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > SHARP]
    return np.asarray(mesh.vertices[sharp if len(sharp) else mesh.edges_unique])


def _drawn(frame: Frame, lines: Sequence[tuple[FloatArray, tuple[int, int, int]]]) -> Image.Image:
    """A photograph with lines (n, 2, 3) in the world, each set in a colour."""
    picture = Image.fromarray(np.rint(255.0 * frame.image()).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    shares = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
    for ends, colour in lines:
        for first, last in ends:
            pixels, depths = frame.camera.project(first + shares * (last - first))
            seen = np.isfinite(pixels).all(axis=1) & (depths > 0.0)
            for k in np.flatnonzero(seen[:-1] & seen[1:]):
                draw.line([*map(tuple, pixels[k : k + 2])], fill=colour, width=max(1, frame.camera.width // 640))
    return picture
