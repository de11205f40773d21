"""Stages of criticism: models compared, and what of that is kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from splatsoil.commands._experiments import Chosen, experiment_of
from splatsoil.errors import RunError

if TYPE_CHECKING:
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._progress import Report
    from splatsoil.experiment.base import Experiment
    from splatsoil.inverse.criticism.design import Prior
    from splatsoil.inverse.criticism.diagnosis import Diagnosis
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model


def _team(crew: Crew | None, folder: RunFolder, device: str, effects: Iterable[str]) -> AbstractContextManager[Crew]:
    """Helpers that are there already, or new ones: asked for by who holds the folder's lock."""
    from splatsoil.commands._crew import Crew

    return Crew(folder, device, effects) if crew is None else nullcontext(crew)


def diagnosed(
    folder: RunFolder,
    model: Model,
    begin: Callable[[str], Report],
    effects: Iterable[str] = (),
    *,
    crew: Crew | None = None,
) -> dict[str, Any]:
    """Compare the latest fit's model with those that have an effect more; the result is ``diagnosis.json`` and, by
    model, ``diagnoses/NAME.json``.

    ``crew`` are processes for these effects that are there already.
    """
    from splatsoil.files import write_json

    result = _compared_models(folder, model, begin("diagnose"), tuple(effects), crew, with_effects=True)
    write_json(folder.path / "diagnoses" / f"{result['fit']}.json", result)
    write_json(folder.path / "diagnosis.json", result)
    return result


def misfit(folder: RunFolder, model: Model, report: Report, *, crew: Crew | None = None) -> dict[str, Any]:
    """Whether the latest fit's model leaves more than noise, where and when; kept as ``comparison/misfit.json``.

    ``crew`` are processes for no effects that are there already.
    """
    from splatsoil.files import plain, write_json
    from splatsoil.inverse.criticism.record import misfit_of

    result = misfit_of(_compared_models(folder, model, report, (), crew, with_effects=False))
    write_json(folder.comparison / "misfit.json", result)
    return dict(plain(result))


def _compared_models(
    folder: RunFolder,
    model: Model,
    report: Report,
    effects: tuple[str, ...],
    crew: Crew | None,
    *,
    with_effects: bool,
) -> dict[str, Any]:
    from splatsoil import __version__
    from splatsoil.commands._control import code_of, judged_by
    from splatsoil.inverse.criticism.next_stroke import posterior_draws
    from splatsoil.inverse.criticism.record import record
    from splatsoil.report.data import estimates

    began = time.perf_counter()
    fit, seed = folder.fit(), folder.description["seed"]
    chosen = Chosen.of(fit)
    experiment, simulate = experiment_of(folder, model, chosen, (effects or None) if with_effects else ())
    with (
        folder.lock(),
        _team(crew, folder, model.device, effects) as mine,
        mine.helping(chosen, experiment, simulate),
    ):
        found = judged(experiment, simulate, fit, report, seed, with_effects=with_effects)
    return {
        **record(experiment, found, simulate.asked),
        "draws": posterior_draws(found.evidence, seed),
        "candidates": list(effects),
        "fit": fit["name"],
        "values": estimates(fit),
        "preset": model.preset,
        "device": model.device,
        "version": __version__,
        "code": code_of((*chosen.effects, *effects)),
        "judged_by": judged_by(),
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "simulated_now": simulate.made,
    }


def judged(
    experiment: Experiment,
    simulate: Simulations,
    fit: Mapping[str, Any],
    report: Report,
    seed: int,
    *,
    with_effects: bool,
) -> Diagnosis:
    """A fit's model against something else, and against models with an effect more; it starts from what the search has
    found and simulated.

    Args:
        experiment: of the model.
        simulate: its simulations.
        fit: what ``fit.json`` holds, or will hold.
        report: progress.
        seed: of the run.
        with_effects: whether effects that are off are models, too.

    Raises:
        SimulationError: the model as it is could not be simulated often enough.
    """
    from splatsoil.inverse.criticism.design import Run
    from splatsoil.inverse.criticism.diagnosis import diagnose

    stage, share = "", 0.0

    def told(what: str, done: float) -> None:
        nonlocal stage, share
        stage, share = what, done
        report(stage, share)

    def starting(purpose: str) -> None:
        report(f"{stage}, {simulate.made + 1}: {purpose.replace('_', ' ')}", share)

    simulate.told = starting
    return diagnose(
        experiment,
        {name: entry["estimate"] for name, entry in fit["minimum"].items()},
        simulate=simulate,
        effects=with_effects,
        seed=seed,
        known=[Run(step["parameters"], seed=step["seed"]) for step in fit["history"] if step["status"] == "ok"],
        prior=prior_of(experiment, fit),
        progress=told,
    )


def prior_of(experiment: Experiment, fit: Mapping[str, Any]) -> Prior:
    """What is believed of the parameters beforehand, given what the search for a fit leaves possible."""
    from splatsoil.inverse.criticism.design import Prior

    low, high = ({name: entry[end] for name, entry in fit["minimum"].items()} for end in ("low", "high"))
    return Prior.of(experiment, low, high)


def entry(fit: dict[str, Any], held_out: dict[str, Any]) -> dict[str, Any]:
    """A model's line in the history: its fit, and its error on what was set aside."""
    return {
        "model": fit["name"],
        "effects": list(fit["setup"]["effects"]),
        "parameters": {
            name: {key: p[key] for key in ("estimate", "std", "unit", "title")} for name, p in fit["parameters"].items()
        },
        "loss": fit["loss"],
        "held_out": held_out["error"],
        "floor": held_out["noise"],
    }


def pictured(folder: RunFolder) -> bool:
    """Whether there are pictures at the latest fit's estimate."""
    from splatsoil.report.data import estimates
    from splatsoil.run_files import COMPARISON_FORMAT, read_kept

    path, fit = folder.comparison / "comparison.json", folder.fit()
    if not path.is_file():
        return False
    data = read_kept(path, COMPARISON_FORMAT)
    return bool(data["fit"] == fit["name"] and data["parameters"] == estimates(fit))


def keep_pictures(folder: RunFolder) -> None:
    """Put the comparison of the model before aside, so that before and after can be shown."""
    import shutil

    if not (folder.comparison / "comparison.json").is_file():
        return
    before = folder.path / "before"
    with folder.lock():
        shutil.rmtree(before, ignore_errors=True)
        folder.comparison.rename(before)


def latest_diagnosis(folder: RunFolder, effect: str) -> dict[str, Any] | None:
    """The diagnosis of the latest fit by the code as it is, an effect or its file among it, if there is one."""
    from splatsoil.commands._control import code_of, judged_by
    from splatsoil.report.data import estimates
    from splatsoil.run_files import DIAGNOSIS_FORMAT, read_kept

    fit = folder.fit()
    path = folder.path / "diagnoses" / f"{fit['name']}.json"
    if not path.is_file():
        return None
    data = read_kept(path, DIAGNOSIS_FORMAT)
    code = code_of((*fit["setup"]["effects"], effect))
    same = data.get("code") == code and data.get("judged_by") == judged_by()
    return data if same and data["values"] == estimates(fit) else None


def need_fit(folder: RunFolder) -> dict[str, Any]:
    """The latest fit.

    Raises:
        RunError: there is none.
    """
    try:
        return folder.fit()
    except RunError as error:
        raise RunError(f"{error}; a diagnosis starts from a fit") from error
