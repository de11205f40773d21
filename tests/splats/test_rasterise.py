"""The picture against closed forms, and bad input."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from splatsoil.errors import ParameterError
from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, rasterise, rasterise_features

CameraMaker = Callable[..., Camera]
CloudMaker = Callable[..., Gaussians]


def ball(
    z: float = 2.0,
    sigma: float = 0.1,
    opacity: float = 0.8,
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
    x: float = 0.0,
    y: float = 0.0,
) -> Gaussians:
    """One round Gaussian."""
    return Gaussians(
        means=torch.tensor([[x, y, z]]),
        scales=torch.full((1, 3), sigma),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.tensor([opacity]),
        colours=torch.tensor([colour]),
    )


def joined(*parts: Gaussians) -> Gaussians:
    """All of several sets, in order."""
    return Gaussians(*(torch.cat([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Gaussians)))


def test_one_gaussian_in_closed_form(camera_at: CameraMaker) -> None:
    # variance (100 · 0.1 / 2)² + 0.3 = 25.3 px²; the image's middle is a corner of four pixels
    picture = rasterise(ball(), camera_at())
    alpha = picture.alpha
    torch.testing.assert_close(picture.projection.conics[0], torch.tensor([1 / 25.3, 0.0, 1 / 25.3]))
    assert alpha[31, 31].item() == pytest.approx(0.7921338, abs=2e-7)
    assert alpha.sum().item() == pytest.approx(126.526, abs=2e-3)
    assert int((alpha > 0).sum()) == 840
    assert picture.projection.reaches[0].tolist() == pytest.approx([16.404, 16.404], abs=1e-3)
    dx = torch.arange(64) + 0.5 - 32
    expected = 0.8 * torch.exp(-(dx[None, :] ** 2 + dx[:, None] ** 2) / (2 * 25.3))
    torch.testing.assert_close(alpha, torch.where(expected >= 1 / 255, expected, 0.0), rtol=2e-6, atol=1e-7)
    torch.testing.assert_close(picture.colour, alpha[:, :, None].expand(-1, -1, 3))


def test_antialiasing_factor_in_closed_form(camera_at: CameraMaker) -> None:
    # variance 25 + 0.1 px²; √(25² / 25.1²) = 0.9960159
    picture = rasterise(ball(), camera_at(), antialias=True)
    assert picture.projection.strengths.item() / 0.8 == pytest.approx(0.9960159, abs=2e-7)
    # a speck keeps its total: 2π·σ²·o; the factor has a floor of 0.005
    speck = rasterise(ball(sigma=0.002), camera_at(), antialias=True)
    assert speck.projection.strengths.item() == pytest.approx(0.8 * 0.01 / 0.11, rel=1e-4)
    dust = rasterise(ball(sigma=1e-5, opacity=0.99), camera_at(), antialias=True)
    assert dust.projection.strengths.item() == pytest.approx(0.99 * 0.005, rel=1e-5)


def test_two_gaussians_compose_front_to_back(camera_at: CameraMaker) -> None:
    near = ball(z=1.0, opacity=0.6, colour=(1.0, 0.0, 0.2), sigma=0.3)
    far = ball(z=3.0, opacity=0.9, colour=(0.0, 1.0, 0.5), sigma=0.9)
    both = joined(far, near)  # given in the wrong order on purpose
    background = torch.tensor([0.3, 0.1, 0.7])
    picture = rasterise(both, camera_at(), background=background)
    a1, a2 = (rasterise(g, camera_at()).alpha[:, :, None] for g in (near, far))
    expected = a1 * near.colours[0] + (1 - a1) * a2 * far.colours[0] + (1 - a1) * (1 - a2) * background
    torch.testing.assert_close(picture.colour, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(picture.alpha, (1 - (1 - a1) * (1 - a2))[:, :, 0], rtol=1e-5, atol=1e-6)
    depth = (a1 * 1.0 + (1 - a1) * a2 * 3.0) / (1 - (1 - a1) * (1 - a2))
    torch.testing.assert_close(picture.depth, depth[:, :, 0], rtol=1e-5, atol=1e-6)


def test_clamped_opacity_has_no_gradient_and_a_second_one_is_dropped(camera_at: CameraMaker) -> None:
    near, far = ball(z=1.0, sigma=0.3, opacity=1.0), ball(z=3.0, sigma=0.9, opacity=1.0, colour=(0.0, 0.0, 0.0))
    opacities = torch.tensor([1.0, 1.0], requires_grad=True)
    both = joined(near, far).replace(opacities=opacities)
    picture = rasterise(both, camera_at(width=8, height=8, f=400.0), background=(1.0, 1.0, 1.0))
    # 0.99 of white; the next would leave 1e-4, so it is not blended and the background shows through the remaining 0.01
    torch.testing.assert_close(picture.alpha, torch.full((8, 8), 0.99))
    torch.testing.assert_close(picture.colour, torch.ones(8, 8, 3))
    (gradient,) = torch.autograd.grad(picture.alpha.sum(), opacities)
    assert gradient.tolist() == [0.0, 0.0]


def test_depth_is_the_centres_and_nothing_where_nothing_is(camera_at: CameraMaker) -> None:
    picture = rasterise(ball(x=0.1, y=-0.2, z=1.5), camera_at())
    covered = picture.alpha > 0
    assert covered.any()
    torch.testing.assert_close(picture.depth[covered], torch.full_like(picture.depth[covered], 1.5))
    assert float(picture.depth[~covered].abs().sum()) == 0.0


def test_a_disc_beside_the_camera_is_no_haze(camera_at: CameraMaker) -> None:
    """A flat disc beneath the camera, out of sight: along every ray of the picture its opacity is less than 1/255."""
    camera = camera_at(f=64.0)
    below, spread = 0.3, 0.08  # m; the camera's y points down, so that the disc lies in the plane y = below
    x, y = np.meshgrid(np.arange(64) + 0.5 - 32.0, np.arange(64) + 0.5 - 32.0)
    with np.errstate(divide="ignore"):
        reach = np.where(y > 0, below / (y / 64.0), np.inf)
    with np.errstate(invalid="ignore"):
        true = 0.9 * np.exp(-0.5 * (((reach - 0.12) / spread) ** 2 + (reach * x / 64.0 / spread) ** 2))
    assert np.nanmax(true) < 1 / 255
    disc = Gaussians(
        torch.tensor([[0.0, below, 0.12]]),
        torch.tensor([[spread, 0.001, spread]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([0.9]),
        torch.ones(1, 3),
    )
    assert float(rasterise(disc, camera).alpha.max()) == 0.0
    farther = disc.replace(means=torch.tensor([[0.0, below, 0.8]]))
    assert float(rasterise(farther, camera).alpha.max()) > 0.8


def test_nothing_in_view_shows_the_background(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    camera = camera_at(width=21, height=9)
    behind = cloud(5).replace(means=cloud(5).means * torch.tensor([1.0, 1.0, -1.0]))
    for gaussians in (cloud(5)[:0], behind, cloud(5).replace(means=cloud(5).means + 100.0)):
        colours = gaussians.colours.clone().requires_grad_()
        picture = rasterise(gaussians.replace(colours=colours), camera, background=(0.1, 0.2, 0.3))
        torch.testing.assert_close(picture.colour, torch.tensor([0.1, 0.2, 0.3]).expand(9, 21, 3))
        assert not picture.alpha.any()
        assert not picture.depth.any()
        (gradient,) = torch.autograd.grad(picture.colour.sum(), colours)
        assert gradient.shape == colours.shape
        assert not gradient.any()


def test_broken_gaussians_are_not_drawn(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    """NaN, infinite and gigantic Gaussians neither crash nor spoil the others."""
    good = cloud(20)
    camera = camera_at()
    bad = cloud(4, seed=1)
    means, scales = bad.means.clone(), bad.scales.clone()
    means[0, 1], means[1, 2], scales[2, 0] = math.nan, math.inf, math.nan
    scales[3] = 1e12
    both = rasterise(joined(good, bad[:3].replace(means=means[:3], scales=scales[:3])), camera)
    assert torch.equal(both.colour, rasterise(good, camera).colour)
    huge = rasterise(bad[3:].replace(means=means[3:], scales=scales[3:]), camera)
    assert torch.isfinite(huge.colour).all()


def test_bad_arguments_are_explained(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    g, camera = cloud(3), camera_at()
    with pytest.raises(ParameterError, match="undistorted"):
        rasterise(g, dataclasses.replace(camera, k1=0.1))
    with pytest.raises(ParameterError, match="background"):
        rasterise(g, camera, background=(1.0, 1.0))
    with pytest.raises(ParameterError, match="empty"):
        rasterise(g, dataclasses.replace(camera, width=0))
    with pytest.raises(ParameterError, match="features"):
        rasterise_features(g.means, g.covariances(), g.opacities, torch.zeros(3, 9), camera)
    with pytest.raises(ParameterError, match="covariances"):
        rasterise_features(g.means, torch.zeros(3, 6), g.opacities, g.colours, camera)
    with pytest.raises(ParameterError, match="float64"):
        rasterise_features(g.means.double(), g.covariances(), g.opacities, g.colours, camera)
    with pytest.raises(ParameterError, match="scales"):
        g.replace(scales=torch.zeros(3, 2))
