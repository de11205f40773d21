"""USD: one stage with the particles, the tool and the soil's surface, in metres, z up, one time code a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Gf, Usd, UsdGeom, Vt

from splatsoil.colour import linear
from splatsoil.export.replay import Moment
from splatsoil.model import Model


class UsdWriter:
    """Writes ``prediction.usdc``: ``/World/Particles`` (Points: positions, velocities, the soil's albedo where
    photographs show it), ``/World/Tool`` (Mesh, one transform a frame) and ``/World/Surface`` (Mesh)."""

    def __init__(self, folder: Path, model: Model, frames: tuple[int, ...]) -> None:
        """Args: an empty folder, the model, and its frames that come."""
        self.stage = Usd.Stage.CreateNew(str(folder / "prediction.usdc"))
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self.stage, UsdGeom.LinearUnits.meters)
        rate = model.measurement.frame_rate
        self.stage.SetTimeCodesPerSecond(rate)
        self.stage.SetFramesPerSecond(rate)
        self.stage.SetStartTimeCode(frames[0])
        self.stage.SetEndTimeCode(frames[-1])
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())

        self.particles = UsdGeom.Points.Define(self.stage, "/World/Particles")
        self.spacing = model.resolution.spacing
        self.particles.CreateWidthsAttr([self.spacing])
        self.particles.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        if model.photographed:
            colours = linear(model.scene().grain_albedo.cpu().numpy().astype(np.float64))
            _vectors(self.particles.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).GetAttr(), colours)

        mesh = model.measurement.tool.mesh
        self.tool = UsdGeom.Mesh.Define(self.stage, "/World/Tool")
        _vectors(self.tool.CreatePointsAttr(), mesh.vertices)
        _topology(self.tool, np.asarray(mesh.faces))
        _vectors(self.tool.CreateExtentAttr(), mesh.bounds)
        self.pose = self.tool.AddTransformOp()

        self.surface = UsdGeom.Mesh.Define(self.stage, "/World/Surface")

    def add(self, moment: Moment) -> None:
        """Write one frame's time samples."""
        code, half = Usd.TimeCode(moment.frame), 0.5 * self.spacing
        _vectors(self.particles.CreatePointsAttr(), moment.positions, code)
        _vectors(self.particles.CreateVelocitiesAttr(), moment.velocities, code)
        corners = np.stack([moment.positions.min(axis=0) - half, moment.positions.max(axis=0) + half])
        _vectors(self.particles.CreateExtentAttr(), corners, code)

        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = moment.tool
        # USD multiplies row vectors.
        self.pose.Set(Gf.Matrix4d(matrix.T.tolist()), code)

        points = moment.surface_points
        if not self.surface.GetFaceVertexCountsAttr().HasAuthoredValue():
            _topology(self.surface, moment.surface_quads)
        _vectors(self.surface.CreatePointsAttr(), points, code)
        _vectors(self.surface.CreateExtentAttr(), np.stack([points.min(axis=0), points.max(axis=0)]), code)

    def finish(self, force: npt.NDArray[np.float64]) -> None:
        """Save the stage."""
        self.stage.GetRootLayer().Save()


def _topology(mesh: Any, faces: npt.NDArray[np.integer]) -> None:
    """Faces (k, corners) of a mesh that no one is to round off."""
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1), dtype=np.int32)))


def _vectors(attribute: Any, values: npt.ArrayLike, code: Any = None) -> None:
    """Set an attribute to vectors (n, 3), at a time or for all times."""
    array = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))
    attribute.Set(array, Usd.TimeCode.Default() if code is None else code)
