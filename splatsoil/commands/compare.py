"""``splatsoil compare``: predicted against measured pictures, at the estimate of a run."""

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
#: Checks shown on the screen.
SHOWN = 12
#: What --json prints of the misfit.
MISFIT = ("adequate", "probability", "estimates", "checks", "passes")


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Test whether the fitted model is adequate, and where and when it fails.

    Pictures, losses and forces at the latest estimate; residuals over their expected standard deviation, which
    simulations with other seeds and finer cells give.
    """

    quick: bool = option(False, "Only pictures, losses and forces, from one simulation; no test.")


def run(config: Config) -> int:
    """Simulate, draw, compare; pictures, losses and the misfit by block go into the run folder."""
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
    """Losses of each camera, and what the whole comes to; ``adequate`` is what a comparison with something else
    says of it."""
    name, rows = result["loss"], []
    for camera in result["cameras"]:
        frames = [entry for entry in result["frames"] if entry["camera"] == camera]
        worst = max(frames, key=lambda entry: entry["losses"][name])
        mean, rgb = (float(np.mean([entry["losses"][key] for entry in frames])) for key in (name, "rgb"))
        rows.append((camera, f"{mean:.4g}", f"{worst['losses'][name]:.4g}", str(worst["frame"]), f"{rgb:.3g}"))
    print_table("loss at the estimate", ("instrument", "mean", "worst", "at frame", "rgb mean square"), rows)
    print_text(residual_sentence(result, adequate), f"pictures in {folder}")


def show_misfit(misfit: Mapping[str, Any], run: str) -> None:
    """The worst checks, and whether the model is adequate; the parameters where ``misfit`` has them."""
    checks = misfit["checks"]
    failed = {number for number, check in enumerate(checks) if check["p"] < SIGNIFICANT}
    print_table(
        "residual over what is expected, the worst first",
        ("stage", "region", "instrument", "× expected", "p"),
        ((c["stage"], c["region"], c["channel"], f"{c['ratio']:.2f}", f"{c['p']:.2g}") for c in checks[:SHOWN]),
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
    # Wrapped, it couldn't be pasted.
    print(ask, command_line("diagnose", run))
