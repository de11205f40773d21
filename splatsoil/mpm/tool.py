"""The tool as a signed-distance field on its measured path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
import warp as wp

from splatsoil.errors import SimulationError

FAR = 1.0e6
SAMPLES_ACROSS = 4
"""Distance samples across the tool where it is thin, so that a plate keeps both its faces."""
MOST_SAMPLES = 160
PARALLEL = 0.9
"""Cosine of the angle between two faces of a plate, at least."""
SAME_PLANE = 0.1
"""Singular values, over the largest, below which faces that meet lie in one plane."""


@wp.struct
class Tool:
    """A rigid body's distance field in its own frame, with the penalty law of its surface.

    Attributes:
        distance: signed distance in m from where soil stops, negative inside, on a regular lattice.
        lower: position of the first sample in the tool's frame, m.
        spacing: lattice spacing, m.
        stiffness: normal force per penetration of one particle, N/m.
        damping: normal force per closing speed of one particle, N s/m.
    """

    distance: wp.array3d(dtype=float)
    lower: wp.vec3
    spacing: float
    stiffness: float
    damping: float


@wp.kernel
def _measure_distance(mesh: wp.uint64, lower: wp.vec3, spacing: float, distance: wp.array3d(dtype=float)) -> None:
    i, j, k = wp.tid()
    point = lower + spacing * wp.vec3(float(i), float(j), float(k))
    query = wp.mesh_query_point_sign_winding_number(mesh, point, 1.0e3)
    nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    distance[i, j, k] = query.sign * wp.length(point - nearest)


@wp.func
def signed_distance(tool: Tool, point: wp.vec3) -> float:
    """Distance in m at a point of the tool's frame (trilinear), or FAR away from the lattice."""
    q = (point - tool.lower) / tool.spacing
    nx = tool.distance.shape[0]
    ny = tool.distance.shape[1]
    nz = tool.distance.shape[2]
    inside = q[0] >= 0.0 and q[1] >= 0.0 and q[2] >= 0.0
    inside = inside and q[0] < float(nx - 1) and q[1] < float(ny - 1) and q[2] < float(nz - 1)
    if not inside:
        return FAR
    i = int(q[0])
    j = int(q[1])
    k = int(q[2])
    fx = q[0] - float(i)
    fy = q[1] - float(j)
    fz = q[2] - float(k)
    d00 = wp.lerp(tool.distance[i, j, k], tool.distance[i + 1, j, k], fx)
    d10 = wp.lerp(tool.distance[i, j + 1, k], tool.distance[i + 1, j + 1, k], fx)
    d01 = wp.lerp(tool.distance[i, j, k + 1], tool.distance[i + 1, j, k + 1], fx)
    d11 = wp.lerp(tool.distance[i, j + 1, k + 1], tool.distance[i + 1, j + 1, k + 1], fx)
    return wp.lerp(wp.lerp(d00, d10, fy), wp.lerp(d01, d11, fy), fz)


@wp.func
def distance_normal(tool: Tool, point: wp.vec3) -> wp.vec3:
    """Outward unit normal of the distance field at a point of the tool's frame."""
    e = 0.5 * tool.spacing
    gradient = wp.vec3(
        signed_distance(tool, point + wp.vec3(e, 0.0, 0.0)) - signed_distance(tool, point - wp.vec3(e, 0.0, 0.0)),
        signed_distance(tool, point + wp.vec3(0.0, e, 0.0)) - signed_distance(tool, point - wp.vec3(0.0, e, 0.0)),
        signed_distance(tool, point + wp.vec3(0.0, 0.0, e)) - signed_distance(tool, point - wp.vec3(0.0, 0.0, e)),
    )
    return wp.normalize(gradient)


@wp.kernel
def _measure_thickness(
    mesh: wp.uint64,
    centre: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    inside: float,
    thickness: wp.array(dtype=float),
) -> None:
    i = wp.tid()
    # from a little inside, or the ray would end where it begins
    through = wp.mesh_query_ray(mesh, centre[i] - inside * normal[i], -normal[i], FAR)
    thickness[i] = FAR
    # a triangle without area has no normal, and its ray meets nothing
    if through.result and wp.dot(normal[i], wp.mesh_eval_face_normal(mesh, through.face)) < -PARALLEL:
        thickness[i] = inside + through.t


