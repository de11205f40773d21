"""Where simulations run, and what ends with what."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from splatsoil.inverse.executors import THREADS, kill, processes

from splatsoil.errors import ParameterError

WORKS_ON = """
import os, time
from splatsoil.inverse.executors import processes

if __name__ == "__main__":
    pool = processes(1)
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 600)
    time.sleep(600)
"""


def works(process: int) -> bool:
    """Whether it is there, and not only because nobody has asked how it ended."""
    told = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True).stdout.strip()
    return bool(told) and not told.startswith("Z")


def ended(process: int) -> bool:
    for _ in range(100):
        if not works(process):
            return True
        time.sleep(0.1)
    os.kill(process, signal.SIGKILL)
    return False


def test_a_worker_ends_with_the_process_it_works_for(tmp_path: Path) -> None:
    script = tmp_path / "works_on.py"
    script.write_text(WORKS_ON)
    first = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    worker = int(first.stdout.readline())
    assert works(worker)
    first.kill()
    first.communicate()
    assert ended(worker), "the worker goes on alone"


def test_workers_are_ended_whatever_they_are_at() -> None:
    pool = processes(1)
    worker = pool.submit(os.getpid).result()
    pool.submit(time.sleep, 600)
    kill(pool)
    assert ended(worker)


def threads_of_worker() -> int:
    import torch

    return torch.get_num_threads()


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    workers = max(2, os.cpu_count() or 1)
    with processes(workers) as pool:
        assert pool.submit(threads_of_worker).result() == 1
        assert not set(THREADS) & os.environ.keys(), "this process has all cores, whatever it loads later"
    monkeypatch.setenv(THREADS[0], "2")
    with processes(1) as pool:
        assert pool.submit(threads_of_worker).result() == min(2, os.cpu_count() or 1), "what the user has set stays"


def test_no_worker_is_refused() -> None:
    with pytest.raises(ParameterError, match="at least one"):
        processes(0)
