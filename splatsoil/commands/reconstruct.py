"""``splatsoil reconstruct``: from photographs to Gaussians, surface and mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatsoil.commands import _model
from splatsoil.commands._options import PRESET, SEED, SET, Preset, check_seed
from splatsoil.commands._output import print_remarks, print_result, print_table, print_text, stages
from splatsoil.devices import resolve_device
from splatsoil.files import check_folder
from splatsoil.options import JSON, argument, option
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from splatsoil.reconstruction import Reconstruction

INTERRUPTED = "nothing was written; start again with"


@dataclass(frozen=True)
class Config:
    """Photographs to Gaussians, soil surface and mesh."""

    set: Path = argument(SET)
    out: Path | None = option(None, "Folder for the result; runs/NAME-reconstruction if not given.")
    preset: Preset = option("small", PRESET)
    seed: int = option(0, SEED, expert=True)
    device: str = option("auto", "Where to train: auto, cpu, cuda:0, …")
    holdout: int = option(8, "One of so many views is held out to measure quality; 0 for none.", expert=True)
    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Reconstruct, save and print; set, options and folder are checked first."""
    from splatsoil.measurement import Measurement

    check_seed(config.seed)
    hush()
    device = resolve_device(config.device)
    measurement = Measurement.load(config.set)
    print_remarks(measurement)
    out = config.out or Path("runs") / f"{measurement.name}-reconstruction"
    check_folder(out)
    with stages(quiet=config.json) as begin:
        result = _model.new_reconstruction(
            measurement,
            seed=config.seed,
            device=device,
            preset=config.preset,
            holdout=config.holdout,
            progress=begin("reconstruct"),
        )
    result.save(out)
    data = {"set": str(measurement.folder), "out": str(out), **result.summary()}
    none = result.fault and f"no answer: {result.fault}"
    return print_result(config, data, lambda: _show(result, out), none=none)


def _show(result: Reconstruction, out: Path) -> None:
    rows = [(view.name, f"{view.psnr:.2f}", f"{view.ssim:.3f}") for view in result.held_out]
    if rows:
        rows.append(("mean", f"{result.psnr:.2f}", f"{result.ssim:.3f}"))
    title = f"reconstruction of {result.metadata['measurement']}"
    print_table(title, ("held-out photograph", "PSNR in dB", "SSIM"), rows)
    height = result.surface.height
    print_text(
        f"{len(result.gaussians)} Gaussians ({int(result.soil.sum())} soil, {int(result.tool.sum())} tool); "
        f"surface {height.min():.3f} to {height.max():.3f} m in cells of {1e3 * max(result.surface.cell):.1f} mm; "
        f"{result.seconds:.0f} s",
        f"written to {out}",
    )
