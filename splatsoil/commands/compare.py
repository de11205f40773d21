"""``splatsoil compare``: predicted against measured pictures, at the estimate of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.commands._answer import why_none
from splatsoil.commands._options import RunOptions, command_line
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.commands._crew import Crew
    from splatsoil.inverse.run_folder import RunFolder

#: A check fails below this p.
SURE = 0.05
#: Checks shown on the screen.
SHOWN = 12
#: What --json prints of the misfit.
TOLD = ("adequate", "probability", "estimates", "checks", "passes")


@dataclass(frozen=True)
class Config(RunOptions):
    """Test whether the fitted model is adequate, and where and when it fails.

    Pictures, losses and forces at the latest estimate; residuals over their expected standard deviation, which
    simulations with other seeds and finer cells give.
    """

    quick: bool = False
    """Only pictures, losses and forces, from one simulation; no test."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Simulate, draw, compare; pictures, losses and the misfit by block go into the run folder."""
    from contextlib import nullcontext

    from splatsoil.commands import _stages as stage
    from splatsoil.commands._crew import Crew
    from splatsoil.errors import NoAnswer

    folder = stage.opened(config)
    none = why_none(folder.fit())
    folder.check_writable()
    with nullcontext() if config.quick else Crew(folder, config.device, ()) as crew:
        result, misfit = _compared(config, folder, crew)
    told = tuple(key for key in TOLD if not (none and key == "estimates"))
    if config.json:
        extra = {} if misfit is None else {"misfit": {k: misfit[k] for k in told}}
        said = {"ok": False, "error": none} if none else {"ok": True}
        print_json({**said, "run": str(folder.path), **result, **extra})
    else:
        if none:
            print(none)
        show(result, str(folder.comparison), None if misfit is None else bool(misfit["adequate"]))
        if misfit is not None:
            show_misfit(
                {key: value for key, value in misfit.items() if key != "estimates" or not none}, str(folder.path)
            )
    return NoAnswer.code if none else 0


def _compared(config: Config, folder: RunFolder, crew: Crew | None) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Pictures and losses, and the misfit where helpers for it have begun; what takes seconds to load is loaded
    here."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _experiments as experiments
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.quiet import hush

    hush()
    device = resolve_device(config.device)
    stage.note_other_sources(folder)
    with stages(quiet=config.json) as begin:
        model = experiments.model_of(folder, device, begin("reconstruct"))
        result = stage.compared(folder, model, begin("compare"))
        if crew is None:
            return result, None
        return result, criticism.misfit(folder, model, begin("models"), crew=crew)


def interrupted(config: Config) -> str:
    """Simulations are kept one by one."""
    again = config.again(
        "compare", ("--quick", config.quick, False), ("--device", config.device, "auto"), ("--json", config.json, False)
    )
    return f"the comparison was not finished; start again with: {again}"


def show(result: Mapping[str, Any], folder: str, adequate: bool | None = None) -> None:
    """Losses of each camera, and what the whole comes to; ``adequate`` is what a comparison with something else
    says of it."""
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import residual_sentence

    name = result["loss"]
    table = Table(title="loss at the estimate", title_justify="left")
    for column in ("camera", "mean", "worst", "at frame", "rgb mean square"):
        table.add_column(column, justify="left" if column == "camera" else "right")
    for camera in result["cameras"]:
        frames = [entry for entry in result["frames"] if entry["camera"] == camera]
        worst = max(frames, key=lambda entry: entry["losses"][name])
        mean, rgb = (float(np.mean([entry["losses"][key] for entry in frames])) for key in (name, "rgb"))
        table.add_row(escape(camera), f"{mean:.4g}", f"{worst['losses'][name]:.4g}", str(worst["frame"]), f"{rgb:.3g}")
    console = Console(highlight=False)
    console.print(table)
    console.print(residual_sentence(result, adequate))
    console.print(f"pictures in {escape(folder)}")


def show_misfit(misfit: Mapping[str, Any], run: str) -> None:
    """The worst checks, and whether the model is adequate; the parameters where ``misfit`` has them."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import averaged_sentence, probability

    table = Table(title="residual over what is expected, the worst first", title_justify="left")
    for column in ("stage", "region", "instrument", "× expected", "p"):
        table.add_column(column, justify="right" if column in ("× expected", "p") else "left")
    for check in misfit["checks"][:SHOWN]:
        where = (escape(check[key]) for key in ("stage", "region", "channel"))
        style = None if check["p"] < SURE else "dim"
        table.add_row(*where, f"{check['ratio']:.2f}", f"{check['p']:.2g}", style=style)
    console = Console(highlight=False)
    console.print(table)
    word = "adequate" if misfit["adequate"] else "not adequate"
    failed = sum(check["p"] < SURE for check in misfit["checks"])
    console.print(
        f"[bold]{word}[/bold]: the model as it is has a probability of {probability(misfit['probability'])} against "
        f"something else; {failed} of {len(misfit['checks'])} checks fail"
    )
    if "estimates" in misfit:
        console.print(escape(averaged_sentence(misfit["estimates"])))
    for sentence in misfit["sentences"]:
        console.print(escape(sentence))
    ask = "Could these data show a missing effect?" if misfit["adequate"] else "Which effect is missing?"
    # Wrapped, it couldn't be pasted.
    console.print(f"{ask} {escape(command_line('diagnose', (run,)))}", soft_wrap=True)
