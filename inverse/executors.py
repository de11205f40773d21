"""Where evaluations run: here, in processes of this machine, or on a Dask cluster, all shaped like a
``concurrent.futures.Executor``.

A worker that dies (killed, out of memory) costs the one evaluation it was at, which is repeated.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from splatsoil.errors import ParameterError, RunError

#: A job whose worker dies this often is to blame itself.
ATTEMPTS = 4
#: What decides how many threads a worker's libraries start.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_ENVIRONMENT = threading.Lock()


class Serial(Executor):
    """Runs each job where it is submitted, at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run it; the future returned is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(Executor):
    """Worker processes of this machine, each with a pool of its own: the death of one leaves the others at work.

    Args:
        workers: their number.

    Raises:
        ParameterError: fewer than one.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise ParameterError(f"processes:{workers}: at least one worker is needed")
        # Each worker's libraries would start a thread for every core, and stand in each other's way. What the user has
        # set stays.
        share = str(max(1, (os.cpu_count() or 1) // workers))
        self._limits = {} if any(name in os.environ for name in THREADS) else dict.fromkeys(THREADS, share)
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[..., Any], tuple[Any, ...], dict[str, Any]] | None]
        self._jobs = queue.SimpleQueue()
        self._closed = False
        pools = [self._started() for _ in range(workers)]
        self._threads = [threading.Thread(target=self._work, args=(pool,), daemon=True) for pool in pools]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a job; function, arguments and result have to be picklable."""
        if self._closed:
            raise RuntimeError("the executor has been shut down")
        future: Future[Any] = Future()
        self._jobs.put((future, fn, args, kwargs))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the workers finish what is queued (or only what they are at), and end them."""
        self._closed = True
        if cancel_futures:
            self._forget()
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads if wait else ():
            thread.join()

    def dismiss(self, count: int) -> None:
        """End as many workers as come first to the end of what has been queued."""
        for _ in range(count):
            self._jobs.put(None)

    def kill(self) -> None:
        """End the workers, and with them all other child processes, without waiting for what they are at."""
        self._closed = True
        self._forget()
        for child in multiprocessing.active_children():
            child.terminate()
        self.shutdown()

    def _forget(self) -> None:
        """Cancel what is queued."""
        while True:
            try:
                job = self._jobs.get_nowait()
            except queue.Empty:
                return
            if job is not None:
                job[0].cancel()

    def _started(self) -> ProcessPoolExecutor:
        """A worker, on its way. What limits its libraries is in its environment alone: this process may load them
        later."""
        # A fresh interpreter: forking a process that has threads or a CUDA context breaks both.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(1, mp_context=context, initializer=_end_with_parent)
        with _ENVIRONMENT:
            os.environ.update(self._limits)
            try:
                pool.submit(int)
            finally:
                for name in self._limits:
                    del os.environ[name]
        return pool

    def _work(self, first: ProcessPoolExecutor) -> None:
        pool: ProcessPoolExecutor | None = first
        while (job := self._jobs.get()) is not None:
            future, fn, args, kwargs = job
            if not future.set_running_or_notify_cancel():
                continue
            for attempt in range(1, ATTEMPTS + 1):
                pool = pool or self._started()
                try:
                    future.set_result(pool.submit(fn, *args, **kwargs).result())
                except BrokenProcessPool:
                    pool.shutdown(wait=False)
                    pool = None
                    if attempt < ATTEMPTS and not self._closed:
                        continue
                    future.set_exception(
                        RunError(f"a worker died {ATTEMPTS} times at the same evaluation; is there enough memory?")
                    )
                except Exception as error:
                    future.set_exception(error)
                break
        if pool is not None:
            pool.shutdown(wait=True)


def _end_with_parent() -> None:
    """In a worker: whatever kills the process that it works for ends it, too; it would go on in a folder that is no
    longer locked, and keep its memory."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()


def in_order(pool: Executor, fn: Callable[..., Any], jobs: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Results of ``fn(*job)`` in the order of the jobs; in this process each is made when it is asked for."""
    if isinstance(pool, Serial):
        for job in jobs:
            yield pool.submit(fn, *job).result()
    else:
        for future in [pool.submit(fn, *job) for job in jobs]:
            yield future.result()


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
        workers = Processes(int(detail))
        try:
            yield workers
        finally:
            workers.shutdown(cancel_futures=True)
    elif kind == "dask" and detail:
        with _dask(detail) as pool:
            yield pool
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
        yield client.get_executor(pure=False, retries=ATTEMPTS - 1)
    finally:
        client.close()
