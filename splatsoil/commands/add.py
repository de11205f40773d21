"""``splatsoil add``: add a missing effect to the model, and fit again."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil import report
from splatsoil.commands import _model, _stages
from splatsoil.commands._options import BUDGET, ComputingOptions, FitOptions, check_evaluations, command_line
from splatsoil.commands._output import Stage, print_result, print_table
from splatsoil.errors import ParameterError, RunError
from splatsoil.files import write_json
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import argument, option
from splatsoil.report.data import kept_of, load
from splatsoil.report.text import amount, model_name
from splatsoil.run_files import COMPARISON_FORMAT, HISTORY_FORMAT, read_format

if TYPE_CHECKING:
    from splatsoil.model import Model

INTERRUPTED = "finished simulations are kept; go on with"


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Add effects to the model, and fit again.

    Reports the error on held-out data without and with the effect. Earlier fits stay.
    """

    effects: tuple[str, ...] = argument("Effects to add, by name, or files that define one each.")
    budget: int | None = option(None, BUDGET, expert=True)


def run(config: Config) -> int:
    """Fit with each effect, and write history and report."""
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
            raise ParameterError(f"{name} defines several effects; give each one a file of its own")
    load(folder.path)  # damaged files are reported before the work
    under_way = history(folder)["adding"]
    half_done = under_way.get("effects") == on
    # A repeated command continues an interrupted one, whose effects are on already.
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
    last = f"report: {page}\nIs anything else missing? {command_line('diagnose', folder.path)}"
    return print_result(config, data, lambda: show(models), last=last, run=folder)


def history(folder: RunFolder) -> dict[str, Any]:
    """``models`` so far, the first one first, and the unfinished addition of an effect (``adding``)."""
    path = folder.path / "history.json"
    return {"models": [], "adding": {}, **(read_format(path, HISTORY_FORMAT) if path.is_file() else {})}


def write_history(
    folder: RunFolder, models: Sequence[Mapping[str, Any]], under_way: Mapping[str, Any] | None = None
) -> None:
    """Write the models so far, and the state of an unfinished addition."""
    more = {"adding": under_way} if under_way else {}
    write_json(folder.path / "history.json", {"format": HISTORY_FORMAT, "models": list(models), **more})


def _line(fit: Mapping[str, Any], held_out: Mapping[str, Any]) -> dict[str, Any]:
    """A model in the history: its fit, and its error on held-out data."""
    keys = ("estimate", "std", "unit", "title")
    return {
        "model": fit["name"],
        "effects": list(fit["setup"]["effects"]),
        "parameters": {name: {key: p[key] for key in keys} for name, p in fit["parameters"].items()},
        "loss": fit["loss"],
        "held_out": held_out["error"],
        "noise_level": held_out["noise"],
    }


def _compared(folder: RunFolder) -> bool:
    """Whether the latest fit has a comparison."""
    return kept_of(folder.comparison / "comparison.json", COMPARISON_FORMAT, folder.fit()) is not None


def add_effect(
    folder: RunFolder, model: Model, name: str, begin: Stage, *, budget: int | None = None, command: Sequence[str] = ()
) -> Model:
    """Add one effect: diagnosis with it, fit, comparison; returns the model with it.

    ``command`` are all effects that the command adds.
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
        # A diagnosis has the held-out error of the best effect only.
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
    # Before the new fit becomes the latest one.
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
    """Finish an addition whose fit is the latest one."""
    if not _compared(folder):
        if (folder.comparison / "comparison.json").is_file():  # the report shows before and after
            with folder.lock():
                shutil.rmtree(folder.path / "before", ignore_errors=True)
                folder.comparison.rename(folder.path / "before")
        _stages.draw_comparison(folder, model, begin("compare"))
    line = {**_line(fit, under_way["held_out"]), **under_way["line"]}
    command, done = under_way["command"], [*under_way["done"], under_way["effect"]]
    write_history(folder, [*history(folder)["models"], line], {"command": command, "done": done} if command else None)


def show(models: Sequence[Mapping[str, Any]]) -> None:
    """Print error and parameters of each model."""
    print_table(
        "error on held-out data",
        ("model", "error", "noise level", "loss, all frames", "parameters"),
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
