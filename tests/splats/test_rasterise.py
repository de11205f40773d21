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
from splatsoil.splats import (
    Gaussians,
    OrthographicCamera,
    rasterise,
    rasterise_covariances,
    rasterise_features,
)

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
    both = Gaussians.concatenate([far, near])  # given in the wrong order on purpose
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
    both = Gaussians.concatenate([near, far]).replace(opacities=opacities)
    picture = rasterise(both, camera_at(width=8, height=8, f=400.0), background=(1.0, 1.0, 1.0))
    # 0.99 of white; the next would leave 1e-4, so it is not blended and the background shows through the remaining 0.01
    torch.testing.assert_close(picture.alpha, torch.full((8, 8), 0.99))
    torch.testing.assert_close(picture.colour, torch.ones(8, 8, 3))
    (gradient,) = torch.autograd.grad(picture.alpha.sum(), opacities)
    assert gradient.tolist() == [0.0, 0.0]


def test_depth_and_normal_of_a_tilted_disc(camera_at: CameraMaker) -> None:
    half = math.radians(20.0) / 2
    disc = Gaussians(
        means=torch.tensor([[0.1, -0.2, 1.5]]),
        scales=torch.tensor([[0.2, 0.2, 0.001]]),
        quaternions=torch.tensor([[math.cos(half), math.sin(half), 0.0, 0.0]]),
        opacities=torch.tensor([0.9]),
        colours=torch.tensor([[0.2, 0.4, 0.6]]),
    )
    picture = rasterise(disc, camera_at())
    covered = picture.alpha > 0
    assert covered.any()
    torch.testing.assert_close(picture.depth[covered], torch.full_like(picture.depth[covered], 1.5))
    assert float(picture.depth[~covered].abs().sum()) == 0.0
    assert picture.normal is not None
    # its own z axis turned by 20° about x is (0, −sin 20°, cos 20°); the camera at the origin sees the other side
    expected = torch.tensor([0.0, math.sin(math.radians(20)), -math.cos(math.radians(20))])
    weights = picture.alpha[:, :, None]
    torch.testing.assert_close(picture.normal, weights * expected, rtol=1e-5, atol=1e-6)
    assert rasterise(disc, camera_at(), normals=False).normal is None


def test_orthographic_size_place_and_depth() -> None:
    camera = OrthographicCamera.looking((0, 0, -1), (-0.3, -0.1, 0.0), (0.5, 0.3, 0.2), 0.01)
    assert (camera.width, camera.height) == (80, 40)
    # a Gaussian at x = −0.1 is 20 px from the left edge, at y = 0.2 it is 10 px below the upper edge
    picture = rasterise(ball(x=-0.1, y=0.2, z=0.05, sigma=0.04), camera)
    assert picture.projection.centres[0].tolist() == pytest.approx([20.0, 10.0], abs=1e-4)
    torch.testing.assert_close(picture.projection.conics[0], torch.tensor([1 / 16.3, 0.0, 1 / 16.3]))
    assert picture.depth[10, 20].item() == pytest.approx(0.15, abs=1e-6)
    assert picture.normal is not None
    floor = rasterise(ball(sigma=0.04).replace(scales=torch.tensor([[0.04, 0.04, 0.001]])), camera)
    assert floor.normal is not None
    assert floor.normal[20, 30, 2].item() == pytest.approx(floor.alpha[20, 30].item())


@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 0, 0), (0, 1, 0), (0.3, -0.4, -0.8), (-1, 2, 3)])
def test_orthographic_camera_just_covers_its_box(direction: tuple[float, float, float]) -> None:
    lower, upper = np.array([-0.2, 0.1, 0.0]), np.array([0.4, 0.9, 0.3])
    camera = OrthographicCamera.looking(direction, lower, upper, 0.002)
    pose = camera.world_to_camera
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[2, :3], np.array(direction) / np.linalg.norm(direction), atol=1e-12)
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, -1).T
    seen = corners @ pose[:3, :3].T + pose[:3, 3]
    pixels = seen[:, :2] / camera.pixel_size + np.array([camera.width, camera.height]) / 2
    size = np.array([camera.width, camera.height])
    assert (pixels > -1e-6).all()
    assert (pixels < size + 1e-6).all()
    assert (np.ptp(pixels, axis=0) > size - 1 - 1e-6).all()
    assert seen[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_orthographic_depth_map_of_a_sphere() -> None:
    """Shadow maps and height maps rest on this: many small opaque Gaussians on a sphere, seen obliquely."""
    g = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(30_000, 3, generator=g), dim=1) * 0.5
    camera = OrthographicCamera.looking((1, 0.5, -2), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0.025)
    covariances = torch.eye(3).expand(len(points), 3, 3) * 0.015**2
    ones = torch.ones(len(points), 1)
    picture = rasterise_covariances(points, covariances, 0.95 * ones[:, 0], ones.expand(-1, 3), None, camera)
    row, column = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    x = (column + 0.5 - camera.width / 2) * 0.025
    y = (row + 0.5 - camera.height / 2) * 0.025
    inside = x**2 + y**2 < 0.2**2  # steeper parts look nearer, by about slope times a Gaussian's size
    centre_depth = float(camera.world_to_camera[2, 3])
    expected = centre_depth - torch.sqrt(0.25 - x**2 - y**2)
    error = (picture.depth - expected)[inside]
    assert float(error.abs().mean()) < 0.01
    assert float(picture.alpha[inside].min()) > 0.99


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
    both = rasterise(Gaussians.concatenate([good, bad[:3].replace(means=means[:3], scales=scales[:3])]), camera)
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
        rasterise_covariances(g.means, torch.zeros(3, 6), g.opacities, g.colours, None, camera)
    with pytest.raises(ParameterError, match="float64"):
        rasterise_covariances(g.means.double(), g.covariances(), g.opacities, g.colours, None, camera)
    with pytest.raises(ParameterError, match="scales"):
        g.replace(scales=torch.zeros(3, 2))
