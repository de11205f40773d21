"""The stages that commands are made of: set, run folder, reconstruction, fit, comparison."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil.commands._control import code_of
from splatsoil.commands._options import EVALUATIONS, FitOptions, RunOptions, check_evaluations, command_line
from splatsoil.commands._output import say_remarks
from splatsoil.errors import MeasurementError, ParameterError, RunError

if TYPE_CHECKING:
    from splatsoil.commands._progress import Report
    from splatsoil.inverse.criticism.diagnosis import Diagnosis
    from splatsoil.inverse.evaluations import EvaluationRecord
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.measurement import Measurement
    from splatsoil.model import Model
    from splatsoil.reconstruction import Reconstruction

#: Share of a fit's time that is its search.
SEARCH = 0.5
#: Differences are shown this many times as strong as they are.
GAIN = 4.0


def prepare(options: FitOptions) -> tuple[Measurement, RunFolder]:
    """The checked set and its run folder; says what the fit will need. Nothing is written before all is found good.

    Raises:
        MeasurementError, ParameterError, RunError: what is wrong, before any work.
    """
    from splatsoil import __version__
    from splatsoil.commands._limits import COMPARISON, check_memory, needs
    from splatsoil.envs.devices import resolve_device
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.measurement import Measurement
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    check_evaluations(options.budget)
    if not 0 <= options.seed < 2**63:
        raise ParameterError(f"--seed: must be 0 or more and less than 2^63, not {options.seed}")
    effects = find_effects(options.effects)
    device = resolve_device(options.device)
    measurement = Measurement.load(options.set)
    say_remarks(measurement)
    known = [p.name for p in Law(effect.for_measurement(measurement) for effect in effects).parameters]
    unknown = [name for name in options.parameters if name not in known]
    if unknown:
        raise ParameterError(f"--parameters: unknown {', '.join(unknown)}; this model has {', '.join(known)}")
    if not measurement.frames:
        raise MeasurementError("has no video frames from 0 on: there is nothing to compare with", file=options.set)
    simulations = (options.budget or EVALUATIONS * max(1, len(options.parameters))) + COMPARISON
    pictures = needs(measurement, options.preset, device, simulations, particles=1)
    check_memory(pictures, device, options.set)  # how much soil there is isn't known yet
    print(needs(measurement, options.preset, device, simulations).sentence(device), file=sys.stderr)
    run = RunFolder.prepare(
        options.folder(measurement.name),
        measurement={
            "name": measurement.name,
            "folder": str(measurement.folder.resolve()),
            "hash": measurement.hash,
        },
        preset=options.preset,
        seed=options.seed,
        version=__version__,
    )
    run.check_writable()
    return measurement, run


def reconstructed(
    measurement: Measurement, run: RunFolder, device: str, report: Report, *, anew: bool = True
) -> Reconstruction:
    """The run's reconstruction: from the folder, or made ``anew`` and kept there.

    Raises:
        RunError: what is kept is damaged, or nothing is and it may not be made.
    """
    from splatsoil import __version__
    from splatsoil.files import RECONSTRUCTING, code_digest
    from splatsoil.reconstruction import Reconstruction, reconstruct

    preset, seed = run.description["preset"], run.description["seed"]
    wanted = {
        "measurement_hash": measurement.hash,
        "preset": preset,
        "seed": seed,
        "version": __version__,
        "code": code_digest(RECONSTRUCTING),
    }
    if (run.reconstruction / "reconstruction.json").is_file():
        report("reading", 0.0)
        try:
            kept = Reconstruction.load(run.reconstruction)
        except RunError as error:
            raise RunError(f"{error}: delete the folder {run.reconstruction} and run the command again") from error
        if all(kept.metadata.get(key) == value for key, value in wanted.items()):
            return kept
    if not anew:
        raise RunError(f"{run.path}: its reconstruction isn't there")
    made = reconstruct(measurement, seed=seed, device=device, preset=preset, progress=report)
    with run.lock():
        made.save(run.reconstruction)
    # Read back: float32 on disk is what every later command will start from.
    return Reconstruction.load(run.reconstruction)


def model_on(
    measurement: Measurement,
    run: RunFolder,
    reconstruction: Reconstruction,
    effects: Iterable[str],
    preset: str,
    device: str,
) -> Model:
    """A model of a run's set. What photographs say of light and albedo is kept in the run's ``features/``: processes
    that work side by side, and later commands, find it there."""
    from splatsoil import __version__
    from splatsoil.files import FORWARD, code_digest
    from splatsoil.inverse.evaluations import digest
    from splatsoil.model import Model

    what = {
        "measurement": measurement.hash,
        "reconstruction": digest_of(reconstruction),
        "device": device.split(":")[0],
        "version": __version__,
        "code": code_digest(FORWARD),
    }

    def file(spacing: float) -> Path:
        return run.path / "features" / f"intrinsic-{digest({**what, 'spacing': spacing})[:24]}.npz"

    return Model(measurement, reconstruction, effects=effects, preset=preset, device=device, intrinsic=file)


def digest_of(reconstruction: Reconstruction) -> str:
    """SHA-256 of what simulations and pictures start from; the same arrays, the same digest."""
    digest = hashlib.sha256()
    g = reconstruction.gaussians
    tensors = (g.means, g.scales, g.quaternions, g.opacities, g.colours, reconstruction.soil, reconstruction.tool)
    for tensor in tensors:
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes())
    digest.update(np.ascontiguousarray(reconstruction.surface.height).tobytes())
    return digest.hexdigest()


def facts(model: Model) -> dict[str, str]:
    """How a model computes, for readers."""
    r = model.resolution
    step = r.frame_time / r.steps
    return {
        "cell": f"{1e3 * r.cell:.3g} mm",
        "particles": f"{len(model.particles(0))}, {1e3 * r.spacing:.3g} mm apart",
        "time step": f"{1e3 * step:.3g} ms, in {r.substeps(r.steps)} substeps",
        "compared frames": f"{len(model.frames) - 1} of each of {len(model.measurement.cameras)} cameras",
    }


def fitted(
    options: FitOptions, measurement: Measurement, run: RunFolder, model: Model, report: Report
) -> dict[str, Any]:
    """Search, evaluation by evaluation, and compare the model with something else by what was simulated, and more; what
    is in the run folder already isn't simulated again.
    """
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._experiments import Chosen, experiment_of
    from splatsoil.commands._limits import check_memory, needs
    from splatsoil.envs.measured import LOSS, MeasuredProblem
    from splatsoil.inverse.fitting import TOGETHER, FitSetup, fit

    space = model.space(options.parameters or None)
    budget = options.budget or EVALUATIONS * len(space)
    need = needs(measurement, options.preset, model.device, budget, particles=len(model.particles(0)))
    check_memory(need, model.device, measurement.folder)
    version, code = sources(options.effects)
    setup = FitSetup(
        measurement=measurement.hash,
        reconstruction=digest_of(model.reconstruction),
        parameters=space.names,
        effects=options.effects,
        preset=options.preset,
        device=model.device,
        seed=options.seed,
        version=version,
        code=code,
        loss=LOSS,
    )
    report("reading the video", 0.0)
    chosen = Chosen(tuple(options.effects), options.preset, space.names)
    experiment, simulate = experiment_of(run, model, chosen, ())
    problem = MeasuredProblem(experiment)
    units = {p.name: "°" if p.unit == "deg" else f" {p.unit}" for p in space}
    finished = 0

    def told(done: int, record: EvaluationRecord) -> None:
        nonlocal finished
        finished = done
        if record.loss is not None:
            simulate.keep(problem.features(record.blocks), record.parameters, record.seed)
        said = ", ".join(f"{name} {record.parameters[name]:.4g}{unit}" for name, unit in units.items())
        outcome = "failed" if record.loss is None else f"loss {record.loss:.4g}"
        report(f"{done} of {budget}: {said}, {outcome}", SEARCH * done / budget)

    def simulating(frame: int, last: int) -> None:
        share = min((finished + TOGETHER * frame / (last + 1)) / budget, 1.0)
        report(f"simulation {finished + 1}, frame {frame}", SEARCH * share)

    def compared(found: dict[str, Any]) -> Diagnosis:
        def comparing(what: str, share: float) -> None:
            report(what, SEARCH + (1.0 - SEARCH) * share)

        experiment.progress = None
        with Crew(run, model.device, ()) as crew, crew.helping(chosen, experiment, simulate):
            return criticism.judged(experiment, simulate, found, comparing, options.seed, with_effects=False)

    experiment.progress = simulating
    return fit(
        problem,
        run,
        setup,
        budget=budget,
        facts=facts(model),
        compare=compared,
        after_evaluation=told,
    )


def sources(effects: Iterable[str]) -> tuple[str, str]:
    """Version and digest of the code that a fit with some effects would be made by now."""
    from splatsoil import __version__

    return __version__, code_of(effects)


def note_other_sources(run: RunFolder) -> None:
    """Say on stderr, in one line, if the latest fit was made by other sources than these."""
    from splatsoil.commands._anew import anew
    from splatsoil.run_files import read_fit

    fit = read_fit(run.path)
    setup = fit["setup"]
    then = (setup.get("version"), setup.get("code"))
    try:
        now = sources(setup["effects"])
    except RunError as error:
        print(f"splatsoil: {run.path}: effects that it was fitted with are gone ({error})", file=sys.stderr)
        return
    if then != now:
        print(
            f"splatsoil: {run.path} was fitted by splatsoil {then[0]}, code {then[1]}, and this is {now[0]}, code "
            f"{now[1]}; this makes it anew: {anew(run, fit)}",
            file=sys.stderr,
        )


def compared(run: RunFolder, model: Model, report: Report) -> dict[str, Any]:
    """Simulate at the latest fit's estimate, and keep pictures and losses of every frame in ``comparison/``."""
    with run.lock():
        return _compared(run, model, report)


