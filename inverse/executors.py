"""Pools of worker processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import InvalidStateError, ProcessPoolExecutor
from contextlib import contextmanager

from splatsoil.errors import ParameterError
from splatsoil.threads import cores

#: Environment variables that set the number of threads of a worker's libraries.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def processes(workers: int) -> ProcessPoolExecutor:
    """A pool of worker processes that share the cores and end with this process.

    Raises:
        ParameterError: fewer than one.
    """
    if workers < 1:
        raise ParameterError(f"processes:{workers}: at least one worker is needed")
    # Not fork: it breaks threads and CUDA contexts.
    context = multiprocessing.get_context("spawn")
    share = str(max(1, cores() // workers))
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(share,))


def kill(pool: ProcessPoolExecutor) -> None:
    """End the workers, and all other child processes, at once."""
    with _quietly_broken():
        for child in multiprocessing.active_children():
            child.terminate()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _quietly_broken() -> Iterator[None]:
    """The thread of a pool that loses its workers while work that was cancelled waits ends by an error in Python before
    3.13, which it would print."""
    usual = threading.excepthook

    def hook(given: threading.ExceptHookArgs) -> None:
        if not issubclass(given.exc_type, InvalidStateError):
            usual(given)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = usual


def _begin(threads: str) -> None:
    """Limit the threads of a new worker's libraries, unless the user has set them, and end the worker with its parent:
    without it, the folder is no longer locked."""
    if not any(name in os.environ for name in THREADS):
        os.environ.update(dict.fromkeys(THREADS, threads))
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
