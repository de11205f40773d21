"""``splatsoil report``: the page for reading."""

from __future__ import annotations

from dataclasses import dataclass

from splatsoil.commands._answer import need_answer
from splatsoil.commands._options import RunOptions
from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config(RunOptions):
    """Write the page report.html of a run."""

    json: bool = False
    """Print one JSON object instead of a sentence."""


def run(config: Config) -> int:
    """Write the page; RunError when the folder has no finished fit."""
    from splatsoil.commands import _stages as stage
    from splatsoil.report import write_report
    from splatsoil.run_files import read_fit

    folder = stage.opened(config)
    stage.note_other_sources(folder)
    path = write_report(folder.path)
    need_answer(read_fit(folder.path), f"report: {path}")
    if config.json:
        print_json({"ok": True, "report": str(path)})
    else:
        print(f"report: {path}")
    return 0


def interrupted(config: Config) -> str:
    """The page is written whole or not at all."""
    again = config.again("report", ("--json", config.json, False))
    return f"the page was not written; start again with: {again}"
