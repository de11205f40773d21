"""``splatsoil compare``: test of the fitted model's adequacy."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatsoil.commands import _model, _stages, _workers
from splatsoil.commands._options import ComputingOptions, command_line
from splatsoil.commands._output import print_result, print_table, print_text
from splatsoil.options import option
from splatsoil.report.text import SIGNIFICANT, averaged_sentence, no_answer, probability, residual_sentence

INTERRUPTED = "the comparison was not finished; start again with"
#: Printed checks.
MAX_CHECKS = 12
#: Keys of the misfit in the JSON output.
MISFIT = ("adequate", "probability", "estimates", "checks", "passes")


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Test whether the fitted model is adequate, and where and when it fails.

    Pictures, losses and forces at the latest estimate; residuals over their expected standard deviation, which
    simulations with other seeds and finer cells give.
    """

    quick: bool = option(False, "Only pictures, losses and forces, from one simulation; no test.")


def run(config: Config) -> int:
    """Simulate, draw and compare; results go into the run folder."""
    folder = _model.opened(config)
    none = no_answer(folder.fit())
    folder.check_writable()
    # Workers start first: they load libraries for seconds.
    with (
        nullcontext() if config.quick else _workers.Workers(folder, config.device, ()) as workers,
        _model.loaded(config, folder) as (model, begin),
    ):
        result = _stages.draw_comparison(folder, model, begin("compare"))
        misfit = {} if config.quick else _stages.check_adequacy(folder, model, begin("models"), workers=workers)
    misfit = {key: value for key, value in misfit.items() if not (none and key == "estimates")}
    extra = {"misfit": {key: misfit[key] for key in MISFIT if key in misfit}} if misfit else {}

    def show_all() -> None:
        show(result, str(folder.comparison), misfit.get("adequate"))
        if misfit:
            show_misfit(misfit, str(folder.path))

    return print_result(config, {**result, **extra}, show_all, run=folder, none=none)


def show(result: Mapping[str, Any], folder: str, adequate: bool | None = None) -> None:
    """Print the losses of each camera and in total; ``adequate`` is the result of the comparison of models."""
    name, rows = result["loss"], []
    for camera in result["cameras"]:
        frames = [entry for entry in result["frames"] if entry["camera"] == camera]
        worst = max(frames, key=lambda entry: entry["losses"][name])
        mean, rgb = (float(np.mean([entry["losses"][key] for entry in frames])) for key in (name, "rgb"))
        rows.append((camera, f"{mean:.4g}", f"{worst['losses'][name]:.4g}", str(worst["frame"]), f"{rgb:.3g}"))
    print_table("loss at the estimate", ("instrument", "mean", "worst", "at frame", "rgb mean square"), rows)
    print_text(residual_sentence(result, adequate), f"pictures in {folder}")


def show_misfit(misfit: Mapping[str, Any], run: str) -> None:
    """Print the worst checks, whether the model is adequate, and its parameters, if there are any."""
    checks = misfit["checks"]
    failed = {number for number, check in enumerate(checks) if check["p"] < SIGNIFICANT}
    print_table(
        "residual over its expected value, the worst first",
        ("stage", "region", "instrument", "× expected", "p"),
        ((c["stage"], c["region"], c["channel"], f"{c['ratio']:.2f}", f"{c['p']:.2g}") for c in checks[:MAX_CHECKS]),
        left=("stage", "region", "instrument"),
        faint=set(range(len(checks))) - failed,
    )
    print_text(
        f"{'adequate' if misfit['adequate'] else 'not adequate'}: the model as it is has a probability of "
        f"{probability(misfit['probability'])} against something else; {len(failed)} of {len(checks)} checks fail",
        style="bold",
    )
    print_text(*([averaged_sentence(misfit["estimates"])] if "estimates" in misfit else []), *misfit["sentences"])
    ask = "Could these data show a missing effect?" if misfit["adequate"] else "Which effect is missing?"
    # Not wrapped, so that it can be pasted.
    print(ask, command_line("diagnose", run))
