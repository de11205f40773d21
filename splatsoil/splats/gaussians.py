"""Sets of Gaussians, in metres and plain (not log or logit) values."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from splatsoil.errors import ParameterError


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4) wxyz of any non-zero length (they are normalised here)."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=-1,
    ).reshape(*quaternions.shape[:-1], 3, 3)  # fmt: skip


@dataclass(frozen=True)
class Gaussians:
    """A set of n anisotropic Gaussians, all tensors on one device and float32.

    Attributes:
        means: centres (n, 3), m, world frame.
        scales: standard deviations along the Gaussian's own axes (n, 3), m.
        quaternions: rotation from own axes to the world (n, 4), wxyz, any non-zero length.
        opacities: peak opacity (n,), in (0, 1).
        colours: red, green, blue (n, 3), in [0, 1]; sRGB or albedo, as the owner decides.
    """

    means: Tensor
    scales: Tensor
    quaternions: Tensor
    opacities: Tensor
    colours: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        shapes = {"means": (n, 3), "scales": (n, 3), "quaternions": (n, 4), "opacities": (n,), "colours": (n, 3)}
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape:
                raise ParameterError(f"Gaussians: {name} has shape {tuple(tensor.shape)}, expected {shape}")
            if tensor.device != self.means.device:
                raise ParameterError(f"Gaussians: {name} is on {tensor.device}, means are on {self.means.device}")

    @classmethod
    def discs(cls, means: Tensor, radius: float, thickness: float, opacity: float, colours: Tensor) -> Gaussians:
        """Level ones at places (n, 3), of standard deviations along the ground and across it, m, and colours (n, 3)."""
        scales = means.new_tensor([radius, radius, thickness]).expand(len(means), 3)
        upright = means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
        return cls(means, scales, upright, means.new_full((len(means),), opacity), colours)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """The subset that a boolean mask (n,), an index tensor (m,) or a slice picks."""
        return Gaussians(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self.means.device

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))

    def detach(self) -> Gaussians:
        """The same values without their gradient history."""
        return Gaussians(*(getattr(self, f.name).detach() for f in fields(self)))

    def replace(self, **changes: Tensor) -> Gaussians:
        """A copy with some tensors replaced."""
        return replace(self, **changes)

    def rotations(self) -> Tensor:
        """Rotation matrices (n, 3, 3); columns are the Gaussian's own axes in the world frame."""
        return rotation_matrices(self.quaternions)

    def covariances(self) -> Tensor:
        """Covariance matrices R diag(s²) Rᵀ (n, 3, 3), m²; differentiable."""
        half = self.rotations() * self.scales[:, None, :]
        return half @ half.transpose(1, 2)
