"""What other processes do for criticism."""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.commands import _crew
from splatsoil.errors import SimulationError


@pytest.mark.parametrize("count", [1, 3])
def test_a_helper_prepares_what_goes_together_and_makes_what_can_be_made(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[Sequence[Any]] = []
    made: list[int] = []

    def simulate(*, number: int) -> None:
        if number == 1:
            raise SimulationError("blew up")
        made.append(number)

    experiment = SimpleNamespace(prepare=prepared.append)
    monkeypatch.setitem(_crew._known, (tmp_path, "cpu", ()), (None, experiment, simulate))  # type: ignore[misc]
    jobs = [{"number": number} for number in range(count)]
    _crew._simulate(tmp_path, "cpu", (), 2, jobs)
    assert made == [number for number in range(count) if number != 1]
    assert prepared == ([] if count == 1 else [jobs])


class Workers:
    """Processes that are none, and what becomes of them."""

    def __init__(self, count: int) -> None:
        self.jobs, self.words, self.ended = list[Any](), list[Any](), list[str]()
        made.append(self)

    def submit(self, job: Any, *words: Any) -> Future[None]:
        self.jobs.append(job)
        self.words.append(words)
        return Future()

    def dismiss(self, count: int) -> None:
        self.ended += ["dismissed"] * count

    def kill(self) -> None:
        self.ended.append("killed")

    def shutdown(self, *, cancel_futures: bool) -> None:
        assert cancel_futures
        self.ended.append("let go")


made: list[Workers] = []


@pytest.fixture
def three_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with as many, whose processes are none."""
    made.clear()
    monkeypatch.setattr("splatsoil.inverse.executors.Processes", Workers)
    monkeypatch.setattr("splatsoil.threads.cores", lambda: 3)


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize(("helps", "fails"), [(False, False), (False, True), (True, False), (True, True)])
@pytest.mark.parametrize("control", [False, True])
def test_helpers_begin_with_the_command_and_nothing_outlives_it(
    helps: bool, fails: bool, control: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The control is first, if it is wanted at all, and one of it is enough."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder: Any = SimpleNamespace(path=tmp_path / "run")
    experiment: Any = SimpleNamespace(together=1, prepare=len, base=SimpleNamespace(device="cpu"))
    first = [_crew._ready] * 2 + [_crew._replay] * control
    with suppress(SimulationError), _crew.Crew(folder, "cpu", (), control=control) as crew:
        (workers,) = made
        assert crew.count == 2 and workers.jobs == first
        if helps:
            with crew.helping(experiment, Simulations(experiment)) as replay:
                making = replay()
                assert replay() is making and workers.jobs == first + [_crew._replay] * (not control)
                # what a helper has begun with when it is ended
                place = workers.words[-1][-1]
                assert place.is_dir() and tmp_path in place.parents
                (place / "replay").mkdir()
                assert making is not None
                making.set_result(None)
                assert replay() is not making, "it came to nothing: once more"
                if fails:
                    raise SimulationError("blew up")
        elif fails:
            raise SimulationError("blew up")
    assert workers.ended == ["let go" if helps and not fails else "killed"]
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize(("free", "left"), [(20.0, 2), (9.0, 1), (5.0, 0)])
def test_a_gpu_with_little_memory_keeps_few_helpers(
    free: float, left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They began before it was known how much is free there."""
    monkeypatch.setattr(_crew, "_free", {"cuda:0": free}.__getitem__)
    folder: Any = SimpleNamespace(path=tmp_path)
    experiment: Any = SimpleNamespace(together=1, prepare=len, base=SimpleNamespace(device="cuda:0"))
    with _crew.Crew(folder, "auto", (), control=True) as crew, crew.helping(experiment, Simulations(experiment)) as ask:
        (workers,) = made
        assert crew.count == left
        assert (ask() is None) is (left == 0)
    assert workers.ended == (["dismissed"] * (2 - left) + ["let go"] if left else ["killed"])


EARLY = """
import sys
from pathlib import Path
from types import SimpleNamespace
from splatsoil.commands import _crew, _criticism, {command}
from splatsoil.inverse import executors
from splatsoil.inverse.run_folder import RunFolder

class Helpers:
    def __init__(self, count):
        pass

    def submit(self, job, *words):
        if job is _crew._replay:
            sys.exit(1 if {{"torch", "kornia"}} & sys.modules.keys() else 0)

fit = {{"setup": {{"effects": []}}}}
RunFolder.open = lambda path: SimpleNamespace(path=path, fit=lambda: fit, check_writable=lambda: None)
executors.Processes = Helpers
_crew.MOST_HELPERS = 1
splatsoil.threads.cores = lambda: 2
{command}.run({command}.Config(Path("run")))
sys.exit(2)
"""


@pytest.mark.parametrize("command", ["diagnose", "compare"])
def test_helpers_begin_before_what_takes_seconds_is_loaded(command: str) -> None:
    """They load the same, beside it; and the control, which all wait for in the end, begins as early."""
    script = "import splatsoil.threads\n" + EARLY.format(command=command)
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
