"""Scenes for the rasteriser's tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians


@pytest.fixture(scope="session")
def camera_at() -> Callable[..., Camera]:
    """Makes a pinhole camera at the origin that looks along world +z with +y down (or at the pose given)."""

    def make(
        width: int = 64,
        height: int = 64,
        f: float = 100.0,
        cx: float | None = None,
        cy: float | None = None,
        camera_to_world: np.ndarray | None = None,
    ) -> Camera:
        pose = np.diag([1.0, -1.0, -1.0, 1.0]) if camera_to_world is None else camera_to_world
        centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
        return Camera(width=width, height=height, fx=f, fy=f, cx=centre[0], cy=centre[1], camera_to_world=pose)

    return make


@pytest.fixture(scope="session")
def cloud() -> Callable[..., Gaussians]:
    """Makes n random Gaussians between z = 1 and 2 in front of `camera_at`, ``sigma`` px large, needles among them."""

    def make(n: int, f: float = 100.0, extent: float = 0.7, sigma: float = 2.0, seed: int = 0) -> Gaussians:
        g = torch.Generator().manual_seed(seed)
        z = 1 + torch.rand(n, generator=g)
        xy = (torch.rand(n, 2, generator=g) - 0.5) * extent * z[:, None]
        scales = (sigma / f * z)[:, None] * torch.exp(0.7 * torch.randn(n, 3, generator=g))
        return Gaussians(
            means=torch.cat([xy, z[:, None]], dim=1),
            scales=scales,
            quaternions=torch.randn(n, 4, generator=g),
            opacities=torch.rand(n, generator=g) * 0.95 + 0.05,
            colours=torch.rand(n, 3, generator=g),
        )

    return make
