"""``splatsoil report``: the page for reading."""

from __future__ import annotations

from dataclasses import dataclass

from splatsoil.commands import _folder
from splatsoil.commands._options import RunOptions
from splatsoil.commands._output import print_json
from splatsoil.options import JSON, option

INTERRUPTED = "the page was not written; start again with"


@dataclass(frozen=True)
class Config(RunOptions):
    """Write the page report.html of a run."""

    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Write the page; RunError when the folder has no finished fit."""
    from splatsoil.report import write_report
    from splatsoil.run_files import read_fit

    folder = _folder.opened(config)
    _folder.note_other_sources(folder)
    path = write_report(folder.path)
    _folder.require_answer(read_fit(folder.path), f"report: {path}")
    if config.json:
        print_json({"ok": True, "report": str(path)})
    else:
        print(f"report: {path}")
    return 0
