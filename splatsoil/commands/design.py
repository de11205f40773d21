"""``splatsoil design``: which stroke of the tool would tell most of which model is right?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from splatsoil.commands._options import RunOptions
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.commands._experiments import Chosen
    from splatsoil.commands._progress import Report, Stage
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.experiment.strokes import Stroke
    from splatsoil.inverse.criticism.next_stroke import Information
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.measurement import ToolMotion
    from splatsoil.model import Model


@dataclass(frozen=True)
class Config(RunOptions):
    """Propose the stroke of the tool that is expected to tell most of which model is right.

    Starts from a diagnosis. Simulates its probable models under other motions of the tool; the best one is written as
    the tool_motion.csv of a measurement set. Simulations are kept: an interrupted design goes on.
    """

    draws: int = 8
    """Simulations of each model and motion."""
    preset: Literal["tiny", "small", "paper", "fine"] = "tiny"
    """How finely to simulate; differences between models are looked at, for which the coarsest will do."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Simulate other strokes; the result goes into ``design/`` of the run folder."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.errors import ParameterError
    from splatsoil.files import check_folder
    from splatsoil.inverse.criticism.next_stroke import FEWEST, KEPT, probable
    from splatsoil.quiet import hush

    if not FEWEST <= config.draws <= KEPT:
        raise ParameterError(f"--draws: between {FEWEST} and {KEPT} simulations, not {config.draws}")
    folder = stage.opened(config)
    criticism.need_fit(folder)
    diagnosis = diagnosis_of(folder)
    probable(diagnosis)  # refused before the rest is loaded
    folder.check_writable()
    check_folder(folder.path / "design")
    hush()
    device = resolve_device(config.device)
    stage.note_other_sources(folder)
    with stages(quiet=config.json) as begin:
        result = _designed(config, folder, diagnosis, device, begin)
    if config.json:
        print_json({"ok": True, "run": str(folder.path), **result})
    else:
        show(result)
        print(f"kept in {folder.path / 'design'}")
    return 0


def interrupted(config: Config) -> str:
    """Simulations are kept one by one."""
    again = config.again(
        "design",
        ("--draws", config.draws, 8),
        ("--preset", config.preset, "tiny"),
        ("--device", config.device, "auto"),
        ("--json", config.json, False),
    )
    return f"finished simulations are kept; go on with: {again}"


def diagnosis_of(folder: RunFolder) -> dict[str, Any]:
    """The diagnosis of the latest fit.

    Raises:
        RunError: there is none, or it is of another fit or by other code.
    """
    import shlex

    from splatsoil.commands._control import code_of, judged_by
    from splatsoil.errors import RunError
    from splatsoil.report.data import estimates
    from splatsoil.run_files import DIAGNOSIS_FORMAT, read_kept

    fit, path = folder.fit(), folder.path / "diagnosis.json"
    make = f"make one first: splatsoil diagnose {shlex.quote(str(folder.path))}"
    if not path.is_file():
        raise RunError(f"{folder.path}: has no diagnosis; {make}")
    data = read_kept(path, DIAGNOSIS_FORMAT)
    same = data["values"] == estimates(fit) and data.get("judged_by") == judged_by() and "draws" in data
    if not same or data["code"] != code_of((*fit["setup"]["effects"], *data["candidates"])):
        raise RunError(f"{folder.path}: its diagnosis is of another fit, or by other code; {make}")
    return data


