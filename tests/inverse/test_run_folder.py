from __future__ import annotations

from pathlib import Path

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.errors import RunError
from splatsoil.files import read_json

MEASUREMENT = {"name": "plow", "folder": "sets/plow", "hash": "a" * 64}


def prepare(path: Path, **changes: object) -> RunFolder:
    options: dict = {"measurement": MEASUREMENT, "preset": "tiny", "seed": 0, "version": "1"} | changes
    return RunFolder.prepare(path, **options)


def test_a_run_says_what_it_is_for(tmp_path: Path) -> None:
    made = prepare(tmp_path / "deep" / "run")
    again = RunFolder.open(tmp_path / "deep" / "run")
    assert again.description == made.description
    assert again.description["measurement"] == MEASUREMENT
    assert prepare(tmp_path / "deep" / "run").description == made.description


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"measurement": MEASUREMENT | {"hash": "b" * 64}}, "another measurement set .plow."),
        ({"preset": "small"}, "preset tiny, not small"),
        ({"seed": 1}, "seed 0, not 1"),
    ],
)
def test_another_experiment_is_refused(tmp_path: Path, changes: dict[str, object], says: str) -> None:
    prepare(tmp_path / "run")
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(RunError, match=says):
        prepare(tmp_path / "run", **changes)
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_a_folder_with_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match="isn't a run folder"):
        prepare(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "other/1"}', '{"format": "splatsoil-run/1"}'])
def test_a_broken_description_gets_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run\.json"):
        RunFolder.open(tmp_path)


def test_opening_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such run folder"):
        RunFolder.open(tmp_path / "nothing")
    with pytest.raises(RunError, match=r"`splatsoil fit SET --run '.*/not here'`"):
        RunFolder.open(tmp_path / "not here")
    with pytest.raises(RunError, match=r"no run\.json"):
        RunFolder.open(tmp_path)


def test_the_latest_fit_and_the_earlier_ones(tmp_path: Path) -> None:
    run = prepare(tmp_path)
    with pytest.raises(RunError, match="no fit"):
        run.fit()
    empty = {"format": "splatsoil-fit/2", "parameters": {}, "minimum": {}, "history": []}
    first, second = (
        {**empty, "name": name, "setup": {"effects": [], "preset": "tiny"}} for name in ("base", "cohesion")
    )
    run.write_fit("base", first)
    run.write_fit("cohesion", second)
    assert run.fit() == second
    assert read_json(tmp_path / "fits" / "base.json") == first


def test_a_run_that_another_process_writes_into_is_not_writable(tmp_path: Path) -> None:
    run = prepare(tmp_path)
    run.check_writable()
    with run.lock(), pytest.raises(RunError, match="another process is writing"):
        run.check_writable()
    (tmp_path / "comparison").write_text("in the way")
    with pytest.raises(RunError, match="comparison"):
        run.check_writable()
