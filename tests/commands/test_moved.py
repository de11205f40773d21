"""A measurement set or a run folder that has moved, as all commands meet it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.commands import _model, _stages
from splatsoil.commands._options import FitOptions
from splatsoil.errors import RunError

Refused = Callable[..., str]
COMMANDS = ("compare", "diagnose", "add", "posterior", "export")


@pytest.fixture
def project(small_set: Path, tmp_path: Path, fit_of: Callable[..., dict[str, Any]]) -> Path:
    """A folder with a set and its run: ``data/set`` and ``runs/run``."""
    place = tmp_path / "project"
    shutil.move(small_set, place / "data" / "set")
    _, run = _stages.prepare(FitOptions(place / "data" / "set", preset="tiny", run=place / "runs" / "run"))
    run.write_fit("base", fit_of())
    return place


@pytest.fixture
def reaches(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders of the sets with which reconstructions were asked for."""
    found: list[Path] = []

    def asked(measurement: Any, *_: object, **__: object) -> None:
        found.append(measurement.folder)
        raise RunError("far enough")

    monkeypatch.setattr(_model, "reconstructed", asked)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_a_set_elsewhere_is_asked_for_and_then_known(
    project: Path, reaches: list[Path], refused: Refused, command: str
) -> None:
    run, new = project / "runs" / "run", project / "elsewhere" / "new"
    shutil.move(project / "data" / "set", new)
    assert f"`splatsoil report {run} --set FOLDER` notes where it is now" in refused(command, run)
    assert "far enough" in refused(command, run, "--set", new)
    assert "far enough" in refused(command, run)
    assert reaches == [new, new], "once given, it is stored"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_project_on_another_machine(
    project: Path, reaches: list[Path], tmp_path: Path, refused: Refused, command: str
) -> None:
    other = tmp_path / "other" / "machine"
    shutil.move(project, other)
    before = (other / "runs" / "run" / "run.json").read_bytes()
    assert "far enough" in refused(command, other / "runs" / "run")
    assert reaches == [other / "data" / "set"]
    assert (other / "runs" / "run" / "run.json").read_bytes() == before


def test_a_run_without_its_way_finds_a_set_beside_it(project: Path) -> None:
    """As one of an earlier version, whose set lies beside it now."""
    run = project / "runs" / "run"
    data = json.loads((run / "run.json").read_text())
    del data["way"]
    (run / "run.json").write_text(json.dumps(data))
    shutil.move(project / "data" / "set", project / "runs" / "set")
    assert _model.measurement_of(RunFolder.open(run)).folder == project / "runs" / "set"


@pytest.mark.usefixtures("reaches")
def test_a_fit_takes_the_new_place(project: Path, refused: Refused) -> None:
    run, new = project / "runs" / "run", project / "elsewhere" / "new"
    shutil.move(project / "data" / "set", new)
    assert "far enough" in refused("fit", new, "--preset", "tiny", "--run", run)
    assert _model.measurement_of(RunFolder.open(run)).folder == new


@pytest.mark.parametrize("given", [True, False])
def test_another_set_is_not_taken(project: Path, refused: Refused, given: bool) -> None:
    run, place = project / "runs" / "run", project / "data" / "set"
    before = (run / "run.json").read_bytes()
    (place / "experiment.json").write_text((place / "experiment.json").read_text().replace("1600", "1700"))
    assert "has changed since" in refused("compare", run, *(["--set", place] if given else []))
    assert (run / "run.json").read_bytes() == before