@dataclass(frozen=True)
class _Design:
    """What strokes are compared by.

    Attributes:
        folder: the run.
        model: of the measured stroke.
        chosen: what makes it.
        measured: the experiment of that stroke.
        kept: its simulations.
        diagnosis: what ``diagnosis.json`` holds.
        probability: of the models to be told apart.
        draws: parameters of each, and of the model as it is.
    """

    folder: RunFolder
    model: Model
    chosen: Chosen
    measured: PlowExperiment
    kept: Simulations
    diagnosis: Mapping[str, Any]
    probability: Mapping[str, float]
    draws: Mapping[str, Sequence[Mapping[str, float]]]

    @classmethod
    def of(cls, folder: RunFolder, model: Model, chosen: Chosen, diagnosis: Mapping[str, Any], draws: int) -> _Design:
        from splatsoil.commands._experiments import experiment_of
        from splatsoil.inverse.criticism.evidence import AS_IT_IS
        from splatsoil.inverse.criticism.next_stroke import probable

        measured, kept = experiment_of(folder, model, chosen, diagnosis["candidates"] or None)
        probability = probable(diagnosis)
        drawn = {name: diagnosis["draws"][name][:draws] for name in dict.fromkeys((AS_IT_IS, *probability))}
        return cls(folder, model, chosen, measured, kept, diagnosis, probability, drawn)

    def expected(self, stroke: Stroke, report: Report) -> tuple[Information, int]:
        """What a stroke is expected to tell, and how many new simulations and drawings that took."""
        from concurrent.futures import Future
        from contextlib import nullcontext

        from splatsoil.commands._stages import model_on
        from splatsoil.experiment.strokes import StrokeExperiment
        from splatsoil.files import code_digest
        from splatsoil.inverse.criticism.next_stroke import expected_information, runs_of
        from splatsoil.inverse.criticism.simulations import Helpers, Simulations
        from splatsoil.inverse.evaluations import digest

        seed, chosen, model = int(self.folder.description["seed"]), self.chosen, self.model
        measurement = stroke.prepared(self.measured)
        other = model_on(measurement, self.folder, model.reconstruction, chosen.effects, chosen.preset, model.device)
        experiment = StrokeExperiment(other, self.measured, self.diagnosis["candidates"] or None)
        motion = table(stroke.measurement.tool.motion)
        identity = {
            **self.kept.identity,
            "stroke": digest({"motion": motion, "rate": stroke.measurement.frame_rate, "start": stroke.start}),
            "strokes": code_digest(("experiment/strokes.py",)),
            "layout": list(experiment.layout.shape),
        }
        runs = [run for mine in runs_of(self.draws, seed).values() for run in mine]
        simulate = Simulations(experiment, self.kept.folder, identity, sources=self.kept.sources)
        count = len(runs) + len(experiment.guesses) + len(experiment.redrawn)
        simulate.told = lambda purpose: report(purpose.replace("_", " "), simulate.asked / count)
        # A GPU makes several at a time, all of them in this process.
        batch = Helpers(lambda jobs: Future(), experiment.together, experiment.prepare)
        with simulate.helped(batch) if experiment.together > 1 else nullcontext():
            simulate.ahead(lambda ask: [ask(**run.arguments()) for run in runs])
            found = expected_information(
                experiment, self.draws, self.probability, simulate, numerics=self.diagnosis["numerics"], seed=seed
            )
        return found, simulate.made


