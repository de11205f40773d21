"""``splatsoil run``: from a measurement set to the report, in one command."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil import report
from splatsoil.commands import _model, _stages, add, compare
from splatsoil.commands._options import FitOptions, command_line
from splatsoil.commands._output import Stage, print_result, print_rows, print_text, stages
from splatsoil.errors import ParameterError, SplatsoilError
from splatsoil.files import plain, read_json
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import option
from splatsoil.report.data import load
from splatsoil.report.summary import headline, rows

if TYPE_CHECKING:
    from splatsoil.model import Model

INTERRUPTED = _stages.interrupted
#: Keys of a diagnosis in the JSON output.
DIAGNOSIS = ("verdict", "class", "sentences", "models", "checks", "held_out", "estimates", "simulations")


@dataclass(frozen=True)
class Config(FitOptions):
    """From a set to the report: check, reconstruct, fit, compare, and name missing effects.

    The model is compared with all effects that are off. A missing one is added and fitted, until the model is
    adequate, no effect is probable enough, or the limit is reached. An interrupted run continues.
    """

    no_effects: bool = option(False, "Only test whether the model is adequate; do not add effects.")
    most_effects: int = option(2, "Largest number of effects that are added.", expert=True)


def run(config: Config) -> int:
    """Run each stage; existing results are not computed again."""
    if config.most_effects < 0:
        raise ParameterError(f"--most-effects: must be 0 or more, not {config.most_effects}")
    stopped, diagnosis, misfit = "", None, None
    with stages(quiet=config.json) as begin:
        folder, model, result = _stages.fitted(config, begin)
        comparison = _stages.draw_comparison(folder, model, begin("compare"))
        unknown = ""
        try:
            if config.no_effects:
                misfit = _stages.check_adequacy(folder, model, begin("models"))
            else:
                diagnosis, stopped = add_missing(folder, model, config.most_effects, begin)
                result, comparison = folder.fit(), read_json(folder.comparison / "comparison.json")
        except SplatsoilError as error:  # the fit is valid all the same
            unknown = f"whether the model is adequate isn't known: {error}"
        begin("report")("drawing figures", 0.0)
        page = report.write_report(folder.path)
    if unknown:
        print(unknown, file=sys.stderr)
    _model.require_answer(folder, result, f"report: {page}")
    data: dict[str, Any] = {
        "report": str(page),
        "comparison": {key: comparison[key] for key in ("loss", "total", "noise")},
    }
    models = [] if diagnosis is None else add.history(folder)["models"]
    if misfit is not None:
        data["misfit"] = {key: misfit[key] for key in compare.MISFIT}
    if diagnosis is not None:
        data |= {"diagnosis": plain({key: diagnosis[key] for key in DIAGNOSIS}), "models": models, "stopped": stopped}

    def show() -> None:
        told = load(folder.path)
        print_text(headline(told), style="bold")
        print()
        print_rows(rows(told))
        print()
        if len(models) > 1:
            add.show(models)
        # Not wrapped, so that they can be pasted.
        print("  page   ", page)
        print("  numbers", folder.path / "fit.json")
        print("  look   ", command_line("view", folder.path))
        print("  details", command_line("compare", folder.path))
        if diagnosis is not None:
            print_text(f"Stopped because {stopped}.")
        elif misfit is not None:
            print("  effects", command_line("diagnose", folder.path))

    return print_result(config, {**data, **result}, show, run=folder)


def add_missing(folder: RunFolder, model: Model, most: int, begin: Stage) -> tuple[dict[str, Any], str]:
    """Diagnose and add up to ``most`` effects; returns the last diagnosis and the reason of the end."""
    count = 0
    while True:
        diagnosis = _stages.run_diagnosis(folder, model, begin)
        if diagnosis["verdict"] == "adequate":
            return diagnosis, "nothing more is needed to explain the data"
        if diagnosis["verdict"] != "missing":
            hint = ""
            if diagnosis["class"]:
                nearest = diagnosis["class"][0]
                tries = command_line("add", folder.path, nearest)
                hint = f"; the most probable is {nearest.replace('_', ' ')}: {tries} tries it"
            return diagnosis, f"no single effect is probable enough to be added{hint}"
        if count == most:
            return diagnosis, f"{most} effects have been added, which is the limit (--most-effects)"
        model = add.add_effect(folder, model, diagnosis["class"][0], begin)
        count += 1
