"""The tool's mesh from files that are right in substance and awkward in form: its volume is the right one."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatsoil.errors import MeasurementError
from splatsoil.measurement.tool import read_mesh

SIZE = (0.02, 0.12, 0.1)
VOLUME = float(np.prod(SIZE))
CONTENT_TYPES = (
    '<?xml version="1.0"?><Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"><Default'
    ' Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
NAMESPACE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"


def box(at: tuple[float, float, float] = (0.0, 0.0, 0.0), *, inside_out: bool = False) -> trimesh.Trimesh:
    out = trimesh.creation.box(SIZE)
    out.apply_translation(at)
    if inside_out:
        out.invert()
    return out


def obj_with_seams(folder: Path) -> Path:
    """Each face has corners of its own, as exporters write them: texture and normal differ from face to face."""
    mesh = box()
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"vt {k / 36} {(k * 7 % 36) / 36}" for k in range(36)]
    lines += [f"vn {x} {y} {z}" for x, y, z in mesh.face_normals]
    lines += [
        "f " + " ".join(f"{v + 1}/{3 * i + k + 1}/{i + 1}" for k, v in enumerate(face))
        for i, face in enumerate(mesh.faces)
    ]
    (folder / "tool.obj").write_text("\n".join(lines))
    return folder / "tool.obj"


def with_faces(*faces: list[int]) -> Callable[[Path], Path]:
    """A box with further faces, which enclose nothing; a ninth corner lies on an edge's middle."""

    def write(folder: Path) -> Path:
        mesh = box()
        corners = np.vstack([mesh.vertices, mesh.vertices[mesh.faces[0, :2]].mean(axis=0)])
        given = np.vstack([mesh.faces, np.array(faces)])
        trimesh.Trimesh(corners, given, process=False).export(folder / "tool.ply")
        return folder / "tool.ply"

    return write


def stl_of(*bodies: trimesh.Trimesh) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        trimesh.util.concatenate(bodies).export(folder / "tool.stl")
        return folder / "tool.stl"

    return write


def turned_over(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Its upper side is its lower one, and divided into triangles in the other way."""
    height = 2.0 * mesh.centroid[2]
    mesh.vertices[:, 2] = height - mesh.vertices[:, 2]
    mesh.invert()
    return mesh


def three_mf(folder: Path) -> Path:
    """In millimetres, as the file tells."""
    pytest.importorskip("lxml")
    corners = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in 1000.0 * box().vertices)
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in box().faces)
    model = (
        f'<?xml version="1.0"?><model unit="millimeter" xmlns="{NAMESPACE}"><resources><object id="1" type="model">'
        f"<mesh><vertices>{corners}</vertices><triangles>{faces}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>'
    )
    with zipfile.ZipFile(folder / "tool.3mf", "w") as file:
        file.writestr("[Content_Types].xml", CONTENT_TYPES)
        file.writestr("3D/3dmodel.model", model)
    return folder / "tool.3mf"


FIRST = [int(v) for v in box().faces[0]]
APART = (0.3, 0.0, 0.0)


@pytest.mark.parametrize(
    ("write", "bodies"),
    [
        (obj_with_seams, 1),
        (with_faces(FIRST), 1),
        (with_faces(FIRST[::-1]), 1),
        (with_faces([3, 3, 5]), 1),
        (with_faces([FIRST[0], FIRST[1], 8]), 1),
        (stl_of(box(inside_out=True)), 1),
        (stl_of(box(), box(APART, inside_out=True)), 2),
        (stl_of(box(inside_out=True), box(APART), box((0.0, 0.3, 0.0), inside_out=True)), 3),
        (three_mf, 1),
    ],
    ids=["seams", "doubled", "doubled-turned", "repeated-corner", "collinear", "inside-out", "two", "three", "3mf"],
)
def test_a_closed_mesh_is_read_with_its_volume(write: Callable[[Path], Path], bodies: int, tmp_path: Path) -> None:
    mesh = read_mesh(write(tmp_path))
    assert mesh.is_watertight and mesh.body_count == bodies
    assert mesh.volume == pytest.approx(bodies * VOLUME, rel=1e-6)
    for body in mesh.split():
        assert body.volume == pytest.approx(VOLUME, rel=1e-6), "each body's faces look outwards"
        np.testing.assert_allclose(body.extents, SIZE, rtol=1e-6)


ABOVE, ACROSS = (0.0, 0.0, SIZE[2]), (SIZE[0], 0.0, SIZE[2])


@pytest.mark.parametrize(
    ("other", "at"),
    [
        (box(ABOVE), ABOVE),
        (turned_over(box(ABOVE)), ABOVE),
        (box(ACROSS), ACROSS),
    ],
    ids=["face", "face-of-other-triangles", "edge"],
)
def test_bodies_may_touch(other: trimesh.Trimesh, at: tuple[float, float, float], tmp_path: Path) -> None:
    """Points in both have the winding number 1, by the solid angles of the triangles (van Oosterom & Strackee 1983)."""
    mesh = read_mesh(stl_of(box(), other)(tmp_path))
    assert mesh.volume == pytest.approx(2.0 * VOLUME, rel=1e-6)
    for point, inside in (((0.0, 0.0, 0.4 * SIZE[2]), 1.0), (at, 1.0), ((0.0, 0.0, 2.0 * SIZE[2]), 0.0)):
        a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        dots = [np.sum(u * v, axis=1) * w for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb))]
        solid_angles = 2.0 * np.arctan2(np.sum(a * np.cross(b, c), axis=1), la * lb * lc + sum(dots))
        assert solid_angles.sum() / (4.0 * np.pi) == pytest.approx(inside, abs=1e-6)


def test_bodies_that_touch_and_look_into_different_directions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="turn its faces outwards"):
        read_mesh(stl_of(box(), box(ACROSS, inside_out=True), box(APART))(tmp_path))


def test_what_a_type_of_file_needs_is_named(tmp_path: Path) -> None:
    (tmp_path / "tool.3mf").write_bytes(b"PK")
    code = (
        "import sys\n"
        "class Without:\n"
        "    def find_spec(name, path=None, target=None):\n"
        "        if name.startswith('lxml'): raise ModuleNotFoundError(f'No module named {name!r}')\n"
        "sys.meta_path.insert(0, Without)\n"
        "from pathlib import Path\nfrom splatsoil.measurement.tool import read_mesh\nread_mesh(Path('tool.3mf'))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stderr.strip().endswith("read by the package lxml, which is missing: pip install lxml")


def test_faces_that_enclose_nothing_are_no_mesh(tmp_path: Path) -> None:
    (tmp_path / "tool.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2\nf 1 1 1\n")
    with pytest.raises(MeasurementError, match="no volume"):
        read_mesh(tmp_path / "tool.obj")
