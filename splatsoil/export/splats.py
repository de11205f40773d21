"""Splats: the scene at the first and at the last frame, as .ply files of the reference 3DGS code's layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from splatsoil.errors import ParameterError
from splatsoil.export.replay import Moment
from splatsoil.model import Model
from splatsoil.scene import Posed, Scene, encoded, linear
from splatsoil.scene.layers import TOOL_OPACITY
from splatsoil.splats import Gaussians, save_ply


class SplatWriter:
    """Writes ``splats_N.ply`` of the first and the last frame, in the world's metres, z up."""

    def __init__(self, folder: Path, model: Model, frames: tuple[int, ...]) -> None:
        """Args: an empty folder, the model, and its frames that come; the first and the last are written.

        Raises:
            ParameterError: no photograph shows the soil.
        """
        if not model.photographed:
            raise ParameterError(
                f"--to ply: {model.measurement.name} has no photographs, which Gaussians are made from"
            )
        self.folder, self.scene, self.frames = folder, model.scene(), (frames[0], frames[-1])

    def add(self, moment: Moment) -> None:
        """Write a frame, if it is one of them."""
        if moment.frame in self.frames:
            posed = self.scene.pose(moment.positions, moment.deformations, moment.tool)
            save_ply(self.folder / f"splats_{moment.frame:06d}.ply", lit_gaussians(self.scene, posed))

    def finish(self, force: npt.NDArray[np.float64]) -> None:
        """All is written."""


def lit_gaussians(scene: Scene, posed: Posed) -> Gaussians:
    """A posed scene as Gaussians of the colours that are seen (n, 3), on the CPU.

    Soil has its albedo in the light that reaches the surface over it, surroundings their own colour. The tool has one
    colour, that of level ground's light.
    """
    discs, flat = posed.discs
    of_soil = posed.features[:, 3:] > 0.5
    light = posed.shading.irradiance(posed.centres, 0.5 * scene.spacing)
    albedo = posed.features[:, :3]
    colours = torch.where(of_soil, encoded(linear(albedo) * light), albedo)
    tool = encoded(torch.as_tensor(scene.tool_albedo, dtype=torch.float32, device=scene.device))
    means = torch.cat([posed.centres, discs])
    scales, quaternions = _axes(torch.cat([posed.covariances, flat]))
    return Gaussians(
        means=means.cpu(),
        scales=scales,
        quaternions=quaternions,
        opacities=torch.cat([posed.opacities, discs.new_full((len(discs),), TOOL_OPACITY)]).cpu(),
        colours=torch.cat([colours, tool.expand(len(discs), 3)]).clamp(0.0, 1.0).cpu(),
    )


def _axes(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations (n, 3) along the principal axes of covariances (n, 3, 3), and quaternions (n, 4) wxyz of the
    rotations to these."""
    variances, axes = torch.linalg.eigh(covariances.cpu().double())
    axes[:, :, 2] *= torch.linalg.det(axes)[:, None]  # right-handed
    quaternions = Rotation.from_matrix(axes.numpy()).as_quat(scalar_first=True)
    return variances.clamp_min(0.0).sqrt().float(), torch.from_numpy(quaternions).float()
