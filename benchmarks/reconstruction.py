"""How good is a reconstruction? Time, likeness to photographs set aside, and the surface against the true one.

``python -m splatsoil.benchmarks.reconstruction examples/plow-dry examples/plow-damp`` prints a table; ``--json`` an
object. Sets without ``truth_particles.npz`` get no surface error.

The true surface is that of the true particles at frame 0, found without any part of the reconstruction: their volume on
a fine grid, blurred by a Gaussian of one spacing, and in each column the uppermost height at which 0.45 of the bulk
remains. That is how the sets' pictures were made, on a coarser grid that is not known; other grids move this surface by
up to 0.2 mm on average and 0.7 mm in a cell.
"""

from __future__ import annotations

import argparse
import resource
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.ndimage import gaussian_filter, map_coordinates
from splatsoil.benchmarks._common import here

from splatsoil.commands._output import only_json, print_json
from splatsoil.measurement import Measurement
from splatsoil.reconstruction import HeightField, Reconstruction, reconstruct, volume
from splatsoil.reconstruction.progress import progress_bar

LEVEL = 0.45
"""Share of the bulk density at which the pictures' surface was drawn."""

FINENESS = 4
"""Grid cells per particle spacing."""

PADDING = 3
"""Spacings of empty space around the bed, so that the blur ends in nothing."""


@dataclass(frozen=True)
class Score:
    """What one set gave.

    Attributes:
        name: the set.
        seconds: wall-clock time of `reconstruct`.
        psnr: mean over the photographs set aside, dB.
        ssim: the same for structural similarity.
        gaussians: how many.
        rmse: of the surface's heights inside the bin, m; None without truth.
        bias: mean height minus the true one, m; None without truth.
        rmse_inner: the same 2 cells and more from the walls, where the true surface does not dive into the blur's edge.
        volume: soil volume over that of the true particles, minus 1; None without truth.
    """

    name: str
    seconds: float
    psnr: float
    ssim: float
    gaussians: int
    rmse: float | None = None
    bias: float | None = None
    rmse_inner: float | None = None
    volume: float | None = None


def true_surface(folder: Path, measurement: Measurement, cells: HeightField) -> HeightField | None:
    """The surface of the true particles at frame 0 at the given cells, or None when the set has no truth."""
    file = folder / "truth_particles.npz"
    if not file.is_file():
        return None
    with np.load(file, allow_pickle=False) as truth:
        spacing = float(truth["spacing"])
        places = truth["f000"] * float(truth["scale"])
    step = spacing / FINENESS
    lower = measurement.bed.lower - PADDING * spacing
    shape = np.ceil((measurement.bed.upper + PADDING * spacing - lower) / step).astype(int)
    bulk, _ = np.histogramdd(places, bins=shape.tolist(), range=list(zip(lower, lower + shape * step, strict=True)))
    bulk = gaussian_filter(bulk * (spacing / step) ** 3, FINENESS)
    # Columns at the cells asked for, all levels.
    xs, ys = np.meshgrid(cells.x, cells.y)
    level = np.arange(shape[2])
    where = [np.repeat((((a - lower[k]) / step) - 0.5)[..., None], len(level), axis=2) for k, a in enumerate((xs, ys))]
    columns = map_coordinates(bulk, [*where, np.broadcast_to(level, where[0].shape)], order=1)
    filled = columns >= LEVEL
    top = len(level) - 1 - np.argmax(filled[..., ::-1], axis=2)
    under = np.take_along_axis(columns, top[..., None], axis=2)[..., 0]
    over = np.take_along_axis(columns, np.minimum(top + 1, len(level) - 1)[..., None], axis=2)[..., 0]
    height = lower[2] + (top + 0.5 + (under - LEVEL) / np.maximum(under - over, 1e-12)) * step
    return HeightField(cells.x, cells.y, np.where(filled.any(axis=2), height, np.nan))


def score(folder: Path, result: Reconstruction, measurement: Measurement) -> Score:
    """A reconstruction's numbers."""
    likeness = (measurement.name, result.seconds, result.psnr, result.ssim, len(result.gaussians))
    exact = true_surface(folder, measurement, result.surface)
    if exact is None:
        return Score(*likeness)
    inner = exact.height.copy()
    inner[:2] = inner[-2:] = inner[:, :2] = inner[:, -2:] = np.nan
    with np.load(folder / "truth_particles.npz", allow_pickle=False) as truth:
        true_volume = len(truth["f000"]) * float(truth["spacing"]) ** 3
    return Score(
        *likeness,
        rmse=result.surface.rmse(exact),
        bias=result.surface.bias(exact),
        rmse_inner=result.surface.rmse(HeightField(exact.x, exact.y, inner)),
        volume=volume(result.surface, measurement.bed) / true_volume - 1.0,
    )


def main(arguments: list[str] | None = None) -> int:
    """Reconstruct each set and print its numbers."""
    parser = argparse.ArgumentParser(prog="splatsoil.benchmarks.reconstruction", description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path, help="folders of measurement sets")
    parser.add_argument("--preset", default="small")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    with only_json() if options.json else nullcontext():
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    scores = []
    for folder in options.sets:
        measurement = Measurement.load(folder)
        with progress_bar(quiet=options.json) as report:
            result = reconstruct(
                measurement, preset=options.preset, seed=options.seed, device=options.device, progress=report
            )
        scores.append(score(folder, result, measurement))
    # Linux counts in KiB, macOS in bytes.
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    if options.json:
        print_json({"scores": [vars(s) for s in scores], "memory": memory})
    else:
        _show(scores, memory)
    return 0


def _show(scores: list[Score], memory: int) -> None:
    table = Table(title=f"reconstruction, {memory / 2**30:.2f} GiB at most", title_justify="left")
    for column in ("set", "s", "PSNR dB", "SSIM", "RMSE mm", "bias mm", "RMSE inner mm", "volume %", "Gaussians"):
        table.add_column(column, justify="left" if column == "set" else "right")

    def scaled(value: float | None, factor: float) -> str:
        return "" if value is None else f"{factor * value:.2f}"

    for s in scores:
        row: list[Any] = [s.name, f"{s.seconds:.0f}", f"{s.psnr:.2f}", f"{s.ssim:.3f}", scaled(s.rmse, 1e3)]
        row += [scaled(s.bias, 1e3), scaled(s.rmse_inner, 1e3), scaled(s.volume, 1e2), str(s.gaussians)]
        table.add_row(*row)
    Console(highlight=False).print(table)


if __name__ == "__main__":
    raise SystemExit(main())
