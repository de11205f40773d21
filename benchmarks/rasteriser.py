"""How long drawing takes: forward, forward + backward, SSIM, with the slow reference's time as a yardstick.

``python -m splatsoil.benchmarks.rasteriser`` prints a table of medians for 5000 and 20 000 Gaussians of 3 px at 256².
Times are those of the calling thread (CPU time), which other programs on the machine disturb less than the clock's; on
CUDA, and with more than one thread, the clock's.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from kornia.losses import ssim_loss
from rich.console import Console
from rich.table import Table
from splatsoil.benchmarks._common import here

from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, rasterise, reference, ssim

LEAVES = ("means", "scales", "quaternions", "opacities", "colours")


@dataclass(frozen=True)
class Timing:
    """Medians in milliseconds.

    Attributes:
        gaussians: how many were drawn.
        forward: `rasterise` without gradients, colour, alpha and depth.
        both: `rasterise` and its gradients by all five tensors.
        both_normals: the same with normals.
        reference_ratio: the slow reference's forward time over ``forward``, on a share of the Gaussians scaled up.
        ssim: SSIM and its gradient for one image.
        ssim_kornia: `kornia.losses.ssim_loss` with the same window and its gradient.
    """

    gaussians: int
    forward: float
    both: float
    both_normals: float
    reference_ratio: float
    ssim: float
    ssim_kornia: float


def scene(count: int, size: int = 256, sigma: float = 3.0, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Random Gaussians of about ``sigma`` px spread over an image of ``size``² px."""
    g = torch.Generator().manual_seed(seed)
    z = 1 + torch.rand(count, generator=g)
    xy = (torch.rand(count, 2, generator=g) - 0.5) * z[:, None]
    gaussians = Gaussians(
        means=torch.cat([xy, z[:, None]], dim=1),
        scales=(sigma / size * z)[:, None] * torch.exp(0.3 * torch.randn(count, 3, generator=g)),
        quaternions=torch.randn(count, 4, generator=g),
        opacities=torch.rand(count, generator=g) * 0.8 + 0.1,
        colours=torch.rand(count, 3, generator=g),
    )
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    return gaussians, Camera(width=size, height=size, fx=size, fy=size, cx=size / 2, cy=size / 2, camera_to_world=pose)


def measure(count: int, size: int = 256, repeats: int = 11, device: str = "cpu") -> Timing:
    """Time ``count`` Gaussians on an image of ``size``² px."""
    gaussians, camera = scene(count, size)
    gaussians = gaussians.to(device)
    target = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(1)).to(device)
    leaves = Gaussians(*(getattr(gaussians, name).clone().requires_grad_() for name in LEAVES))
    picture = target.clone().requires_grad_()

    def both(normals: bool) -> None:
        drawn = rasterise(leaves, camera, normals=normals)
        outputs = [drawn.colour, drawn.depth] + ([drawn.normal] if drawn.normal is not None else [])
        torch.autograd.backward(outputs, [torch.ones_like(o) for o in outputs])

    few = gaussians[: max(count // 50, 1)].to("cpu")

    def slowly() -> None:
        reference.rasterise_features(few.means, few.covariances(), few.opacities, few.colours, camera)

    def median(task: Callable[[], object], times: int = repeats) -> float:
        return _median(task, times, device)

    forward = median(lambda: rasterise(gaussians, camera, normals=False))
    return Timing(
        gaussians=count,
        forward=forward,
        both=median(lambda: both(False)),
        both_normals=median(lambda: both(True)),
        reference_ratio=_median(slowly, 1, "cpu") * count / len(few) / forward,
        ssim=median(lambda: ssim(picture, 0.9 * target).backward()),
        ssim_kornia=median(lambda: ssim_loss(_planes(picture), _planes(0.9 * target), 11).backward()),
    )


def run(counts: tuple[int, ...] = (5_000, 20_000), size: int = 256, device: str = "cpu") -> list[Timing]:
    """Measure, print a table and return its rows."""
    table = Table("Gaussians", "forward", "forward + backward", "with normals", "reference", "SSIM", "SSIM by kornia")
    rows = []
    for count in counts:
        row = measure(count, size, device=device)
        rows.append(row)
        times = (row.forward, row.both, row.both_normals)
        reference_column = f"{row.reference_ratio:.0f} × forward"
        table.add_row(
            str(count),
            *(f"{t:.1f} ms" for t in times),
            reference_column,
            f"{row.ssim:.1f} ms",
            f"{row.ssim_kornia:.1f} ms",
        )
    table.title = f"{size} × {size} px, σ = 3 px, {device}, {torch.get_num_threads()} thread(s)"
    Console().print(table)
    return rows


def _planes(picture: torch.Tensor) -> torch.Tensor:
    """(h, w, c) to kornia's (1, c, h, w)."""
    return picture.permute(2, 0, 1)[None]


def _median(task: Callable[[], object], repeats: int, device: str) -> float:
    """Median time of a task in ms, after one call to warm up."""
    alone = device == "cpu" and torch.get_num_threads() == 1
    clock = time.thread_time if alone else time.perf_counter
    task()
    times = []
    for _ in range(repeats):
        if device != "cpu":
            torch.cuda.synchronize()
        begin = clock()
        task()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(clock() - begin)
    return 1e3 * statistics.median(times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    run(device=arguments.device)
