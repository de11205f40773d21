"""The tool: its mesh, its motion and, where it was measured, the force on it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile, is_zipfile

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError
from splatsoil.files import check_unpacked
from splatsoil.measurement.fields import read_table
from splatsoil.measurement.motion import ToolMotion, check_clock

#: Types of mesh, by their suffix. Others run readers that follow paths, or unpack whatever is in an archive.
FORMATS = ("stl", "obj", "ply", "off", "glb", "gltf", "3mf")
FORCE_COLUMNS = ("frame", "time", "fx", "fy", "fz")
DEFAULT_FRICTION = 0.3


@dataclass(frozen=True, eq=False)
class Tool:
    """A rigid tool.

    Attributes:
        mesh: closed surface in the tool's frame, metres.
        motion: where that frame is over time.
        friction: Coulomb coefficient between tool and soil.
        force: (n, 5) columns frame, time, fx, fy, fz: the soil's force on the tool in newtons, world axes; or None.
        mesh_path: the file the mesh came from, if any.
        force_path: the file the force came from, if any.
    """

    mesh: trimesh.Trimesh
    motion: ToolMotion
    friction: float = DEFAULT_FRICTION
    force: FloatArray | None = None
    mesh_path: Path | None = None
    force_path: Path | None = None

    def placed(self, time: float) -> trimesh.Trimesh:
        """The mesh in the world at ``time``."""
        return self.mesh.copy().apply_transform(self.motion.matrix(time))

    def bounds(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner (3,) of the tool's axis-aligned box in the world at ``time``."""
        rotation, position = self.motion.pose(time)
        corners = self.mesh.vertices @ rotation.T + position
        return corners.min(axis=0), corners.max(axis=0)

    def touches(self, lower: FloatArray, upper: FloatArray) -> npt.NDArray[np.bool_]:
        """For each row of the motion, whether the tool's box overlaps that from ``lower`` to ``upper``: (n,) bool."""
        out = np.zeros(len(self.motion.times), dtype=bool)
        for i, time in enumerate(self.motion.times):
            low, high = self.bounds(float(time))
            out[i] = bool(np.all(low < upper) and np.all(high > lower))
        return out


def read_mesh(file: Path) -> trimesh.Trimesh:
    """A closed mesh in metres with outward faces, on each of its bodies, from a file of one of the types `FORMATS`.
    Nothing that the file names is read.

    Corners that differ by texture or normal alone are joined, and units that the file has (3MF) converted.
    Bodies may touch.

    Raises:
        MeasurementError: it can't be read, or encloses no volume.
    """
    kind = file.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise MeasurementError(
            f"{file.suffix or 'a name without suffix'} is no type of mesh that is read, as STL, OBJ and PLY are; is it"
            " what its name says?",
            file=file,
        )
    try:
        data = file.read_bytes()
        if is_zipfile(io.BytesIO(data)):
            check_unpacked(io.BytesIO(data))
    except (OSError, ValueError, BadZipFile) as error:
        raise MeasurementError(f"cannot be read ({error})", file=file) from error
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind)
    except Exception as error:  # trimesh's readers raise whatever their parsers do, in their own terms
        if kind == "3mf" and isinstance(error, ImportError):
            fault = "a file of this type is read by the package lxml, which is missing: pip install lxml"
        else:
            fault = "the mesh cannot be read; is it whole, in one file, uncompressed, and what its name says?"
        raise MeasurementError(fault, file=file) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeasurementError("the file holds no triangles; is it what its name says?", file=file)
    if not np.isfinite(mesh.vertices).all():
        raise MeasurementError("the mesh has vertices that are not finite numbers", file=file, field="vertices")
    if mesh.units:
        mesh.convert_units("meters")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces((mesh.faces != np.roll(mesh.faces, 1, axis=1)).all(axis=1))
    with np.errstate(all="ignore"):  # the centre of mass of a flat mesh divides by zero
        closed = _closed(mesh)
        solid = mesh if closed is None else closed
        volume = float(solid.volume)
    extents = np.zeros(3) if solid.extents is None else np.asarray(solid.extents)
    if not abs(volume) > 1e-9 * float(np.prod(np.maximum(extents, extents.max() * 1e-3))):
        raise MeasurementError(
            "the mesh has no volume; give the tool its thickness and close its surface", file=file, field="faces"
        )
    if closed is None:
        raise MeasurementError(
            "the mesh has holes or loose edges, so it has no volume; close its surface, and turn its faces outwards",
            file=file,
            field="faces",
        )
    return closed


def _closed(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """The mesh with outward faces, without those that keep it from enclosing a volume: faces that are given again, both
    faces where two bodies touch, faces without area. None if that does not close it."""
    once = mesh.unique_faces()
    _, number, times = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    outer, thick = once & (times[number.ravel()] % 2 == 1), mesh.nondegenerate_faces()
    for kept in (once, outer, once & thick, outer & thick):
        found = mesh.copy()
        found.update_faces(kept)
        found.remove_unreferenced_vertices()
        if found.is_watertight:
            # Bodies one by one: one that is inside out takes its volume from the others'.
            trimesh.repair.fix_normals(found, multibody=True)
            return found
        if found.volume < 0.0:
            found.invert()
        if _looks_outwards(found):
            return found
    return None


def _looks_outwards(mesh: trimesh.Trimesh) -> bool:
    """Whether bodies that share edges are closed and have outward faces: faces run along each edge as often to the one
    side as to the other, and the winding number just behind a face is 1 or more, in each part that shared edges bound.

    The winding number is the sum of the triangles' solid angles (van Oosterom & Strackee 1983, IEEE Trans. Biomed. Eng.
    30:125).
    """
    side = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1.0, -1.0)
    if np.any(np.bincount(mesh.edges_unique_inverse, side)):
        return False
    parts = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    for face in np.unique(parts, return_index=True)[1]:
        behind = mesh.triangles_center[face] - 1e-3 * np.sqrt(mesh.area_faces[face]) * mesh.face_normals[face]
        corners = np.moveaxis(mesh.triangles - behind, 1, 0)
        lengths = np.linalg.norm(corners, axis=2)
        below = np.prod(lengths, axis=0)
        for k in range(3):
            below = below + np.sum(corners[k] * corners[k - 1], axis=1) * lengths[k - 2]
        above = np.sum(corners[0] * np.cross(corners[1], corners[2]), axis=1)
        if np.arctan2(above, below).sum() < np.pi:  # half of a solid angle of 4 pi
            return False
    return True


def read_force(file: Path) -> FloatArray:
    """``frame,time,fx,fy,fz``: (n, 5)."""
    table = read_table(file, FORCE_COLUMNS)
    check_clock(table[:, 0], table[:, 1], file)
    return table