def _compared(run: RunFolder, model: Model, report: Report) -> dict[str, Any]:
    from splatsoil import __version__
    from splatsoil.comparison import Comparator
    from splatsoil.envs.measured import LOSS
    from splatsoil.experiment.forces import force_record
    from splatsoil.files import write_json
    from splatsoil.report.data import estimates
    from splatsoil.run_files import COMPARISON_FORMAT

    result = run.fit()
    values = estimates(result)
    report("reading the video", 0.0)
    comparator = Comparator(model.measurement, surface=model.reconstruction.surface, frames=model.frames)
    prediction = model.predict(values, 0, lambda frame, last: report(f"frame {frame}", 0.9 * frame / last))
    comparison = comparator.compare(prediction.images)
    report("writing pictures", 0.95)
    frames = []
    for camera, frame in comparator.keys:
        strip = comparator.picture(prediction.images, camera, frame, GAIN)
        names = {kind: f"{camera}_{frame:04d}_{kind}.jpg" for kind in ("observed", "predicted", "difference")}
        for name, picture in zip(names.values(), np.split(strip, 3, axis=1), strict=True):
            write_jpeg(run.comparison / name, picture)
        losses = {LOSS: comparison.losses[camera, frame], "rgb": comparison.rgb_mse[camera, frame]}
        frames.append({"camera": camera, "frame": frame, "losses": losses, **names})
    data = {
        "format": COMPARISON_FORMAT,
        "fit": result["name"],
        "parameters": values,
        "seed": prediction.seed,
        "preset": model.preset,
        "device": model.device,
        "version": __version__,
        "measurement": run.description["measurement"]["hash"],
        "loss": LOSS,
        "total": {LOSS: comparison.loss, "rgb": comparison.rgb},
        "noise": {} if comparator.noise is None else {LOSS: comparator.noise},
        # The loss is measured in units of what soil at rest would leave.
        "motionless": {LOSS: 1.0},
        "gain": GAIN,
        "cameras": list(comparator.cameras),
        "frames": frames,
        "force": force_record(model.measurement, comparator.frames, prediction.trajectory.force),
        "seconds": sum(prediction.seconds.values()),
    }
    write_json(run.comparison / "comparison.json", data)
    return data


