"""Other processes that make a diagnosis' simulations ahead of it, on the cores that it leaves free."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model

MOST_HELPERS = 3
"""Each holds a reconstruction and a scene: half a GiB."""


@contextmanager
def simulated_ahead(
    folder: RunFolder, model: Model, effects: Iterable[str], jobs: Sequence[Mapping[str, Any]]
) -> Iterator[None]:
    """While the block runs, other processes make simulations that it will ask for, beginning with the last.

    All keep what they make in ``features/`` and find it there: the results are those of one process, bit for bit, and
    one that dies costs nothing but its help. Nothing is started on a GPU, on one core, or for what is there already.

    Args:
        folder: the run folder, locked by this process.
        model: of the latest fit.
        effects: the candidates, as `experiment_of` takes them; none for all.
        jobs: keyword arguments of the simulations.
    """
    import multiprocessing
    import os

    count = min(len(os.sched_getaffinity(0)) - 1, MOST_HELPERS) if model.device == "cpu" else 0
    # Fresh interpreters: forking a process that has threads breaks them.
    context = multiprocessing.get_context("spawn")
    backwards = [dict(job) for job in reversed(jobs)]
    helpers = [
        context.Process(target=_simulate, args=(folder.path, tuple(effects), backwards[k::count]), daemon=True)
        for k in range(count)
    ]
    for helper in helpers:
        helper.start()
    try:
        yield
    finally:
        for helper in helpers:
            helper.terminate()
            helper.join()


def _simulate(path: Path, effects: tuple[str, ...], jobs: Sequence[Mapping[str, Any]]) -> None:
    """A helper's work. Whatever goes wrong, the first process meets it too, and says so."""
    import contextlib
    import signal
    from multiprocessing import parent_process

    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _stages as stage
    from splatsoil.errors import SimulationError, SplatsoilError
    from splatsoil.inverse.run_folder import RunFolder

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
    stage.hush()
    with contextlib.suppress(SplatsoilError, OSError):
        folder = RunFolder.open(path)
        model = criticism.model_of(folder, "cpu", lambda what, share: None)
        _, simulate = criticism.experiment_of(folder, model, effects or None)
        parent = parent_process()
        for job in jobs:
            if parent is None or not parent.is_alive():
                return  # it was killed, and nobody waits for these
            with contextlib.suppress(SimulationError):
                simulate(**job)
