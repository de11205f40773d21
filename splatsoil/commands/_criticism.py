"""Stages of criticism: misfit, diagnosis, an effect tried, and what of these is kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from splatsoil.commands._experiments import experiment_of
from splatsoil.errors import ParameterError, RunError

if TYPE_CHECKING:
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._progress import Report
    from splatsoil.inverse.criticism.diagnosis import Options
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model


def _team(
    crew: Crew | None, folder: RunFolder, device: str, effects: Iterable[str], control: bool
) -> AbstractContextManager[Crew]:
    """Helpers that are there already, or new ones: asked for by who holds the folder's lock."""
    from splatsoil.commands._crew import Crew

    return Crew(folder, device, effects, control=control) if crew is None else nullcontext(crew)


def diagnosed(
    folder: RunFolder,
    model: Model,
    options: Options,
    begin: Callable[[str], Report],
    effects: Iterable[str] = (),
    *,
    with_replay: bool = True,
    crew: Crew | None = None,
) -> dict[str, Any]:
    """Diagnose the latest fit; the result is ``diagnosis.json`` and, by model, ``diagnoses/NAME.json``.

    ``crew`` are processes for these effects that are there already.
    """
    from splatsoil import __version__
    from splatsoil.commands._control import calibrated, control, judged_by
    from splatsoil.files import write_json
    from splatsoil.inverse.criticism.diagnosis import diagnose
    from splatsoil.inverse.criticism.evidence import gather
    from splatsoil.inverse.criticism.record import record
    from splatsoil.report.data import estimates

    began = time.perf_counter()
    fit = folder.fit()
    experiment, simulate = experiment_of(folder, model, tuple(effects) or None)
    share, purpose, report = 0.0, "", begin("diagnose")

    def say(what: str) -> None:
        report(what, share)

    def told(what: str, done: float) -> None:
        nonlocal share
        share = done
        report(purpose or what, share)

    def starting(what: str) -> None:
        nonlocal purpose
        purpose = f"simulation {simulate.made + 1}: {what}"
        report(purpose, share)

    simulate.told = starting
    values = estimates(fit)
    with (
        folder.lock(),
        _team(crew, folder, model.device, effects, with_replay) as mine,
        mine.helping(experiment, simulate) as helper,
    ):
        replays = control(folder, experiment, simulate, helper, say) if with_replay else None
        simulate.ahead(lambda ask: gather(experiment, ask, values, repeats=options.repeats))
        say("where soil plays no part")
        calibration = calibrated(folder, experiment, simulate, values)
        found = diagnose(
            experiment,
            values,
            simulate=simulate,
            options=options,
            replays=replays,
            calibration=calibration,
            progress=told,
        )
        result = {
            **record(experiment, found),
            "fit": fit["name"],
            "preset": model.preset,
            "device": model.device,
            "version": __version__,
            "code": simulate.identity["code"],
            "judged_by": judged_by(),
            "seed": options.seed,
            "seconds": round(time.perf_counter() - began, 1),
            "simulated_now": simulate.made,
        }
        write_json(folder.path / "diagnoses" / f"{fit['name']}.json", result)
        write_json(folder.path / "diagnosis.json", result)
    return result


def misfit(
    folder: RunFolder,
    model: Model,
    options: Options,
    report: Report,
    *,
    with_replay: bool = True,
    crew: Crew | None = None,
) -> dict[str, Any]:
    """How far the model is from the data, where and when, against the floor; kept as ``comparison/misfit.json``.

    ``crew`` are processes for no effects that are there already.
    """
    from dataclasses import replace

    from splatsoil.commands._control import control
    from splatsoil.files import plain, write_json
    from splatsoil.inverse.criticism.diagnosis import judge
    from splatsoil.inverse.criticism.evidence import gather
    from splatsoil.inverse.criticism.record import misfit_record
    from splatsoil.report.data import estimates

    fit = folder.fit()
    experiment, simulate = experiment_of(folder, model, ())
    values = estimates(fit)
    with (
        folder.lock(),
        _team(crew, folder, model.device, (), with_replay) as mine,
        mine.helping(experiment, simulate) as helper,
    ):
        replays = None
        if with_replay:
            replays = control(folder, experiment, simulate, helper, lambda what: report(what, 0.0))
        simulate.ahead(lambda ask: gather(experiment, ask, values, repeats=options.repeats))
        evidence = gather(
            experiment,
            simulate,
            values,
            repeats=options.repeats,
            progress=lambda share: report("simulations for the floor", share),
        )
        if replays is not None:
            evidence = replace(evidence, replays=replays())
        found = judge(experiment, evidence, simulate, options=options)
        result = {**misfit_record(experiment, found), "fit": fit["name"]}
        write_json(folder.comparison / "misfit.json", result)
    return dict(plain(result))


