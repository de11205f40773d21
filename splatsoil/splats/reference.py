"""Reference rasteriser in plain torch, for any float type: one Gaussian after another on all pixels.

It shares no code with the kernels but the constants and the camera, and gradients come from torch's autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats import constants


def project(
    means: Tensor, covariances: Tensor, opacities: Tensor, camera: Camera, antialias: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres (n, 2) px, dilated covariances (n, 2, 2) px², opacities (n,) and depths (n,) m on the image plane."""
    pose = torch.as_tensor(camera.world_to_camera).to(means)
    rotation = pose[:3, :3]
    points = means @ rotation.T + pose[:3, 3]
    x, y, z = points.unbind(1)
    fx, fy, zero, limit = camera.fx, camera.fy, torch.zeros_like(z), constants.TANGENT_LIMIT
    tx, ty = (x / z).clamp(-limit, limit), (y / z).clamp(-limit, limit)
    centres = torch.stack([fx * x / z + camera.cx, fy * y / z + camera.cy], dim=1)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], dim=1).reshape(-1, 2, 3)
    moved = jacobian @ rotation
    plain = moved @ covariances @ moved.transpose(1, 2)
    dilation = constants.PIXEL_VARIANCE if antialias else constants.DILATION
    dilated = plain + dilation * torch.eye(2).to(means)
    if antialias:
        ratio = torch.linalg.det(plain) / torch.linalg.det(dilated)
        opacities = opacities * ratio.clamp_min(constants.ANTIALIAS_MIN**2).sqrt()
    return centres, dilated, opacities, z


def rasterise_features(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    antialias: bool = False,
    skip_below: float = constants.ALPHA_MIN,
) -> tuple[Tensor, Tensor]:
    """Blended features (h, w, k) and coverage (h, w); what `splatsoil.splats.rasterise_features` computes.

    Args:
        means: (n, 3), m.
        covariances: (n, 3, 3), m².
        opacities: (n,).
        features: (n, k).
        camera: without distortion.
        background: (k,), zeros by default.
        antialias: see `splatsoil.splats.rasterise`.
        skip_below: opacity under which a Gaussian is skipped in a pixel; 0 makes the picture smooth in the parameters.
    """
    centres, dilated, strengths, depths = project(means, covariances, opacities, camera, antialias)
    conics = torch.linalg.inv(dilated)
    rows = torch.arange(camera.height).to(means) + 0.5
    columns = torch.arange(camera.width).to(means) + 0.5
    transmittance = torch.ones(camera.height, camera.width).to(means)
    finished = torch.zeros(camera.height, camera.width, dtype=torch.bool, device=means.device)
    image = torch.zeros(camera.height, camera.width, features.shape[1]).to(means)
    ahead = torch.as_tensor(camera.world_to_camera[2, :3]).to(means)
    nearest = constants.REACH_TO_EYE * torch.einsum("i,nij,j->n", ahead, covariances, ahead).sqrt()
    nearest = nearest.clamp_min(constants.NEAR)
    for i in torch.argsort(depths.detach(), stable=True).tolist():
        if depths[i] <= nearest[i] or strengths[i] <= skip_below:
            continue
        dx, dy = columns[None, :] - centres[i, 0], rows[:, None] - centres[i, 1]
        power = 0.5 * (conics[i, 0, 0] * dx**2 + conics[i, 1, 1] * dy**2) + conics[i, 0, 1] * dx * dy
        alpha = (strengths[i] * torch.exp(-power)).clamp(max=constants.ALPHA_MAX)
        after = transmittance * (1 - alpha)
        skipped = alpha < skip_below
        finished = finished | (~skipped & (after <= constants.TRANSMITTANCE_MIN))
        drawn = ~skipped & ~finished
        image = image + torch.where(drawn, alpha * transmittance, 0.0)[:, :, None] * features[i]
        transmittance = torch.where(drawn, after, transmittance)
    if background is not None:
        image = image + transmittance[:, :, None] * background.to(means)
    return image, 1 - transmittance