def write_jpeg(path: Path, picture: np.ndarray) -> None:
    """A picture (h, w, 3) in [0, 1] as a JPEG file, whole or not at all."""
    import io

    from PIL import Image

    from splatsoil.files import write_bytes

    stream = io.BytesIO()
    pixels = np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, format="JPEG", quality=90)
    write_bytes(path, stream.getvalue())


def opened(options: RunOptions) -> RunFolder:
    """The run folder of a command, which knows where its set is now if the command says so.

    Raises:
        RunError: there is none, or the set is another one.
        MeasurementError: there is no set.
    """
    from splatsoil.inverse.run_folder import RunFolder
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
    note = command_line("report", (run.path,), (("--set", "FOLDER", None),))
    raise RunError(
        changed
        or f"{run.path}: its measurement set {first} isn't there any more, nor beside the run; `{note}` notes "
        "where it is now"
    )


def kept(options: FitOptions) -> str:
    """How many evaluations an interrupted fit leaves, for the sentence after Ctrl-C."""
    from splatsoil.inverse.evaluations import EvaluationStore
    from splatsoil.measurement import Measurement

    try:
        folder = options.run or options.folder(Measurement.load(options.set).name)
        with EvaluationStore(folder / "evaluations.db", writable=False) as store:
            count = len(store.records())
    except (RunError, MeasurementError):
        return "no evaluation has been finished"
    return f"{count} evaluation{'s are' if count != 1 else ' is'} kept in {folder}"
