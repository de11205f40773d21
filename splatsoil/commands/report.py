"""``splatsoil report``: the page for reading."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config:
    """Write the page report.html of a run."""

    run: Positional[Path]
    """The run folder."""
    json: bool = False
    """Print one JSON object instead of a sentence."""


def run(config: Config) -> int:
    """Write the page; RunError when the folder has no finished fit."""
    from splatsoil.commands import _stages as stage
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.report import write_report

    stage.note_other_sources(RunFolder.open(config.run))
    path = write_report(config.run)
    if config.json:
        print_json({"ok": True, "report": str(path)})
    else:
        print(f"report: {path}")
    return 0


def interrupted(config: Config) -> str:
    """The page is written whole or not at all."""
    again = command_line("report", (config.run,), (("--json", config.json, False),))
    return f"the page was not written; start again with: {again}"
