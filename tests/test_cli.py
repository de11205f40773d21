"""The command line: what all commands have in common, and ``check``."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

import splatsoil.commands
from splatsoil import cli
from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import RunError
from splatsoil.options import option


def run(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "splatsoil", *words], cwd=cwd, capture_output=True, text=True, timeout=120, check=False
    )


def test_check_shows_a_table_and_json_and_writes_nothing(
    plow_dry: Path, small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(tmp_path.rglob("*"))
    done = run("check", str(plow_dry), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for words in ("plow-dry", "0.8 x 0.5 x 0.27 m", "40 of 320 x 240 pixels", "left, right", "complete and consistent"):
        assert words in done.stdout
    assert cli.main(["check", str(plow_dry), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["ok"] is True and data["views"] == 40 and data["remarks"] == []
    assert data["video"]["pre_roll"] == [-4, -3, -2, -1] and data["bed"]["density"] == 1600.0
    # Remarks are no failure.
    assert cli.main(["check", str(small_set)]) == 0
    assert "only 4 views" in " ".join(capsys.readouterr().out.split())
    assert cli.main(["check", str(small_set), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["remarks"][0]["about"] == "views" and told["set"] == str(small_set)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("words", [["--help"], ["check"], ["check", "--json"]], ids=" ".join)
def test_a_reader_that_has_gone_is_no_error(plow_dry: Path, words: list[str]) -> None:
    """``splatsoil check SET --json | true``."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "splatsoil", *words, *([str(plow_dry)] if words[0] == "check" else [])]
    with os.fdopen(writer, "wb") as gone:
        done = subprocess.run(command, stdout=gone, stderr=subprocess.PIPE, timeout=120, check=False)
    assert done.stderr == b""


def test_a_mistake_is_one_line_without_traceback(small_set: Path) -> None:
    (small_set / "views" / "images" / "001.jpg").unlink()
    done = run("check", str(small_set))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("splatsoil: ") and done.stderr.count("\n") == 1
    assert "001.jpg" in done.stderr and "Traceback" not in done.stderr


def test_usage_errors_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2 and "usage: splatsoil COMMAND" in capsys.readouterr().err
    for words in (["check"], ["check", "a", "--nonsense"]):
        with pytest.raises(SystemExit) as left:
            cli.main(words)
        assert left.value.code == 2, words
    with pytest.raises(SystemExit) as left:
        cli.main(["check", "--help"])
    assert left.value.code == 0 and "usage: splatsoil check SET" in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"splatsoil {splatsoil.__version__}\n"


