"""Stages of commands: check, fit, compare, diagnose."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil import __version__
from splatsoil.commands import _model, _workers
from splatsoil.commands._model import ModelSpec, experiment_of, reconstruction_digest
from splatsoil.commands._options import EVALUATIONS, FitOptions, check_evaluations, check_seed
from splatsoil.commands._output import Report, Stage, by_frame, print_remarks
from splatsoil.commands._resources import COMPARISON, check_memory, check_time, needs
from splatsoil.devices import resolve_device
from splatsoil.errors import MeasurementError, ParameterError, RunError
from splatsoil.files import CRITICISM, code_digest, code_of, plain, write_bytes, write_json
from splatsoil.inverse.evaluations import EvaluationStore
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.quiet import hush
from splatsoil.report.data import estimates
from splatsoil.report.text import NOTHING_MOVES, symbol
from splatsoil.run_files import COMPARISON_FORMAT

if TYPE_CHECKING:
    from splatsoil.commands._workers import Workers
    from splatsoil.experiment.base import Experiment
    from splatsoil.inverse.criticism.design import Prior
    from splatsoil.inverse.criticism.diagnosis import Diagnosis
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.evaluations import EvaluationRecord
    from splatsoil.measurement import Measurement
    from splatsoil.model import Model

#: Share of the search in a fit's time.
SEARCH = 0.5


def prepare(options: FitOptions) -> tuple[Measurement, RunFolder]:
    """The checked set and its run folder; prints the resources of the fit. Nothing is written before all checks pass.

    Raises:
        MeasurementError, ParameterError, RunError: a check fails.
    """
    from splatsoil.measurement import Measurement
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    check_evaluations(options.budget)
    check_seed(options.seed)
    effects = find_effects(options.effects)
    device = resolve_device(options.device)
    measurement = Measurement.load(options.set)
    print_remarks(measurement)
    known = [p.name for p in Law(effect.for_measurement(measurement) for effect in effects).parameters]
    unknown = [name for name in options.parameters if name not in known]
    if unknown:
        raise ParameterError(f"--parameters: unknown {', '.join(unknown)}; this model has {', '.join(known)}")
    if not measurement.frames:
        raise MeasurementError("has no video frames from 0 on: there is nothing to compare with", file=options.set)
    simulations = (options.budget or EVALUATIONS * max(1, len(options.parameters))) + COMPARISON
    pictures = needs(measurement, options.preset, device, simulations, particles=1)
    check_memory(pictures, device, options.set)  # the amount of soil is not known yet
    whole = needs(measurement, options.preset, device, simulations)
    check_time(whole, device, measurement)
    print(whole.sentence(device), file=sys.stderr)
    run = RunFolder.prepare(
        options.folder(measurement.name),
        measurement={"name": measurement.name, "folder": str(measurement.folder.resolve()), "hash": measurement.hash},
        preset=options.preset,
        seed=options.seed,
        version=__version__,
    )
    run.check_writable()
    return measurement, run


def fitted(options: FitOptions, begin: Stage) -> tuple[RunFolder, Model, dict[str, Any]]:
    """From a set to its fit: run folder, model, and contents of ``fit.json``. Existing results are not computed again.

    Raises:
        MeasurementError, ParameterError, RunError: see `prepare`.
    """
    hush()
    begin("check")("reading every image", 0.0)
    measurement, folder = prepare(options)
    device = resolve_device(options.device)
    reconstruction = _model.reconstructed(measurement, folder, device, begin("reconstruct"))
    model = _model.model_on(measurement, folder, reconstruction, options.effects, options.preset, device)
    return folder, model, run_fit(options, folder, model, begin("fit"))


def facts(model: Model) -> dict[str, str]:
    """Resolution of a model, for the reader."""
    r, cameras = model.resolution, len(model.measurement.cameras)
    return {
        "cell": f"{1e3 * r.cell:.3g} mm",
        "particles": f"{len(model.particles(0))}, {1e3 * r.spacing:.3g} mm apart",
        "time step": f"{1e3 * r.frame_time / r.steps:.3g} ms, in {r.substeps(r.steps)} substeps",
        "compared frames": f"{len(model.frames) - 1}" + (f" of each of {cameras} cameras" if cameras else ""),
    }


def run_fit(options: FitOptions, run: RunFolder, model: Model, report: Report) -> dict[str, Any]:
    """Search, then compare the base with the discrepancy model. Stored simulations are not repeated."""
    from splatsoil.envs.measured import LOSS, MeasuredProblem
    from splatsoil.experiment.base import Run
    from splatsoil.inverse.fitting import BATCH_SIZE, FitSetup, fit

    measurement, space = model.measurement, model.space(options.parameters or None)
    budget = options.budget or EVALUATIONS * len(space)
    need = needs(measurement, options.preset, model.device, budget, particles=len(model.particles(0)))
    check_memory(need, model.device, measurement.folder)
    setup = FitSetup(
        measurement=measurement.hash,
        reconstruction=reconstruction_digest(model.reconstruction),
        parameters=space.names,
        effects=options.effects,
        preset=options.preset,
        device=model.device,
        seed=options.seed,
        version=__version__,
        code=code_of(options.effects),
        loss=LOSS,
    )
    report("reading the video", 0.0)
    spec = ModelSpec(tuple(options.effects), options.preset, space.names)
    experiment, simulate = experiment_of(run, model, spec, ())
    problem = MeasuredProblem(experiment)
    finished = 0

    def evaluated(done: int, record: EvaluationRecord) -> None:
        nonlocal finished
        finished = done
        if record.loss is not None:
            simulate.store(problem.features(record.blocks), Run(record.parameters, seed=record.seed))
        values = ", ".join(f"{p.name} {record.parameters[p.name]:.4g}{symbol(p.unit)}" for p in space)
        outcome = "failed" if record.loss is None else f"loss {record.loss:.4g}"
        report(f"{done} of {budget}: {values}, {outcome}", SEARCH * done / budget)

    def simulating(frame: int, last: int) -> None:
        share = min((finished + BATCH_SIZE * frame / (last + 1)) / budget, 1.0)
        report(f"simulation {finished + 1}, frame {frame}", SEARCH * share)

    def comparing(what: str, share: float) -> None:
        report(what, SEARCH + (1.0 - SEARCH) * share)

    def compared(found: dict[str, Any]) -> Diagnosis:
        experiment.progress = None
        with _workers.Workers(run, model.device, ()) as workers, workers.simulating(spec, experiment, simulate):
            return compare_models(experiment, simulate, found, comparing, options.seed, with_effects=False)

    experiment.progress = simulating
    return fit(problem, run, setup, budget=budget, facts=facts(model), compare=compared, after_evaluation=evaluated)


def draw_comparison(run: RunFolder, model: Model, report: Report) -> dict[str, Any]:
    """Simulate at the latest fit's estimate; write pictures and losses of every frame into ``comparison/``."""
    from splatsoil.comparison import GAIN, Comparator
    from splatsoil.envs.measured import LOSS
    from splatsoil.experiment.forces import force_record
    from splatsoil.experiment.heights import CHANNEL, Heights

    with run.lock():
        result = run.fit()
        values = estimates(result)
        report("reading the video", 0.0)
        made = model.reconstruction
        comparator = Comparator(
            model.measurement, surface=made.surface, frames=model.frames, surroundings=made.standing
        )
        began = time.perf_counter()
        prediction = model.predict(values, 0, by_frame(report, 0.9))
        comparison = comparator.compare(prediction.images)
        noise = 0.0 if without_noise(model.measurement) else comparator.noise
        report("writing pictures", 0.95)
        shown = [
            (*key, comparator.pictures(prediction.images, *key), comparison.losses[key]) for key in comparator.keys
        ]
        heights = Heights.of(model.measurement, comparator, [[i] for i in range(len(comparator.frames))])
        if heights is not None:
            left = heights.losses(prediction.surfaces)
            shown += [(CHANNEL, f, heights.pictures(prediction.surfaces, f), loss) for f, loss in left.items()]
        frames: list[dict[str, Any]] = []
        for camera, frame, pictures, loss in shown:
            names = {kind: f"{camera}_{frame:04d}_{kind}.jpg" for kind in pictures}
            for kind, picture in pictures.items():
                write_jpeg(run.comparison / names[kind], picture)
            rgb = float(np.mean((pictures["observed"] - pictures["predicted"]) ** 2))
            losses = {LOSS: loss, "rgb": comparison.rgb_mse.get((camera, frame), rgb)}
            frames.append({"camera": camera, "frame": frame, "losses": losses, **names})
        # The total is that of heights where there are no pictures.
        counted = [f for f in frames if f["camera"] in (comparator.cameras or (CHANNEL,))]
        if heights is not None and not comparator.cameras:
            noise = heights.noise_loss
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
            "total": {key: float(np.mean([f["losses"][key] for f in counted])) for key in (LOSS, "rgb")},
            "noise": {} if noise is None else {LOSS: noise},
            "motionless": {LOSS: NOTHING_MOVES},
            "gain": GAIN,
            "cameras": list(dict.fromkeys(f["camera"] for f in frames)),
            "frames": frames,
            "force": force_record(model.measurement, comparator.frames, prediction.trajectory.force),
            "seconds": round(time.perf_counter() - began, 1),
        }
        write_json(run.comparison / "comparison.json", data)
    return data


