"""Executors and campaigns: what a killed worker or a killed campaign costs."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor
from pathlib import Path
from types import ModuleType

import pytest
from splatsoil.envs.problem import Evaluation
from splatsoil.inverse.campaign import Job, run_campaign
from splatsoil.inverse.evaluations import EvaluationRecord, EvaluationStore
from splatsoil.inverse.executors import THREADS, Processes, Serial, executor

from splatsoil.errors import ParameterError, RunError

MODEL = {"model": "analytic", "device": "cpu", "preset": "tiny", "version": "1", "measurement": "m"}


def jobs(count: int) -> list[Job]:
    return [Job({"friction_angle": 20.0 + 30.0 * k / count}, k) for k in range(count)]


def essence(records: list[EvaluationRecord]) -> list[tuple]:
    return [(r.step, r.key, r.parameters, r.seed, r.status, r.loss, r.blocks, r.message) for r in records]


def run(problem: object, count: int, file: Path, pool: Executor | None = None) -> list[EvaluationRecord]:
    with EvaluationStore(file) as store:
        return run_campaign(problem, jobs(count), store, MODEL, {"agent": "test"}, executor=pool)  # type: ignore[arg-type]


def dies_once(folder: str, answer: int) -> int:
    """Kills its own process the first time it is asked."""
    marker = Path(folder) / str(answer)
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return answer


def dies(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fails(_: int) -> None:
    raise ValueError("no")


def test_a_killed_worker_costs_one_evaluation(tmp_path: Path) -> None:
    pool = Processes(2)
    try:
        futures = [pool.submit(abs, -1), pool.submit(dies_once, str(tmp_path), 5), pool.submit(abs, -2)]
        assert [f.result(timeout=120) for f in futures] == [1, 5, 2]
        with pytest.raises(ValueError, match="no"):
            pool.submit(fails, 0).result(timeout=60)
        with pytest.raises(RunError, match="died 4 times"):
            pool.submit(dies, 0).result(timeout=120)
        assert pool.submit(abs, -3).result(timeout=60) == 3
    finally:
        pool.shutdown()
    with pytest.raises(RuntimeError, match="shut down"):
        pool.submit(abs, 1)


def test_who_is_dismissed_works_no_more() -> None:
    pool = Processes(2)
    try:
        pool.dismiss(1)
        at_work = {future.result(timeout=60) for future in [pool.submit(os.getpid) for _ in range(4)]}
        assert len(at_work) == 1
    finally:
        pool.shutdown()


WORKS_ON = """
import os, sys, time
from splatsoil.inverse.executors import Processes

if __name__ == "__main__":
    pool = Processes(1)
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 600)
    time.sleep(600)
