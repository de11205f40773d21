"""``splatsoil reconstruct``: photographs to Gaussians, surface and solid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json, say_remarks

if TYPE_CHECKING:
    from splatsoil.reconstruction import Reconstruction


@dataclass(frozen=True)
class Config:
    """Photographs to Gaussians, soil surface and mesh."""

    set: Positional[Path]
    """Folder of the measurement set."""
    out: Path | None = None
    """Folder for the result; runs/NAME-reconstruction if not given."""
    preset: Literal["tiny", "small", "paper", "fine"] = "small"
    """Resolution; small suits a laptop without a graphics card."""
    seed: int = 0
    """Of random numbers; one seed gives one result on one processor."""
    device: str = "auto"
    """Where to train: auto, cpu, cuda:0, …"""
    holdout: int = 8
    """Every so many views one is set aside to judge by; 0 for none."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Reconstruct, save, print; an error before any work when set, options or the folder for the result are no good."""
    from splatsoil.envs.devices import resolve_device
    from splatsoil.errors import ParameterError
    from splatsoil.files import check_folder
    from splatsoil.measurement import Measurement
    from splatsoil.quiet import hush
    from splatsoil.reconstruction import reconstruct
    from splatsoil.reconstruction.progress import progress_bar

    if not 0 <= config.seed < 2**63:
        raise ParameterError(f"--seed: must be 0 or more and less than 2^63, not {config.seed}")
    hush()
    device = resolve_device(config.device)
    measurement = Measurement.load(config.set)
    say_remarks(measurement)
    out = config.out or Path("runs") / f"{measurement.name}-reconstruction"
    check_folder(out)
    with progress_bar(quiet=config.json) as report:
        result = reconstruct(
            measurement, seed=config.seed, device=device, preset=config.preset, holdout=config.holdout, progress=report
        )
    result.save(out)
    if config.json:
        print_json({"ok": True, "out": str(out), **result.summary()})
    else:
        _show(result, out)
    return 0


def interrupted(config: Config) -> str:
    """A reconstruction is written when it is complete."""
    again = command_line(
        "reconstruct",
        (config.set,),
        (
            ("--out", config.out, None),
            ("--preset", config.preset, "small"),
            ("--seed", config.seed, 0),
            ("--device", config.device, "auto"),
            ("--holdout", config.holdout, 8),
            ("--json", config.json, False),
        ),
    )
    return f"nothing was written; start again with: {again}"


def _show(result: Reconstruction, out: Path) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(f"reconstruction of {result.metadata['measurement']}"), title_justify="left")
    for column in ("photograph set aside", "PSNR in dB", "SSIM"):
        table.add_column(column, justify="left" if column.startswith("photo") else "right")
    for view in result.held_out:
        table.add_row(escape(view.name), f"{view.psnr:.2f}", f"{view.ssim:.3f}")
    if result.held_out:
        table.add_section()
        table.add_row("mean", f"{result.psnr:.2f}", f"{result.ssim:.3f}")
    console = Console(highlight=False)
    console.print(table)
    height = result.surface.height
    console.print(
        f"{len(result.gaussians)} Gaussians ({int(result.soil.sum())} soil, {int(result.tool.sum())} tool); "
        f"surface {height.min():.3f} to {height.max():.3f} m in cells of {1e3 * max(result.surface.cell):.1f} mm; "
        f"{result.seconds:.0f} s"
    )
    console.print(f"written to {escape(str(out))}")
