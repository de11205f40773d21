"""``splatsoil report``: the report as a page."""

from __future__ import annotations

from dataclasses import dataclass

from splatsoil import report
from splatsoil.commands import _model
from splatsoil.commands._options import RunOptions
from splatsoil.commands._output import print_result
from splatsoil.run_files import read_fit

INTERRUPTED = "the page was not written; start again with"


@dataclass(frozen=True)
class Config(RunOptions):
    """Write the page report.html of a run."""


def run(config: Config) -> int:
    """Write the page; RunError without a finished fit."""
    folder = _model.opened(config)
    _model.note_other_sources(folder)
    path = report.write_report(folder.path)
    _model.require_answer(folder, read_fit(folder.path), f"report: {path}")
    return print_result(config, {"report": str(path)}, last=f"report: {path}", run=folder)
