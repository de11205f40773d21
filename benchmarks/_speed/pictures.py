"""Drawing Gaussians and training them: on one core and two, against the slow reference, and against gsplat on a GPU."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from splatsoil.benchmarks._speed.clock import on_threads, repeated
from splatsoil.benchmarks._speed.rows import Group, Row, Sample, at_least, had, judged
from splatsoil.benchmarks.rasteriser import LEAVES, scene

from splatsoil.measurement import Camera, Measurement
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.reconstruction.presets import PRESETS, preset_named
from splatsoil.splats import Gaussians, rasterise, reference
from splatsoil.threads import cores

COUNT, SIZE = 20_000, 256
BOTH_MS = 45.0
"""Most for drawing ``COUNT`` Gaussians on ``SIZE``² px and for the gradients."""
ITERATIONS = 12.0
"""Least iterations a second of training."""
MINUTES = 120.0
"""Most seconds for a reconstruction on a CPU."""
GPU_SECONDS = 20.0
"""The same on a GPU."""
LESS = 0.1
"""dB that a reconstruction on a GPU may lose before it counts as worse: what chance does."""
SHARE = 50
"""The reference draws one Gaussian of so many."""
GSPLAT, EQUAL = 1.5, 1e-3
"""Most of gsplat's time, and largest difference of a picture's values."""


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch, and with it the rasteriser, use that many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def with_gradients(gaussians: Gaussians) -> Gaussians:
    """The same as leaves."""
    return Gaussians(*(getattr(gaussians, name).clone().requires_grad_() for name in LEAVES))


def drawing(leaves: Gaussians, camera: Camera) -> Callable[[], None]:
    """A task: colour, alpha and depth, and the gradients of colour and depth by all five tensors."""

    def both() -> None:
        drawn = rasterise(leaves, camera, normals=False)
        outputs = [drawn.colour, drawn.depth]
        torch.autograd.backward(outputs, [torch.ones_like(o) for o in outputs])

    return both


def rasteriser(repeats: int, count: int = COUNT, size: int = SIZE) -> Group:
    """Times on one thread and on two, the reference's, and how far pictures are from its."""
    gaussians, camera = scene(count, size)
    both = drawing(with_gradients(gaussians), camera)
    more = 5 * repeats

    def forward() -> None:
        rasterise(gaussians, camera, normals=False)

    few = gaussians[: max(count // SHARE, 1)]
    drawn: list[torch.Tensor] = []

    def slowly() -> None:
        drawn[:] = reference.rasterise_features(few.means, few.covariances(), few.opacities, few.colours, camera)[:1]

    with torch_threads(1):
        one, one_both = (repeated(task, more).scaled(1e3) for task in (forward, both))
        slow = repeated(slowly, 1, warm=0).scaled(1e3 * count / len(few), f"reference, from 1 in {SHARE}")
        off = float((rasterise(few, camera, normals=False).colour - drawn[0]).abs().max())
    with torch_threads(2):
        two, two_both = (on_threads(task, more, "two threads").scaled(1e3) for task in (forward, both))
    what = f"{count} Gaussians at {size}²"
    rows = [
        Row(f"{what}, forward, one core", "ms", one, slow, note=f"pictures differ by {off:.0e} at most"),
        Row(
            f"{what}, forward + backward, one core",
            "ms",
            one_both,
            target=f"≤ {BOTH_MS:g} ms on two cores",
            met=True if one_both.median <= BOTH_MS else None,
        ),
        _scaling(f"{what}, forward, two cores", two, one),
        _scaling(f"{what}, forward + backward, two cores", two_both, one_both, BOTH_MS),
    ]
    note = f"Gaussians of 3 px; colour, alpha and depth; medians of {more}. One core: CPU time; two: the clock's."
    return Group("Rasteriser", tuple(rows), (note,))


def _scaling(what: str, two: Sample, one: Sample, most: float | None = None) -> Row:
    row = Row(what, "ms", two, replace(one, label="one core"))
    if cores() < 2:
        return replace(row, note="this machine has one core")
    row = replace(row, note=had(two, 2))
    return row if most is None else replace(row, target=f"≤ {most:g} ms", met=judged(two, most, "less", 2))


def trained(measurement: Measurement, preset: str, device: str, seed: int = 0) -> tuple[Reconstruction, float, Sample]:
    """A reconstruction, its seconds and its training's iterations a second, a value for each seventh of them.

    On a CPU, where it runs on one core, seconds are CPU seconds.
    """
    clock = time.process_time if device == "cpu" else time.perf_counter
    iterations = preset_named(preset).iterations
    told: list[tuple[float, float]] = []

    def listen(what: str, share: float) -> None:
        if what.startswith("training"):
            told.append((share * iterations, clock()))

    began = clock()
    result = reconstruct(measurement, preset=preset, seed=seed, device=device, progress=listen)
    seconds = clock() - began
    # the first report comes before the first step, which may compile; told every ten steps
    told = told[1:]
    every = max(1, (len(told) - 1) // 7)
    marks = told[::every]
    speeds = [(b[0] - a[0]) / (b[1] - a[1]) for a, b in pairwise(marks) if b[1] > a[1]]
    return result, seconds, Sample(tuple(speeds))


def kept_preset(name: str) -> str:
    """A preset of the reconstruction for a preset of the solver."""
    return name if name in PRESETS else "small"


def training(folder: Path, preset: str, device: str) -> Group:
    """A reconstruction from photographs; on a GPU beside the same on one core of the CPU."""
    measurement = Measurement.load(folder)
    preset = kept_preset(preset)
    what = f"training on {measurement.name}, with SSIM"
    size = f"{preset_named(preset).iterations} iterations"
    if device == "cpu":
        result, seconds, speed = trained(measurement, preset, device)
        rows = [
            Row(what, "it/s", speed, None, "more", f"≥ {ITERATIONS:g} it/s", at_least(speed.median, ITERATIONS)),
            Row(
                f"reconstruction of {measurement.name}",
                "s",
                Sample((seconds,)),
                target=f"≤ {MINUTES:g} s",
                met=seconds <= MINUTES,
            ),
        ]
        note = (
            f"Preset `{preset}`: {size}, {len(result.gaussians)} Gaussians at the end, {result.psnr:.2f} dB on "
            "photographs set aside. One core; its CPU time. Spread of training: seven pieces of it."
        )
        return Group("Reconstruction", tuple(rows), (note,))
    # the first runs compile
    for place in (device, "cpu"):
        trained(measurement, "tiny", place)
    found = [trained(measurement, preset, device, seed) for seed in range(2)]
    reference_result, slow, slow_speed = trained(measurement, preset, "cpu")
    quality = found[0][0].psnr
    good = quality >= reference_result.psnr - LESS
    seconds_all = Sample(tuple(s for _, s, _ in found))
    row = Row(
        f"reconstruction of {measurement.name}",
        "s",
        seconds_all,
        Sample((slow,), "one core of the CPU"),
        target=f"≤ {GPU_SECONDS:g} s at as good pictures",
        met=seconds_all.median <= GPU_SECONDS and good,
        note=f"{quality:.2f} dB on photographs set aside, {reference_result.psnr:.2f} dB by the CPU",
    )
    rows = [Row(what, "it/s", found[0][2], replace(slow_speed, label="one core of the CPU"), "more"), row]
    return Group("Reconstruction", tuple(rows), (f"Preset `{preset}`: {size}; seeds 0 and 1, the dB are seed 0's.",))


def load_gsplat() -> Any:
    """The package, or None where it isn't installed or can't be used."""
    try:
        return importlib.import_module("gsplat")
    except (ImportError, OSError):
        return None


def against_gsplat(
    device: str, repeats: int, cases: tuple[tuple[int, int], ...] = ((COUNT, SIZE), (200_000, 1024))
) -> Group:
    """The same Gaussians with both on a GPU."""
    title, target = "Rasteriser against gsplat", f"≤ {GSPLAT:g} times gsplat's time"
    gsplat = load_gsplat()
    more = 7 * repeats
    rows = []
    for count, size in cases:
        gaussians, camera = scene(count, size)
        gaussians = gaussians.to(device)
        ours, ours_both = with_gradients(gaussians), drawing(with_gradients(gaussians), camera)
        what = f"{count} Gaussians at {size}²"

        def forward(drawn: Gaussians = ours, seen: Camera = camera) -> None:
            with torch.no_grad():
                rasterise(drawn, seen, normals=False)

        times = [repeated(task, more, device, warm=3).scaled(1e3) for task in (forward, ours_both)]
        others: list[Sample | None] = [None, None]
        note = "gsplat is not installed"
        if gsplat is not None:
            try:
                others, off = _gsplat(gsplat, gaussians, camera, device, more)
                note = ""
                rows.append(
                    Row(
                        f"{what}, largest difference of the two pictures",
                        "",
                        Sample((off[0],)),
                        target=f"≤ {EQUAL:g}",
                        met=off[0] <= EQUAL,
                        note=f"on the average {off[1]:.1e}",
                    )
                )
            except Exception as error:  # its compiler's and its own errors are of many kinds, and none is ours
                first = str(error).strip().splitlines() or [""]
                note = f"gsplat cannot run here ({type(error).__name__}: {first[0]})"
        for name, mine, theirs in zip(("forward", "forward + backward"), times, others, strict=True):
            row = Row(f"{what}, {name}", "ms", mine, theirs, target=target, note=note)
            rows.append(row if row.ratio is None else replace(row, met=row.ratio >= 1.0 / GSPLAT))
    told = "Colour, alpha and depth with both; gradients of colour and depth by all five tensors."
    return Group(title, tuple(rows), (told,))


def _gsplat(
    gsplat: Any, gaussians: Gaussians, camera: Camera, device: str, repeats: int
) -> tuple[list[Sample | None], tuple[float, float]]:
    """gsplat's times in ms, forward and forward + backward, and the largest and mean difference of colours."""
    leaves = with_gradients(gaussians)
    view = torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)[None]
    lens = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device)[
        None
    ]

    def draw() -> Any:
        return gsplat.rasterization(
            leaves.means,
            leaves.quaternions,
            leaves.scales,
            leaves.opacities,
            leaves.colours,
            view,
            lens,
            camera.width,
            camera.height,
            near_plane=0.01,
            eps2d=0.3,
            packed=False,
            render_mode="RGB+ED",
        )[0]

    def forward() -> None:
        with torch.no_grad():
            draw()

    def both() -> None:
        image = draw()
        image.backward(torch.ones_like(image))

    label = f"gsplat {getattr(gsplat, '__version__', '')}".strip()
    times: list[Sample | None] = [
        repeated(task, repeats, device, warm=3).scaled(1e3, label) for task in (forward, both)
    ]
    with torch.no_grad():
        off = (draw()[0, ..., :3] - rasterise(gaussians, camera, normals=False).colour).abs()
    return times, (float(off.max()), float(off.mean()))