def thickened(mesh: trimesh.Trimesh, skin: float, thin: float) -> trimesh.Trimesh:
    """A body whose faces have moved outward by ``skin`` (m): all, where it is thicker than ``thin`` (m) on average.

    Of a plate or shell, a face moves so far where another one lies behind, nearly parallel and within ``thin``, and by
    less, with the square of the ratio, where it is farther: its edges stay where they are.
    """
    if 2.0 * mesh.volume > thin * mesh.area:
        return _offset(mesh, np.full(len(mesh.faces), skin))
    surface = _surface(mesh, "cpu")
    thickness = wp.zeros(len(mesh.faces), dtype=float, device="cpu")
    places = [
        wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (mesh.triangles_center, mesh.face_normals)
    ]
    inside = 1.0e-4 * float(mesh.extents.max())
    inputs = [surface.id, *places, inside, thickness]
    wp.launch(_measure_thickness, dim=len(mesh.faces), inputs=inputs, device="cpu")
    moved = skin * np.minimum(thin / thickness.numpy().astype(np.float64), 1.0) ** 2
    return _offset(mesh, moved)


def _offset(mesh: trimesh.Trimesh, moved: npt.NDArray[np.float64]) -> trimesh.Trimesh:
    """Each face moved outward by its own distance (f,) in m."""
    # each corner goes where the planes that met in it meet again: least squares, of the least length
    matrices, targets = np.zeros((len(mesh.vertices), 3, 3)), np.zeros((len(mesh.vertices), 3))
    for corner in np.asarray(mesh.faces).T:
        np.add.at(matrices, corner, mesh.face_normals[:, :, None] * mesh.face_normals[:, None])
        np.add.at(targets, corner, moved[:, None] * mesh.face_normals)
    shifts = np.linalg.pinv(matrices, rcond=SAME_PLANE**2, hermitian=True) @ targets[:, :, None]
    return trimesh.Trimesh(mesh.vertices + shifts[..., 0], mesh.faces, process=False)


def _surface(mesh: trimesh.Trimesh, device: str) -> wp.Mesh:
    return wp.Mesh(
        wp.array(np.asarray(mesh.vertices, dtype=np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(mesh.faces, dtype=np.int32).reshape(-1), dtype=int, device=device),
        support_winding_number=True,
    )


def build_tool(
    mesh: trimesh.Trimesh, *, margin: float, stiffness: float, damping: float, device: str, skin: float, thin: float
) -> Tool:
    """Sample the distance field of ``mesh`` (its own frame, m), :func:`thickened`, out to ``margin`` in m.

    Raises:
        SimulationError: the mesh encloses no volume.
    """
    if not mesh.is_volume:
        raise SimulationError("the tool's mesh encloses no volume; close its holes and orient its faces outward")
    extents = mesh.bounds[1] - mesh.bounds[0]
    # a raked or curved plate is thinner than its box: volume over area tells, 3/2 of a flat plate's thickness
    thinnest = min(extents.min(), 3.0 * mesh.volume / mesh.area)
    spacing = float(max(thinnest / SAMPLES_ACROSS, (extents.max() + 2.0 * margin) / MOST_SAMPLES))
    lower = mesh.bounds[0] - margin
    shape = tuple(int(n) for n in np.ceil((extents + 2.0 * margin) / spacing).astype(int) + 1)
    surface = _surface(thickened(mesh, skin, thin), device)
    distance = wp.zeros(shape, dtype=float, device=device)
    wp.launch(_measure_distance, dim=shape, inputs=[surface.id, wp.vec3(*lower), spacing, distance], device=device)
    tool = Tool()
    tool.distance = distance
    tool.lower = wp.vec3(*lower)
    tool.spacing = spacing
    tool.stiffness = stiffness
    tool.damping = damping
    return tool


@dataclass(frozen=True)
class Pose:
    """Pose and twist of the tool's frame at one instant: position (3,) m, quaternion (4,) xyzw, m/s, rad/s."""

    position: npt.NDArray[np.float64]
    quaternion: npt.NDArray[np.float64]
    velocity: npt.NDArray[np.float64]
    spin: npt.NDArray[np.float64]

    def row(self) -> npt.NDArray[np.float64]:
        """The 13 numbers kernels read: position, quaternion as xyzw, velocity, spin."""
        return np.concatenate([self.position, self.quaternion, self.velocity, self.spin])


@wp.func
def tool_position(pose: wp.array(dtype=float)) -> wp.vec3:
    """Position of the tool's frame in the world, m."""
    return wp.vec3(pose[0], pose[1], pose[2])


@wp.func
def tool_rotation(pose: wp.array(dtype=float)) -> wp.quat:
    """Rotation from the tool's frame to the world."""
    return wp.quat(pose[3], pose[4], pose[5], pose[6])


@wp.func
def tool_velocity(pose: wp.array(dtype=float), point: wp.vec3) -> wp.vec3:
    """Velocity in m/s of the tool's material at a point of the world."""
    spin = wp.vec3(pose[10], pose[11], pose[12])
    return wp.vec3(pose[7], pose[8], pose[9]) + wp.cross(spin, point - tool_position(pose))
