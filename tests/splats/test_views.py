"""Several views at once against each of them by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, kernels_cuda, rasterise_features, rasteriser
from splatsoil.splats.binning import Bins
from splatsoil.splats.views import Seen, rasterise_views

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def views(camera_at: Callable[..., Camera], cloud: Callable[..., Gaussians]) -> list[Seen]:
    """Of four cameras of one size, 5 by 4 tiles: of one cloud, of another one turned, of nothing, of one behind it."""
    out = []
    for k, (count, turn) in enumerate([(400, 0.0), (250, 20.0), (0, 0.0), (100, 180.0)]):
        g = cloud(count, seed=k)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", turn, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        camera = camera_at(70, 50, f=90.0 + 5.0 * k, camera_to_world=pose)
        out.append(Seen(g.means, g.covariances(), g.opacities, g.colours, camera))
    return out


def test_views_together_are_the_same_as_each_alone(views: list[Seen]) -> None:
    image, alpha = rasterise_views(views, background=BACKGROUND, antialias=True)
    assert image.shape == (4, 50, 70, 3) and alpha.shape == (4, 50, 70)
    for k, v in enumerate(views):
        picture, cover = rasterise_features(
            v.means, v.covariances, v.opacities, v.features, v.camera, background=BACKGROUND, antialias=True
        )
        assert torch.equal(image[k], picture) and torch.equal(alpha[k], cover)
    assert alpha[:2].amax(dim=(1, 2)).min() > 0.5 and alpha[2:].max() == 0.0


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_draws_them_as_a_cpu_does(views: list[Seen]) -> None:
    there = [Seen(*(t.cuda() for t in (v.means, v.covariances, v.opacities, v.features)), v.camera) for v in views]
    ours = rasterise_views(views, background=BACKGROUND, antialias=True)
    theirs = rasterise_views(there, background=BACKGROUND.cuda(), antialias=True)
    for here, on_gpu in zip(ours, theirs, strict=True):
        assert torch.allclose(here, on_gpu.cpu(), atol=2e-4)


def test_kernels_of_a_gpu_draw_all_views_in_one_launch(views: list[Seen], monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU: the same as the CPU's own, view by view."""
    launched: list[int] = []

    def launch_pixels(kernel: Any, bins: Bins, inputs: list[Any], like: torch.Tensor) -> None:
        launched.append(len(bins.starts) - 1)
        wp.launch(kernel, dim=launched[-1] * kernels_cuda.THREADS, inputs=[0, *inputs], device="cpu")

    ours = rasterise_views(views, background=BACKGROUND, antialias=True)
    monkeypatch.setattr(rasteriser, "_kernels", lambda like: kernels_cuda)
    monkeypatch.setattr(rasteriser, "_launch_tiles", launch_pixels)
    theirs = rasterise_views(views, background=BACKGROUND, antialias=True)
    assert launched == [4 * 5 * 4]
    for here, there in zip(ours, theirs, strict=True):
        assert torch.allclose(here, there, atol=1e-5)
