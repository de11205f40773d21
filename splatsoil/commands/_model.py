"""What commands load from a run folder: measurement set, latest fit and diagnosis, model, experiment."""

from __future__ import annotations

import hashlib
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil import __version__
from splatsoil.commands._options import FitOptions, RunOptions, command_line, same_again
from splatsoil.commands._output import Report, Stage, places, print_remarks, stages
from splatsoil.devices import resolve_device
from splatsoil.errors import MeasurementError, NoAnswer, ParameterError, RunError, SetWarning
from splatsoil.files import CRITICISM, FORWARD, RECONSTRUCTING, code_digest, code_of, digest, own_files
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.quiet import hush
from splatsoil.report.data import kept_of
from splatsoil.report.text import no_answer
from splatsoil.run_files import DIAGNOSIS_FORMAT, read_fit

if TYPE_CHECKING:
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.measurement import Measurement
    from splatsoil.model import Model
    from splatsoil.reconstruction import Reconstruction
    from splatsoil.soil.effect import Effect


def opened(options: RunOptions) -> RunFolder:
    """The run folder of a command, with a new place of its set if the options name one.

    Raises:
        RunError: there is no run, or the set is another one.
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
    """The measurement set of a run, at its stored place or next to the run.

    Raises:
        RunError: it is not found, or has changed since.
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
    gone = f"{run.path}: its measurement set {first} isn't there any more, nor next to the run; `{note}` notes where it"
    raise RunError(changed or f"{gone} is now")


def latest_fit(folder: RunFolder) -> dict[str, Any]:
    """The fit from which a diagnosis starts; RunError if there is none."""
    try:
        return folder.fit()
    except RunError as error:
        raise RunError(f"{error}; a diagnosis starts from a fit") from error


def require_answer(run: RunFolder, fit: Mapping[str, Any], look: str) -> None:
    """NoAnswer if a fit has no answer; ``look`` is the advice then."""
    if reason := no_answer(fit):
        raise NoAnswer(f"{reason}: {look}", places(run))


def note_other_sources(run: RunFolder) -> None:
    """Print one line on stderr if other source code made the latest fit."""
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
        f"{now[1]}; to repeat it: {same_again('fit', options)}",
        file=sys.stderr,
    )


def current_diagnosis(folder: RunFolder, path: Path, effects: tuple[str, ...] | None = None) -> dict[str, Any] | None:
    """The diagnosis in the file ``path`` if it is of the latest fit and of the present code, else None.

    The code includes the files of ``effects``, or of the diagnosis's own candidates if not given.
    """
    fit = folder.fit()
    data = kept_of(path, DIAGNOSIS_FORMAT, fit)
    if data is None:
        return None
    candidates = data.get("candidates", ()) if effects is None else effects
    digests = code_of((*fit["setup"]["effects"], *candidates)), code_digest(CRITICISM)
    return data if (data.get("code"), data.get("criticism_code")) == digests else None


@dataclass(frozen=True)
class ModelSpec:
    """What defines a run's model, besides its set and reconstruction.

    Attributes:
        effects: names or files of those that are on.
        preset: resolution of the solver.
        parameters: names of the free ones.
    """

    effects: tuple[str, ...]
    preset: str
    parameters: tuple[str, ...]

    @classmethod
    def of(cls, fit: Mapping[str, Any]) -> ModelSpec:
        """Of a fit (contents of ``fit.json``)."""
        return cls(tuple(fit["setup"]["effects"]), fit["setup"]["preset"], tuple(fit["parameters"]))


@contextmanager
def loaded(options: Any, folder: RunFolder, spec: ModelSpec | None = None) -> Iterator[tuple[Model, Stage]]:
    """Context manager: the model of a run, by default that of its latest fit, and the function that begins a stage.

    ``options`` are a command's. Reports if other source code made the fit.
    """
    hush()
    device = resolve_device(options.device)
    note_other_sources(folder)
    with stages(quiet=getattr(options, "json", False)) as begin:
        yield model_of(folder, device, begin("reconstruct"), spec=spec), begin


def model_of(
    folder: RunFolder, device: str, report: Report, *, spec: ModelSpec | None = None, make: bool = True
) -> Model:
    """The model of a run, by default that of its latest fit, on one device.

    ``make``: make a missing reconstruction, and print remarks on the set.

    Raises:
        RunError: the reconstruction is damaged, or missing and not to be made.
    """
    spec = spec or ModelSpec.of(folder.fit())
    measurement = measurement_of(folder)
    if make:
        print_remarks(measurement)
    reconstruction = reconstructed(measurement, folder, device, report, make=make)
    return model_on(measurement, folder, reconstruction, spec.effects, spec.preset, device)


def reconstructed(
    measurement: Measurement, run: RunFolder, device: str, report: Report, *, make: bool = True
) -> Reconstruction:
    """The run's reconstruction, loaded or made.

    Raises:
        RunError: it is damaged, or missing and not to be made.
        NoAnswer: photographs that were set aside rule it out; it is kept.
    """
    found = _reconstructed(measurement, run, device, report, make=make)
    if found.fault:
        raise NoAnswer(f"no answer: {found.fault}: kept in {run.reconstruction}", places(run))
    return found


