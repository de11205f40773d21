"""``splatsoil fit``: from a measurement set to its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatsoil.commands import _laboratory, _model, _stages
from splatsoil.commands._options import FitOptions, command_line
from splatsoil.commands._output import print_parameters, print_result, stages
from splatsoil.report.text import duration, model_name

INTERRUPTED = _stages.interrupted


@dataclass(frozen=True)
class Config(FitOptions):
    """Estimate the parameters, with their uncertainty.

    A search over simulations, then the posterior, which contains discretisation error and model discrepancy. An
    interrupted fit continues.
    """


def run(config: Config) -> int:
    """Reconstruct (unless the run folder has it), fit and print."""
    if _laboratory.is_test(config.set):
        return _laboratory.fit(config)
    with stages(quiet=config.json) as begin:
        folder, _, result = _stages.fitted(config, begin)
    compare = command_line("compare", folder.path)
    _model.require_answer(folder, result, f"`{compare}` shows where")
    asks = f"Is the model adequate, and where does it fail? {compare}"
    return print_result(config, result, lambda: show(result, str(folder.path)), last=asks, run=folder)


def show(result: Mapping[str, Any], folder: str) -> None:
    """Print the parameters and notes."""
    loss = f"loss {result['loss']:.4g} ± {result['loss_std']:.2g} at the estimate; {result['evaluations']} evaluations"
    paragraphs = (f"{loss} in {duration(result['seconds'])}", f"kept in {folder}")
    print_parameters(model_name(result["name"]), result, "estimate", {}, *paragraphs)
