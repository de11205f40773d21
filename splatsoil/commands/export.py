"""``splatsoil export``: a run's prediction for other programs."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatsoil import __version__
from splatsoil.commands import _model
from splatsoil.commands._options import ComputingOptions
from splatsoil.commands._output import by_frame, print_result
from splatsoil.errors import ParameterError, RunError
from splatsoil.files import check_folder, plain, write_json
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import option
from splatsoil.report.data import estimates, load

if TYPE_CHECKING:
    from splatsoil.model import Model

INTERRUPTED = "nothing was written; start again with"
Format = Literal["vtk", "usd", "csv", "ply"]


@dataclass(frozen=True)
class Config(ComputingOptions):
    """The prediction for ParaView, Omniverse, spreadsheets, splat viewers.

    vtk: ParaView; usd: Omniverse, Blender; csv: spreadsheets; ply: viewers of Gaussian splats.
    """

    to: tuple[Format, ...] = option(
        ("vtk", "usd", "csv", "ply"), "Formats; vtk and usd need `pip install 'splatsoil[export]'`."
    )
    out: Path | None = option(
        None, "Folder for them, new or empty; RUN/export, where an older one is replaced, if not given."
    )
    model: Literal["fit", "diagnosis"] = option(
        "fit", "The latest fit, or the most probable model of its diagnosis.", expert=True
    )
    every: int | None = option(
        None, "Frames from one that is written to the next; those of the video are written if not given.", expert=True
    )


def run(config: Config) -> int:
    """Simulate and write all files, or none."""
    from splatsoil.export import check_installed

    if not config.to:
        raise ParameterError("--to: name a format: vtk, usd, csv or ply")
    if config.every is not None and config.every < 1:
        raise ParameterError(f"--every: must be 1 or more, not {config.every}")
    formats = tuple(dict.fromkeys(config.to))
    check_installed(formats)
    folder = _model.opened(config)
    folder.fit()
    target = folder.path / "export" if config.out is None else config.out
    if config.out is not None and target.is_dir() and any(target.iterdir()):
        raise ParameterError(f"--out: {target} is not empty; nothing is overwritten")
    check_folder(target)
    about = _exported(config, folder, formats, target)
    return print_result(config, about, lambda: _show(about), run=folder)


def _exported(config: Config, folder: RunFolder, formats: tuple[str, ...], target: Path) -> dict[str, Any]:
    """Write into a temporary folder, then move it to the target; returns the contents of ``export.json``."""
    from splatsoil.export import make_writers, replay

    with _model.loaded(config, folder) as (fitted, begin):
        model, values = _chosen(config, folder, fitted)
        frames = model.frames if config.every is None else tuple(range(0, model.frames[-1] + 1, config.every))
        if len(formats) > 1 and not model.photographed:  # splats are made from photographs
            formats = tuple(name for name in formats if name != "ply")
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as temporary:
            made = Path(temporary) / target.name
            writers = make_writers(made, formats, model, frames)
            replay(model, values, frames, writers, progress=by_frame(begin("export")))
            about = {
                "run": str(folder.path),
                "measurement": folder.description["measurement"]["name"],
                "model": [effect.name for effect in model.effects],
                "parameters": values,
                "preset": model.preset,
                "device": model.device,
                "version": __version__,
                "frames": list(frames),
                "files": {name: sorted(p.name for p in (made / name).iterdir()) for name in formats},
            }
            write_json(made / "export.json", about)
            with folder.lock() if config.out is None else nullcontext():
                if config.out is None:
                    shutil.rmtree(target, ignore_errors=True)
                elif target.is_dir():
                    target.rmdir()
                shutil.move(made, target)
    return {**plain(about), "out": str(target)}


def _chosen(config: Config, folder: RunFolder, model: Model) -> tuple[Model, dict[str, float]]:
    """The model to simulate, and its parameters."""
    if config.model == "fit":
        return model, estimates(folder.fit())
    diagnosis = load(folder.path).diagnosis
    if diagnosis is None or set(diagnosis["model"]) != {effect.name for effect in model.effects}:
        raise RunError(f"{folder.path}: its latest fit has no diagnosis; splatsoil diagnose makes one")
    best = max((m for m in diagnosis["models"] if m["kind"] != "discrepancy"), key=lambda m: m["probability"])
    if best["kind"] != "base":
        model = model.variant(effects=(*(effect.name for effect in model.effects), best["name"]))
    known = {p.name for p in model.parameters}
    return model, {name: value for name, value in best["values"].items() if name in known}


def _show(about: dict[str, Any]) -> None:
    values = ", ".join(f"{name} {value:.4g}" for name, value in about["parameters"].items())
    print(f"{about['measurement']} at {values}: {len(about['frames'])} frames")
    for name, files in about["files"].items():
        shown = [f for f in files if not f.endswith(".vtu")]
        print(f"{name}: {', '.join(str(Path(about['out']) / name / f) for f in shown)}")
