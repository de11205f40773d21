"""The commands that make a run's latest model anew."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil.commands._options import EVALUATIONS, FitOptions, command_line

if TYPE_CHECKING:
    from splatsoil.inverse.run_folder import RunFolder


def anew(run: RunFolder, fit: Mapping[str, Any]) -> str:
    """A command line: the fit, and the effects that were added to it."""
    from splatsoil.commands._history import history

    setup, entries = fit["setup"], history(run)
    parameters, effects, budget = tuple(fit["parameters"]), tuple(setup["effects"]), fit.get("evaluations")
    if budget == EVALUATIONS * len(parameters):
        budget = None
    added: list[str] = []
    if len(entries) > 1 and entries[-1]["model"] == fit["name"]:
        parameters, effects, budget = tuple(entries[0]["parameters"]), tuple(entries[0]["effects"]), None
        added = [name for one, other in pairwise(entries) for name in other["effects"] if name not in one["effects"]]
    options = FitOptions(
        set=Path(run.description["measurement"]["folder"]),
        parameters=parameters,
        effects=effects,
        budget=budget,
        preset=setup["preset"],
        seed=run.description["seed"],
        run=run.path,
    )
    words = [options.again("fit"), *([command_line("add", (run.path, *added))] if added else [])]
    return " && ".join(words)
