"""Gradients: against finite differences, and the kernels against the slow reference."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, rasterise, rasterise_features, reference, ssim_map
from splatsoil.splats.gaussians import rotation_matrices

CameraMaker = Callable[..., Camera]
CloudMaker = Callable[..., Gaussians]


def symmetric(matrices: Tensor) -> Tensor:
    """Gradient by a symmetric matrix: only the symmetric part has a meaning."""
    return 0.5 * (matrices + matrices.transpose(1, 2)) if matrices.ndim == 3 else matrices


def relative(a: Tensor, b: Tensor) -> float:
    """Largest difference relative to the largest value of ``b``."""
    return float((a.double() - b.double()).abs().max() / b.double().abs().max())


@pytest.mark.parametrize("antialias", [False, True])
def test_reference_gradients_against_finite_differences(
    antialias: bool, camera_at: CameraMaker, cloud: CloudMaker
) -> None:
    """The 1/255 step is taken out: a finite difference would see it jump."""
    g = cloud(4, f=20.0, extent=0.3, seed=4)
    camera = camera_at(width=8, height=7, f=20.0)
    weights = torch.rand(7, 8, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(means: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
        half = rotation_matrices(quaternions) * scales[:, None, :]
        image, alpha = reference.rasterise_features(
            means, half @ half.transpose(1, 2), opacities, features, camera, antialias=antialias, skip_below=0.0
        )
        return (image * weights[:, :, :3]).sum() + (alpha * weights[:, :, 3]).sum()

    opacities = 0.8 * g.opacities  # away from the clamp
    inputs = [t.double().requires_grad_() for t in (g.means, g.scales, g.quaternions, opacities, g.colours)]
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 4, 7, 8])
@pytest.mark.parametrize("antialias", [False, True])
def test_kernels_against_reference(antialias: bool, channels: int, camera_at: CameraMaker, cloud: CloudMaker) -> None:
    """Values and all gradients on a crowded image with partial tiles, clamped and saturated pixels."""
    f = 60.0
    g = cloud(150, f=f, extent=1.0, sigma=3.0, seed=channels)
    camera = camera_at(width=53, height=41, f=f, cx=27.3, cy=18.9)
    generator = torch.Generator().manual_seed(7)
    features = torch.randn(len(g), channels, generator=generator)
    background = torch.rand(channels, generator=generator)
    opacities = g.opacities * 1.05  # some beyond the clamp
    inputs = [t.clone().requires_grad_() for t in (g.means, g.covariances(), opacities, features, background)]
    blended, cover = rasterise_features(*inputs[:4], camera, background=inputs[4], antialias=antialias)
    exact_inputs = [t.detach().double().requires_grad_() for t in inputs]
    image, alpha = reference.rasterise_features(
        *exact_inputs[:4], camera, background=exact_inputs[4], antialias=antialias
    )
    assert float(alpha.detach().max()) > 0.99
    torch.testing.assert_close(blended.double(), image, rtol=0, atol=5e-5)
    torch.testing.assert_close(cover.double(), alpha, rtol=0, atol=2e-5)
    v_image = torch.randn(image.shape, generator=generator)
    v_alpha = torch.randn(alpha.shape, generator=generator)
    gradients = torch.autograd.grad((blended * v_image).sum() + (cover * v_alpha).sum(), inputs)
    exact = torch.autograd.grad((image * v_image).sum() + (alpha * v_alpha).sum(), exact_inputs)
    # in the antialiasing factor of a needle the determinant is a small difference of large numbers
    tolerance = 2e-4 if antialias else 2e-5
    for name, a, b in zip(
        ("means", "covariances", "opacities", "features", "background"), gradients, exact, strict=True
    ):
        assert relative(symmetric(a), symmetric(b)) < tolerance, name


def test_same_bits_with_any_number_of_threads(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    """Run after run, and however many threads share the tiles."""
    g = cloud(6000, sigma=4.0)
    camera = camera_at(width=130, height=130)
    target = torch.rand(130, 130, 3, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 1, 2, 3):
            torch.set_num_threads(threads)
            leaves = [t.clone().requires_grad_() for t in (g.means, g.scales, g.quaternions, g.opacities, g.colours)]
            picture = rasterise(Gaussians(*leaves), camera)
            similarity = ssim_map(picture.colour, target)
            # weights instead of a sum, which torch's threads may add in another order
            gradients = torch.autograd.grad([picture.colour, similarity], leaves, [target, target])
            results.append([picture.colour, picture.depth, similarity, *gradients])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
