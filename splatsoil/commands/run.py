"""``splatsoil run``: from a measurement set to the report, in one command."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.commands._answer import need_answer
from splatsoil.commands._options import FitOptions, Option, command_line
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatsoil.commands._progress import Report
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model


@dataclass(frozen=True)
class Config(FitOptions):
    """From a set to the report: check, reconstruct, fit, compare, and name what the model lacks.

    A model that is not adequate is diagnosed; the missing effect is added and fitted, until the model is adequate, no
    effect is probable enough, or the limit is reached. A run that was interrupted goes on.
    """

    criticise: bool = False
    """Diagnose an adequate model, too."""
    stop_at_floor: bool = False
    """Only say whether the model is adequate; do not look for missing effects."""
    most_effects: int = 2
    """Largest number of effects that are added."""

    def again(self, command: str, *others: Option) -> str:
        """The command line that means this, and other options besides."""
        return super().again(
            command,
            ("--criticise", self.criticise, False),
            ("--stop-at-floor", self.stop_at_floor, False),
            ("--most-effects", self.most_effects, 2),
            *others,
        )


def run(config: Config) -> int:
    """Each stage in turn; what the run folder has already isn't done again."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _history as histories
    from splatsoil.commands import _stages as stage
    from splatsoil.commands import add, compare, fit
    from splatsoil.commands._diagnosis_table import show
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.errors import ParameterError, SplatsoilError
    from splatsoil.files import plain, read_json
    from splatsoil.quiet import hush
    from splatsoil.report import write_report
    from splatsoil.report.words import called_adequate

    hush()
    if config.most_effects < 0:
        raise ParameterError(f"--most-effects: must be 0 or more, not {config.most_effects}")
    if config.criticise and config.stop_at_floor:
        raise ParameterError("--criticise and --stop-at-floor: give one of them")
    stopped, diagnosis, misfit, unknown = "", None, None, ""
    with stages(quiet=config.json) as begin:
        begin("check")("reading every image", 0.0)
        measurement, folder = stage.prepare(config)
        device = resolve_device(config.device)
        reconstruction = stage.reconstructed(measurement, folder, device, begin("reconstruct"))
        model = stage.model_on(measurement, folder, reconstruction, config.effects, config.preset, device)
        result = stage.fitted(config, measurement, folder, model, begin("fit"))
        comparison = stage.compared(folder, model, begin("compare"))
        if not config.criticise:
            try:
                misfit = criticism.misfit(folder, model, begin("models"))
            except SplatsoilError as error:  # the fit stands all the same
                unknown = f"whether the model is adequate isn't known: {error}"
        if config.criticise or not (config.stop_at_floor or misfit is None or misfit["adequate"]):
            try:
                diagnosis, stopped = loop(folder, model, config.most_effects, begin)
            except SplatsoilError as error:
                if config.criticise:
                    raise
                unknown = f"what is missing isn't known: {error}"
            result, comparison = folder.fit(), read_json(folder.comparison / "comparison.json")
        begin("report")("drawing figures", 0.0)
        page = write_report(folder.path)
    if unknown:
        print(unknown, file=sys.stderr)
    need_answer(result, f"report: {page}")
    if config.json:
        losses = {key: comparison[key] for key in ("loss", "total", "noise")}
        extra: dict[str, Any] = {} if misfit is None else {"misfit": {key: misfit[key] for key in compare.TOLD}}
        if diagnosis is not None:
            kept = ("verdict", "class", "sentences", "models", "checks", "held_out", "estimates", "simulations")
            extra = {
                "diagnosis": plain({key: diagnosis[key] for key in kept}),
                "models": histories.history(folder),
                "stopped": stopped,
            }
        print_json({"ok": True, "report": str(page), "comparison": losses, **extra, **result, "run": str(folder.path)})
        return 0
    fit.show(result, str(folder.path))
    compare.show(comparison, str(folder.comparison), called_adequate(result, diagnosis or misfit))
    if diagnosis is None and misfit is not None:
        compare.show_misfit(misfit, str(folder.path))
    if diagnosis is not None:
        if entries := histories.history(folder):
            add.show(entries)
        show(diagnosis)
        print(f"Stopped because {stopped}.")
    print(f"report: {page}")
    return 0


def loop(folder: RunFolder, model: Model, most: int, begin: Callable[[str], Report]) -> tuple[dict[str, Any], str]:
    """Diagnose and add until there is nothing more to be told; the last diagnosis, and why it stopped."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import add

    count = 0
    while True:
        diagnosis = criticism.diagnosed(folder, model, begin)
        if diagnosis["verdict"] == "adequate":
            return diagnosis, "nothing more is needed to explain the data"
        if diagnosis["verdict"] != "missing":
            hint = ""
            if diagnosis["class"]:
                nearest = diagnosis["class"][0]
                tries = command_line("add", (folder.path, nearest))
                hint = f"; the most probable is {nearest.replace('_', ' ')}: {tries} tries it"
            return diagnosis, f"no single effect is probable enough to be added{hint}"
        if count == most:
            return diagnosis, f"{most} effects have been added, which is the limit (--most-effects)"
        add.added(folder, model, diagnosis["class"][0], begin)
        model = model.variant(effects=tuple(folder.fit()["setup"]["effects"]))
        count += 1


def interrupted(config: Config) -> str:
    """What is kept, and the command that goes on."""
    from splatsoil.commands._stages import kept

    return f"{kept(config)}; go on with: {config.again('run')}"
