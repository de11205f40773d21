"""Worker processes that simulate for a comparison of models in parallel with this process."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

from splatsoil import threads
from splatsoil.commands._resources import gpu_memory, memory
from splatsoil.devices import resolve_device
from splatsoil.errors import SetWarning, SplatsoilError
from splatsoil.inverse import executors
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from pathlib import Path

    from splatsoil.commands._model import ModelSpec
    from splatsoil.experiment.base import Run
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations

MAX_WORKERS = 3
PROCESS_MEMORY = {"cpu": 2.0, "cuda": 4.0}
"""Memory for each process, GiB: it loads a reconstruction, a scene and soil."""


class Workers:
    """Worker processes for simulations, at most one for each further core; a context manager.

    They start at once and load the libraries while this process loads its own. All processes store simulations in
    ``features/``; if a worker dies, this process simulates instead. Simulations start once this process has the
    folder's lock. On a CPU each process uses one thread, this one too, so results equal those of one process bit for
    bit. On a shared GPU each process simulates batches, and the processes share the cores.

    Args:
        folder: the run folder.
        device: as the user names it.
        effects: the candidates, as `experiment_of` takes them; none for all.

    Attributes:
        count: number of worker processes.
    """

    def __init__(self, folder: RunFolder, device: str, effects: Iterable[str]) -> None:
        self.count = max(0, int(min(threads.cores(), 1 + MAX_WORKERS, memory() / PROCESS_MEMORY["cpu"])) - 1)
        self._path, self._effects = folder.path, tuple(effects)
        self._pool = self._started(device)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        """End workers that are still running."""
        if self._pool is not None:
            executors.kill(self._pool)
        self._pool = None

    def _started(self, device: str) -> ProcessPoolExecutor | None:
        if self.count == 0:
            return None
        pool = executors.processes(self.count)
        try:
            with _ignoring_interrupts():
                for _ in range(self.count):
                    pool.submit(_load, device)
        except BaseException:
            executors.kill(pool)
            raise
        return pool

    @contextmanager
    def simulating(self, spec: ModelSpec, experiment: PlowExperiment, simulate: Simulations) -> Iterator[None]:
        """While the block runs, in which this process holds the folder's lock, the workers run simulations.

        Args:
            spec: the model.
            experiment: of it.
            simulate: its simulations.
        """
        from splatsoil.inverse.criticism.simulations import Executor

        device = experiment.base.device
        if self._pool is not None and device != "cpu":
            count = max(0, min(self.count, int(gpu_memory(device)[0] / PROCESS_MEMORY["cuda"]) - 1))
            if count < self.count:  # the free GPU memory is known only now
                self.__exit__()
                self.count = count
                self._pool = self._started(device)
        with threads.at_most(_threads(device, self.count)):
            if self._pool is None:
                yield
                return
            pool, model = self._pool, (self._path, device, spec, self._effects, self.count)
            submit = lambda runs: pool.submit(_simulate, *model, runs)  # noqa: E731
            with simulate.using(Executor(submit, experiment.batch_size, experiment.prepare)):
                yield
            pool.shutdown(cancel_futures=True)
            self._pool = None


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Processes started in the block ignore Ctrl-C, also while they load: this process ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # not on every system
        yield
        return
    resource_tracker.ensure_running()  # it sets its own mask when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _threads(device: str, workers: int) -> int:
    """Threads of each process."""
    return 1 if device == "cpu" or workers == 0 else max(1, threads.cores() // (1 + workers))


_experiments: dict[tuple[Path, str, ModelSpec, tuple[str, ...]], tuple[PlowExperiment, Simulations]] = {}


def _load(device: str) -> None:
    """A worker's first job: load the libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process ends this one

    def load(here: str) -> None:
        import torch

        from splatsoil.experiment import plow  # noqa: F401

        torch.zeros(1, device=here)

    _run(load, device, 0)


def _simulate(
    path: Path, device: str, spec: ModelSpec, effects: tuple[str, ...], workers: int, runs: Sequence[Run]
) -> None:
    """A worker's job: run and store simulations."""

    def simulate_all(here: str) -> None:
        experiment, simulate = _experiment(path, here, spec, effects)
        if len(runs) > 1:
            experiment.prepare(runs)
        for run in runs:
            # a failure does not stop the others
            with suppress(SplatsoilError):
                simulate(run)

    _run(simulate_all, device, workers)


def _run(work: Callable[[str], object], device: str, workers: int) -> None:
    """Work on a device. The main process meets the same errors, and reports them."""
    with suppress(SplatsoilError, OSError):
        here = resolve_device(device)
        with threads.at_most(_threads(here, workers)):
            work(here)


def _experiment(
    path: Path, device: str, spec: ModelSpec, effects: tuple[str, ...]
) -> tuple[PlowExperiment, Simulations]:
    """A worker's experiment and simulations, cached."""
    from splatsoil.commands._model import experiment_of, model_of

    key = (path, device, spec, effects)
    if key not in _experiments:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process ends this one
        hush()
        warnings.simplefilter("ignore", SetWarning)  # the main process has printed it
        folder = RunFolder.open(path)
        # a missing reconstruction is made by the main process
        model = model_of(folder, device, lambda what, share: None, spec=spec, make=False)
        _experiments[key] = experiment_of(folder, model, spec, effects or None)
    return _experiments[key]
