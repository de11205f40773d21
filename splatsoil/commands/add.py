"""``splatsoil add``: put a missing effect into the model, fit again, and see the error fall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.commands import _folder, _model, _stages
from splatsoil.commands._options import BUDGET, DEVICE, FitOptions, RunOptions, check_evaluations
from splatsoil.commands._output import print_table, tell
from splatsoil.errors import ParameterError, RunError
from splatsoil.options import JSON, argument, option

if TYPE_CHECKING:
    from splatsoil.commands._output import Stage
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model

INTERRUPTED = "finished simulations are kept; go on with"


@dataclass(frozen=True)
class Config(RunOptions):
    """Add effects to the model, and fit again.

    Reports the error on data set aside without and with the effect. Earlier fits stay.
    """

    effects: tuple[str, ...] = argument("Effects to add, by name, or files that define one each.")
    budget: int | None = option(None, BUDGET, expert=True)
    device: str = option("auto", DEVICE)
    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Fit with each effect, keep the history, draw the report."""
    from splatsoil.report import write_report
    from splatsoil.report.data import load
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    check_evaluations(config.budget)
    folder = _folder.opened(config)
    fit = _folder.latest_fit(folder)
    on = fit["setup"]["effects"]
    if not config.effects:
        raise ParameterError("name an effect to add, for example: splatsoil add RUN cohesion")
    for name in config.effects:
        if len(find_effects([name])) != 1:
            raise ParameterError(f"{name} defines several effects; put each that is to be added into a file of its own")
    # All that the report will show: what is damaged is better known now than after hours.
    load(folder.path)
    before = _folder.adding(folder)
    half_done = before.get("effects") == on
    left = remaining(config.effects, on, before, half_done=half_done)
    Law(find_effects((*on, *left)))
    folder.check_writable()
    with _model.loaded(config, folder) as (model, begin):
        if half_done:
            finish(folder, model, fit, before, begin)
        for name in left:
            model = add_effect(folder, model, name, begin, budget=config.budget, command=config.effects)
        begin("report")("drawing figures", 0.0)
        page = write_report(folder.path)
    entries = _folder.history(folder)
    _folder.write_history(folder, entries)
    _folder.require_answer(folder, folder.fit(), f"report: {page}")

    def show_all() -> None:
        show(entries)
        print(f"report: {page}")

    return tell(config, {**_folder.places(folder), "report": str(page), "models": entries}, show_all)


def remaining(effects: Sequence[str], on: Sequence[str], before: Mapping[str, Any], *, half_done: bool) -> list[str]:
    """Effects that are still to be added: a command that was interrupted, and is given again, goes on.

    Args:
        effects: of the command.
        on: of the latest fit.
        before: the addition that was under way, see `splatsoil.commands._folder.adding`.
        half_done: whether its fit is the latest.

    Raises:
        ParameterError: one is on that this command didn't put in.
    """
    from splatsoil.soil.library import find_effects

    mine = set(before["done"] if before.get("command") == list(effects) else ())
    mine |= {before["effect"]} if half_done else set()
    left = [name for name in effects if not (name in on and name in mine)]
    _model.off_effects(left, find_effects(on))
    return left


def add_effect(
    folder: RunFolder, model: Model, name: str, begin: Stage, *, budget: int | None = None, command: Sequence[str] = ()
) -> Model:
    """One effect more: a diagnosis that knows it, full fit, comparison; returns the model with it.

    ``command`` is all the effects that are being added, where one command adds several.
    """
    from splatsoil.soil.library import find_effects

    before, (effect,) = folder.fit(), find_effects([name])
    setup = before["setup"]
    effects = (*setup["effects"], name)
    larger = model.variant(effects=effects)
    own = next(e for e in larger.law.effects if e.name == effect.name)
    free = [p.name for p in own.parameters if p.off is not None or p.name in own.shapes]
    known = _folder.current_diagnosis(folder, folder.path / "diagnoses" / f"{before['name']}.json", (name,))
    if known is None or effect.name not in {h["model"] for h in known["held_out"]}:
        # A diagnosis gives the held-out error of the best effect only: alone, it is that.
        known = _stages.run_diagnosis(folder, model, begin, (name,))
    scores = {h["model"]: h for h in known["held_out"]}
    if effect.name not in scores:
        raise RunError(f"{effect.name} cannot be added: {'; '.join(known['notes']) or 'it could not be simulated'}")
    entries = _folder.history(folder)
    if not entries or entries[-1]["model"] != before["name"]:
        entries = [_folder.history_entry(before, scores[""])]
    entries[-1]["held_out"], entries[-1]["floor"] = scores[""]["error"], scores[""]["noise"]
    if not _folder.compared_already(folder):
        _stages.draw_comparison(folder, model, begin("compare"))
    under_way = {
        "command": list(command),
        "done": list(command[: command.index(name)]) if command else [],
        "effect": name,
        "effects": sorted(effects),
        "held_out": scores[effect.name],
        "line": {"added": effect.name},
    }
    # Before the fit is the latest one: from then on nothing else knows what it was made from.
    _folder.write_history(folder, entries, under_way)
    options = FitOptions(
        set=model.measurement.folder,
        parameters=(*before["parameters"], *free),
        effects=effects,
        budget=budget,
        preset=setup["preset"],
        device=model.device,
        seed=folder.description["seed"],
        run=folder.path,
    )
    fit = _stages.run_fit(options, model.measurement, folder, larger, begin(f"fit with {effect.name}"))
    finish(folder, larger, fit, under_way, begin)
    return larger


def finish(folder: RunFolder, model: Model, fit: Mapping[str, Any], under_way: Mapping[str, Any], begin: Stage) -> None:
    """What is left to do once the fit with the new effect is the latest one."""
    if not _folder.compared_already(folder):
        _folder.keep_earlier_comparison(folder)
        _stages.draw_comparison(folder, model, begin("compare"))
    entry = {**_folder.history_entry(fit, under_way["held_out"]), **under_way["line"]}
    # Until all of the command is done, what it has put in is known to be its own.
    command, done = under_way["command"], [*under_way["done"], under_way["effect"]]
    rest = {"command": command, "done": done} if command else None
    _folder.write_history(folder, [*_folder.history(folder), entry], rest)


def show(entries: Sequence[Mapping[str, Any]]) -> None:
    """The falling error, and how the parameters moved."""
    from splatsoil.report.text import amount, model_name

    print_table(
        "error on data that were set aside",
        ("model", "error", "noise alone", "loss, all frames", "parameters"),
        (
            (
                model_name(entry["model"]),
                *(f"{entry[key]:.3g}" for key in ("held_out", "floor", "loss")),
                ", ".join(f"{n} {amount(p['estimate'], p['std'], p['unit'])}" for n, p in entry["parameters"].items()),
            )
            for entry in entries
        ),
        left=("model", "parameters"),
    )
