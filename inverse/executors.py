"""Worker processes of this machine, as ``concurrent.futures`` has them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor

from splatsoil.errors import ParameterError
from splatsoil.threads import cores

#: What decides how many threads a worker's libraries start.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def processes(workers: int) -> ProcessPoolExecutor:
    """Worker processes of this machine, which share its cores and end with this process.

    Raises:
        ParameterError: fewer than one.
    """
    if workers < 1:
        raise ParameterError(f"processes:{workers}: at least one worker is needed")
    # A fresh interpreter: forking a process that has threads or a CUDA context breaks both.
    context = multiprocessing.get_context("spawn")
    share = str(max(1, cores() // workers))
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(share,))


def kill(pool: ProcessPoolExecutor) -> None:
    """End the workers, and with them all other child processes, without waiting for what they are at."""
    pool.shutdown(wait=False, cancel_futures=True)
    for child in multiprocessing.active_children():
        child.terminate()
    pool.shutdown()


def _begin(threads: str) -> None:
    """In a new worker, before its libraries are loaded: each would start a thread for every core, and stand in the
    others' way. What the user has set stays.

    Whatever kills the process that it works for ends it, too; it would go on in a folder that is no longer locked.
    """
    if not any(name in os.environ for name in THREADS):
        os.environ.update(dict.fromkeys(THREADS, threads))
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
