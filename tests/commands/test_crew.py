"""What other processes do for criticism."""

import subprocess
import sys
from collections.abc import Sequence
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
    _crew._simulate(tmp_path, "cpu", (), 1, jobs)
    assert made == [number for number in range(count) if number != 1]
    assert prepared == ([] if count == 1 else [jobs])


class Workers:
    """Processes that are none, and what becomes of them."""

    def __init__(self, count: int) -> None:
        self.jobs, self.ended = list[Any](), list[str]()
        made.append(self)

    def submit(self, job: Any, *words: Any) -> None:
        self.jobs.append(job)

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
def test_helpers_begin_with_the_command_and_none_outlives_it(helps: bool, fails: bool, tmp_path: Path) -> None:
    """And only who holds the folder's lock, so that they help, tidies up there: the replay may be another one's."""
    replay = tmp_path / "replay"
    replay.mkdir()
    folder: Any = SimpleNamespace(path=tmp_path)
    experiment: Any = SimpleNamespace(together=1, prepare=len, base=SimpleNamespace(device="cpu"))
    with suppress(SimulationError), _crew.Crew(folder, "cpu", ()) as crew:
        (workers,) = made
        assert workers.jobs == [_crew._ready] * crew.count == [_crew._ready] * 2
        if helps:
            with crew.helping(experiment, Simulations(experiment)) as ask:
                ask({})
                assert workers.jobs[-1] is _crew._replay
                if fails:
                    raise SimulationError("blew up")
        elif fails:
            raise SimulationError("blew up")
    assert workers.ended == ["let go" if helps and not fails else "killed"]
    assert replay.exists() is not helps


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize(("free", "left"), [(20.0, 2), (9.0, 1), (5.0, 0)])
def test_a_gpu_with_little_memory_keeps_few_helpers(
    free: float, left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They began before it was known how much is free there."""
    monkeypatch.setattr(_crew, "_memory", {"cpu": 64.0, "cuda:0": free}.__getitem__)
    folder: Any = SimpleNamespace(path=tmp_path)
    experiment: Any = SimpleNamespace(together=1, prepare=len, base=SimpleNamespace(device="cuda:0"))
    with _crew.Crew(folder, "auto", ()) as crew, crew.helping(experiment, Simulations(experiment)) as ask:
        ask({})
        (workers,) = made
        assert crew.count == left
        assert workers.jobs == [_crew._ready] * 2 + [_crew._replay] * (left > 0)
    assert workers.ended == ["dismissed"] * (2 - left) + ["let go"] * (left > 0)


EARLY = """
import sys
from pathlib import Path
from types import SimpleNamespace
from splatsoil.commands import _crew, _criticism, diagnose
from splatsoil.inverse.run_folder import RunFolder

def helpers(*words):
    sys.exit(1 if {"torch", "kornia"} & sys.modules.keys() else 0)

RunFolder.open = lambda path: SimpleNamespace(check_writable=lambda: None)
_criticism.need_fit = lambda folder: {"setup": {"effects": []}}
_crew.Crew = helpers
diagnose.run(diagnose.Config(Path("run"), effects=("cohesion",)))
"""


def test_a_diagnosis_has_helpers_before_it_loads_what_takes_seconds() -> None:
    """They load the same, beside it."""
    assert subprocess.run([sys.executable, "-c", EARLY], check=False).returncode == 0