def without_noise(measurement: Measurement) -> bool:
    """Whether frames before the tool moves are identical: then they are rendered, not photographed."""
    still = measurement.pre_roll
    first = {name: measurement.video_frame(name, measurement.frames[0]).image() for name in measurement.cameras}
    return bool(still) and all(np.array_equal(f.image(), first[f.camera_name]) for f in still)


def write_jpeg(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3), clipped to [0, 1], as a JPEG file."""
    from PIL import Image

    stream = io.BytesIO()
    pixels = np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, format="JPEG", quality=90)
    write_bytes(path, stream.getvalue())


def interrupted(options: FitOptions) -> str:
    """The message after Ctrl-C: what an interrupted fit has stored."""
    from splatsoil.measurement import Measurement

    try:
        folder = options.run or options.folder(Measurement.load(options.set).name)
        with EvaluationStore(folder / "evaluations.db", writable=False) as store:
            count = len(store.records())
    except (RunError, MeasurementError):
        return "no evaluation has been finished; go on with"
    return f"{count} evaluation{'s are' if count != 1 else ' is'} kept in {folder}; go on with"


def run_diagnosis(
    folder: RunFolder, model: Model, begin: Stage, effects: Iterable[str] = (), *, workers: Workers | None = None
) -> dict[str, Any]:
    """Compare the latest fit's model with models of one more effect; write ``diagnosis.json`` and
    ``diagnoses/NAME.json``. ``workers`` are running processes for these effects."""
    result = _compared_models(folder, model, begin("diagnose"), tuple(effects), workers, with_effects=True)
    write_json(folder.path / "diagnoses" / f"{result['fit']}.json", result)
    write_json(folder.path / "diagnosis.json", result)
    return result


def check_adequacy(
    folder: RunFolder, model: Model, report: Report, *, workers: Workers | None = None
) -> dict[str, Any]:
    """Test whether the latest fit's model is adequate; write ``comparison/misfit.json``. ``workers`` are running
    processes without effects."""
    from splatsoil.inverse.criticism.record import misfit_of

    result = misfit_of(_compared_models(folder, model, report, (), workers, with_effects=False))
    write_json(folder.comparison / "misfit.json", result)
    return dict(plain(result))


def _compared_models(
    folder: RunFolder,
    model: Model,
    report: Report,
    effects: tuple[str, ...],
    workers: Workers | None,
    *,
    with_effects: bool,
) -> dict[str, Any]:
    from splatsoil.inverse.criticism.next_stroke import posterior_draws
    from splatsoil.inverse.criticism.record import record

    began = time.perf_counter()
    fit, seed = folder.fit(), folder.description["seed"]
    spec = ModelSpec.of(fit)
    experiment, simulate = experiment_of(folder, model, spec, (effects or None) if with_effects else ())
    with (
        folder.lock(),
        _workers.Workers(folder, model.device, effects) if workers is None else nullcontext(workers) as mine,
        mine.simulating(spec, experiment, simulate),
    ):
        found = compare_models(experiment, simulate, fit, report, seed, with_effects=with_effects)
    return {
        **record(experiment, found, simulate.requested),
        "draws": posterior_draws(found.evidence, seed),
        "candidates": list(effects),
        "fit": fit["name"],
        "values": estimates(fit),
        "preset": model.preset,
        "device": model.device,
        "version": __version__,
        "code": code_of((*spec.effects, *effects)),
        "criticism_code": code_digest(CRITICISM),
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "simulated_now": simulate.simulated,
    }


def compare_models(
    experiment: Experiment,
    simulate: Simulations,
    fit: Mapping[str, Any],
    report: Report,
    seed: int,
    *,
    with_effects: bool,
) -> Diagnosis:
    """Compare a fit's model with the discrepancy model and, ``with_effects``, with models of one more effect.

    ``fit`` holds the contents of ``fit.json``; the comparison uses its simulations.

    Raises:
        SimulationError: too few simulations of the base model succeeded.
    """
    from splatsoil.experiment.base import Run
    from splatsoil.inverse.criticism.diagnosis import diagnose

    at = "", 0.0

    def progress(what: str, share: float) -> None:
        nonlocal at
        at = what, share
        report(what, share)

    simulate.report = lambda purpose: report(f"{at[0]}, {simulate.simulated + 1}: {purpose.replace('_', ' ')}", at[1])
    return diagnose(
        experiment,
        {name: entry["estimate"] for name, entry in fit["minimum"].items()},
        simulate=simulate,
        effects=with_effects,
        seed=seed,
        known=[Run(step["parameters"], seed=step["seed"]) for step in fit["history"] if step["status"] == "ok"],
        prior=prior_of(experiment, fit),
        progress=progress,
    )


def prior_of(experiment: Experiment, fit: Mapping[str, Any]) -> Prior:
    """The prior of the parameters, given the interval of a fit's search."""
    from splatsoil.inverse.criticism.design import Prior

    low, high = ({name: entry[end] for name, entry in fit["minimum"].items()} for end in ("low", "high"))
    return Prior.of(experiment, low, high)
