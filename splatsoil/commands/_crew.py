"""Other processes that simulate for criticism beside this one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from shutil import rmtree
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import Future
    from pathlib import Path

    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.executors import Processes
    from splatsoil.inverse.run_folder import RunFolder

MOST_HELPERS = 3
SHARE = {"cpu": 2.0, "cuda": 4.0}
"""Memory that each process is to have, GiB: it holds a reconstruction, a scene and soil."""


Replay = Callable[[Mapping[str, float]], "Future[None] | None"]
"""Has a helper make the replay control at these values; None where there is no helper."""


class Crew:
    """Other processes that simulate, too: one for every other core, as far as there is use for them.

    They begin at once, so that they have loaded what takes seconds when the first process has. All keep what they make
    in ``features/`` and find it there, and one that dies costs nothing but its help. On a CPU each process keeps to one
    thread, the first one too: the results are those of one process, bit for bit, and with more they would wait for each
    other. A GPU is shared: each process makes simulations that are alike as one batch, as one leaves most of it idle,
    and cores are shared out.

    Args:
        folder: the run folder.
        device: where it is computed, in the user's word.
        effects: the candidates, as `experiment_of` takes them; none for all.
    """

    def __init__(self, folder: RunFolder, device: str, effects: Iterable[str]) -> None:
        from splatsoil.inverse.executors import Processes
        from splatsoil.threads import cores

        self.count = max(0, int(min(cores(), 1 + MOST_HELPERS, _memory("cpu") / SHARE["cpu"])) - 1)
        self._path, self._effects = folder.path, tuple(effects)
        self._workers = Processes(self.count) if self.count > 0 else None
        if self._workers is not None:
            for _ in range(self.count):
                self._workers.submit(_ready, device)

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        """End those that never came to help."""
        if self._workers is not None:
            self._workers.kill()

    @contextmanager
    def helping(self, experiment: PlowExperiment, simulate: Simulations) -> Iterator[Replay]:
        """While the block runs, where this process holds the folder's lock, they simulate.

        Args:
            experiment: of the latest fit.
            simulate: what is helped.

        Yields:
            What has a helper make the replay control, before what it is asked for later.
        """
        from splatsoil.inverse.criticism.simulations import Helpers
        from splatsoil.threads import at_most, cores

        device = experiment.base.device
        workers, self._workers = self._fitting(device), None
        threads = 1 if device == "cpu" or workers is None else max(1, cores() // (1 + self.count))
        with at_most(threads):
            if workers is None:
                yield lambda values: None
                return

            def submit(job: Callable[..., None], *more: object) -> Future[None]:
                return workers.submit(job, self._path, device, self._effects, threads, *more)

            def together(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
                return submit(_simulate, [dict(job) for job in jobs])

            try:
                with simulate.helped(Helpers(self.count, together, experiment.together, experiment.prepare)):
                    yield lambda values: submit(_replay, dict(values))
                workers.shutdown(cancel_futures=True)
            except BaseException:
                workers.kill()
                raise
            finally:
                # a helper that was ended at the replay couldn't tidy up
                rmtree(self._path / "replay", ignore_errors=True)

    def _fitting(self, device: str) -> Processes | None:
        """The helpers that a device has memory for, if any; the others end."""
        workers = self._workers
        if workers is not None and device != "cpu":
            count = max(0, min(self.count, int(_memory(device) / SHARE["cuda"]) - 1))
            workers.dismiss(self.count - count)
            self.count = count
        return workers if self.count > 0 else None


def _memory(device: str) -> float:
    """GiB: the machine's whole, or what is free on a GPU."""
    import os

    import torch

    if device != "cpu":
        return float(torch.cuda.mem_get_info(device)[0]) / 2**30
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):  # not every system tells
        return float("inf")


_known: dict[tuple[Path, str, tuple[str, ...]], tuple[RunFolder, PlowExperiment, Simulations]] = {}


def _ready(device: str) -> None:
    """A helper's work: to load what takes seconds, before it is needed."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
    with _quietly(1):
        import torch

        from splatsoil.commands import _control, _criticism  # noqa: F401
        from splatsoil.envs.devices import resolve_device
        from splatsoil.experiment import plow  # noqa: F401

        torch.zeros(1, device=resolve_device(device))


def _simulate(
    path: Path, device: str, effects: tuple[str, ...], threads: int, jobs: Sequence[Mapping[str, Any]]
) -> None:
    """A helper's work."""
    from splatsoil.errors import SplatsoilError

    with _quietly(threads):
        _, experiment, simulate = _known_here(path, device, effects)
        if len(jobs) > 1:
            experiment.prepare(jobs)
        for job in jobs:
            # one that can't be made doesn't keep the others from being made
            with suppress(SplatsoilError):
                simulate(**job)


def _replay(path: Path, device: str, effects: tuple[str, ...], threads: int, values: Mapping[str, float]) -> None:
    """A helper's work."""
    from splatsoil.commands._control import replayed

    with _quietly(threads):
        replayed(*_known_here(path, device, effects), values, lambda what: None)


@contextmanager
def _quietly(threads: int) -> Iterator[None]:
    """Whatever goes wrong, the first process meets it too, and says so."""
    from splatsoil.errors import SplatsoilError
    from splatsoil.threads import at_most

    with at_most(threads), suppress(SplatsoilError, OSError):
        yield


def _known_here(path: Path, device: str, effects: tuple[str, ...]) -> tuple[RunFolder, PlowExperiment, Simulations]:
    """What a helper works with, made once."""
    import signal

    from splatsoil.commands import _criticism as criticism
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.quiet import hush

    key = (path, device, effects)
    if key not in _known:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
        hush()
        folder = RunFolder.open(path)
        model = criticism.model_of(folder, device, lambda what, share: None)
        _known[key] = (folder, *criticism.experiment_of(folder, model, effects or None))
    return _known[key]
