"""Other processes that simulate for criticism beside this one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model

MOST_HELPERS = 3
"""Each holds a reconstruction and a scene: half a GiB, and on a GPU a context of its own."""


@contextmanager
def crew(folder: RunFolder, model: Model, effects: Iterable[str], simulate: Simulations) -> Iterator[None]:
    """While the block runs, other processes simulate, too: one for every other core, as far as there is use for them.

    All keep what they make in ``features/`` and find it there: the results are those of one process, bit for bit, and
    one that dies costs nothing but its help. A GPU is shared: one simulation leaves most of it idle. Each process keeps
    to one thread, this one too: with more, they wait for each other.

    Args:
        folder: the run folder, locked by this process.
        model: of the latest fit.
        effects: the candidates, as `experiment_of` takes them; none for all.
        simulate: what is helped.
    """
    import torch

    from splatsoil.envs.devices import cores
    from splatsoil.inverse.criticism.simulations import Helpers
    from splatsoil.inverse.executors import Processes

    count = min(cores() - 1, MOST_HELPERS)
    if count < 1:
        yield
        return
    threads, named = torch.get_num_threads(), tuple(effects)
    torch.set_num_threads(1)
    workers = Processes(count)

    def submit(job: Mapping[str, Any]) -> Any:
        return workers.submit(_simulate, folder.path, model.device, named, dict(job))

    finished = False
    try:
        with simulate.helped(Helpers(count, submit)):
            yield
        finished = True
    finally:
        torch.set_num_threads(threads)
        if finished:
            workers.shutdown(cancel_futures=True)
        else:
            workers.kill()


_known: dict[tuple[Path, str, tuple[str, ...]], Simulations] = {}


def _simulate(path: Path, device: str, effects: tuple[str, ...], job: Mapping[str, Any]) -> None:
    """A helper's work. Whatever goes wrong, the first process meets it too, and says so."""
    import contextlib
    import signal

    import torch

    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _stages as stage
    from splatsoil.errors import SplatsoilError
    from splatsoil.inverse.run_folder import RunFolder

    key = (path, device, effects)
    with contextlib.suppress(SplatsoilError, OSError):
        if key not in _known:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
            stage.hush()
            torch.set_num_threads(1)
            folder = RunFolder.open(path)
            model = criticism.model_of(folder, device, lambda what, share: None)
            _known[key] = criticism.experiment_of(folder, model, effects or None)[1]
        _known[key](**job)
