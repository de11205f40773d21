"""A run folder as commands meet it: its set, its latest fit, and what is made of that."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil import __version__
from splatsoil.commands._options import FitOptions, RunOptions, command_line, same_again
from splatsoil.errors import MeasurementError, NoAnswer, RunError
from splatsoil.files import JUDGING, code_digest, code_of
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.report.data import kept_of
from splatsoil.report.text import no_answer
from splatsoil.run_files import DIAGNOSIS_FORMAT, read_fit

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement


def opened(options: RunOptions) -> RunFolder:
    """The run folder of a command, which knows where its set is now if the command says so.

    Raises:
        RunError: there is none, or the set is another one.
        MeasurementError: there is no set.
    """
    from splatsoil.measurement import Measurement

    run = RunFolder.open(options.run)
    if options.set is None:
        return run
    measurement = Measurement.load(options.set)
    if measurement.hash != run.description["measurement"]["hash"]:
        raise RunError(f"{run.path}: --set {options.set} isn't the set that it was made from, or has changed since")
    return run.moved(measurement.folder.resolve())


def measurement_of(run: RunFolder) -> Measurement:
    """The set that a run was made from: where it was, or beside the run if both have moved.

    Raises:
        RunError: it is at none of these places, or has changed since.
    """
    from splatsoil.measurement import Measurement
    from splatsoil.measurement.measurement import EXPERIMENT

    first, *others = run.measurement_places()
    changed = ""
    for folder in (first, *others):
        if not (folder / EXPERIMENT).is_file():
            continue
        try:
            measurement = Measurement.load(folder)
        except MeasurementError:
            if folder == first:
                raise
            continue
        if measurement.hash == run.description["measurement"]["hash"]:
            return measurement
        changed = changed or f"{run.path}: its measurement set {folder} has changed since; fit again into another --run"
    note = command_line("report", run.path, "--set", "FOLDER")
    gone = f"{run.path}: its measurement set {first} isn't there any more, nor beside the run; `{note}` notes where it"
    raise RunError(changed or f"{gone} is now")


def places(run: RunFolder) -> dict[str, str]:
    """The run folder and its set, as commands' JSON objects have them."""
    return {"run": str(run.path), "set": str(run.description["measurement"]["folder"])}


def latest_fit(folder: RunFolder) -> dict[str, Any]:
    """The fit that a diagnosis starts from; RunError where there is none."""
    try:
        return folder.fit()
    except RunError as error:
        raise RunError(f"{error}; a diagnosis starts from a fit") from error


def require_answer(run: RunFolder, fit: Mapping[str, Any], look: str) -> None:
    """NoAnswer where a run's fit has none; ``look`` says what to look at then."""
    if reason := no_answer(fit):
        raise NoAnswer(f"{reason}: {look}", places(run))


def note_other_sources(run: RunFolder) -> None:
    """Say on stderr, in one line, if the latest fit was made by other sources than these."""
    fit = read_fit(run.path)
    setup = fit["setup"]
    then = (setup.get("version"), setup.get("code"))
    try:
        now = (__version__, code_of(setup["effects"]))
    except RunError as error:
        print(f"splatsoil: {run.path}: effects that it was fitted with are gone ({error})", file=sys.stderr)
        return
    if then == now:
        return
    options = FitOptions(
        set=Path(run.description["measurement"]["folder"]),
        parameters=tuple(fit["parameters"]),
        effects=tuple(setup["effects"]),
        preset=setup["preset"],
        seed=run.description["seed"],
        run=run.path,
    )
    print(
        f"splatsoil: {run.path} was fitted by splatsoil {then[0]}, code {then[1]}, and this is {now[0]}, code "
        f"{now[1]}; this makes it anew: {same_again('fit', options)}",
        file=sys.stderr,
    )


def current_diagnosis(folder: RunFolder, path: Path, effects: tuple[str, ...] | None = None) -> dict[str, Any] | None:
    """A diagnosis (its file is ``path``) of the latest fit by the code as it is, or None.

    Code is also that of the files of ``effects``, or of the diagnosis's own candidates if not given.
    """
    fit = folder.fit()
    data = kept_of(path, DIAGNOSIS_FORMAT, fit)
    if data is None:
        return None
    candidates = data.get("candidates", ()) if effects is None else effects
    digests = code_of((*fit["setup"]["effects"], *candidates)), code_digest(JUDGING)
    return data if (data.get("code"), data.get("judged_by")) == digests else None
