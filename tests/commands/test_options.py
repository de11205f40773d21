"""Options: what is parsed, what help says of it, what Ctrl-C says can be pasted, and what makes no sense."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import shlex
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli
from splatsoil.commands._options import FitOptions, parse, parser_of, same_again
from splatsoil.errors import RunError
from splatsoil.options import argument, option

#: Options of each command, none of them as usual.
GIVEN = {
    "add": "'a run' cohesion 'my effects/crust.py' --set 'a set' --budget 9 --device cpu --json",
    "benchmark": "--json",
    "check": "'my set' --pictures 'drawn over' --json",
    "compare": "'a run' --set 'a set' --quick --device cpu --json",
    "design": "'a run' --set 'a set' --draws 5 --preset small --device cpu --json",
    "diagnose": "'a run' --set 'a set' --effects cohesion 'my effects/crust.py' --device cpu --json",
    "element": "--test isotropic --confining 5e4 --friction-angle 30 --with dilatancy 'my effects/crust.py' --set "
    "dilatancy_angle=9 --strain 0.1 --pressure 1e6 --records 20 --void-ratio 0.7 --young 1e7 --poisson 0.3 "
    "--strain-rate 1e-3 --depth 0.1 --matching extension --plot 'a plot.svg' --json",
    "export": "'a run' --set 'a set' --to csv ply --out 'a folder' --model diagnosis --every 5 --device cpu --json",
    "fit": "nowhere --parameters friction_angle --with cohesion --budget 9 --preset fine "
    "--device cpu --seed 2 --run 'a run' --json",
    "import": "'a folder' out --sfm --images i --scale 2 --distance a b 0.5 --tags 0.1 --known k.csv --points p.csv "
    "--up 0 -1 0 --tool t.stl mm --motion m.csv m --motion-tags t.csv --force f.csv "
    "--robot-to-world r.txt --mesh-to-flange f.txt "
    "--video 'a b.mp4=c.jpg' d.mp4=e.png --video-every 3 --clock-offset -0.5 --experiment e.json --json",
    "posterior": "runs/a --set 'a set' --checks 0 --device cpu --seed 1 --json",
    "reconstruct": "'my set' --out a/b --preset tiny --seed 3 --device cpu --holdout 0 --json",
    "report": "'a run' --set 'a set' --json",
    "run": "nowhere --parameters friction_angle --with cohesion --budget 9 --preset fine "
    "--device cpu --seed 2 --run 'a run' --no-effects --most-effects 3 --json",
    "simulate": "out --friction-angle 31.5 --with cohesion tilt --set cohesion=300 tilt_x=-2 --scene paper --depth "
    "0.09 --preset tiny --seed 4 --particle-seed 5 --views 12 --picture-scale 0.5 --device cuda:0 --like 'a set' "
    "--container heap --heights --depth-maps --json",
    "view": "'a run' --compare-with base --port 8081 --device cpu",
}


@pytest.mark.parametrize("name", sorted(cli.commands()))
def test_what_ctrl_c_says_can_be_pasted(name: str) -> None:
    """It parses to the very options that were given: all of them, or none."""
    command, given = cli.commands()[name], shlex.split(GIVEN[name])
    config = parse(name, command.Config, given)
    as_usual = [f.name for f in dataclasses.fields(config) if getattr(config, f.name) == f.default]
    assert as_usual == (["name", "arguments"] if name == "benchmark" else [])
    places = [f for f in dataclasses.fields(config) if f.default is dataclasses.MISSING]
    for each in (config, parse(name, command.Config, given[: len(places)])):
        hint = cli.after_interrupt(name, command, each)
        again = shlex.split(hint[hint.index("splatsoil ") :])
        assert again[:2] == ["splatsoil", name] and parse(name, command.Config, again[2:]) == each


def test_a_command_line_leaves_out_what_is_as_usual() -> None:
    options = FitOptions(Path("my set"), effects=("cohesion",), budget=20, seed=3)
    assert same_again("fit", options) == "splatsoil fit 'my set' --with cohesion --budget 20 --seed 3"
    assert options.folder("plow") == Path("runs/plow-small-seed3")


@dataclass(frozen=True)
class Dig:
    """Dig."""

    places: tuple[Path, ...] = argument("Where.")
    depth: float = option(1.0, "Metres.")
    count: int | None = option(None, "Holes.", name="holes")
    tool: tuple[str, float] | None = option(None, "Kind and width.", metavar="KIND METRES")
    kind: Literal["wet", "dry"] = option("dry", "100 % of one.")
    fast: bool = option(False, "In a hurry.", expert=True)


def test_words_become_values_wherever_they_stand() -> None:
    words = "--depth -2.5 a --fast --tool spade 0.2 --holes 3 --kind wet"
    assert parse("dig", Dig, words.split()) == Dig(
        (Path("a"),), depth=-2.5, count=3, tool=("spade", 0.2), kind="wet", fast=True
    )
    assert parse("dig", Dig, ["a", "--kind=dry", "b c"]) == Dig((Path("a"), Path("b c")))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("a --depth deep", "argument --depth: invalid float value: 'deep'"),
        ("a --holes 2.5", "argument --holes: invalid int value: '2.5'"),
        ("a --kind drie", "argument --kind: invalid choice: 'drie'"),
        ("a --tool spade wide", "argument --tool: could not convert string to float: 'wide'"),
        ("a --tool spade", "argument --tool: expected 2 arguments"),
        ("a --dept 2", "unrecognized argument: --dept, did you mean --depth?"),
        ("a --count 2", "unrecognized argument: --count"),
        ("", "are required: PLACES"),
    ],
)
def test_a_usage_error_is_one_line(words: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        parse("dig", Dig, words.split())
    out, err = capsys.readouterr()
    assert left.value.code == 2 and out == "" and err.count("\n") == 1
    assert says in err and err.endswith("; splatsoil dig --help lists its options\n")


def test_help_is_short_and_begins_with_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As an 80-column terminal of 40 lines shows it."""
    monkeypatch.setenv("COLUMNS", "80")
    commands = cli.commands()
    assert cli.main(["--help"]) == 0
    pages = {"": capsys.readouterr().out}
    for name, command in commands.items():
        pages[name] = parser_of(name, command.Config).format_help()
        assert not re.search(r"^  --[\w-]+(?: \S+)*\n  -", pages[name], re.MULTILINE), "each option has a text"
    for name, page in pages.items():
        assert len(page.splitlines()) <= 40 and max(map(len, page.splitlines())) <= 80, name
    listed = re.findall(r"^  ([a-z-]+) ", pages[""], flags=re.MULTILINE)
    assert listed[0] == "run" and sorted(listed) == sorted(commands)
    assert pages["run"].index("--preset") < pages["run"].index("expert:") < pages["run"].index("--budget")
    assert "[small]" in pages["run"]


