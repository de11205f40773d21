"""Where simulations run: here, in processes of this machine, or on a Dask cluster, as ``concurrent.futures`` has it."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from splatsoil.errors import ParameterError
from splatsoil.threads import cores

#: What decides how many threads a worker's libraries start.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Serial(Executor):
    """Runs each job in this process: a submitted one at once, a mapped one when its result is asked for."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run it; the future returned is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future

    def map(self, fn: Callable[..., Any], *iterables: Any, **_: Any) -> Iterator[Any]:
        """As the built-in one."""
        return map(fn, *iterables)


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


@contextmanager
def executor(where: str = "serial") -> Iterator[Executor]:
    """An executor by name.

    Args:
        where: ``serial``, ``processes:N``, or ``dask:ADDRESS`` (a scheduler's, as ``tcp://host:8786``; needs the extra
            ``cluster``). SLURM and cloud clusters start such a scheduler with dask-jobqueue and dask-cloudprovider.

    Raises:
        ParameterError: another name, Dask isn't installed, or its scheduler doesn't answer.
    """
    kind, _, detail = where.partition(":")
    if kind == "serial" and not detail:
        yield Serial()
    elif kind == "processes" and detail.isdigit():
        pool = processes(int(detail))
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
    elif kind == "dask" and detail:
        with _dask(detail) as cluster:
            yield cluster
    else:
        raise ParameterError(f"executor {where!r} is unknown; give serial, processes:N or dask:ADDRESS")


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ParameterError("executor dask needs the extra: pip install 'splatsoil[cluster]'") from error
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ParameterError(f"no Dask scheduler answers at {address} ({error})") from error
    try:
        # A simulation is no pure function of its arguments to Dask: its own cache is not to answer for the database.
        yield client.get_executor(pure=False)
    finally:
        client.close()
