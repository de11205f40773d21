"""Files of a run folder that are damaged or of other sources, as commands meet them: before any work."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands import _model, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.errors import RunError
from splatsoil.files import write_json

FitOf = Callable[..., dict[str, Any]]
Refused = Callable[..., str]
ALL = ("compare", "diagnose", "add", "report", "posterior")
SHOWN = ("add", "report")
FIT = '{"format": "splatsoil-fit/2", "name": "base"'
DIAGNOSIS = '{"format": "splatsoil-diagnosis/3", "fit": "base", "values": {}, "model": []'


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    ("file", "text", "says", "commands"),
    [
        ("fit.json", "{}", "isn't of format splatsoil-fit/2", ALL),
        ("fit.json", "[]", "isn't of format splatsoil-fit/2", ALL),
        ("fit.json", FIT + "}", "lacks parameters", ALL),
        ("fit.json", FIT + ', "parameters": {"a": {}}}', "lacks parameters.a.estimate", ALL),
        ("fit.json", FIT + ', "parameters": {}, "setup": {"effects": [3]}}', "lacks setup.effects.0", ALL),
        ("run.json", '{"format": "splatsoil-run/1"}', "lacks measurement", ALL),
        ("run.json", '{"format": "splatsoil-run/1", "measurement": {}}', "lacks measurement.name", ALL),
        ("run.json", '{"format": "splatsoil-run/2"}', "isn't of format splatsoil-run/1", ALL),
        ("history.json", "{}", "isn't of format splatsoil-history/2", SHOWN),
        ("history.json", '{"format": "splatsoil-history/2", "models": [{}]}', "lacks models.0.model", SHOWN),
        ("diagnoses/base.json", "{}", "isn't of format splatsoil-diagnosis/3", SHOWN),
        ("diagnoses/base.json", DIAGNOSIS + ', "models": [{"name": ""}]}', "lacks models.0.probability", SHOWN),
        ("comparison/misfit.json", "{}", "isn't of format splatsoil-misfit/3", SHOWN),
        ("comparison/comparison.json", "{}", "isn't of format splatsoil-comparison/1", SHOWN),
    ],
)
def test_json_of_another_shape_is_named_before_any_work(
    run: RunFolder, refused: Refused, file: str, text: str, says: str, commands: tuple[str, ...]
) -> None:
    (run.path / file).parent.mkdir(exist_ok=True)
    (run.path / file).write_text(text)
    for command in commands:
        said = refused(command, run)
        assert said.count("\n") == 1 and file in said and says in said, said


def test_a_page_that_lacks_something_says_so(run: RunFolder, refused: Refused) -> None:
    """A fit without its number of evaluations, say: what makes it one is there."""
    fit = run.fit()
    del fit["evaluations"]
    run.write_fit("base", fit)
    said = refused("report", run)
    assert said.count("\n") == 1 and "fit.json: is damaged, it lacks" in said


def test_a_fit_into_a_run_that_does_not_say_what_it_is_for_is_refused(
    plow_dry: Path, tmp_path: Path, refused: Refused
) -> None:
    (tmp_path / "run.json").write_text('{"format": "splatsoil-run/1"}')
    assert "run.json: is damaged, it lacks measurement" in refused("fit", plow_dry, "--run", tmp_path)


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("command", ["compare", "diagnose", "add"])
def test_what_cannot_be_written_to_is_met_before_any_work(
    run: RunFolder, refused: Refused, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    with run.lock():
        assert "another process is writing into this run folder" in refused(command, run)

    def denied(suffix: str | None = None, prefix: str | None = None, dir: Path | None = None) -> str:
        assert dir == run.path
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    # root may write anywhere
    monkeypatch.setattr(tempfile, "mkdtemp", denied)
    assert "cannot be written (Permission denied)" in refused(command, run)


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("command", ["fit", "run"])
def test_a_fit_meets_another_process_before_any_work(
    plow_dry: Path, tmp_path: Path, refused: Refused, command: str
) -> None:
    _, run = _stages.prepare(FitOptions(plow_dry, run=tmp_path))
    with run.lock():
        assert "another process is writing into this run folder" in refused(command, plow_dry, "--run", tmp_path)


def test_pictures_are_written_by_one_process_at_a_time(run: RunFolder) -> None:
    with run.lock(), pytest.raises(RunError, match="another process is writing"):
        _stages.draw_comparison(run, cast(Any, None), lambda what, share: pytest.fail("work has begun"))


def test_a_damaged_reconstruction_is_to_be_deleted(run: RunFolder) -> None:
    write_json(run.reconstruction / "reconstruction.json", {"format": "splatsoil-reconstruction/1"})
    measurement = cast(Any, SimpleNamespace(hash="a" * 64))
    with pytest.raises(RunError, match=r"delete the folder .*my run/reconstruction and run the command again"):
        _model.reconstructed(measurement, run, "cpu", lambda what, share: None)


@pytest.mark.parametrize("command", ["compare", "diagnose", "add", "report"])
@pytest.mark.parametrize("change", [{}, {"version": "0.0.1"}, {"code": "of yesterday"}], ids=str)
def test_a_fit_by_other_sources_is_said_to_be_one(
    run: RunFolder,
    refused: Refused,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    change: dict[str, str],
    fit_of: FitOf,
) -> None:
    fit = fit_of(["tilt", "exposure"], tilt_x=1.0)
    fit["setup"] |= change
    run.write_fit("tilt+exposure", fit)

    def goes_on(*_: object, **__: object) -> None:
        raise RunError("has gone on")

    monkeypatch.setattr(_model, "model_of", goes_on)
    monkeypatch.setattr("splatsoil.report.write_report", goes_on)
    *said, last = refused(command, run).splitlines()
    assert last == "splatsoil: has gone on" and len(said) == bool(change)
    if change:
        was = f"was fitted by splatsoil {fit['setup']['version']}, code {fit['setup']['code']}, and this is "
        anew = f"splatsoil fit '{run.path.parent}/my set' --parameters friction_angle tilt_x --with exposure tilt"
        assert was in said[0] and said[0].endswith(f"{anew} --preset tiny --run '{run.path}'")
