"""``splatsoil design``: the stroke with the largest expected information about which model is correct."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil import __version__
from splatsoil.commands import _model
from splatsoil.commands._options import ComputingOptions, Preset, command_line
from splatsoil.commands._output import Report, print_result, print_table, print_text
from splatsoil.errors import ParameterError, RunError, SimulationError
from splatsoil.files import check_folder, code_digest, digest, write_json, write_text
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import option
from splatsoil.report.text import listed, model_label
from splatsoil.run_files import DESIGN_FORMAT

if TYPE_CHECKING:
    from splatsoil.commands._model import ModelSpec
    from splatsoil.experiment.strokes import Stroke
    from splatsoil.inverse.criticism.next_stroke import Information
    from splatsoil.measurement import ToolMotion
    from splatsoil.model import Model

INTERRUPTED = "finished simulations are kept; go on with"


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Propose the most informative stroke of the tool.

    Simulates the probable models of a diagnosis under other motions of the tool. The motion with the largest expected
    information about which model is correct is written as a set's tool_motion.csv. An interrupted design continues.
    """

    draws: int = option(8, "Simulations of each model and motion.")
    preset: Preset = option("tiny", "Resolution; the coarsest suffices for differences between models.")


def run(config: Config) -> int:
    """Simulate other strokes; write the result into ``design/`` of the run folder."""
    from splatsoil.inverse.criticism.next_stroke import MIN_SIMULATIONS, STORED_DRAWS, probable

    if not MIN_SIMULATIONS <= config.draws <= STORED_DRAWS:
        raise ParameterError(f"--draws: between {MIN_SIMULATIONS} and {STORED_DRAWS} simulations, not {config.draws}")
    folder = _model.opened(config)
    fit = _model.latest_fit(folder)
    diagnosis = diagnosis_of(folder)
    probable(diagnosis)  # fails before the work
    folder.check_writable()
    check_folder(folder.path / "design")
    spec = replace(_model.ModelSpec.of(fit), preset=config.preset)
    with _model.loaded(config, folder, spec) as (model, begin):
        result = _designed(config, folder, diagnosis, model, spec, begin("design"))
    return print_result(config, result, lambda: show(result), last=f"kept in {folder.path / 'design'}", run=folder)


def diagnosis_of(folder: RunFolder) -> dict[str, Any]:
    """The diagnosis of the latest fit.

    Raises:
        RunError: there is none, or it is of another fit or by other code.
    """
    path, make = folder.path / "diagnosis.json", f"make one first: {command_line('diagnose', folder.path)}"
    if not path.is_file():
        raise RunError(f"{folder.path}: has no diagnosis; {make}")
    data = _model.current_diagnosis(folder, path)
    if data is None or "draws" not in data:
        raise RunError(f"{folder.path}: its diagnosis is of another fit, or by other code; {make}")
    return data


