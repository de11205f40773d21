"""What other processes do for criticism."""

import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest
from splatsoil.inverse.criticism.simulations import Simulations
from splatsoil.inverse.executors import processes

from splatsoil.commands import _stages, _workers
from splatsoil.commands._model import ModelSpec
from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.base import Run

BASE = ModelSpec((), "tiny", ("friction_angle",))


@pytest.mark.parametrize("count", [1, 3])
def test_a_worker_prepares_what_goes_together_and_makes_what_can_be_made(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[Sequence[Any]] = []
    made: list[int] = []

    def simulate(run: Run) -> None:
        if run.seed == 1:
            raise SimulationError("blew up")
        made.append(run.seed)

    experiment = SimpleNamespace(prepare=prepared.append)
    monkeypatch.setitem(_workers._experiments, (tmp_path, "cpu", BASE, ()), (experiment, simulate))  # type: ignore[misc]
    runs = [Run({}, seed=seed) for seed in range(count)]
    _workers._simulate(tmp_path, "cpu", BASE, (), 2, runs)
    assert made == [number for number in range(count) if number != 1]
    assert prepared == ([] if count == 1 else [runs])


class Pool:
    """Processes that are none, and what becomes of them."""

    def __init__(self, count: int) -> None:
        self.jobs, self.words, self.ended = list[Any](), list[Any](), list[str]()
        made.append(self)

    def submit(self, job: Any, *words: Any) -> Future[None]:
        self.jobs.append(job)
        self.words.append(words)
        return Future()

    def shutdown(self, *, cancel_futures: bool) -> None:
        assert cancel_futures
        self.ended.append("let go")


made: list[Pool] = []


@pytest.fixture
def three_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with as many, whose processes are none."""
    made.clear()
    monkeypatch.setattr("splatsoil.inverse.executors.processes", Pool)
    monkeypatch.setattr("splatsoil.inverse.executors.kill", lambda pool: pool.ended.append("killed"))
    monkeypatch.setattr("splatsoil.threads.cores", lambda: 3)


def experiment_on(device: str) -> Any:
    """What workers need of one."""
    layout = SimpleNamespace(shape=(1, 1))
    base = SimpleNamespace(device=device)
    return SimpleNamespace(batch_size=1, prepare=len, base=base, layout=layout, albedo_draws=(), renderings=())


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize(("helps", "fails"), [(False, False), (False, True), (True, False), (True, True)])
def test_workers_begin_with_the_command_and_nothing_outlives_it(helps: bool, fails: bool, tmp_path: Path) -> None:
    folder: Any = SimpleNamespace(path=tmp_path)
    experiment = experiment_on("cpu")
    simulate = Simulations(experiment)
    with suppress(SimulationError), _workers.Workers(folder, "cpu", ("tilt",)) as workers:
        (pool,) = made
        assert workers.count == 2 and pool.jobs == [_workers._load] * 2
        if helps:
            with workers.simulating(BASE, experiment, simulate):
                simulate.prefetch(Run({"angle": 30.0}, seed=seed) for seed in (1, 2))
                assert pool.jobs[2:] == [_workers._simulate] * 2
                *known, (first,) = pool.words[-1]
                assert known == [tmp_path, "cpu", BASE, ("tilt",), 2]
                assert first == Run({"angle": 30.0}, seed=1), "the first ones are made here"
                if fails:
                    raise SimulationError("blew up")
            simulate.prefetch([Run({"angle": 31.0})])
            assert len(pool.jobs) == 4, "nobody helps any more"
        elif fails:
            raise SimulationError("blew up")
    assert pool.ended == ["let go" if helps and not fails else "killed"]


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize("stage", ["run_diagnosis", "check_adequacy"])
def test_who_is_not_alone_in_a_folder_has_no_workers(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def taken() -> NoReturn:
        raise RunError("another process is writing")

    fit = {"parameters": {}, "setup": {"effects": [], "preset": "tiny"}}
    folder: Any = SimpleNamespace(lock=taken, fit=lambda: fit, description={"seed": 0})
    model: Any = SimpleNamespace(device="cpu")
    monkeypatch.setattr(_stages, "experiment_of", lambda *words: (SimpleNamespace(), SimpleNamespace()))

    def report(*words: Any) -> Any:
        return lambda *words: None

    with pytest.raises(RunError, match="another process"):
        getattr(_stages, stage)(folder, model, report)
    assert not made


@pytest.mark.usefixtures("three_cores")
@pytest.mark.parametrize(("free", "left"), [(20.0, 2), (9.0, 1), (5.0, 0), (3.0, 0)])
def test_a_gpu_with_little_memory_keeps_few_workers(
    free: float, left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They began before it was known how much is free there."""
    monkeypatch.setattr(_workers, "gpu_memory", {"cuda:0": (free, 80.0)}.__getitem__)
    folder: Any = SimpleNamespace(path=tmp_path)
    experiment = experiment_on("cuda:0")
    simulate = Simulations(experiment)
    with _workers.Workers(folder, "auto", ()) as workers, workers.simulating(BASE, experiment, simulate):
        assert workers.count == left
        simulate.prefetch([Run({"angle": 30.0})])
    assert [pool.jobs.count(_workers._load) for pool in made] == ([2] if left == 2 else [2, 1] if left else [2])
    assert [pool.ended for pool in made] == {2: [["let go"]], 1: [["killed"], ["let go"]], 0: [["killed"]]}[left]
    assert (_workers._simulate in made[-1].jobs) is (left > 0)


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="this system has no masks")
def test_workers_never_hear_of_an_interrupt_and_the_first_process_does() -> None:
    """Not even while they load: one would print a traceback beside the sentence of the first."""
    pool = processes(1)
    try:
        with _workers._ignoring_interrupts():
            masked = pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, [])
        assert signal.SIGINT in masked.result()
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    finally:
        pool.shutdown()


EARLY = """
import sys
from pathlib import Path
from types import SimpleNamespace
from splatsoil import threads
from splatsoil.commands import _workers, {command}
from splatsoil.inverse import executors
from splatsoil.inverse.run_folder import RunFolder

class Pools:
    def __init__(self, count):
        pass

    def submit(self, job, *words):
        if job is _workers._load:
            sys.exit(1 if {{"torch", "kornia"}} & sys.modules.keys() else 0)

fit = {{"setup": {{"effects": []}}, "loss": 0.5, "best": {{"loss": 0.5}}, "parameters": {{}}}}
RunFolder.open = lambda path: SimpleNamespace(path=path, fit=lambda: fit, check_writable=lambda: None)
executors.processes = Pools
executors.kill = lambda pool: None
_workers.MAX_WORKERS = 1
threads.cores = lambda: 2
{command}.run({command}.Config(Path("run")))
sys.exit(2)
"""


@pytest.mark.parametrize("command", ["diagnose", "compare"])
def test_workers_begin_before_what_takes_seconds_is_loaded(command: str) -> None:
    """They load the same, beside it."""
    assert subprocess.run([sys.executable, "-c", EARLY.format(command=command)], check=False).returncode == 0