"""


def test_a_worker_ends_with_the_process_it_works_for(tmp_path: Path) -> None:
    script = tmp_path / "works_on.py"
    script.write_text(WORKS_ON)
    first = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    worker = int(first.stdout.readline())
    assert works(worker)
    first.kill()
    first.wait()
    for _ in range(100):
        if not works(worker):
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the worker goes on alone")


def works(process: int) -> bool:
    """Whether it is there, and not only because nobody has asked how it ended."""
    told = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True).stdout.strip()
    return bool(told) and not told.startswith("Z")


def test_every_executor_gives_the_same_records(analytic: ModuleType, tmp_path: Path) -> None:
    here = run(analytic.AnalyticProblem(fails_below=25.0), 12, tmp_path / "a.db")
    assert [r.step for r in here] == list(range(12)) and {r.status for r in here} == {"ok", "failed"}
    assert all("nothing holds" in r.message for r in here if r.status == "failed")
    serial = run(analytic.AnalyticProblem(fails_below=25.0), 12, tmp_path / "b.db", Serial())
    assert essence(serial) == essence(here)


class Ready:
    """An executor whose futures end in another order than they came."""

    def __init__(self) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self.threads = ThreadPoolExecutor(4)

    def submit(self, fn, /, *args):  # type: ignore[no-untyped-def]
        def late() -> Evaluation:
            time.sleep(random.Random(args[2]).uniform(0.0, 0.05))
            return fn(*args)

        return self.threads.submit(late)


def test_the_order_in_which_evaluations_end_does_not_matter(analytic: ModuleType, tmp_path: Path) -> None:
    mixed = run(analytic.AnalyticProblem(), 12, tmp_path / "a.db", Ready())  # type: ignore[arg-type]
    assert essence(mixed) == essence(run(analytic.AnalyticProblem(), 12, tmp_path / "b.db"))


def test_a_longer_campaign_takes_over_what_a_shorter_one_made(analytic: ModuleType, tmp_path: Path) -> None:
    problem = analytic.AnalyticProblem()
    with EvaluationStore(tmp_path / "e.db") as store:
        run_campaign(problem, jobs(8)[:4], store, MODEL, {"agent": "short"})
        run_campaign(problem, jobs(8), store, MODEL, {"agent": "long"})
    assert problem.calls == 8


def _campaign(analytic: ModuleType, file: Path, delay: float) -> None:
    run(analytic.AnalyticProblem(delay=delay), 40, file)


def test_killed_twenty_times_at_random_moments(analytic: ModuleType, tmp_path: Path) -> None:
    """No finished evaluation is lost, none is made twice, and the end is that of the uninterrupted campaign."""
    file = tmp_path / "killed.db"
    context = multiprocessing.get_context("fork")
    chance = random.Random(5)
    kept = 0
    for _ in range(22):
        process = context.Process(target=_campaign, args=(analytic, file, 0.02))
        process.start()
        time.sleep(chance.uniform(0.01, 0.12))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        with EvaluationStore(file) as store:
            count = len(store.records())
        assert count >= kept
        kept = count
    assert kept > 0
    problem = analytic.AnalyticProblem()
    records = run(problem, 40, file)
    assert problem.calls == 40 - kept
    assert essence(records) == essence(run(analytic.AnalyticProblem(), 40, tmp_path / "whole.db"))


def threads_of_worker() -> int:
    import torch

    return torch.get_num_threads()


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    workers = max(2, os.cpu_count() or 1)
    with executor(f"processes:{workers}") as pool:
        assert not set(THREADS) & os.environ.keys(), "this process has all cores, whatever it loads later"
        assert pool.submit(threads_of_worker).result() == 1
    monkeypatch.setenv(THREADS[0], "2")
    with executor(f"processes:{workers}") as pool:
        assert pool.submit(threads_of_worker).result() == min(2, os.cpu_count() or 1), "what the user has set stays"


@pytest.mark.parametrize("name", ["", "threads", "processes:", "processes:two", "dask:", "serial:1"])
def test_executors_that_do_not_exist(name: str) -> None:
    with pytest.raises(ParameterError, match="executor"), executor(name):
        pass


def test_no_workers() -> None:
    with pytest.raises(ParameterError, match="at least one"), executor("processes:0"):
        pass


def test_a_scheduler_that_does_not_answer() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ParameterError, match="no Dask scheduler"), executor("dask:nowhere"):
        pass


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same(analytic: ModuleType, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    from splatsoil.envs.synthetic import SyntheticProblem

    problem = SyntheticProblem()
    problem.begin(3)
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None)
    with cluster, executor(f"dask:{cluster.scheduler_address}") as pool:
        there = run(problem, 4, tmp_path / "a.db", pool)
    assert essence(there) == essence(run(problem, 4, tmp_path / "b.db"))


@pytest.mark.slow
def test_worker_processes_give_the_same(tmp_path: Path) -> None:
    from splatsoil.envs.synthetic import SyntheticProblem

    problem = SyntheticProblem()
    problem.begin(3)
    with executor("processes:2") as pool:
        there = run(problem, 6, tmp_path / "a.db", pool)
    assert essence(there) == essence(run(problem, 6, tmp_path / "b.db"))