def _designed(
    config: Config, folder: RunFolder, diagnosis: Mapping[str, Any], model: Model, spec: ModelSpec, report: Report
) -> dict[str, Any]:
    """The strokes, the most informative first; written into ``design/``."""
    from splatsoil.experiment.strokes import StrokeExperiment, strokes
    from splatsoil.inverse.criticism.evidence import BASE_MODEL
    from splatsoil.inverse.criticism.next_stroke import entropy, expected_information, probable, runs_of
    from splatsoil.inverse.criticism.simulations import Executor, Simulations

    began, seed = time.perf_counter(), int(folder.description["seed"])
    if model.measurement.cameras:
        report("light and colours", 0.0)
        model.scene()  # cached; in other strokes the tool may start elsewhere than in the photographs
    candidates = diagnosis["candidates"] or None
    measured, simulations = _model.experiment_of(folder, model, spec, candidates)
    probability = probable(diagnosis)
    draws = {name: diagnosis["draws"][name][: config.draws] for name in dict.fromkeys((BASE_MODEL, *probability))}
    runs = [run for mine in runs_of(draws, seed).values() for run in mine]
    proposed = {s.name: s for s in strokes(model.measurement, float(np.nanmean(model.reconstruction.surface.height)))}
    made = 0

    def expected(number: int, stroke: Stroke) -> Information:
        """Expected information of a stroke."""
        nonlocal made
        measurement = stroke.prepared(measured)
        other = _model.model_on(measurement, folder, model.reconstruction, spec.effects, spec.preset, model.device)
        experiment = StrokeExperiment(other, measured, candidates)
        motion = {"motion": motion_csv(stroke.measurement.tool.motion), "rate": stroke.measurement.frame_rate}
        identity = {
            **simulations.identity,
            "stroke": digest({**motion, "start": stroke.start}),
            "strokes": code_digest(("experiment/strokes.py",)),
            "layout": list(experiment.layout.shape),
        }
        simulate = Simulations(experiment, simulations.folder, identity, sources=simulations.sources)
        count = len(runs) + len(experiment.albedo_draws) + len(experiment.renderings)
        simulate.report = lambda purpose: report(
            f"{stroke.name}, {purpose.replace('_', ' ')}", (number + simulate.requested / count) / len(proposed)
        )
        # A GPU simulates batches in this process.
        batch = Executor(lambda jobs: Future(), experiment.batch_size, experiment.prepare)
        with simulate.using(batch) if experiment.batch_size > 1 else nullcontext():
            simulate.prefetch(runs)
            found = expected_information(
                experiment,
                draws,
                probability,
                simulate,
                discretisation_factor=diagnosis["discretisation_factor"],
                seed=seed,
            )
        made += simulate.simulated
        return found

    found: dict[str, Information] = {}
    notes = []
    with folder.lock():
        for number, (name, stroke) in enumerate(proposed.items()):
            try:
                found[name] = expected(number, stroke)
            except SimulationError as error:
                notes.append(f"{name}: {error}")
        if not found:
            raise SimulationError(f"no stroke could be simulated ({notes[0]})")
        order = sorted(found, key=lambda name: -found[name].mean)
        best = found[order[0]]
        result = {
            "format": DESIGN_FORMAT,
            "fit": diagnosis["fit"],
            "models": dict(probability),
            "entropy": entropy(probability),
            "stroke": order[0],
            "strokes": [
                {
                    "name": name,
                    "bits": found[name].mean,
                    "std": found[name].std,
                    "distinguished": [list(pair) for pair in found[name].distinguished],
                    "pairs": [[*pair, right] for pair, right in found[name].pairs.items()],
                    "less_than_best": best.exceeds(found[name]),
                }
                for name in order
            ],
            "draws": config.draws,
            "preset": config.preset,
            "device": model.device,
            "version": __version__,
            "seed": seed,
            "notes": notes,
            "simulated_now": made,
            "seconds": round(time.perf_counter() - began, 1),
        }
        motion = proposed[order[0]].motion(model.measurement.frame_rate)
        write_text(folder.path / "design" / "tool_motion.csv", motion_csv(motion))
        write_json(folder.path / "design" / "design.json", result)
    return result


def motion_csv(motion: ToolMotion) -> str:
    """A motion as a measurement set's ``tool_motion.csv``."""
    from splatsoil.measurement.motion import MOTION_COLUMNS

    rows = np.column_stack([motion.times, motion.positions, motion.quaternions]).round(9).tolist()
    lines = [",".join([str(frame), *map(repr, row)]) for frame, row in zip(motion.frames.tolist(), rows, strict=True)]
    return "\n".join([",".join(MOTION_COLUMNS), *lines]) + "\n"


def show(result: Mapping[str, Any]) -> None:
    """Print the strokes and the proposed one."""
    models = listed([f"{model_label(name)} ({100.0 * p:.0f} %)" for name, p in result["models"].items()])
    print_text(f"models: {models}; at most {result['entropy']:.2f} bits of information")
    print_table(
        "the next stroke",
        ("motion", "expected information", "distinguishes"),
        (
            (
                stroke["name"],
                f"{stroke['bits']:.2f} ± {stroke['std']:.2f} bits",
                "; ".join(f"{model_label(a)} from {model_label(b)}" for a, b in stroke["distinguished"]) or "–",
            )
            for stroke in result["strokes"]
        ),
        left=("motion", "distinguishes"),
    )
    first, *others = result["strokes"]
    best = f"Largest expected information: {first['name']}, {first['bits']:.2f} ± {first['std']:.2f} bits"
    if alike := [s["name"] for s in others if not s["less_than_best"]]:
        best += f"; not significantly better than {listed(alike)}"
    elif others:
        best += ", significantly more than the others"
    print_text(f"{best}.", notes=result["notes"])
    print(f"{result['simulated_now']} new simulations and renderings, {result['seconds']:.0f} s")