@pytest.mark.parametrize(
    ("words", "hint"),
    [(["fti", "set"], "did you mean fit?"), (["chek"], "did you mean check?"), (["xyzzy"], "no command 'xyzzy';")],
)
def test_a_command_that_is_misspelt_gets_a_hint(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert hint in err and out == "" and err.count("\n") == 1


def test_help_and_check_do_not_load_the_heavy_packages(plow_dry: Path) -> None:
    """What makes a command line slow to answer stays out until it is needed."""
    code = (
        "import sys; from splatsoil import cli; cli.commands()\n"
        f"assert cli.main(['check', {str(plow_dry)!r}, '--json']) == 0\n"
        "print(sorted({'torch', 'warp', 'botorch', 'matplotlib', 'kornia'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0 and done.stderr == "[]\n"


def command(monkeypatch: pytest.MonkeyPatch, behaviour: object) -> None:
    """Make ``splatsoil try`` a command that does ``behaviour``."""

    @dataclass(frozen=True)
    class Config:
        """Try something."""

        json: bool = option(False, "Print JSON.")

    def act(config: Config) -> int:
        print("chatter")
        return behaviour()  # type: ignore[operator, no-any-return]

    known = cli.commands()
    known["try"] = SimpleNamespace(Config=Config, run=act, INTERRUPTED=lambda _: "3 of 10 are kept; go on with")
    monkeypatch.setattr(cli, "commands", lambda: known)


def test_ctrl_c_says_what_is_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt() -> int:
        raise KeyboardInterrupt

    command(monkeypatch, interrupt)
    assert cli.main(["try"]) == 130
    assert capsys.readouterr().err == "\nsplatsoil: interrupted; 3 of 10 are kept; go on with: splatsoil try\n"
    assert cli.main(["try", "--json"]) == 130
    assert json.loads(capsys.readouterr().out)["error"].startswith("interrupted; 3 of 10 are kept")


SWALLOWS = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(1)
except BaseException:
    pass
print("has gone on")
"""
RAISES = """
import os, signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
os.kill(os.getpid(), signal.SIGINT)
time.sleep(9)
"""


@pytest.mark.parametrize(("module", "text"), [("typing", SWALLOWS), ("gymnasium", SWALLOWS), ("argparse", RAISES)])
def test_ctrl_c_while_the_program_loads_leaves_no_traceback(tmp_path: Path, module: str, text: str) -> None:
    """From the first module on that the package needs to those of the command line, and though the one that is being
    loaded would swallow it."""
    (tmp_path / f"{module}.py").write_text(text)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}

    def heard(*words: str) -> subprocess.CompletedProcess[str]:
        # a shell's background jobs, tests in one among them, ignore the signal
        return subprocess.run(
            [sys.executable, *words], env=environment, capture_output=True, text=True, timeout=120, check=False,
            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip

    done = heard("-m", "splatsoil", "check", "nothing")
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.strip() == "splatsoil: interrupted; start the command again"
    # of other programs that import the package the signal is theirs
    assert module != "gymnasium" or "has gone on" in heard("-c", "import splatsoil").stdout


def test_ctrl_c_ends_the_program_whatever_threads_go_on(tmp_path: Path) -> None:
    """As those of a server do to which a browser is connected."""
    program = (
        "import sys, threading, time\n"
        "from splatsoil import __main__, cli\n"
        "def serve():\n"
        "    threading.Thread(target=time.sleep, args=(60,)).start()\n"
        "    print('served', flush=True)\n"
        "    return 130\n"
        "cli.main = serve\n"
        "sys.exit(__main__.main())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=40, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "served\n", "")


def test_a_new_command_is_one_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "dig_deep.py").write_text(
        "from dataclasses import dataclass\n"
        "from splatsoil.options import option\n"
        "@dataclass(frozen=True)\n"
        "class Config:\n    'Dig.'\n    depth: float = option(1.0, 'Metres.')\n"
        "def run(config):\n    print(config.depth)\n    return 7\n"
    )
    monkeypatch.setattr(splatsoil.commands, "__path__", [*splatsoil.commands.__path__, str(tmp_path)])
    assert cli.main(["dig-deep", "--depth", "2.5"]) == 7
    assert capsys.readouterr().out == "2.5\n"


def test_json_is_alone_on_stdout(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever else a command or a library prints goes to stderr, errors come as an object too."""

    def answer() -> int:
        print_json({"a": 1})
        print("more chatter")
        return 0

    command(monkeypatch, answer)
    assert cli.main(["try", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"a": 1}
    assert err == "chatter\nmore chatter\n"

    def fail() -> int:
        raise RunError("the run folder\nis of another set")

    command(monkeypatch, fail)
    assert cli.main(["try", "--json"]) == 2
    out, err = capsys.readouterr()
    assert json.loads(out) == {"ok": False, "error": "the run folder is of another set"}
    assert err == "chatter\nsplatsoil: the run folder is of another set\n"


def test_defects_are_not_dressed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that is not the user's keeps its traceback."""

    def break_down() -> int:
        raise ZeroDivisionError

    command(monkeypatch, break_down)
    with pytest.raises(ZeroDivisionError):
        cli.main(["try"])


def test_json_holds_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="JSON"), only_json():
        print_json({"loss": float("nan")})
    assert capsys.readouterr().out == ""


def test_a_command_that_simulates_says_nothing_of_what_the_machine_lacks(tmp_path: Path) -> None:
    done = run("element", "--test", "triaxial", "--json", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_the_readme_shows_is_what_commands_print(
    repository: Path,
    plow_dry: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (repository / "README.md").read_text()

    def cells(lines: str) -> str:
        return " ".join(re.sub(r"[│┃]", " ", lines).split())

    for words in (["check", str(plow_dry)], ["element", "--friction-angle", "35"]):
        assert cli.main(words) == 0
        printed = cells(capsys.readouterr().out)
        (shown,) = re.findall(rf"^\$ splatsoil {words[0]} .*\n((?:.+\n)+)", text, flags=re.MULTILINE)
        for line in shown.replace("```", "").splitlines():
            assert cells(line) in printed, line


def test_the_readmes_make_targets_exist(repository: Path) -> None:
    # A command stands at a line's start or in backquotes: "make" is a word of English too.
    targets = set(re.findall(r"(?:^|`)make ([a-z-]+)", (repository / "README.md").read_text(), flags=re.MULTILINE))
    assert targets >= {"demo", "test"}
    for target in targets:
        asked = subprocess.run(
            ["make", "--dry-run", target], cwd=repository, capture_output=True, timeout=60, check=False
        )
        assert asked.returncode == 0, asked.stderr


def test_ctrl_c_is_heard_though_a_module_swallows_it_while_it_loads(tmp_path: Path) -> None:
    """As trimesh does, which imports scipy under `except BaseException`."""
    (tmp_path / "swallows.py").write_text(SWALLOWS)
    program = (
        f"import signal, sys, time\nsys.path.insert(0, {str(tmp_path)!r})\n"
        "from splatsoil.__main__ import _interrupt\nsignal.signal(signal.SIGINT, _interrupt)\n"
        "try:\n    import swallows\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    print('heard')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=50, check=False)
    assert done.stdout == "has gone on\nheard\n", done.stderr


def test_kernels_go_elsewhere_where_their_folder_cannot_be_written_to(tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    program = (
        "import os, warp\n"
        "from splatsoil.quiet import hush\n"
        "hush()\n"
        "folder = warp.config.kernel_cache_dir\n"
        "print(folder.startswith(os.environ['WARP_CACHE_PATH']), os.access(folder, os.W_OK))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "WARP_CACHE_PATH": str(in_the_way), "TMPDIR": str(tmp_path)},
        cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.stdout == "True True\n", done.stderr
    assert done.stderr.count("\n") == 1 and "let WARP_CACHE_PATH name a folder" in done.stderr
    assert list(tmp_path.iterdir()) == [in_the_way], "it goes with the process"


def test_a_machine_whose_warp_compiles_nothing_for_cpus_is_told_so(
    monkeypatch: pytest.MonkeyPatch, plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before any work, also for a GPU."""
    monkeypatch.setattr("warp.is_cpu_available", lambda: False)
    assert cli.main(["fit", str(plow_dry), "--device", "cuda:0", "--run", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "compiler for CPUs" in said and not (tmp_path / "run").exists()
