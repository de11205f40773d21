"""Cached simulations of an experiment: each is run once and its feature table stored on disk."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatsoil.arrays import FloatArray
from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment, Run
from splatsoil.files import digest, read_npy, write_bytes

Simulate = Callable[..., FloatArray]


@dataclass(frozen=True)
class Executor:
    """Worker processes that run simulations of the same experiment and store them in the same folder.

    Attributes:
        submit: simulations to a future that is done when they are stored or have failed.
        batch_size: number of simulations that one worker runs as a batch.
        prepare: runs a batch of simulations in this process.
    """

    submit: Callable[[Sequence[Run]], Future[Any]]
    batch_size: int = 1
    prepare: Callable[[Sequence[Run]], object] = lambda runs: None


@dataclass(frozen=True)
class _Batch:
    """Simulations by key, submitted together."""

    runs: Mapping[str, Run]
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

    def __call__(self, run: Run, purpose: str = "") -> FloatArray:
        """(t, s) predicted features; ``purpose`` is reported instead of the run's label.

        Raises:
            SimulationError: the simulation failed.
            RunError: the cached file is damaged.
        """
        key = self._key(run)
        if key not in self._tables:
            try:
                self._tables[key] = self._load_or_run(key, run, purpose or run.label)
            except SimulationError as error:
                self._tables[key] = error
        table = self._tables[key]
        if isinstance(table, SimulationError):
            raise table
        return table

    def store(self, table: FloatArray, run: Run) -> None:
        """Cache a prediction (t, s) from another source; an existing one stays.

        Raises:
            RunError: the folder can't be written to.
        """
        key = self._key(run)
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

    def prefetch(self, runs: Iterable[Run]) -> None:
        """Submit simulations that will be requested in this order, the last ones first: this process runs the first."""
        if self._executor is None:
            return
        renderings = {*self.experiment.albedo_draws, *self.experiment.renderings}
        batches: list[dict[str, Run]] = []
        latest: dict[object, dict[str, Run]] = {}
        for key, run in {self._key(run): run for run in runs}.items():
            if key in self._tables or key in self._submitted or self._cached(key) is not None:
                continue
            # Renderings of one simulation stay in one process: on a GPU a second simulation differs in the last bits.
            rendered = run.variant in renderings
            kind = self._key(replace(run, variant="")) if rendered else (*sorted(run.effects), run.variant)
            if kind not in latest or (len(latest[kind]) == self._executor.batch_size and not rendered):
                latest[kind] = {}
                batches.append(latest[kind])
            latest[kind][key] = run
        with suppress(BrokenExecutor):  # without workers this process runs everything
            for batch in reversed(batches):
                self._submitted |= dict.fromkeys(batch, _Batch(batch, self._executor.submit(list(batch.values()))))

    def _key(self, run: Run) -> str:
        effects = sorted(f"{name} {self.sources.get(name, '')}".rstrip() for name in run.effects)
        return digest({**self.identity, **vars(run), "values": dict(run.values), "effects": effects})

    def _load_or_run(self, key: str, run: Run, purpose: str) -> FloatArray:
        """From the cache, from a worker that has begun it, or run here with the rest of its batch."""
        batch, cached = self._submitted.pop(key, None), self._cached(key)
        if cached is not None and batch is None:
            return cached
        self.report(purpose)
        if batch is not None and batch.future.cancel():
            self._submitted = {name: other for name, other in self._submitted.items() if other is not batch}
            return self._run_batch(key, batch.runs)
        if batch is not None:
            wait([batch.future])
            if (cached := self._cached(key)) is not None:
                self.simulated += 1
                return cached
        # A worker's error is raised here again, with its message.
        return self._run(key, run)

    def _run_batch(self, key: str, runs: Mapping[str, Run]) -> FloatArray:
        """Run and cache a batch; return the table of ``key``."""
        if len(runs) > 1 and self._executor is not None:
            self._executor.prepare(list(runs.values()))
        table = self._run(key, runs[key])
        for other in (name for name in runs if name != key):
            # the error is raised when this simulation is requested
            with suppress(SimulationError):
                if self._cached(other) is None:
                    self._run(other, runs[other])
        return table

    def _run(self, key: str, run: Run) -> FloatArray:
        table = self.experiment.predict(run)
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