def _reconstructed(
    measurement: Measurement, run: RunFolder, device: str, report: Report, *, make: bool
) -> Reconstruction:
    from splatsoil.reconstruction import Reconstruction

    settings = {"preset": run.description["preset"], "seed": run.description["seed"]}
    code = code_digest(RECONSTRUCTING)
    identity = {"measurement_hash": measurement.hash, "version": __version__, "code": code, **settings}
    if (run.reconstruction / "reconstruction.json").is_file():
        report("reading", 0.0)
        try:
            stored = Reconstruction.load(run.reconstruction)
        except RunError as error:
            raise RunError(f"{error}: delete the folder {run.reconstruction} and run the command again") from error
        if all(stored.metadata.get(key) == value for key, value in identity.items()):
            return stored
    if not make:
        raise RunError(f"{run.path}: its reconstruction isn't there")
    made = new_reconstruction(measurement, device=device, progress=report, **settings)
    with run.lock():
        made.save(run.reconstruction)
    # Every later command starts from the float32 values on disk.
    return Reconstruction.load(run.reconstruction)


def new_reconstruction(measurement: Measurement, **settings: Any) -> Reconstruction:
    """A reconstruction by these settings of `reconstruct`, with a remark on each fixed camera whose clock is off."""
    from splatsoil.importing.clock import late_cameras
    from splatsoil.reconstruction import reconstruct

    made = reconstruct(measurement, **settings)
    late = [
        f"video: Camera {name!r} sees the tool where it is {abs(offset):.3f} s {'later' if offset > 0.0 else 'earlier'}"
        " than the camera's times; are they on the clock of the tool's motion?"
        for name, offset in late_cameras(measurement).items()
    ]
    for remark in late:
        warnings.warn(remark, SetWarning, stacklevel=2)
    return replace(made, metadata={**made.metadata, "remarks": [*made.metadata["remarks"], *late]})


def model_on(
    measurement: Measurement,
    run: RunFolder,
    reconstruction: Reconstruction,
    effects: Iterable[str],
    preset: str,
    device: str,
) -> Model:
    """A model of a run's set. Light and albedo from the photographs are cached in ``features/``."""
    from splatsoil.model import Model

    what = {
        "measurement": measurement.hash,
        "reconstruction": reconstruction_digest(reconstruction),
        "device": device.split(":")[0],
        "version": __version__,
        "code": code_digest(FORWARD),
    }

    def file(spacing: float) -> Path:
        return run.path / "features" / f"intrinsic-{digest({**what, 'spacing': spacing})[:24]}.npz"

    return Model(measurement, reconstruction, effects=effects, preset=preset, device=device, intrinsic=file)


def reconstruction_digest(reconstruction: Reconstruction) -> str:
    """SHA-256 of the arrays from which simulations and pictures start."""
    g = reconstruction.gaussians
    tensors = (g.means, g.scales, g.quaternions, g.opacities, g.colours, reconstruction.soil, reconstruction.tool)
    arrays = [*(tensor.detach().cpu().numpy() for tensor in tensors), reconstruction.surface.height]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def experiment_of(
    folder: RunFolder, model: Model, spec: ModelSpec, effects: Iterable[str] | None = None
) -> tuple[PlowExperiment, Simulations]:
    """The run as an experiment with some candidates or all, and its simulations, cached in ``features/``.

    Raises:
        ParameterError: an effect is unknown or already on.
    """
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.soil.library import find_effects

    named = None if effects is None else tuple(effects)
    wanted = None if named is None else off_effects(named, model.law.effects)
    experiment = PlowExperiment(model, spec.parameters, candidates=wanted)
    identity = {
        "measurement": folder.description["measurement"]["hash"],
        "reconstruction": reconstruction_digest(model.reconstruction),
        "model": sorted(experiment.model),
        "preset": model.preset,
        "device": model.device.split(":")[0],
        "version": __version__,
        "code": code_of(spec.effects),
        "layout": list(experiment.layout.shape),
    }
    # A user's file affects only simulations with its effect on.
    own = {e.name: code_digest((), [file]) for file in own_files(named or ()) for e in find_effects([file])}
    return experiment, Simulations(experiment, folder.path / "features", identity, sources=own)


def off_effects(names: Iterable[str], on: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects by name, or from files, that are off.

    Raises:
        ParameterError: one is unknown, already on, or part of the discretisation error in a diagnosis.
    """
    from splatsoil.soil.library import find_effects

    wanted, taken = find_effects(names), {effect.name for effect in on}
    for effect in wanted:
        if effect.name in taken:
            raise ParameterError(f"effect {effect.name} is on already; name one that is off")
        if effect.numerical:
            raise ParameterError(
                f"effect {effect.name} can't be distinguished from discretisation error in a diagnosis; "
                f"fit it: splatsoil fit SET --with {effect.name}"
            )
    return wanted
