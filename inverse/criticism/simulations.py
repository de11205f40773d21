"""Cached simulations of an experiment: each is run once and its feature table stored on disk."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.files import digest, read_npy, write_bytes

FloatArray = npt.NDArray[np.float64]
Simulate = Callable[..., FloatArray]
Arguments = Mapping[str, Any]
"""Of a simulation, by name; see :meth:`~splatsoil.experiment.base.Experiment.predict`."""


@dataclass(frozen=True)
class Executor:
    """Worker processes that run simulations of the same experiment and store them in the same folder.

    Attributes:
        submit: simulations to a future that is done when they are stored or have failed.
        batch_size: number of simulations that one worker runs as a batch.
        prepare: runs a batch of simulations in this process.
    """

    submit: Callable[[Sequence[Arguments]], Future[Any]]
    batch_size: int = 1
    prepare: Callable[[Sequence[Arguments]], object] = lambda jobs: None


@dataclass(frozen=True)
class _Batch:
    """Simulations by key, submitted together."""

    jobs: Mapping[str, Arguments]
    future: Future[Any]


class Simulations:
    """An experiment's predictions, cached in a folder.

    Args:
        experiment: predicts.
        folder: holds the feature tables; None caches in memory only.
        identity: everything that decides a prediction, besides the arguments of ``predict``.
        sources: digests of the files that define a user's own effects, by effect.

    Attributes:
        simulated: number of simulations that were run, not read.
        report: called before each new simulation with its purpose.
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path | None = None,
        identity: Mapping[str, Any] | None = None,
        sources: Mapping[str, str] | None = None,
    ) -> None:
        self.experiment, self.folder = experiment, folder
        self.identity, self.sources = dict(identity or {}), dict(sources or {})
        self.report: Callable[[str], None] = lambda purpose: None
        self.simulated = 0
        self._tables: dict[str, FloatArray | SimulationError] = {}
        self._submitted: dict[str, _Batch] = {}
        self._executor: Executor | None = None

    @property
    def requested(self) -> int:
        """Number of different simulations that were requested and succeeded."""
        return sum(not isinstance(table, SimulationError) for table in self._tables.values())

    def __call__(
        self,
        values: Mapping[str, float],
        *,
        effects: tuple[str, ...] = (),
        seed: int = 0,
        variant: str = "",
        purpose: str = "",
    ) -> FloatArray:
        """(t, s) predicted features.

        Raises:
            SimulationError: the simulation failed.
            RunError: the cached file is damaged.
        """
        arguments = {"values": dict(values), "effects": effects, "seed": seed, "variant": variant}
        key = self._key(arguments)
        if key not in self._tables:
            try:
                self._tables[key] = self._load_or_run(key, arguments, purpose)
            except SimulationError as error:
                self._tables[key] = error
        table = self._tables[key]
        if isinstance(table, SimulationError):
            raise table
        return table

    def store(self, table: FloatArray, values: Mapping[str, float], seed: int) -> None:
        """Cache a prediction (t, s) of the base model from another source; an existing one stays.

        Raises:
            RunError: the folder can't be written to.
        """
        key = self._key({"values": dict(values), "effects": (), "seed": seed, "variant": ""})
        if self._cached(key) is None:
            self._write(key, table)

    @contextmanager
    def using(self, executor: Executor) -> Iterator[None]:
        """While the block runs, ``prefetch`` submits simulations to the executor."""
        self._executor = executor
        try:
            yield
        finally:
            self._executor, self._submitted = None, {}

    def prefetch(self, work: Callable[[Simulate], object]) -> None:
        """Submit the simulations that some work will request, the last ones first: this process runs the first.

        Args:
            work: requests simulations from its argument, which returns zeros here.
        """
        if self._executor is None:
            return
        requested: dict[str, Arguments] = {}

        def record(values: Mapping[str, float], *, purpose: str = "", **others: Any) -> FloatArray:
            arguments = {"values": dict(values), "effects": (), "seed": 0, "variant": "", **others}
            requested.setdefault(self._key(arguments), arguments)
            return np.zeros(self.experiment.layout.shape)

        work(record)
        drawings = {*self.experiment.albedo_draws, *self.experiment.renderings}
        batches: list[dict[str, Arguments]] = []
        latest: dict[object, dict[str, Arguments]] = {}
        for key, arguments in requested.items():
            if key in self._tables or key in self._submitted or self._cached(key) is not None:
                continue
            # Renderings of one simulation stay in one process: on a GPU a second simulation differs in the last bits.
            drawn = arguments["variant"] in drawings
            kind = (
                self._key({**arguments, "variant": ""})
                if drawn
                else (*sorted(arguments["effects"]), arguments["variant"])
            )
            if kind not in latest or (len(latest[kind]) == self._executor.batch_size and not drawn):
                latest[kind] = {}
                batches.append(latest[kind])
            latest[kind][key] = arguments
        with suppress(BrokenExecutor):  # without workers this process runs everything
            for jobs in reversed(batches):
                self._submitted |= dict.fromkeys(jobs, _Batch(jobs, self._executor.submit(list(jobs.values()))))

    def _key(self, arguments: Arguments) -> str:
        effects = sorted(f"{name} {self.sources.get(name, '')}".rstrip() for name in arguments["effects"])
        return digest({**self.identity, **arguments, "effects": effects})

    def _load_or_run(self, key: str, arguments: Arguments, purpose: str) -> FloatArray:
        """From the cache, from a worker that has begun it, or run here with the rest of its batch."""
        batch, cached = self._submitted.pop(key, None), self._cached(key)
        if cached is not None and batch is None:
            return cached
        self.report(purpose)
        if batch is not None and batch.future.cancel():
            self._submitted = {name: other for name, other in self._submitted.items() if other is not batch}
            return self._run_batch(key, batch.jobs)
        if batch is not None:
            wait([batch.future])
            if (cached := self._cached(key)) is not None:
                self.simulated += 1
                return cached
        # A worker's error is raised here again, with its message.
        return self._run(key, arguments)

    def _run_batch(self, key: str, jobs: Mapping[str, Arguments]) -> FloatArray:
        """Run and cache a batch; return the table of ``key``."""
        if len(jobs) > 1 and self._executor is not None:
            self._executor.prepare(list(jobs.values()))
        table = self._run(key, jobs[key])
        for other in (name for name in jobs if name != key):
            # the error is raised when this simulation is requested
            with suppress(SimulationError):
                if self._cached(other) is None:
                    self._run(other, jobs[other])
        return table

    def _run(self, key: str, arguments: Arguments) -> FloatArray:
        table = self.experiment.predict(**arguments)
        self.simulated += 1
        self._write(key, table)
        return table

    def _cached(self, key: str) -> FloatArray | None:
        if self.folder is None:
            table = self._tables.get(key)
            return None if isinstance(table, SimulationError) else table
        path = self.folder / f"{key[:32]}.npy"
        table = read_npy(path) if path.is_file() else None
        return table if table is not None and table.shape == self.experiment.layout.shape else None

    def _write(self, key: str, table: FloatArray) -> None:
        if self.folder is None:
            self._tables[key] = table
            return
        stream = io.BytesIO()
        np.save(stream, table, allow_pickle=False)
        write_bytes(self.folder / f"{key[:32]}.npy", stream.getvalue())
