"""``splatsoil diagnose``: is the model adequate, and if not, which effect is missing?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatsoil.commands import _laboratory, _model, _stages, _workers
from splatsoil.commands._options import ComputingOptions, command_line
from splatsoil.commands._output import print_result, print_table, print_text
from splatsoil.files import plain
from splatsoil.options import option
from splatsoil.report.text import LITTLE, averaged_sentence, estimate, model_label, no_answer, probability, verdict

INTERRUPTED = "finished simulations are kept; go on with"


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Name the effect that the model lacks, with its probability.

    Simulates the base model and the model with each effect that is off, at several sizes, and compares them with all
    data. An interrupted diagnosis continues.
    """

    effects: tuple[str, ...] = option(
        (), "Effects to consider, by name, or files that define some; all that such data can show if not given."
    )


def run(config: Config) -> int:
    """Diagnose; write the result into the run folder."""
    from splatsoil.soil.library import find_effects

    if _laboratory.is_run(config.run) or _laboratory.is_test(config.run):
        return _laboratory.diagnose(config)
    folder = _model.opened(config)
    fit = _model.latest_fit(folder)
    none = no_answer(fit)
    folder.check_writable()
    # Workers start first: they load libraries for seconds.
    with _workers.Workers(folder, config.device, config.effects) as workers:
        _model.off_effects(config.effects, find_effects(fit["setup"]["effects"]))
        with _model.loaded(config, folder) as (model, begin):
            result = _stages.run_diagnosis(folder, model, begin, config.effects, workers=workers)
    result = {key: value for key, value in result.items() if not (none and key == "estimates")}
    last = f"kept in {folder.path / 'diagnosis.json'}\n{_next(result, str(folder.path))}"
    return print_result(config, plain(result), lambda: show(result), last=last, run=folder, none=none)


def _next(result: Mapping[str, Any], run: str) -> str:
    """The command that goes on from a verdict."""
    if result["verdict"] == "adequate":
        return f"The page: {command_line('report', run)}"
    if result["verdict"] in ("missing", "one of"):
        return f"Does it explain the data? {command_line('add', run, result['class'][0])}"
    return f"Which stroke would tell? {command_line('design', run)}"


def show(result: Mapping[str, Any]) -> None:
    """Print models, verdict, parameters and sentences."""
    print_table(
        f"models compared with {result['fit']}",
        ("model", "probability", "size", "smallest detectable"),
        (
            (
                model_label(model["name"]),
                probability(model["probability"]),
                estimate(model["estimate"], model["std"], model["unit"]),
                estimate(model["detectable"], None, model["unit"]),
            )
            for model in result["models"]
        ),
        faint=[number for number, model in enumerate(result["models"]) if model["probability"] < LITTLE],
    )
    print_text(verdict(result), style="bold")
    averaged = [averaged_sentence(result["estimates"])] if "estimates" in result else []
    print_text(*averaged, *result["sentences"], notes=result["notes"])
    print(f"{result['simulations']} simulations, {result['simulated_now']} of them new, {result['seconds']:.0f} s")
