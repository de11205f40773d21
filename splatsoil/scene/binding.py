"""Linear blend skinning: Gaussians that move with particles.

A Gaussian of the reconstruction rests at X with covariance Σ. Its particles p (the nearest at rest) have moved from X_p
to x_p and deformed by F_p (the visual deformation). With weights w that sum to 1,

    x = Σ w (x_p + F_p (X − X_p)),      F = Σ w F_p with singular values clamped,      Σ' = F Σ Fᵀ

so a rigid motion of all particles moves the Gaussian rigidly, and no deformation leaves it as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from splatsoil.splats.warp_torch import as_warp, launch

NEIGHBOURS = 4
"""Particles a Gaussian rides on."""

REACH = 0.5
"""Standard deviation of the weights' kernel, in particle spacings."""

STRETCH = (0.5, 2.0)
"""Singular values of the visual deformation are held between these: beyond, Gaussians become flakes and needles."""


@dataclass(frozen=True)
class Binding:
    """Which Gaussians ride on which particles.

    Attributes:
        rest: (n, 3) the Gaussians' centres at rest, m.
        covariances: (n, 3, 3) at rest, m².
        particles: (p, 3) the particles at rest, m.
        index: (n, k) int32 particles of each Gaussian.
        weights: (n, k) float32, rows sum to 1.
        thickness: (n,) standard deviations at rest along the Gaussians' shortest axes, m.
    """

    rest: Tensor
    covariances: Tensor
    particles: Tensor
    index: Tensor
    weights: Tensor
    thickness: Tensor

    def __len__(self) -> int:
        return self.rest.shape[0]

    def to_particles(self, particles: Tensor, spacing: float) -> Binding:
        """The same Gaussians on other particles (p, 3) at rest, m, with this spacing, m."""
        index, weights = _riders(self.rest, particles, spacing)
        return replace(self, particles=particles.detach().float().contiguous(), index=index, weights=weights)

    def carry(self, positions: Tensor, deformations: Tensor | None) -> tuple[Tensor, Tensor]:
        """Where the Gaussians are and what shape they have.

        Args:
            positions: (p, 3) float32 particles now, m.
            deformations: (p, 3, 3) float32 visual deformation since rest, or None for none at all.

        Returns:
            (n, 3) centres and (n, 3, 3) covariances.
        """
        if positions.shape != self.particles.shape:
            raise ValueError(f"{tuple(self.particles.shape)} particles at rest, {tuple(positions.shape)} now")
        centres, covariances = torch.empty_like(self.rest), torch.empty_like(self.covariances)
        if deformations is None:
            held = torch.eye(3, device=positions.device).expand(len(positions), 3, 3).contiguous()
        else:
            held = torch.empty_like(deformations)
            launch(_hold, len(held), [as_warp(deformations, wp.mat33), *STRETCH, as_warp(held, wp.mat33)], held)
        inputs = [as_warp(self.rest, wp.vec3), as_warp(self.covariances, wp.mat33), as_warp(self.particles, wp.vec3)]
        inputs += [as_warp(positions, wp.vec3), as_warp(held, wp.mat33), as_warp(self.index, wp.int32)]
        inputs += [as_warp(self.weights, wp.float32), *STRETCH, as_warp(centres, wp.vec3)]
        launch(_carry, len(self), [*inputs, as_warp(covariances, wp.mat33)], centres)
        return centres, covariances


def bind(centres: Tensor, covariances: Tensor, particles: Tensor, spacing: float) -> Binding:
    """Let Gaussians ride on the particles nearest to them.

    Args:
        centres: (n, 3) at rest, m.
        covariances: (n, 3, 3) at rest, m².
        particles: (p, 3) at rest, m.
        spacing: side of the cube that a particle stands for, m.
    """
    index, weights = _riders(centres, particles, spacing)
    smallest = torch.linalg.eigvalsh(covariances.detach().cpu().double())[:, 0].clamp_min(0.0)
    return Binding(
        centres.detach().float().contiguous(),
        covariances.detach().float().contiguous(),
        particles.detach().float().contiguous(),
        index,
        weights,
        smallest.sqrt().to(centres.device, torch.float32),
    )


def _riders(centres: Tensor, particles: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Particles (n, k) int32 that each Gaussian rides on, and their weights (n, k)."""
    k = min(NEIGHBOURS, len(particles))
    distance, index = cKDTree(particles.detach().cpu().numpy()).query(centres.detach().cpu().numpy(), k=k)
    away = torch.from_numpy(distance.reshape(len(centres), k)).to(centres.device)
    # Relative to the nearest, so that a Gaussian far from all particles still has weights.
    weights = torch.exp(-0.5 * (away.square() - away[:, :1].square()) / (REACH * spacing) ** 2)
    weights = (weights / weights.sum(dim=1, keepdim=True)).float()
    chosen = torch.from_numpy(index.reshape(len(centres), k)).to(centres.device, torch.int32)
    return chosen.contiguous(), weights.contiguous()


@wp.func
def bounded_deformation(f: wp.mat33, smallest: float, largest: float) -> wp.mat33:
    """One deformation with its singular values held within bounds."""
    square = wp.transpose(f) * f
    # Bounds on the squared singular values from norms spare most deformations the decomposition.
    off = wp.abs(square[0, 1]) + wp.abs(square[0, 2]) + wp.abs(square[1, 2])
    low = wp.min(square[0, 0], wp.min(square[1, 1], square[2, 2])) - off
    high = wp.max(square[0, 0], wp.max(square[1, 1], square[2, 2])) + off
    if low >= smallest * smallest and high <= largest * largest:
        return f
    u = wp.mat33()
    s = wp.vec3()
    v = wp.mat33()
    wp.svd3(f, u, s, v)
    # svd3 returns rotations, so a reflection shows as a negative value: only its size is held.
    held = wp.vec3()
    for a in range(3):
        size = wp.clamp(wp.abs(s[a]), smallest, largest)
        held[a] = wp.where(s[a] < 0.0, -size, size)
    return u * wp.diag(held) * wp.transpose(v)


@wp.kernel(enable_backward=False)
def _hold(
    deformations: wp.array(dtype=wp.mat33), smallest: float, largest: float, held: wp.array(dtype=wp.mat33)
) -> None:
    p = wp.tid()
    held[p] = bounded_deformation(deformations[p], smallest, largest)


@wp.kernel(enable_backward=False)
def _carry(
    rest: wp.array(dtype=wp.vec3),
    covariances: wp.array(dtype=wp.mat33),
    particles: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    deformations: wp.array(dtype=wp.mat33),
    index: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
    smallest: float,
    largest: float,
    centres_out: wp.array(dtype=wp.vec3),
    covariances_out: wp.array(dtype=wp.mat33),
) -> None:
    g = wp.tid()
    x = wp.vec3()
    f = wp.mat33()
    for k in range(index.shape[1]):
        p = index[g, k]
        w = weights[g, k]
        x += w * (positions[p] + deformations[p] * (rest[g] - particles[p]))
        f += w * deformations[p]
    f = bounded_deformation(f, smallest, largest)
    centres_out[g] = x
    covariances_out[g] = f * covariances[g] * wp.transpose(f)
