"""Benchmarks of several parts: what is kept, what is written into a page, and what is refused."""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import pytest
from splatsoil.benchmarks._common import keep_to_one_protocol, with_section
from splatsoil.benchmarks._parts import Row, Section, parts_parser, run_parts

from splatsoil.errors import ParameterError, RunError, SimulationError

BEGIN = "<!-- speed: written by the command, what stands here is overwritten -->"
END = "<!-- speed: end -->"
DOCS = Path(__file__).parents[2] / "docs"


def options(*words: str) -> argparse.Namespace:
    return parts_parser("", "runs/parts").parse_args(words)


def page(folder: Path) -> Path:
    file = folder / "page.md"
    file.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    return file


def test_only_what_stands_between_the_lines_is_replaced(tmp_path: Path) -> None:
    file = page(tmp_path)
    new = with_section(file, "speed", "new")
    assert new == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    for wrong in ("mine", f"{BEGIN}\n", f"{END}\n{BEGIN}\n", new + new):
        file.write_text(wrong)
        with pytest.raises(RunError, match="has no lines"):
            with_section(file, "speed", "new")
    with pytest.raises(RunError, match="cannot be read"):
        with_section(tmp_path / "nothing.md", "speed", "new")


def test_the_documents_have_a_place_for_each_table() -> None:
    marks = {"measurements": "whole path", "validation": "validation", "information": "information tiny"}
    for name, mark in (*marks.items(), ("performance", "speed cpu"), ("performance", "speed cuda")):
        assert "a new table" in with_section(DOCS / f"{name}.md", mark, "a new table")


def test_parts_are_kept_and_put_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, done, code = page(tmp_path), list[str](), {"code": "a"}

    def part(name: str, held: bool) -> Section:
        done.append(name)
        file.write_text(file.read_text() + "written meanwhile")
        return Section(name, [Row(f"row of {name}", "1", "2", held)])

    parts = {"first": partial(part, "first", True), "second": partial(part, "second", False)}
    out = ["--out", str(tmp_path / "out")]

    def measured(*words: str) -> int:
        return run_parts(options(*out, *words), parts, lambda _: code, "speed")

    assert measured("--only", "second") == 0 and done == ["second"]
    assert "| row of second | 1 | 2 | **fails** |" in capsys.readouterr().out
    assert measured("--only", "first", "--json", "--page", str(file)) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["parts"]) == ["first"] and told["parts"]["first"]["rows"][0]["held"] is True
    written = file.read_text()
    assert written.index("### first") < written.index("### second") and "1 of 2 comparisons hold" in written
    assert written.count("written meanwhile") == 2, "what was written while parts were measured stays"
    assert measured() == 0 and done == ["second", "first"], "what is there is not measured again"
    assert measured("--again", "--only", "first") == 0 and done[2:] == ["first"]
    code["code"] = "b"
    assert measured() == 0 and done[3:] == ["first", "second"], "other code measures anew"


def test_mistakes_are_found_before_anything_is_measured_and_failures_name_their_part(tmp_path: Path) -> None:
    def failing() -> Section:
        raise SimulationError("it broke")

    def never() -> Section:
        raise AssertionError("measured")

    mine = tmp_path / "mine.md"
    mine.write_text("mine")
    out = ["--out", str(tmp_path / "out")]
    with pytest.raises(ParameterError, match="'alchemy' is not among never"):
        run_parts(options(*out, "--only", "alchemy"), {"never": never}, lambda _: {}, "speed")
    with pytest.raises(RunError, match="has no lines"):
        run_parts(options(*out, "--page", str(mine)), {"never": never}, lambda _: {}, "speed")
    assert mine.read_text() == "mine" and not (tmp_path / "out").exists()
    with pytest.raises(SimulationError, match="part failing: it broke"):
        run_parts(options(*out), {"failing": failing}, lambda _: {}, "speed")


def test_a_folder_keeps_one_protocol(tmp_path: Path) -> None:
    keep_to_one_protocol(tmp_path, {"seed": 1, "sizes": (1, 2)})
    keep_to_one_protocol(tmp_path, {"seed": 1, "sizes": (1, 2)})
    with pytest.raises(ParameterError, match="another protocol"):
        keep_to_one_protocol(tmp_path, {"seed": 2, "sizes": (1, 2)})
