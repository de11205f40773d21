"""``splatsoil add``: put a missing effect into the model, fit again, and see the error fall."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from splatsoil.commands._answer import need_answer
from splatsoil.commands._options import FitOptions, RunOptions, check_evaluations
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.commands._progress import Report
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model


@dataclass(frozen=True)
class Config(RunOptions):
    """Add effects to the model, and fit again.

    Reports the error on data set aside without and with the effect. Earlier fits stay.
    """

    effects: Positional[tuple[str, ...]]
    """Effects to add, by name, or files that define one each."""
    budget: int | None = None
    """Evaluations of each fit; 10 for each free parameter if not given."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Fit with each effect, keep the history, draw the report."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _experiments as experiments
    from splatsoil.commands import _history as histories
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.errors import ParameterError
    from splatsoil.quiet import hush
    from splatsoil.report import write_report
    from splatsoil.report.data import load
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    hush()
    check_evaluations(config.budget)
    folder = stage.opened(config)
    fit = criticism.need_fit(folder)
    on = fit["setup"]["effects"]
    if not config.effects:
        raise ParameterError("name an effect to add, for example: splatsoil add RUN cohesion")
    for name in config.effects:
        if len(find_effects([name])) != 1:
            raise ParameterError(f"{name} defines several effects; put each that is to be added into a file of its own")
    # All that the report will show: what is damaged is better known now than after hours.
    load(folder.path)
    before = histories.adding(folder)
    half_done = before.get("effects") == on
    left = remaining(config.effects, on, before, half_done=half_done)
    Law(find_effects((*on, *left)))
    folder.check_writable()
    device = resolve_device(config.device)
    stage.note_other_sources(folder)
    with stages(quiet=config.json) as begin:
        if half_done:
            finished(folder, experiments.model_of(folder, device, begin("reconstruct")), fit, before, begin)
        for name in left:
            model = experiments.model_of(folder, device, begin("reconstruct"))
            added(folder, model, name, begin, budget=config.budget, command=config.effects)
        begin("report")("drawing figures", 0.0)
        page = write_report(folder.path)
    entries = histories.history(folder)
    histories.remember(folder, entries)
    need_answer(folder.fit(), f"report: {page}")
    if config.json:
        print_json({"ok": True, "run": str(folder.path), "report": str(page), "models": entries})
    else:
        show(entries)
        print(f"report: {page}")
    return 0


def interrupted(config: Config) -> str:
    """Simulations and evaluations are kept one by one."""
    again = config.again(
        "add",
        ("--budget", config.budget, None),
        ("--device", config.device, "auto"),
        ("--json", config.json, False),
        positional=config.effects,
    )
    return f"finished simulations are kept; go on with: {again}"


def remaining(effects: Sequence[str], on: Sequence[str], before: Mapping[str, Any], *, half_done: bool) -> list[str]:
    """Effects that are still to be added: a command that was interrupted, and is given again, goes on.

    Args:
        effects: of the command.
        on: of the latest fit.
        before: the addition that was under way, see `splatsoil.commands._history.adding`.
        half_done: whether its fit is the latest.

    Raises:
        ParameterError: one is on that this command didn't put in.
    """
    from splatsoil.commands._experiments import off_effects
    from splatsoil.soil.library import find_effects

    mine = set(before["done"] if before.get("command") == list(effects) else ())
    mine |= {before["effect"]} if half_done else set()
    left = [name for name in effects if not (name in on and name in mine)]
    off_effects(left, find_effects(on))
    return left


def added(
    folder: RunFolder,
    model: Model,
    name: str,
    begin: Callable[[str], Report],
    *,
    budget: int | None = None,
    command: Sequence[str] = (),
) -> dict[str, Any]:
    """One effect more: a diagnosis that knows it, full fit, comparison; returns the new entry of the history.

    ``command`` is all the effects that are being added, where one command adds several.
    """
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _history as histories
    from splatsoil.commands import _stages as stage
    from splatsoil.errors import RunError
    from splatsoil.soil.library import find_effects

    before, (effect,) = folder.fit(), find_effects([name])
    setup = before["setup"]
    effects = (*setup["effects"], name)
    larger = model.variant(effects=effects)
    own = next(e for e in larger.law.effects if e.name == effect.name)
    mine = [p.name for p in own.parameters if p.off is not None or p.name in own.shapes]
    free = (*before["parameters"], *mine)
    known = criticism.latest_diagnosis(folder, name)
    if known is None or effect.name not in {h["model"] for h in known["held_out"]}:
        # Only the best effect's error is told: alone, it is that.
        known = criticism.diagnosed(folder, model, begin, (name,))
    scores = {h["model"]: h for h in known["held_out"]}
    if effect.name not in scores:
        raise RunError(f"{effect.name} cannot be added: {'; '.join(known['notes']) or 'it could not be simulated'}")
    entries = histories.history(folder)
    base, with_it = scores[""], scores[effect.name]
    if not entries or entries[-1]["model"] != before["name"]:
        entries = [criticism.entry(before, base)]
    entries[-1]["held_out"], entries[-1]["floor"] = base["error"], base["noise"]
    fitting = FitOptions(
        set=model.measurement.folder,
        parameters=free,
        effects=effects,
        budget=budget,
        preset=setup["preset"],
        device=model.device,
        seed=folder.description["seed"],
        run=folder.path,
    )
    if not criticism.pictured(folder):
        stage.compared(folder, model, begin("compare"))
    under_way = {
        "command": list(command),
        "done": list(command[: command.index(name)]) if command else [],
        "effect": name,
        "effects": sorted(effects),
        "held_out": with_it,
        "line": {"added": effect.name},
    }
    # Before the fit is the latest one: from then on nothing else knows what it was made from.
    histories.remember(folder, entries, under_way)
    result = stage.fitted(fitting, model.measurement, folder, larger, begin(f"fit with {effect.name}"))
    return finished(folder, larger, result, under_way, begin)


def finished(
    folder: RunFolder,
    model: Model,
    fit: dict[str, Any],
    under_way: Mapping[str, Any],
    begin: Callable[[str], Report],
) -> dict[str, Any]:
    """What is left to do once the fit with the new effect is the latest one; returns the new entry of the history."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _history as histories
    from splatsoil.commands import _stages as stage

    if not criticism.pictured(folder):
        criticism.keep_pictures(folder)
        stage.compared(folder, model, begin("compare"))
    fresh = {**criticism.entry(fit, under_way["held_out"]), **under_way["line"]}
    # Until all of the command is done, what it has put in is known to be its own.
    command, done = under_way["command"], [*under_way["done"], under_way["effect"]]
    rest = {"command": command, "done": done} if command else None
    histories.remember(folder, [*histories.history(folder), fresh], rest)
    return fresh


def show(entries: list[dict[str, Any]]) -> None:
    """The falling error, and how the parameters moved."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import model_name, symbol, with_std

    table = Table(title="error on data that were set aside", title_justify="left")
    for column in ("model", "error", "noise alone", "loss, all frames", "parameters"):
        table.add_column(column, justify="right" if column in ("error", "noise alone", "loss, all frames") else "left")
    for entry in entries:
        values = []
        for name, p in entry["parameters"].items():
            value, std = with_std(p["estimate"], p["std"])
            values.append(f"{name} {value} ± {std}{symbol(p['unit'])}")
        table.add_row(
            escape(model_name(entry["model"])),
            f"{entry['held_out']:.3g}",
            f"{entry['floor']:.3g}",
            f"{entry['loss']:.3g}",
            escape(", ".join(values)),
        )
    Console(highlight=False).print(table)
