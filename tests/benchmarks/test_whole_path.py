"""``splatsoil benchmark whole-path``: its table, the page it writes into, and its parts on few particles."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
from splatsoil.benchmarks import whole_path
from splatsoil.benchmarks.whole_path import BEGIN, END, Row, Task, table, written

from splatsoil.cli import main as command_line
from splatsoil.errors import RunError

MADE = {
    "made": "2026-01-02T03:04:05", "splatsoil": "0.1.0", "code": "abc", "processor": "a processor", "cores": "2",
    "memory": "8 GiB", "system": "Linux", "load": "0.0",
}  # fmt: skip


def tiny(plow_dry: Path, plow_damp: Path, out: Path) -> Task:
    return Task(plow_dry, plow_damp, "tiny", 1, "cpu", out)


def test_what_misses_its_aim_is_bold() -> None:
    lines = table([Row("a", "1", "2", True), Row("b", "3", "2", False), Row("c", "4")]).splitlines()
    assert lines[2:] == ["| a | 1 | 2 |", "| b | **3** | 2 |", "| c | 4 |  |"]


def test_only_what_stands_between_the_lines_is_written() -> None:
    page = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    new = written(page, [Row("a", "1", "2", True)], MADE)
    assert new.startswith(f"before\n{BEGIN}\n| | measured | aim |") and new.endswith(f"{END}\nafter\n")
    assert "old" not in new and "| a | 1 | 2 |" in new and "On 2026-01-02: a processor" in new
    assert written(new, [Row("a", "1", "2", True)], MADE) == new
    with pytest.raises(RunError, match="no lines"):
        written("some other page", [], MADE)


def test_the_measurements_have_a_place_for_the_table() -> None:
    page = Path(__file__).parents[2] / "docs" / "measurements.md"
    assert "| a | 1 |" in written(page.read_text(encoding="utf-8"), [Row("a", "1")], MADE)


def test_a_page_without_a_place_is_told_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("mine")
    assert command_line(["benchmark", "whole-path", "--page", str(page), "--out", str(tmp_path / "out")]) == 2
    assert "no lines" in capsys.readouterr().err
    assert page.read_text() == "mine" and not list((tmp_path / "out").glob("*.json"))


def test_parts_are_kept_and_put_together(
    plow_dry: Path, plow_damp: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = {"reconstruction": [Row("first", "1", "2", True)], "angle": [Row("second", "-2")]}
    done: list[str] = []

    def part(name: str) -> list[Row]:
        done.append(name)
        page.write_text(page.read_text() + "written meanwhile")
        return made[name]

    monkeypatch.setattr(whole_path, "parts", lambda task: {name: partial(part, name) for name in made})
    page = tmp_path / "page.md"
    page.write_text(f"{BEGIN}\n{END}\n")
    sets = ["--dry", str(plow_dry), "--damp", str(plow_damp)]
    words = ["benchmark", "whole-path", *sets, "--out", str(tmp_path), "--page", str(page), "--only"]
    assert command_line([*words, "angle"]) == 0
    capsys.readouterr()
    assert command_line([*words, "reconstruction", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["what"] for row in told["rows"]] == ["first", "second"]
    assert page.read_text().count("written meanwhile") == len(done)
    assert page.read_text().index("| first | 1 | 2 |") < page.read_text().index("| second | −2 |")
    assert command_line(words[:-1]) == 0
    assert done == ["angle", "reconstruction"], "what is there isn't measured again"
    assert command_line([*words, "angle"]) == 0 and done[2:] == ["angle"]


def test_what_the_solver_misses_is_seen() -> None:
    good = {"true_angle": 36.0, "best_angle": 37.5, "rmse_mm": {"50": 1.9, "199": 3.9}, "volume": (-0.01, 0.004)}
    shifts = {"half the step": 0.9, "finer cells": -1.0}
    rows = whole_path.of_solver({"sand": {**good, "shifts": shifts}}, "small")
    assert [row.met for row in rows] == [True, True]
    for change in ({"best_angle": 38.1}, {"best_angle": 33.9}, {"rmse_mm": {"50": 4.1}}, {"volume": (0.0, 0.006)}):
        assert whole_path.of_solver({"sand": {**good, "shifts": {}, **change}}, "small")[0].met is False, change
    assert whole_path.of_solver({"sand": {**good, "shifts": {"a": 0.0, "b": -1.1}}}, "small")[1].met is False


def test_what_fits_miss_is_seen(
    plow_dry: Path, plow_damp: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rows(estimates: tuple[float, ...], seconds: float, memory: int) -> list[bool | None]:
        found = iter({"parameters": {"friction_angle": {"estimate": e, "std": 0.5}}} for e in estimates)
        monkeypatch.setattr(whole_path, "_fitted", lambda *words: whole_path.Run(next(found), seconds, memory))
        return [row.met for row in whole_path.angle(tiny(plow_dry, plow_damp, tmp_path))]

    assert rows((34.1, 36.0, 37.9), 479.0, 2**31) == [True, True]
    assert rows((34.1, 36.0, 38.1), 481.0, 2**30) == [False, False]
    assert rows((33.9, 36.0, 36.0), 1.0, 2**31 + 1) == [False, False]


def test_a_command_that_fails_is_told(plow_dry: Path, plow_damp: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="budget"):
        whole_path._fitted(tiny(plow_dry, plow_damp, tmp_path), plow_dry, "run", "fit", "--budget", "0")


@pytest.mark.slow
def test_reconstruction_renderer_and_simulation_reach_their_aims_even_with_few_particles(
    plow_dry: Path, plow_damp: Path, tmp_path: Path
) -> None:
    task = tiny(plow_dry, plow_damp, tmp_path)
    rows = [*whole_path.reconstruction(task), *whole_path.simulation(task)]
    assert len(rows) == 3 and rows[2].met
    loss, raw = whole_path.renderer(task)
    least, weak, strong = (float(word) for word in loss.measured.replace("and", "against").split("against"))
    assert 0.0 < least < min(weak, strong) and loss.met == (least < 0.5 * min(weak, strong))
    assert raw.met is None
