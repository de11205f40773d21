"""CUDA kernels against the slow reference: on a GPU; and without one compiled for the GPU, and run on the CPU."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from torch import Tensor

from splatsoil.measurement import Camera
from splatsoil.splats import (
    Gaussians,
    binning,
    kernels_binning,
    kernels_cuda,
    kernels_projection,
    rasterise,
    rasteriser,
    reference,
    ssim,
)

CameraMaker = Callable[..., Camera]
CloudMaker = Callable[..., Gaussians]

NAMES = ("means", "scales", "quaternions", "opacities", "colours")


def on_gpu(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test that needs a GPU."""
    return pytest.mark.cuda(pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")(test))


def outputs_and_gradients(
    g: Gaussians, paint: Callable[[Gaussians, Tensor], dict[str, Tensor]], dtype: torch.dtype
) -> dict[str, Tensor]:
    """Every output of a rendering, and the gradients of a fixed random weighting of all of them, on the CPU."""
    leaves = [getattr(g, name).detach().to(dtype).requires_grad_() for name in NAMES]
    background = torch.tensor([0.3, 0.6, 0.1], device=g.device, dtype=dtype, requires_grad=True)
    outputs = paint(Gaussians(*leaves), background)
    generator = torch.Generator().manual_seed(0)
    weighted = [(o * torch.randn(o.shape, generator=generator).to(o)).sum() for o in outputs.values()]
    gradients = torch.autograd.grad(torch.stack(weighted).sum(), [*leaves, background])
    named = zip((*(f"by {n}" for n in NAMES), "by background"), gradients, strict=True)
    return {name: value.detach().float().cpu() for name, value in (outputs | dict(named)).items()}


def draw(g: Gaussians, camera: Camera, antialias: bool = False) -> dict[str, Tensor]:
    """By the rasteriser, where ``g`` lives."""

    def paint(h: Gaussians, background: Tensor) -> dict[str, Tensor]:
        picture = rasterise(h, camera, background=background, antialias=antialias)
        return {"colour": picture.colour, "alpha": picture.alpha, "depth": picture.depth}

    return outputs_and_gradients(g, paint, torch.float32)


def draw_slowly(g: Gaussians, camera: Camera, antialias: bool = False) -> dict[str, Tensor]:
    """By the reference in double precision: no Warp kernel takes part, so it runs on any machine."""

    def paint(h: Gaussians, background: Tensor) -> dict[str, Tensor]:
        depths = reference.project(h.means, h.covariances(), h.opacities, camera)[3]
        features = torch.cat([h.colours, depths[:, None]], dim=1)
        behind = torch.cat([background, background.new_zeros(1)])
        image, alpha = reference.rasterise_features(
            h.means, h.covariances(), h.opacities, features, camera, background=behind, antialias=antialias
        )
        return {"colour": image[:, :, :3], "alpha": alpha, "depth": image[:, :, 3] / alpha.clamp_min(1e-8)}

    return outputs_and_gradients(g, paint, torch.float64)


def assert_agree(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    """Values to 1e-4 and gradients to 1e-3 of their largest, for all but a few that rounding moves across 1/255."""
    for name, value in a.items():
        limit = (1e-3 if name.startswith("by") else 1e-4) * float(value.abs().max())
        wrong = (value - b[name]).abs() > limit
        assert float(wrong.double().mean()) < 2e-3, name
        assert float((value - b[name]).abs().max()) < 0.02 * float(value.abs().max()), name


@pytest.fixture
def crowd(camera_at: CameraMaker, cloud: CloudMaker) -> tuple[Gaussians, Camera]:
    """Crowded and saturated, partial tiles, needles, clamped opacities; and a camera."""
    g = cloud(400, f=60.0, extent=1.0, sigma=3.0)
    camera = camera_at(width=53, height=41, f=60.0, cx=27.3, cy=18.9)
    return g.replace(opacities=(g.opacities * 1.1).clamp(max=1.0)), camera


def launch_pixels(kernel: Any, bins: binning.Bins, inputs: list[Any], like: Tensor) -> None:
    """As for a GPU: one thread per pixel of every tile."""
    wp.launch(kernel, dim=bins.tiles_x * bins.tiles_y * kernels_cuda.THREADS, inputs=[0, *inputs], device="cpu")


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("parts", [1, kernels_cuda.WARPS])
def test_cuda_kernels_on_the_cpu(
    parts: int, antialias: bool, monkeypatch: pytest.MonkeyPatch, crowd: tuple[Gaussians, Camera]
) -> None:
    """The same sorting and kernels, a warp being one lane wide: all but three warp-wide operations is tested."""
    expected = draw_slowly(*crowd, antialias)
    monkeypatch.setattr(kernels_cuda, "PARTS", parts)
    monkeypatch.setattr(kernels_cuda, "_PARTS", wp.constant(wp.int32(parts)))
    monkeypatch.setattr(kernels_cuda, "backward_kernel", kernels_cuda.backward_kernel.__wrapped__)
    monkeypatch.setattr(rasteriser, "_kernels", lambda like: kernels_cuda)
    monkeypatch.setattr(rasteriser, "_launch_tiles", launch_pixels)
    monkeypatch.setattr(binning, "_depth_order", binning._depth_order_torch)
    monkeypatch.setattr(binning, "_sort_by_tile", binning._sort_by_tile_torch)
    assert_agree(draw(*crowd, antialias), expected)


def test_what_no_pixel_shows_has_no_gradient_in_the_order_of_cuda(
    monkeypatch: pytest.MonkeyPatch, crowd: tuple[Gaussians, Camera]
) -> None:
    """That order has the invisible ones, too; their opacity in the picture is 0, by which gradients are divided."""
    monkeypatch.setattr(binning, "_depth_order", binning._depth_order_torch)
    g, camera = crowd
    parts = {name: torch.cat([getattr(g, name)] * 2) for name in NAMES}
    parts["means"][len(g) :] += 100.0
    picture = rasterise(Gaussians(**{name: part.requires_grad_() for name, part in parts.items()}), camera)
    picture.projection.strengths.retain_grad()
    (picture.colour.sum() + picture.alpha.sum()).backward()
    gradient = picture.projection.strengths.grad
    assert gradient is not None
    hidden = ~picture.projection.visible
    assert hidden.sum() >= len(g)
    assert torch.isfinite(gradient).all() and not gradient[hidden].any() and gradient.any()


@pytest.mark.parametrize("channels", [1, 8])
def test_cuda_kernels_compile(channels: int, tmp_path: Path) -> None:
    """NVRTC comes with Warp, so a CUDA compiler error shows without a GPU; sm_90 is an H100 or H200."""
    wp.init()
    for kernel in (
        kernels_cuda.forward_kernel(channels),
        kernels_cuda.backward_kernel(channels),
        kernels_binning.gather_kernel(channels),
        kernels_binning.pack,
        kernels_binning.list_tiles,
        kernels_projection.project_forward,
        kernels_projection.project_backward,
        kernels_projection.covariance_forward,
        kernels_projection.covariance_backward,
    ):
        (artifact,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
        text = Path(artifact).read_text()
        assert ".entry" in text
        if "splat" in kernel.key:
            assert "vote.sync" in text
            assert "local_depot" not in text, "sums that should stay in registers spill to memory"


def test_a_launch_on_a_gpu_is_the_first_that_warp_hears_of() -> None:
    """In a fresh process, as a command has it: Warp must know its devices before a stream is asked for."""
    code = """
import sys
from types import SimpleNamespace
import torch
import warp as wp
from splatsoil.splats import warp_torch

def stream(device):
    sys.exit(0 if wp.get_devices.__globals__["runtime"] is not None else 1)

torch.cuda.current_stream = lambda device: SimpleNamespace(cuda_stream=7)
wp.stream_from_torch = stream
warp_torch.launch(None, 1, [], SimpleNamespace(is_cuda=True, device=torch.device("cuda:0")))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@on_gpu
@pytest.mark.parametrize("antialias", [False, True])
def test_values_and_gradients_on_cuda(antialias: bool, crowd: tuple[Gaussians, Camera]) -> None:
    g, camera = crowd
    assert_agree(draw(g.to("cuda"), camera, antialias), draw_slowly(g, camera, antialias))


@on_gpu
def test_a_large_scene_on_cuda(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    """Too large for the reference: a crop, on another grid of tiles, must be the crop of the picture."""
    camera = camera_at(width=512, height=400, f=600.0)
    g = cloud(50_000, f=600.0, sigma=2.0).to("cuda")
    whole, part = rasterise(g, camera), rasterise(g, camera.cropped(101, 53, 300, 280))
    for name in ("colour", "alpha", "depth"):
        difference = (getattr(whole, name)[53:333, 101:401] - getattr(part, name)).abs()
        assert float((difference > 2e-5).double().mean()) < 2e-3, name
        assert float(difference.max()) < 0.02
    assert float(whole.alpha.max()) > 0.999


@on_gpu
def test_on_a_stream_of_its_own(crowd: tuple[Gaussians, Camera]) -> None:
    g, camera = crowd
    expected = draw(g.to("cuda"), camera)
    moved = g.to("cuda")
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        assert_agree(draw(moved, camera), expected)


@on_gpu
def test_ssim_on_cuda() -> None:
    g = torch.Generator().manual_seed(0)
    a, b = torch.rand(70, 83, 3, generator=g), torch.rand(70, 83, 3, generator=g)
    results = []
    for device, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        x = a.to(device, dtype).requires_grad_()
        value = ssim(x, b.to(device, dtype))
        (gradient,) = torch.autograd.grad(value, x)
        results.append((value.detach().float().cpu(), gradient.float().cpu()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-5)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=0, atol=1e-4 * float(results[1][1].abs().max()))
