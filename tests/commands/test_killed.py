"""``kill -9`` at any moment, and files cut short by a power cut: the same command comes to the same end, or says why.

The set is small and its answer means nothing; that it is the same to the last bit is the point.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splatsoil import cli

#: What a clock or an interruption, but nothing else, may change.
CLOCKS = {"seconds", "created", "simulated_now"}
QUICK = ("--preset", "tiny", "--budget", "2", "--device", "cpu")
WHOLE = ("--preset", "tiny", "--budget", "2", "--no-effects", "--device", "cpu")

#: Runs the program and kills it at a certain one of the moments at which it touches a file of a folder; by a negative
#: number, the disk is full from then on.
KILLER = """
import errno, os, signal, sys
folder, moment = os.path.abspath(sys.argv[1]), int(sys.argv[2])
seen = 0
def touched(event, given):
    global seen
    writes = event == "open" and isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    if writes or event in ("os.rename", "os.mkdir", "os.remove", "os.chmod", "sqlite3.connect"):
        if isinstance(given[0], (str, os.PathLike)) and os.path.abspath(given[0]).startswith(folder):
            seen += 1
            if seen == moment:
                os.kill(os.getpid(), signal.SIGKILL)
            if 0 < -moment <= seen and event in ("open", "os.mkdir"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), given[0])
sys.addaudithook(touched)
from splatsoil.cli import main
code = main(sys.argv[3:])
print(seen, file=sys.stderr)
sys.exit(code)
"""


@pytest.fixture(scope="module")
def place(plow_dry: Path, cut: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a set: five views and four frames of one camera, at half the size."""
    folder = tmp_path_factory.mktemp("killed")
    cut(plow_dry, folder / "set", 10, every=8, cameras="left", shrunk=2)
    return folder


def start(place: Path, words: tuple[str, ...], *, run: str, moment: int = 0) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", KILLER, run, str(moment), words[0], "set", *words[1:], "--run", run, "--json"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=place, stdout=pipe, stderr=pipe, text=True, env=environment)


def finish(place: Path, words: tuple[str, ...], *, run: str) -> tuple[dict[str, Any], int]:
    """What the command prints, and how often it touched a file."""
    process = start(place, words, run=run)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return json.loads(out), int(err.splitlines()[-1])


def timeless(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: timeless(value) for key, value in data.items() if key not in CLOCKS}
    return [timeless(item) for item in data] if isinstance(data, list) else data


def essence(run: Path) -> dict[str, Any]:
    """All that a run came to, but for what clocks say: JSON, evaluations, and the bytes of arrays and pictures."""
    out: dict[str, Any] = {}
    for file in sorted(run.rglob("*")):
        name = file.relative_to(run).as_posix()
        if file.suffix == ".json" and not file.name.startswith("."):
            out[name] = timeless(json.loads(file.read_text()))
        elif file.suffix in (".npy", ".npz", ".ply", ".jpg", ".png") and not file.name.startswith("."):
            out[name] = file.read_bytes()
    with contextlib.closing(sqlite3.connect(run / "evaluations.db")) as database:
        columns = "key, model, parameters, seed, loss, blocks"
        out["evaluations"] = database.execute(f"SELECT {columns} FROM evaluations ORDER BY key").fetchall()
    return out


