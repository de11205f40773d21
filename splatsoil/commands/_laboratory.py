"""The commands `fit`, `diagnose`, `check` and `simulate` for laboratory tests, which have no cameras."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatsoil.commands._options import FitOptions
from splatsoil.commands._output import print_result, stages
from splatsoil.devices import resolve_device
from splatsoil.errors import MeasurementError, RunError
from splatsoil.files import check_folder, plain, write_json
from splatsoil.quiet import hush
from splatsoil.run_files import read_format

ABOUT = "laboratory.json"
"""File of a run folder that names test and model."""
ABOUT_FORMAT = "splatsoil-laboratory-run/1"


def is_test(folder: Path) -> bool:
    """Whether a folder is a laboratory test: its ``experiment.json`` has a kind."""
    from splatsoil.measurement.fields import read_json

    try:
        data = read_json(folder / "experiment.json")
    except MeasurementError:  # reported when it is read as a measurement set
        return False
    return isinstance(data, dict) and "kind" in data


def is_run(folder: Path) -> bool:
    """Whether a folder is the run folder of a laboratory test."""
    return (folder / ABOUT).is_file()


def fit(config: FitOptions) -> int:
    """Estimate the parameters of a test's model; write ``fit.json``."""
    settings = {"effects": list(config.effects), "preset": config.preset, "seed": config.seed}
    about = {"set": str(config.set.resolve()), **settings}
    return _answered(config, about, config.set, config.run)


def diagnose(config: Any) -> int:
    """Compare models of a fitted test, or of a test's folder; write ``diagnosis.json``."""
    about: Mapping[str, Any] = {"set": str(config.run), "effects": [], "preset": "small", "seed": 0}
    kept = None
    if is_run(config.run):
        about, kept = read_format(config.run / ABOUT, ABOUT_FORMAT), config.run
    folder = config.set or Path(about["set"])
    if not folder.is_dir():
        raise RunError(f"{folder}: the test is no longer there; give its place with --set")
    return _answered(config, about, folder, kept, tuple(config.effects) or None, with_effects=True)


def _answered(
    config: Any,
    about: Mapping[str, Any],
    folder: Path,
    run: Path | None,
    candidates: tuple[str, ...] | None = None,
    *,
    with_effects: bool = False,
) -> int:
    """Compute, store and print a result of the test in ``folder``; the run folder is named after it if not given."""
    from splatsoil.commands.diagnose import show
    from splatsoil.laboratory.answer import diagnosed, fitted
    from splatsoil.laboratory.folder import Options, load

    device = resolve_device(config.device)
    hush()
    experiment = load(folder, Options(tuple(about["effects"]), candidates, about["preset"], device))
    run = run or Path("runs") / f"{folder.resolve().name}-{about['preset']}"
    check_folder(run)
    began = time.perf_counter()
    with stages(quiet=config.json) as begin:
        report = begin("diagnose" if with_effects else "fit")
        result = (diagnosed if with_effects else fitted)(experiment, run / "features", about["seed"], report)
    result = {**result, "seconds": round(time.perf_counter() - began, 1)}
    if with_effects:
        write_json(run / "diagnosis.json", result)
    else:
        write_json(run / ABOUT, {"format": ABOUT_FORMAT, **about})
        write_json(run / "fit.json", result)
    data = {**plain(result), "run": str(run), "set": str(folder)}
    return print_result(config, data, lambda: show(result), last=f"kept in {run}")


def check(config: Any) -> int:
    """Print the contents of a test."""
    from splatsoil.laboratory.folder import load

    experiment = load(config.set)
    layout, readings = experiment.layout, int(experiment.seen.sum())
    about = {
        "set": str(config.set),
        "kind": experiment.kind,
        "name": experiment.name,
        "instruments": list(layout.channels),
        "readings": readings,
        "from": layout.times[0],
        "to": layout.times[-1],
        "over": layout.time_name,
    }
    lines = (
        f"{experiment.kind.replace('_', ' ')}: {experiment.name}",
        f"{readings} readings of {', '.join(layout.channels)}",
        f"{layout.time_name}: {layout.times[0]:g} to {layout.times[-1]:g}",
    )
    return print_result(config, about, last="\n".join(lines))


def simulate(config: Any, values: Mapping[str, float]) -> int:
    """Write a test of known soil."""
    from splatsoil.laboratory.folder import simulate as write

    hush()
    shape = write(config.scene, config.out, values, config.effects, config.preset or "small", config.seed)
    data = {"set": str(config.out), "kind": config.scene, "parameters": dict(values), "effects": list(shape.model)}
    said = ", ".join(f"{name} {value:g}" for name, value in values.items())
    return print_result(config, data, last=f"{config.scene.replace('_', ' ')} with {said}: written to {config.out}")