DOCUMENTS = {"README.md": 4, "docs/fit.md": 5, "docs/export.md": 3, "docs/own-photographs.md": 4}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_the_commands_of_the_documents_parse(repository: Path, document: str) -> None:
    page = (repository / document).read_text(encoding="utf-8").replace("\\\n", "")
    lines = re.findall(r"^(?:\$ )?splatsoil (.+)$", "\n".join(re.findall(r"```.*?```", page, re.DOTALL)), re.MULTILINE)
    commands, parsed = cli.commands(), 0
    for line in lines:
        name, *words = [word for word in shlex.split(line, comments=True) if word != "…"]
        if name != "--help":
            parse(name, commands[name].Config, words)
            parsed += 1
    assert parsed >= DOCUMENTS[document]


#: Places in the lines of `GIVEN`, and what is put there: SET is a set, RUN a run.
PLACES = {"my set": "SET", "a set": "SET", "nowhere": "SET", "a run": "RUN", "runs/a": "RUN", "a folder": "SET/views"}
ODD = st.sampled_from(
    ["", " ", "-", "--", "-1", "0", "1", "2", "nan", "inf", "-inf", "1e400", "1e-400", "9" * 30, "0x10", "1_0", "½",
     "１", ".", "..", "/", "~", "*", "a=b", "=", "a=1=2", "--json", "--help", "-h", "--run", "--set", "--with",
     "--device", "cpu", "cuda:0", "cuda:-1", "auto", "tiny", "cohesion", "cohesion=1e3", "tilt", "friction_angle",
     "csv", "SET", "RUN", "SET/tool.stl", "RUN/fit.json", "full", "full/note.txt", "new", "a\nb", "a\0b", "\ud800",
     "ü ö", "😀", "x" * 5000, "$(touch x)", "`touch x`", "<b>", "[red]", "%s", "{0}"]
)  # fmt: skip


@st.composite
def lines(draw: st.DrawFn) -> list[str]:
    """The words of a command with all of its options, of which some are left out, doubled, moved or replaced."""
    name = draw(st.sampled_from(sorted(GIVEN)))
    words = [PLACES.get(word, word) for word in shlex.split(GIVEN[name])]
    for _ in range(draw(st.integers(1, 4))):
        how = draw(st.sampled_from(["odd", "odd", "drop", "again", "put", "swap", "cut"]))
        k = draw(st.integers(0, max(len(words) - 1, 0)))
        if how == "put" or not words:
            words.insert(k, draw(ODD))
        elif how == "odd":
            words[k] = draw(ODD)
        elif how == "drop":
            del words[k]
        elif how == "again":
            words.insert(k, words[k])
        elif how == "swap":
            words[k], words[-1] = words[-1], words[k]
        else:
            words = words[: k + 1]
    return [name, *words]


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where work would begin, it ends."""

    def begun(*_: object, **__: object) -> Any:
        raise RunError("work would begin here")

    for name in (
        "splatsoil.reconstruction.reconstruct",
        "splatsoil.commands._model.reconstructed",
        "splatsoil.commands._model.model_of",
        "splatsoil.commands._model.model_on",
        "splatsoil.synthetic.make_set",
        "splatsoil.soil.element.drive",
        "splatsoil.importing.build.import_set",
        "splatsoil.inverse.posterior.run_posterior",
    ):
        monkeypatch.setattr(name, begun)
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None if name == "viser" else there(name))


def files(place: Path) -> dict[Path, bytes | None]:
    found = (p for p in place.rglob("*") if not p.name.startswith("writer.lock"))
    return {p: p.read_bytes() if p.is_file() else None for p in found}


@settings(
    max_examples=1000,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(words=lines())
def check_lines(run: RunFolder, small_set: Path, place: Path, words: list[str]) -> None:
    words = [word.replace("SET", str(small_set)).replace("RUN", str(run.path)) for word in words]
    note(shlex.join(words))
    before, out, err = files(place), StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = cli.main(words)
        except SystemExit as left:
            code = left.code
    assert code in (0, 2, 3)
    if code == 2 and "work would begin here" not in err.getvalue():
        note(err.getvalue()[:2000])
        *stages, said = err.getvalue().splitlines()
        assert said.startswith("splatsoil: ") and not [line for line in stages if line.startswith("splatsoil: ")]
        assert files(place) == before


@pytest.mark.slow
@pytest.mark.usefixtures("idle")
def test_command_lines_begin_end_or_are_refused_in_a_sentence(
    run: RunFolder,
    fit_of: Callable[..., dict[str, Any]],
    small_set: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run.write_fit("base", fit_of())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path.parent / "state"))
    check_lines(run=run, small_set=small_set, place=tmp_path)