def helpers(process: subprocess.Popen[str]) -> list[int]:
    """Children of a process, by their numbers."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            words = status.read_text().rsplit(")", 1)[1].split()
            if int(words[1]) == process.pid:
                found.append(int(status.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="moments are told by what a system's kernel tells")
def test_a_fit_killed_while_it_writes_comes_to_the_same_end(place: Path) -> None:
    """Twice: at the file that describes the run, and later."""
    words = ("fit", *QUICK)
    printed, touched = finish(place, words, run="quick")
    for moment in (3, random.Random(0).randrange(8, touched)):
        process = start(place, words, run="quick-killed", moment=moment)
        _, err = process.communicate(timeout=600)
        assert process.returncode == -signal.SIGKILL, err
    again, _ = finish(place, words, run="quick-killed")
    assert timeless(again) | {"run": ""} == timeless(printed) | {"run": ""}
    whole, killed = essence(place / "quick"), essence(place / "quick-killed")
    assert without_places(killed) == without_places(whole)


@pytest.mark.slow
def test_a_full_disk_is_named_and_the_fit_comes_to_the_same_end(place: Path) -> None:
    """At five moments, one after the other."""
    words = ("fit", *QUICK)
    printed, touched = finish(place, words, run="roomy")
    for moment in sorted(random.Random(0).sample(range(2, touched), 5)):
        process = start(place, words, run="full", moment=-moment)
        out, err = process.communicate(timeout=600)
        if process.returncode == 0:  # kept evaluations need fewer files
            continue
        said = err.splitlines()[-2]  # before the number of moments
        assert process.returncode == 2 and said.startswith("splatsoil: ") and "No space left" in said, err
        assert "Traceback" not in err and json.loads(out)["ok"] is False
    again, _ = finish(place, words, run="full")
    assert timeless(again) | {"run": ""} == timeless(printed) | {"run": ""}


def without_places(result: dict[str, Any]) -> dict[str, Any]:
    """A run but for the folder it is in."""
    return {name: data for name, data in result.items() if name != "run.json"}


@pytest.fixture(scope="module")
def whole(place: Path) -> Path:
    """``run``, undisturbed."""
    finish(place, ("run", *WHOLE), run="whole")
    return place / "whole"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [int(os.environ.get("SPLATSOIL_KILL_SEED", "0"))])
def test_a_run_killed_at_random_moments_comes_to_the_same_end(place: Path, whole: Path, seed: int) -> None:
    """Ten moments: half of them where a file is touched, half at any time; and now and then a helper alone."""
    chance, words, killed, run = random.Random(seed), ("run", *WHOLE), 0, f"killed-{seed}"
    for number in range(100):
        if killed == 10:
            break
        moment = chance.randrange(1, 25) if number % 2 else 0
        process = start(place, words, run=run, moment=moment)
        if moment == 0:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=chance.uniform(4.0, 20.0))
            for helper in helpers(process)[:1]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(helper, signal.SIGKILL)
            time.sleep(chance.uniform(0.0, 1.0))
            process.kill()
        process.communicate(timeout=600)
        killed += process.returncode == -signal.SIGKILL
        if process.returncode == 0:  # it had come to its end
            shutil.rmtree(place / run)
    finish(place, words, run=run)
    assert killed == 10
    same, other = without_places(essence(whole)), without_places(essence(place / run))
    assert {name: other.get(name) for name in same} == same
    assert "<html" in (place / run / "report.html").read_text()


def kinds(run: Path) -> list[Path]:
    """One file of each kind that a run folder has."""
    found: dict[tuple[str, str], Path] = {}
    for file in sorted(p for p in run.rglob("*") if p.is_file()):
        name = file.relative_to(run)
        alike = name.suffix if name.parent.name in ("features", "comparison") and name.suffix != ".json" else name.name
        found.setdefault((name.parent.name, alike), name)
    return list(found.values())


@pytest.fixture
def command(
    place: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Runs a command in a place where ``damaged`` is a copy of the whole run with a file of other contents, if they are
    given; returns the one sentence that says what is wrong, if anything is."""
    monkeypatch.chdir(place)
    monkeypatch.setattr("splatsoil.threads.cores", lambda: 1)

    def run(words: str, name: Path, contents: bytes | None = None) -> str:
        if contents is not None:
            shutil.rmtree("damaged", ignore_errors=True)
            shutil.copytree(whole, "damaged")
            (Path("damaged") / name).write_bytes(contents)
        code = cli.main(words.split())
        said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("splatsoil: ")]
        said = [line for line in said if "was fitted by splatsoil" not in line]
        assert code in (0, 2, 3) and len(said) == (code == 2), (name, words, code, said)
        return "".join(said)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("left", ["nothing", "half", "all but a byte"])
def test_files_cut_short_are_made_anew_or_named(whole: Path, command: Callable[..., str], left: str) -> None:
    for name in kinds(whole):
        contents = (whole / name).read_bytes()
        part = str(Path("damaged") / (name.parent if name.parent.name == "reconstruction" else name))
        short = contents[: {"nothing": 0, "half": len(contents) // 2, "all but a byte": -1}[left]]
        said = command("report damaged", name, short)
        assert not said or part in said
        said = command(" ".join(("run set", *WHOLE, "--run damaged")), name, short)
        assert not said or part in said
        if not said:
            again, fit = (json.loads((run / "fit.json").read_text()) for run in (Path("damaged"), whole))
            assert timeless(again) == timeless(fit), name


@pytest.mark.slow
@pytest.mark.parametrize("seed", [int(os.environ.get("SPLATSOIL_FLIP_SEED", "0"))])
def test_flipped_bits_are_named_or_do_no_harm(whole: Path, command: Callable[..., str], seed: int) -> None:
    """One bit of every file in turn; one of the letters of a key where it holds any, so that it can still be read. What
    takes long is done with one file of each kind."""
    chance, first = random.Random(seed), kinds(whole)
    for name in sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file()):
        contents = bytearray((whole / name).read_bytes())
        keys = [found.start(1) for found in re.finditer(rb'"([a-z_]+)":', contents)] if name.suffix == ".json" else []
        read_by_fits = name.parts[0] in ("features", "evaluations.db", "fit.json")
        for places in filter(None, (range(len(contents)), keys)):
            flipped = contents.copy()
            flipped[chance.choice(places)] ^= 1 << chance.randrange(8 if places is not keys else 3)
            said = [command("report damaged", name, bytes(flipped))]
            for words in ("compare damaged --quick", "export damaged --to csv") if name in first else ():
                said.append(command(words, name))
            if read_by_fits and name in first:
                said.append(command("posterior damaged --checks 0", name))
            assert all("damaged" in sentence for sentence in said if sentence), (name, said)


def test_two_commands_on_one_run_folder(place: Path, run_elsewhere: Callable[[], Path]) -> None:
    """The second says so in one sentence, and the first goes on."""
    folder = run_elsewhere()
    done = subprocess.run(
        [sys.executable, "-m", "splatsoil", "fit", "set", *QUICK, "--run", str(folder)],
        cwd=place, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    said = done.stderr.splitlines()[-1]
    assert "another process is writing into this run folder" in said and "Traceback" not in done.stderr


@pytest.fixture
def run_elsewhere(place: Path, tmp_path: Path) -> Any:
    """Makes a run folder into which another process is writing until the test ends."""
    holder: list[subprocess.Popen[str]] = []

    def begin() -> Path:
        script = (
            "import sys, time\nfrom splatsoil.inverse.evaluations import writer_lock\n"
            "with writer_lock(sys.argv[1]):\n    print('held', flush=True)\n    time.sleep(300)\n"
        )
        folder = tmp_path / "run"
        process = subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE, text=True)
        holder.append(process)
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        return folder

    yield begin
    for process in holder:
        process.kill()
        process.communicate()