def confirmed(folder: RunFolder, model: Model, name: str, options: Options, report: Report) -> dict[str, Any]:
    """The model as it is and with one effect (by name, or from its file), each refitted on every other frame."""
    from dataclasses import replace

    from splatsoil.commands._control import calibrated, control
    from splatsoil.files import plain
    from splatsoil.inverse.criticism.confirmation import confirm
    from splatsoil.inverse.criticism.evidence import gather
    from splatsoil.inverse.criticism.looks import foreseen, look
    from splatsoil.inverse.criticism.own_floor import on_its_own_floor
    from splatsoil.inverse.criticism.record import confirmation
    from splatsoil.report.data import estimates

    experiment, simulate = experiment_of(folder, model, (name,))
    (effect,) = (candidate.name for candidate in experiment.candidates)
    values = estimates(folder.fit())
    with (
        folder.lock(),
        _team(None, folder, model.device, (name,), True) as mine,
        mine.helping(experiment, simulate) as helper,
    ):
        replays = control(folder, experiment, simulate, helper, lambda what: report(what, 0.0))
        simulate.ahead(lambda ask: gather(experiment, ask, values, repeats=options.repeats))
        evidence = gather(
            experiment,
            simulate,
            values,
            repeats=options.repeats,
            progress=lambda share: report("simulations", 0.7 * share),
        )
        foreseen(experiment, evidence, simulate)
        calibration = calibrated(folder, experiment, simulate, values)
        evidence = replace(evidence, replays=replays(), calibration=calibration)
        looks = look(experiment, evidence, simulate, level=options.level, seed=options.seed)
        evidence, bench = looks.evidence, looks.bench
        if effect in evidence.failed:
            raise RunError(f"{effect} cannot be added: {evidence.failed[effect]}")
        left = (experiment.observed - evidence.mean)[experiment.seen]
        found = confirm(
            experiment,
            evidence,
            bench.floor,
            list(bench.candidates),
            simulate,
            options.refit_steps,
            bench.basis,
            report,
            looks.vantage,
        )
        if found[effect].visits:
            (candidate,) = bench.candidates
            found[effect] = on_its_own_floor(experiment, evidence, found[effect], candidate, simulate, left).refit
    return {"refits": {key or "as it is": plain(confirmation(c)) for key, c in found.items()}}


def entry(fit: dict[str, Any], refit: dict[str, Any]) -> dict[str, Any]:
    """A model's line in the history: its fit on all frames, its error on frames that a refit has not seen."""
    return {
        "model": fit["name"],
        "effects": list(fit["setup"]["effects"]),
        "parameters": {
            name: {key: p[key] for key in ("estimate", "std", "unit", "title")} for name, p in fit["parameters"].items()
        },
        "loss": fit["loss"],
        "held_out": refit["held_out"],
        "floor": refit["floor"],
        "refit": dict(refit["values"]),
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


def check_budget(repeats: int, refits: int = 1, refit_steps: int = 1) -> None:
    """ParameterError for numbers that make no sense.

    Raises:
        ParameterError: see above.
    """
    if repeats < 2:
        raise ParameterError(f"--repeats: chance needs at least 2 repeats, not {repeats}")
    if refits < 1 or refit_steps < 1:
        raise ParameterError("--refits and --refit-steps: give 1 or more")


def need_fit(folder: RunFolder) -> dict[str, Any]:
    """The latest fit.

    Raises:
        RunError: there is none.
    """
    try:
        return folder.fit()
    except RunError as error:
        raise RunError(f"{error}; a diagnosis starts from a fit") from error
