"""PSNR and SSIM against scikit-image, a loop, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from splatsoil.splats import psnr, ssim, ssim_map
from splatsoil.splats.metrics import ssim_map_torch


def pair(height: int = 40, width: int = 51, channels: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, channels, generator=g)
    return a, (0.6 * a + 0.4 * torch.rand(height, width, channels, generator=g))


def test_psnr() -> None:
    a, b = pair()
    assert psnr(torch.zeros(4, 4), torch.full((4, 4), 0.1)).item() == pytest.approx(20.0, abs=1e-4)
    assert psnr(a, b).item() == pytest.approx(peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0), abs=1e-4)
    assert math.isinf(psnr(a, a).item())


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("width", [12, 51, 300])
def test_ssim_map_is_that_of_scikit_image(width: int, channels: int) -> None:
    a, b = pair(height=37, width=width, channels=channels)
    _, expected = structural_similarity(
        a.numpy().astype(np.float64), b.numpy().astype(np.float64), data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, channel_axis=2, full=True,
    )  # fmt: skip
    # the border differs: scikit-image mirrors, the splatting papers pad with zeros
    np.testing.assert_allclose(ssim_map(a, b).numpy()[5:-5, 5:-5], expected[5:-5, 5:-5], atol=2e-5)


def test_ssim_at_the_border_by_a_loop() -> None:
    a, b = pair(height=9, width=7, channels=2)
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    for row, column, channel in ((0, 0, 0), (8, 3, 1), (4, 6, 0)):
        sums = np.zeros(5)
        for i in range(-5, 6):
            for j in range(-5, 6):
                if 0 <= row + i < 9 and 0 <= column + j < 7:
                    u, v = float(a[row + i, column + j, channel]), float(b[row + i, column + j, channel])
                    sums += weights[i + 5, j + 5] * np.array([u, v, u * u, v * v, u * v])
        mu, mv, uu, vv, uv = sums
        expected = (2 * mu * mv + 1e-4) * (2 * (uv - mu * mv) + 9e-4)
        expected /= (mu**2 + mv**2 + 1e-4) * (uu - mu**2 + vv - mv**2 + 9e-4)
        assert ssim_map(a, b)[row, column, channel].item() == pytest.approx(expected, abs=1e-5)


def test_ssim_gradients() -> None:
    """Kernel and autograd agree on both gradients, and both with finite differences in double precision."""
    a, b = pair(height=23, width=19)
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(a.shape, generator=g)
    fast = [t.clone().requires_grad_() for t in (a, b)]
    slow = [t.double().requires_grad_() for t in (a, b)]
    got = torch.autograd.grad((ssim_map(*fast) * weights).sum(), fast)
    exact = torch.autograd.grad((ssim_map(*slow) * weights).sum(), slow)
    for x, y in zip(got, exact, strict=True):
        torch.testing.assert_close(x.double(), y, rtol=0, atol=float(y.abs().max()) * 1e-5)
    direction = torch.randn(a.shape, generator=g, dtype=torch.float64)
    with torch.no_grad():
        there, back = ((ssim_map(slow[0] + s * direction, slow[1]) * weights).sum() for s in (1e-5, -1e-5))
    assert float((there - back) / 2e-5) == pytest.approx(float((exact[0] * direction).sum()), rel=1e-6)
    # only one of the two wanted, and a grey picture
    (one,) = torch.autograd.grad((ssim_map(fast[0], b) * weights).sum(), fast[0])
    assert torch.equal(one, got[0])
    grey = a[:, :, 0].clone().requires_grad_()
    (flat,) = torch.autograd.grad(ssim(grey, b[:, :, 0]), grey)
    assert flat.shape == (23, 19)


def test_the_path_without_kernels_gives_the_same_map() -> None:
    """The path for CUDA, which no GPU need be there to check."""
    a, b = pair()
    torch.testing.assert_close(ssim_map_torch(a, b), ssim_map(a, b), rtol=0, atol=1e-5)
