"""Commands on a test of a laboratory, which has no cameras: what `fit`, `diagnose`, `check` and `simulate` do then."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil.commands._output import print_json, stages
from splatsoil.errors import MeasurementError, RunError

if TYPE_CHECKING:
    from splatsoil.commands._options import FitOptions
    from splatsoil.experiment.laboratory import LaboratoryExperiment
    from splatsoil.laboratory.folder import Options

ABOUT = "laboratory.json"
"""Of a run folder: which test it is of, and with what model."""
ABOUT_FORMAT = "splatsoil-laboratory-run/1"


def is_test(folder: Path) -> bool:
    """Whether a folder holds a test of a laboratory: its ``experiment.json`` names a kind."""
    from splatsoil.measurement.fields import read_json

    try:
        data = read_json(folder / "experiment.json")
    except MeasurementError:  # what is wrong with it is said by whoever reads it as a measurement set
        return False
    return isinstance(data, dict) and "kind" in data


def fit(config: FitOptions) -> int:
    """Estimate the parameters of a test's model; the result goes into the run folder as ``fit.json``."""
    from splatsoil.files import write_json
    from splatsoil.laboratory.folder import Options

    options = Options(config.effects, preset=config.preset, device=_device(config.device))
    experiment, run = _opened(config.set, options, config.run)
    about = {
        "format": ABOUT_FORMAT,
        "set": str(config.set.resolve()),
        "effects": list(config.effects),
        "preset": config.preset,
        "seed": config.seed,
    }
    result = _answered(experiment, run, config.seed, with_effects=False, quiet=config.json)
    write_json(run / ABOUT, about)
    write_json(run / "fit.json", result)
    return _told(result, run, quiet=config.json)


def diagnose(run: Path, candidates: Sequence[str], device: str, moved: Path | None, *, quiet: bool) -> int:
    """Compare the models of a test that was fitted, or the base model of a test's folder; the result is
    ``diagnosis.json`` in the run folder."""
    from splatsoil.files import write_json
    from splatsoil.laboratory.folder import Options
    from splatsoil.run_files import read_kept

    about: Mapping[str, Any] = {"set": str(run), "effects": [], "preset": "small", "seed": 0}
    kept = None
    if (run / ABOUT).is_file():
        about, kept = read_kept(run / ABOUT, ABOUT_FORMAT), run
    options = Options(tuple(about["effects"]), tuple(candidates) or None, about["preset"], _device(device))
    folder = Path(about["set"]) if moved is None else moved
    if not folder.is_dir():
        raise RunError(f"{folder}: the test is no longer there; say with --set where it is now")
    experiment, kept = _opened(folder, options, kept)
    result = _answered(experiment, kept, about["seed"], with_effects=True, quiet=quiet)
    write_json(kept / "diagnosis.json", result)
    return _told(result, kept, quiet=quiet)


def check(folder: Path, *, quiet: bool) -> int:
    """Say what a test holds."""
    from splatsoil.laboratory.folder import load

    experiment = load(folder)
    layout = experiment.layout
    about = {
        "kind": experiment.kind,
        "name": experiment.name,
        "instruments": list(layout.channels),
        "readings": int(experiment.seen.sum()),
        "from": layout.times[0],
        "to": layout.times[-1],
        "over": layout.time_name,
    }
    if quiet:
        print_json({"ok": True, "folder": str(folder), **about})
    else:
        print(f"{experiment.kind.replace('_', ' ')}: {experiment.name}")
        print(f"{about['readings']} readings of {', '.join(layout.channels)}")
        print(f"{layout.time_name}: {layout.times[0]:g} to {layout.times[-1]:g}")
    return 0


def simulate(
    kind: str,
    out: Path,
    values: Mapping[str, float],
    effects: tuple[str, ...],
    preset: str,
    seed: int,
    *,
    quiet: bool,
) -> int:
    """Write a test of known soil."""
    from splatsoil.laboratory.folder import simulate as write
    from splatsoil.quiet import hush

    hush()
    shape = write(kind, out, values, effects, preset, seed)
    told = {"out": str(out), "kind": kind, "parameters": dict(values), "effects": list(shape.model)}
    if quiet:
        print_json({"ok": True, **told})
    else:
        print(f"{kind.replace('_', ' ')} with {', '.join(f'{n} {v:g}' for n, v in values.items())}: written to {out}")
    return 0


def is_run(folder: Path) -> bool:
    """Whether a folder is what `fit` made of a test."""
    return (folder / ABOUT).is_file()


def _device(name: str) -> str:
    from splatsoil.envs.devices import resolve_device

    return resolve_device(name)


def _opened(folder: Path, options: Options, run: Path | None) -> tuple[LaboratoryExperiment, Path]:
    from splatsoil.laboratory.folder import load
    from splatsoil.quiet import hush

    hush()
    experiment = load(folder, options)
    return experiment, run or Path("runs") / f"{folder.resolve().name}-{options.preset}"


def _answered(
    experiment: LaboratoryExperiment, run: Path, seed: int, *, with_effects: bool, quiet: bool
) -> dict[str, Any]:
    from splatsoil.laboratory.answer import diagnosed, fitted

    began = time.perf_counter()
    with stages(quiet=quiet) as begin:
        answer = diagnosed if with_effects else fitted
        report = begin("diagnose" if with_effects else "fit")
        result = answer(experiment, run / "features", seed, report)
    return {**result, "seconds": round(time.perf_counter() - began, 1)}


def _told(result: dict[str, Any], run: Path, *, quiet: bool) -> int:
    from splatsoil.commands.diagnose import show
    from splatsoil.files import plain

    if quiet:
        print_json({"ok": True, **plain(result), "run": str(run)})
    else:
        show(result)
        print(f"kept in {run}")
    return 0
