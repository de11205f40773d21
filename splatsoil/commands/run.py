"""``splatsoil run``: from a measurement set to the report, in one command."""

from __future__ import annotations

from dataclasses import dataclass

from splatsoil.commands._options import FitOptions
from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config(FitOptions):
    """All of it: check the set, reconstruct, fit, compare, write the report. Goes on where it was interrupted."""


def run(config: Config) -> int:
    """Each stage in turn; what the run folder has already isn't done again."""
    from splatsoil.commands import _stages as stage
    from splatsoil.commands import compare, fit
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.model import Model
    from splatsoil.report import write_report

    stage.hush()
    with stages(quiet=config.json) as begin:
        begin("check")("reading every image", 0.0)
        measurement, folder = stage.prepare(config)
        device = resolve_device(config.device)
        reconstruction = stage.reconstructed(measurement, folder, device, begin("reconstruct"))
        model = Model(measurement, reconstruction, effects=config.effects, preset=config.preset, device=device)
        result = stage.fitted(config, measurement, folder, model, begin("fit"))
        comparison = stage.compared(folder, model, begin("compare"))
        begin("report")("drawing figures", 0.0)
        page = write_report(folder.path)
    if config.json:
        losses = {key: comparison[key] for key in ("loss", "total", "noise")}
        print_json({"ok": True, "run": str(folder.path), "report": str(page), "comparison": losses, **result})
    else:
        fit.show(result, str(folder.path))
        compare.show(comparison, str(folder.comparison))
        print(f"report: {page}")
    return 0


def interrupted(config: Config) -> str:
    """What is kept, and the command that goes on."""
    from splatsoil.commands._stages import kept

    return f"{kept(config)}; go on with: {config.again('run')}"
