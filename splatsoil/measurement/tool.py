"""The tool: its mesh, its motion and, where it was measured, the force on it."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from zipfile import is_zipfile

import numpy as np
import numpy.typing as npt
import trimesh

from splatsoil.errors import MeasurementError
from splatsoil.files import check_unpacked
from splatsoil.measurement.fields import read_table
from splatsoil.measurement.motion import ToolMotion, check_clock

FloatArray = npt.NDArray[np.float64]

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

    Corners that differ by texture or normal alone are joined, faces without area or given twice left out, and units
    that the file tells (3MF does) converted.

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
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        missing = re.search(r"No module named '(\w+)", reason) if isinstance(error, ImportError) else None
        # For bytes that are no text trimesh asks for a module that guesses encodings: no hint for a user.
        if missing and missing[1] not in ("chardet", "charset_normalizer"):
            raise MeasurementError(
                f"a file of this type is read by the package {missing[1]}, which is missing: pip install {missing[1]}",
                file=file,
            ) from error
        reason = "it is no text" if missing else reason
        raise MeasurementError(f"the mesh cannot be read ({reason}); is it what its name says?", file=file) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeasurementError("the file holds no triangles; is it what its name says?", file=file)
    if not np.isfinite(mesh.vertices).all():
        raise MeasurementError("the mesh has vertices that are not finite numbers", file=file, field="vertices")
    if mesh.units:
        mesh.convert_units("meters")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    edges = mesh.faces != np.roll(mesh.faces, 1, axis=1)
    mesh.update_faces(mesh.unique_faces() & edges.all(axis=1))
    if not mesh.is_watertight:  # else thin faces may be what closes it
        mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    extents = np.zeros(3) if mesh.extents is None else np.asarray(mesh.extents)
    with np.errstate(all="ignore"):  # the centre of mass of a flat mesh divides by zero
        # Bodies one by one: one that is inside out takes its volume from the others'.
        trimesh.repair.fix_normals(mesh, multibody=True)
        volume = abs(float(mesh.volume))
    if not volume > 1e-9 * float(np.prod(np.maximum(extents, extents.max() * 1e-3))):
        raise MeasurementError(
            "the mesh has no volume; give the tool its thickness and close its surface", file=file, field="faces"
        )
    if not mesh.is_watertight:
        raise MeasurementError(
            "the mesh has holes or loose edges, so it has no volume; close its surface", file=file, field="faces"
        )
    return mesh


def read_force(file: Path) -> FloatArray:
    """``frame,time,fx,fy,fz``: (n, 5)."""
    table = read_table(file, FORCE_COLUMNS)
    check_clock(table[:, 0], table[:, 1], file)
    return table
