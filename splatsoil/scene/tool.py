"""The tool as a mesh for rays and as flat Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import trimesh
import warp as wp
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.scene import kernels
from splatsoil.scene.kernels_maps import ToolPose
from splatsoil.splats.warp_torch import launch, upload

_SCALE = 0.004
"""Size of the discs that stand for the tool among the splats, m; larger for large tools."""

_MOST = 10_000
"""Discs of a tool, about."""


class ToolBody:
    """The tool's mesh as rays meet it, and as flat Gaussians for its place among the splats; one for each device.

    Attributes:
        centres: (k, 3) middles of the discs, tool frame, m.
        covariances: (k, 3, 3), tool frame, m².
    """

    def __init__(self, mesh: trimesh.Trimesh | None, device: torch.device | str = "cpu") -> None:
        """Args: mesh in the tool's frame, metres, or None for no tool; device of the scene's tensors."""
        self._mesh: Any = None
        self._centre, self._radius = np.zeros(3), 0.0
        self.centres = torch.zeros((0, 3), device=device)
        self.covariances = torch.zeros((0, 3, 3), device=device)
        if mesh is not None:
            centres, covariances = _discs(mesh)
            self.centres, self.covariances = centres.to(device), covariances.to(device)
            wp.init()
            where = wp.device_from_torch(torch.device(device))
            vertices = np.asarray(mesh.vertices, dtype=np.float32)
            faces = np.asarray(mesh.faces, dtype=np.int32).reshape(-1)
            self._mesh = wp.Mesh(
                wp.array(vertices, dtype=wp.vec3, device=where), wp.array(faces, dtype=wp.int32, device=where)
            )
            wp.synchronize_device(where)  # rays are cast on torch's stream
            self._centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)).astype(np.float64)
            self._radius = float(np.linalg.norm(vertices - self._centre, axis=1).max()) + 1e-4

    def at(self, rotation: npt.ArrayLike, position: npt.ArrayLike) -> Any:
        """The tool at a pose (rotation (3, 3) tool to world, position (3,) m) in the kernels' form."""
        r, x = np.asarray(rotation, dtype=np.float64), np.asarray(position, dtype=np.float64)
        out = ToolPose()
        out.mesh = wp.uint64(0 if self._mesh is None else self._mesh.id)
        out.rotation = wp.mat33(*r.reshape(-1))
        out.position = wp.vec3(*x)
        out.centre = wp.vec3(*(r @ self._centre + x))
        out.radius = self._radius
        return out

    def discs(self, rotation: npt.ArrayLike, position: npt.ArrayLike) -> tuple[Tensor, Tensor]:
        """Centres (k, 3) and covariances (k, 3, 3) of the discs at a pose, world frame."""
        r, x = (upload(np.asarray(v, dtype=np.float64), self.centres.device) for v in (rotation, position))
        return self.centres @ r.T + x, r @ self.covariances @ r.T

    def absent(self) -> Any:
        """No tool at all."""
        return ToolPose()


def _discs(mesh: trimesh.Trimesh) -> tuple[Tensor, Tensor]:
    """Flat Gaussians that cover a mesh: one for each face of a subdivision into small ones."""
    size = max(_SCALE, float(np.sqrt(2.0 * mesh.area / _MOST)))
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=1.5 * size, max_iter=20)
    corners = np.asarray(vertices)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(across, axis=1)
    kept = area > 1e-12
    normal = across[kept] / (2.0 * area[kept, None])
    plane = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    covariance = 0.5 * area[kept, None, None] * (plane + 0.01 * np.eye(3))
    return torch.from_numpy(corners[kept].mean(axis=1)).float(), torch.from_numpy(covariance).float()


def eye_of(camera: Camera) -> Any:
    """A camera without distortion in the kernels' form."""
    eye = kernels.Eye()
    eye.rotation = wp.mat33(*camera.world_to_camera[:3, :3].T.reshape(-1))
    eye.position = wp.vec3(*camera.position)
    eye.fx, eye.fy, eye.cx, eye.cy = camera.fx, camera.fy, camera.cx, camera.cy
    return eye


def silhouette(tool: Any, camera: Camera, device: torch.device | str = "cpu") -> Tensor:
    """(h, w) bool: pixels of a camera without distortion that would show the tool (a pose from `ToolBody.at`, whose
    ToolBody lives on ``device``) if nothing hid it."""
    shows = torch.zeros((camera.height, camera.width), dtype=torch.uint8, device=device)
    where = wp.from_torch(shows, dtype=wp.uint8)
    launch(kernels.silhouette, (camera.height, camera.width), [eye_of(camera), tool, where], shows)
    return shows.bool()
