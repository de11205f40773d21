"""``splatsoil add``: put a missing effect into the model, fit again, and see the error fall."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil import report
from splatsoil.commands import _model, _stages
from splatsoil.commands._options import BUDGET, ComputingOptions, FitOptions, check_evaluations
from splatsoil.commands._output import Stage, print_result, print_table
from splatsoil.errors import ParameterError, RunError
from splatsoil.files import write_json
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import argument, option
from splatsoil.report.data import kept_of, load
from splatsoil.report.text import amount, model_name
from splatsoil.run_files import COMPARISON_FORMAT, HISTORY_FORMAT, read_kept

if TYPE_CHECKING:
    from splatsoil.model import Model

INTERRUPTED = "finished simulations are kept; go on with"


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Add effects to the model, and fit again.

    Reports the error on data set aside without and with the effect. Earlier fits stay.
    """

    effects: tuple[str, ...] = argument("Effects to add, by name, or files that define one each.")
    budget: int | None = option(None, BUDGET, expert=True)


def run(config: Config) -> int:
    """Fit with each effect, keep the history, draw the report."""
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    check_evaluations(config.budget)
    folder = _model.opened(config)
    fit = _model.latest_fit(folder)
    on = fit["setup"]["effects"]
    if not config.effects:
        raise ParameterError("name an effect to add, for example: splatsoil add RUN cohesion")
    for name in config.effects:
        if len(find_effects([name])) != 1:
            raise ParameterError(f"{name} defines several effects; put each that is to be added into a file of its own")
    load(folder.path)  # all that the report will show: what is damaged is better known now than after hours
    under_way = history(folder)["adding"]
    half_done = under_way.get("effects") == on
    # A command that was interrupted, and is given again, goes on: what it has put in is on already.
    mine = set(under_way["done"] if under_way.get("command") == list(config.effects) else ())
    mine |= {under_way["effect"]} if half_done else set()
    left = [name for name in config.effects if not (name in on and name in mine)]
    _model.off_effects(left, find_effects(on))
    Law(find_effects((*on, *left)))
    folder.check_writable()
    with _model.loaded(config, folder) as (model, begin):
        if half_done:
            finish(folder, model, fit, under_way, begin)
        for name in left:
            model = add_effect(folder, model, name, begin, budget=config.budget, command=config.effects)
        begin("report")("drawing figures", 0.0)
        page = report.write_report(folder.path)
    models = history(folder)["models"]
    write_history(folder, models)
    _model.require_answer(folder, folder.fit(), f"report: {page}")
    data = {"report": str(page), "models": models}
    return print_result(config, data, lambda: show(models), last=f"report: {page}", run=folder)


def history(folder: RunFolder) -> dict[str, Any]:
    """``models`` tried so far, the first one first, and the addition of an effect that is under way (``adding``), as
    `write_history` was given it; empty where none is."""
    path = folder.path / "history.json"
    return {"models": [], "adding": {}, **(read_kept(path, HISTORY_FORMAT) if path.is_file() else {})}


def write_history(
    folder: RunFolder, models: Sequence[Mapping[str, Any]], under_way: Mapping[str, Any] | None = None
) -> None:
    """Keep the models tried, and what is needed to go on with an addition that is under way."""
    more = {"adding": under_way} if under_way else {}
    write_json(folder.path / "history.json", {"format": HISTORY_FORMAT, "models": list(models), **more})


def _line(fit: Mapping[str, Any], held_out: Mapping[str, Any]) -> dict[str, Any]:
    """A model in the history: its fit, and its error on what was set aside."""
    kept = ("estimate", "std", "unit", "title")
    return {
        "model": fit["name"],
        "effects": list(fit["setup"]["effects"]),
        "parameters": {name: {key: p[key] for key in kept} for name, p in fit["parameters"].items()},
        "loss": fit["loss"],
        "held_out": held_out["error"],
        "noise_level": held_out["noise"],
    }


def _compared(folder: RunFolder) -> bool:
    """Whether there are pictures at the latest fit's estimate."""
    return kept_of(folder.comparison / "comparison.json", COMPARISON_FORMAT, folder.fit()) is not None


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
    known = _model.current_diagnosis(folder, folder.path / "diagnoses" / f"{before['name']}.json", (name,))
    if known is None or effect.name not in {h["model"] for h in known["held_out"]}:
        # A diagnosis gives the held-out error of the best effect only: alone, it is that.
        known = _stages.run_diagnosis(folder, model, begin, (name,))
    scores = {h["model"]: h for h in known["held_out"]}
    if effect.name not in scores:
        raise RunError(f"{effect.name} cannot be added: {'; '.join(known['notes']) or 'it could not be simulated'}")
    models = history(folder)["models"]
    if not models or models[-1]["model"] != before["name"]:
        models = [_line(before, scores[""])]
    models[-1] |= {"held_out": scores[""]["error"], "noise_level": scores[""]["noise"]}
    if not _compared(folder):
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
    write_history(folder, models, under_way)
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
    fit = _stages.run_fit(options, folder, larger, begin(f"fit with {effect.name}"))
    finish(folder, larger, fit, under_way, begin)
    return larger


def finish(folder: RunFolder, model: Model, fit: Mapping[str, Any], under_way: Mapping[str, Any], begin: Stage) -> None:
    """What is left to do once the fit with the new effect is the latest one."""
    if not _compared(folder):
        if (folder.comparison / "comparison.json").is_file():  # put aside, so that before and after can be shown
            with folder.lock():
                shutil.rmtree(folder.path / "before", ignore_errors=True)
                folder.comparison.rename(folder.path / "before")
        _stages.draw_comparison(folder, model, begin("compare"))
    line = {**_line(fit, under_way["held_out"]), **under_way["line"]}
    # Until all of the command is done, what it has put in is known to be its own.
    command, done = under_way["command"], [*under_way["done"], under_way["effect"]]
    write_history(folder, [*history(folder)["models"], line], {"command": command, "done": done} if command else None)


def show(models: Sequence[Mapping[str, Any]]) -> None:
    """The falling error, and how the parameters moved."""
    print_table(
        "error on data that were set aside",
        ("model", "error", "noise alone", "loss, all frames", "parameters"),
        (
            (
                model_name(entry["model"]),
                *(f"{entry[key]:.3g}" for key in ("held_out", "noise_level", "loss")),
                ", ".join(f"{n} {amount(p['estimate'], p['std'], p['unit'])}" for n, p in entry["parameters"].items()),
            )
            for entry in models
        ),
        left=("model", "parameters"),
    )
