"""Other processes that simulate for criticism beside this one."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

from splatsoil import threads
from splatsoil.commands._resources import gpu_memory, memory
from splatsoil.envs.devices import resolve_device
from splatsoil.errors import SetWarning, SplatsoilError
from splatsoil.inverse import executors
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from pathlib import Path

    from splatsoil.commands._model import ModelSpec
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Arguments, Simulations

MAX_WORKERS = 3
SHARE = {"cpu": 2.0, "cuda": 4.0}
"""Memory that each process is to have, GiB: it holds a reconstruction, a scene and soil."""


class Workers:
    """Other processes that simulate, too: one for every other core, as far as there is use for them.

    They begin at once, so that they have loaded what takes seconds when the first process has. All keep what they make
    in ``features/`` and find it there, and those that die cost nothing but their help. Simulations wait until the first
    process holds the folder's lock. On a CPU each process keeps to one thread, the first one too: the results are those
    of one process, bit for bit, and with more they would wait for each other. A GPU is shared: each process makes
    simulations that are alike as one batch, as one leaves most of it idle, and cores are shared out.

    Args:
        folder: the run folder.
        device: where it is computed, in the user's word.
        effects: the candidates, as `experiment_of` takes them; none for all.
    """

    def __init__(self, folder: RunFolder, device: str, effects: Iterable[str]) -> None:
        self.count = max(0, int(min(threads.cores(), 1 + MAX_WORKERS, memory() / SHARE["cpu"])) - 1)
        self._path, self._effects = folder.path, tuple(effects)
        self._pool = self._started(device)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        """End those that never came to help."""
        if self._pool is not None:
            executors.kill(self._pool)
        self._pool = None

    def _started(self, device: str) -> ProcessPoolExecutor | None:
        """As many helpers as there are to be, on their way."""
        if self.count == 0:
            return None
        pool = executors.processes(self.count)
        try:
            with _unheard():
                for _ in range(self.count):
                    pool.submit(_ready, device)
        except BaseException:
            executors.kill(pool)
            raise
        return pool

    @contextmanager
    def simulating(self, spec: ModelSpec, experiment: PlowExperiment, simulate: Simulations) -> Iterator[None]:
        """While the block runs, where this process holds the folder's lock, they simulate.

        Args:
            spec: the model.
            experiment: of it.
            simulate: what is helped.
        """
        from splatsoil.inverse.criticism.simulations import Executor

        device = experiment.base.device
        if self._pool is not None and device != "cpu":
            count = max(0, min(self.count, int(gpu_memory(device)[0] / SHARE["cuda"]) - 1))
            if count < self.count:  # they began before it was known how much memory is free there
                self.__exit__()
                self.count = count
                self._pool = self._started(device)
        with threads.at_most(_threads(device, self.count)):
            if self._pool is None:
                yield
                return
            pool, what = self._pool, (self._path, device, spec, self._effects, self.count)
            helpers = Executor(
                lambda jobs: pool.submit(_simulate, *what, jobs), experiment.batch_size, experiment.prepare
            )
            with simulate.using(helpers):
                yield
            pool.shutdown(cancel_futures=True)
            self._pool = None


@contextmanager
def _unheard() -> Iterator[None]:
    """Processes that begin meanwhile never hear of Ctrl-C, not even while they load: the first process ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # not every system has masks
        yield
        return
    resource_tracker.ensure_running()  # it has the mask its own way when it begins
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _threads(device: str, helpers: int) -> int:
    """How many each process keeps to."""
    return 1 if device == "cpu" or helpers == 0 else max(1, threads.cores() // (1 + helpers))


_known: dict[tuple[Path, str, ModelSpec, tuple[str, ...]], tuple[PlowExperiment, Simulations]] = {}


def _ready(device: str) -> None:
    """A helper's work: to load what takes seconds, before it is needed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one

    def load(here: str) -> None:
        import torch

        from splatsoil.experiment import plow  # noqa: F401

        torch.zeros(1, device=here)

    _quietly(load, device, 0)


def _simulate(
    path: Path, device: str, spec: ModelSpec, effects: tuple[str, ...], helpers: int, jobs: Sequence[Arguments]
) -> None:
    """A helper's work."""

    def make(here: str) -> None:
        experiment, simulate = _known_here(path, here, spec, effects)
        if len(jobs) > 1:
            experiment.prepare(jobs)
        for job in jobs:
            # one that can't be made doesn't keep the others from being made
            with suppress(SplatsoilError):
                simulate(**job)

    _quietly(make, device, helpers)


def _quietly(work: Callable[[str], object], device: str, helpers: int) -> None:
    """Work on a device. Whatever goes wrong, the first process meets it too, and says so."""
    with suppress(SplatsoilError, OSError):
        here = resolve_device(device)
        with threads.at_most(_threads(here, helpers)):
            work(here)


def _known_here(
    path: Path, device: str, spec: ModelSpec, effects: tuple[str, ...]
) -> tuple[PlowExperiment, Simulations]:
    """What a helper works with, made once."""
    from splatsoil.commands._model import experiment_of, model_of

    key = (path, device, spec, effects)
    if key not in _known:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
        hush()
        warnings.simplefilter("ignore", SetWarning)  # the first process has said it
        folder = RunFolder.open(path)
        # a reconstruction that isn't kept is the first process's to make
        model = model_of(folder, device, lambda what, share: None, spec=spec, make=False)
        _known[key] = experiment_of(folder, model, spec, effects or None)
    return _known[key]
