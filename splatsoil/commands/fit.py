"""``splatsoil fit``: from a measurement set to its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatsoil.commands._answer import need_answer
from splatsoil.commands._options import FitOptions, command_line
from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config(FitOptions):
    """Estimate the parameters, with their uncertainty.

    A search over simulations, then the posterior, which contains discretisation error and model discrepancy. A fit that
    was interrupted goes on.
    """


def run(config: Config) -> int:
    """Reconstruct (unless the run folder has it), fit, print; everything is kept in the run folder."""
    from splatsoil.commands import _laboratory as laboratory
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.quiet import hush

    if laboratory.is_test(config.set):
        return laboratory.fit(config)
    hush()
    measurement, folder = stage.prepare(config)
    device = resolve_device(config.device)
    with stages(quiet=config.json) as begin:
        reconstruction = stage.reconstructed(measurement, folder, device, begin("reconstruct"))
        model = stage.model_on(measurement, folder, reconstruction, config.effects, config.preset, device)
        result = stage.fitted(config, measurement, folder, model, begin("fit"))
    need_answer(result, f"`{command_line('compare', (folder.path,))}` shows where")
    if config.json:
        print_json({"ok": True, **result, "run": str(folder.path)})
    else:
        show(result, str(folder.path))
        print("Does the model leave more than noise, and where?", command_line("compare", (folder.path,)))
    return 0


def interrupted(config: Config) -> str:
    """What is kept, and the command that goes on."""
    from splatsoil.commands._stages import kept

    return f"{kept(config)}; go on with: {config.again('fit')}"


def show(result: Mapping[str, Any], folder: str) -> None:
    """A table of the parameters, and what to know about them."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import duration, model_name, symbol, with_std

    table = Table(title=escape(f"{model_name(result['name'])}"), title_justify="left")
    for column in ("parameter", "estimate", "5 to 95 %"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for name, entry in result["parameters"].items():
        value, std = with_std(entry["estimate"], entry["std"])
        unit = symbol(entry["unit"])
        table.add_row(escape(name), f"{value} ± {std}{unit}", f"{entry['low']:.4g} to {entry['high']:.4g}{unit}")
    console = Console(highlight=False)
    console.print(table)
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    console.print(
        f"loss {result['loss']:.4g} ± {result['loss_std']:.2g} at the estimate; {result['evaluations']} evaluations "
        f"in {duration(result['seconds'])}"
    )
    console.print(f"kept in {escape(folder)}")