def _designed(
    config: Config, folder: RunFolder, diagnosis: Mapping[str, Any], device: str, begin: Stage
) -> dict[str, Any]:
    """The strokes, the most informative first; kept in ``design/``."""
    import time

    import numpy as np

    from splatsoil import __version__
    from splatsoil.commands import _experiments as experiments
    from splatsoil.errors import SimulationError
    from splatsoil.experiment.strokes import strokes
    from splatsoil.files import write_json, write_text
    from splatsoil.inverse.criticism.next_stroke import entropy
    from splatsoil.run_files import DESIGN_FORMAT

    began = time.perf_counter()
    chosen = replace(experiments.Chosen.of(folder.fit()), preset=config.preset)
    model = experiments.model_of(folder, device, begin("reconstruct"), chosen=chosen)
    report = begin("design")
    report("light and colours", 0.0)
    model.scene()  # kept: in other strokes the tool may begin elsewhere than photographs show it
    design = _Design.of(folder, model, chosen, diagnosis, config.draws)
    proposed = {s.name: s for s in strokes(model.measurement, float(np.nanmean(model.reconstruction.surface.height)))}
    found: dict[str, Information] = {}
    notes, made = [], 0
    with folder.lock():
        for number, (name, stroke) in enumerate(proposed.items()):

            def told(what: str, share: float, number: int = number, name: str = name) -> None:
                report(f"{name}, {what}", (number + share) / len(proposed))

            try:
                found[name], new = design.expected(stroke, told)
                made += new
            except SimulationError as error:
                notes.append(f"{name}: {error}")
        if not found:
            raise SimulationError(f"no stroke could be simulated ({notes[0]})")
        order = sorted(found, key=lambda name: -found[name].mean)
        best = found[order[0]]
        result = {
            "format": DESIGN_FORMAT,
            "fit": diagnosis["fit"],
            "models": dict(design.probability),
            "most": entropy(design.probability),
            "stroke": order[0],
            "strokes": [
                {
                    "name": name,
                    "bits": found[name].mean,
                    "std": found[name].std,
                    "told_apart": [list(pair) for pair in found[name].told_apart],
                    "pairs": [[*pair, right] for pair, right in found[name].pairs.items()],
                    "less_than_best": best.beyond(found[name]),
                }
                for name in order
            ],
            "draws": config.draws,
            "preset": config.preset,
            "device": device,
            "version": __version__,
            "seed": folder.description["seed"],
            "notes": notes,
            "simulated_now": made,
            "seconds": round(time.perf_counter() - began, 1),
        }
        motion = proposed[order[0]].motion(model.measurement.frame_rate)
        write_text(folder.path / "design" / "tool_motion.csv", table(motion))
        write_json(folder.path / "design" / "design.json", result)
    return result


def table(motion: ToolMotion) -> str:
    """A motion as a measurement set's ``tool_motion.csv``."""
    import numpy as np

    from splatsoil.measurement.motion import MOTION_COLUMNS

    rows = np.column_stack([motion.times, motion.positions, motion.quaternions])
    lines = [
        ",".join([str(frame), *(repr(float(v)) for v in row)])
        for frame, row in zip(motion.frames.tolist(), np.round(rows, 9), strict=True)
    ]
    return "\n".join([",".join(MOTION_COLUMNS), *lines]) + "\n"


def show(result: Mapping[str, Any]) -> None:
    """The strokes, what each is expected to tell, and which to make."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import listed, model_label

    console = Console(highlight=False)
    models = listed([f"{model_label(name)} ({100.0 * p:.0f} %)" for name, p in result["models"].items()])
    console.print(f"models: {escape(models)}; to be told at most: {result['most']:.2f} bits")
    shown = Table(title="the next stroke", title_justify="left", box=SIMPLE_HEAD)
    for column in ("motion", "expected information", "would tell apart"):
        shown.add_column(column, justify="right" if column == "expected information" else "left")
    for stroke in result["strokes"]:
        pairs = [f"{model_label(a)} from {model_label(b)}" for a, b in stroke["told_apart"]]
        shown.add_row(
            escape(stroke["name"]), f"{stroke['bits']:.2f} ± {stroke['std']:.2f} bits", escape("; ".join(pairs) or "–")
        )
    console.print(shown)
    console.print(escape(sentence(result)))
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    console.print(f"{result['simulated_now']} new simulations and drawings, {result['seconds']:.0f} s")


def sentence(result: Mapping[str, Any]) -> str:
    """Which stroke, and over which others that can be said."""
    from splatsoil.report.words import listed

    first, *others = result["strokes"]
    alike = [s["name"] for s in others if not s["less_than_best"]]
    said = f"Most is expected of the stroke {first['name']}: {first['bits']:.2f} ± {first['std']:.2f} bits"
    if not others:
        return f"{said}."
    if not alike:
        return f"{said}, more than of any other."
    return f"{said}; by these simulations it is not better than {listed(alike)}."
