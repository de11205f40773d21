"""``splatsoil compare``: predicted against measured pictures, at the estimate of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from splatsoil.commands._output import print_json


@dataclass(frozen=True)
class Config:
    """Compare the prediction at a run's latest estimate with every frame of the video."""

    run: Positional[Path]
    """The run folder."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Simulate, draw, compare; pictures and losses go into the run folder."""
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model

    stage.hush()
    folder = RunFolder.open(config.run)
    setup = folder.fit()["setup"]
    device = resolve_device(config.device)
    measurement = stage.measurement_of(folder)
    with stages(quiet=config.json) as begin:
        reconstruction = stage.reconstructed(measurement, folder, device, begin("reconstruct"))
        model = Model(measurement, reconstruction, effects=setup["effects"], preset=setup["preset"], device=device)
        result = stage.compared(folder, model, begin("compare"))
    if config.json:
        print_json({"ok": True, "run": str(folder.path), **result})
    else:
        show(result, str(folder.comparison))
    return 0


def interrupted(config: Config) -> str:
    """A comparison is complete or it isn't there."""
    return f"the comparison was not finished; start again with: splatsoil compare {config.run}"


def show(result: Mapping[str, Any], folder: str) -> None:
    """Losses of each camera, and what the whole comes to."""
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import residual_sentence

    name = result["loss"]
    table = Table(title="loss at the estimate", title_justify="left")
    for column in ("camera", "mean", "worst", "at frame", "rgb mean square"):
        table.add_column(column, justify="left" if column == "camera" else "right")
    for camera in result["cameras"]:
        frames = [entry for entry in result["frames"] if entry["camera"] == camera]
        worst = max(frames, key=lambda entry: entry["losses"][name])
        mean, rgb = (float(np.mean([entry["losses"][key] for entry in frames])) for key in (name, "rgb"))
        table.add_row(escape(camera), f"{mean:.4g}", f"{worst['losses'][name]:.4g}", str(worst["frame"]), f"{rgb:.3g}")
    console = Console(highlight=False)
    console.print(table)
    console.print(residual_sentence(result))
    console.print(f"pictures in {escape(folder)}")
