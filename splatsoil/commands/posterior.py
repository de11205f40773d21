"""``splatsoil posterior``: not only the best parameters, but all that the pictures leave possible."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatsoil.commands._answer import need_answer
from splatsoil.commands._options import RunOptions, command_line
from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config(RunOptions):
    """Sample the posterior: intervals, correlations, ArviZ file.

    It is the posterior that the estimate and ± of the latest fit are of.
    """

    checks: int = 3
    """Simulations at points drawn from the posterior, which test the emulator."""
    device: str = "auto"
    """Where to compute: auto (what the fit used), cpu, cuda:0, …"""
    seed: int = 0
    """Of chains and checks."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Compare as the fit did, sample, check; ``posterior.json`` and the folder ``posterior`` are kept."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _experiments as experiments
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.errors import ParameterError
    from splatsoil.inverse.posterior import Density, run_posterior
    from splatsoil.quiet import hush

    for name in ("checks", "seed"):
        value = getattr(config, name)
        if value < 0:
            raise ParameterError(f"--{name}: must be 0 or more, not {value}")
    hush()
    folder = stage.opened(config)
    fit = folder.fit()
    need_answer(fit, f"so there is nothing to sample; `{command_line('compare', (folder.path,))}` shows where")
    setup = fit["setup"]
    wanted = ("cuda:0" if setup["device"] == "cuda" else "cpu") if config.device == "auto" else config.device
    device = resolve_device(wanted)
    if device.split(":")[0] != setup["device"]:
        raise ParameterError(
            f"--device {config.device}: the fit in {folder.path} was made on {setup['device']}; give the same or fit "
            "again"
        )
    if (setup["version"], setup["code"]) != stage.sources(setup["effects"]):
        raise ParameterError(
            f"{folder.path}: the fit was made by other sources of splatsoil; fit again before the posterior"
        )
    folder.check_writable()
    chosen = experiments.Chosen.of(fit)
    with stages(quiet=config.json) as begin:
        model = experiments.model_of(folder, device, begin("reconstruct"))
        experiment, simulate = experiments.experiment_of(folder, model, chosen, ())
        with folder.lock(), Crew(folder, device, ()) as crew, crew.helping(chosen, experiment, simulate):
            seed = folder.description["seed"]
            found = criticism.judged(experiment, simulate, fit, begin("models"), seed, with_effects=False)
            result = run_posterior(
                folder,
                experiment,
                simulate,
                Density.of(found.evidence.noise, criticism.prior_of(experiment, fit), seed),
                checks=config.checks,
                seed=config.seed,
                progress=begin("posterior"),
            )
    if config.json:
        print_json({"ok": True, **result, "run": str(folder.path)})
    else:
        show(result, str(folder.path))
    return 0


def interrupted(config: Config) -> str:
    """What is kept, and the command that goes on."""
    again = config.again(
        "posterior",
        ("--checks", config.checks, 3),
        ("--device", config.device, "auto"),
        ("--seed", config.seed, 0),
        ("--json", config.json, False),
    )
    return f"what was simulated is kept; go on with: {again}"


def show(result: Mapping[str, Any], folder: str) -> None:
    """A table of the parameters, and what to know about them."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import duration, model_name, symbol, with_std

    table = Table(title=f"posterior, {escape(model_name(result['fit']))}", title_justify="left")
    for column in ("parameter", "mean", "5 to 95 %", "width / prior", ""):
        table.add_column(column, justify="left" if column in ("parameter", "") else "right")
    for name, entry in result["parameters"].items():
        value, std = with_std(entry["mean"], entry["std"])
        unit = symbol(entry["unit"])
        table.add_row(
            escape(name),
            f"{value} ± {std}{unit}",
            f"{entry['low']:.4g} to {entry['high']:.4g}{unit}",
            f"{entry['contraction']:.2f}",
            entry["verdict"],
        )
    console = Console(highlight=False)
    console.print(table)
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    chains = result["chains"]
    console.print(
        f"{result['simulations']} simulations; R-hat {chains['r_hat']:.3f}, acceptance {chains['acceptance']:.2f}, "
        f"{chains['effective']:.0f} independent samples; {duration(result['seconds'])}"
    )
    console.print(f"kept in {escape(folder)}: posterior.json, posterior/")
