"""Simulations that criticism asks for, each made once and kept, so that an interruption costs one."""

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
class Helpers:
    """Other processes that simulate the same experiment and keep what they make in the same folder.

    Attributes:
        submit: simulations to a future that is done when they are kept, or could not be made.
        together: how many simulations are best made by one at a time.
        prepare: has this process do for simulations what is best done for all of them at once.
    """

    submit: Callable[[Sequence[Arguments]], Future[Any]]
    together: int = 1
    prepare: Callable[[Sequence[Arguments]], object] = lambda jobs: None


@dataclass(frozen=True)
class _Plan:
    """Simulations by key that a helper will make, unless this process is there first."""

    jobs: Mapping[str, Arguments]
    future: Future[Any]


class Simulations:
    """An experiment's predictions, from a folder where they are there already.

    Args:
        experiment: predicts.
        folder: where feature tables are kept; None keeps them in memory only.
        identity: everything beside the arguments of ``predict`` that decides a prediction.
        told: called before each new simulation with what it is for.
        sources: digests of the files that define effects, by their names, where these are a user's own.
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path | None = None,
        identity: Mapping[str, Any] | None = None,
        told: Callable[[str], None] = lambda purpose: None,
        sources: Mapping[str, str] | None = None,
    ) -> None:
        self.experiment, self.folder = experiment, folder
        self.identity, self.sources, self.told = dict(identity or {}), dict(sources or {}), told
        self.made = 0
        """Simulations made, not read."""
        self._tables: dict[str, FloatArray | SimulationError] = {}
        self._planned: dict[str, _Plan] = {}
        self._helpers: Helpers | None = None

    @property
    def asked(self) -> int:
        """Different simulations that were needed, and could be made."""
        return sum(not isinstance(table, SimulationError) for table in self._tables.values())

    def __call__(
        self,
        values: Mapping[str, float],
        *,
        effects: tuple[str, ...] = (),
        seed: int = 0,
        numerics: str = "",
        purpose: str = "",
    ) -> FloatArray:
        """(t, s) predicted features.

        Raises:
            SimulationError: the simulation could not go on.
            RunError: what is kept of it is damaged.
        """
        what = {"values": dict(values), "effects": effects, "seed": seed, "numerics": numerics}
        key = self._key(what)
        if key not in self._tables:
            try:
                self._tables[key] = self._found(key, what, purpose)
            except SimulationError as error:
                self._tables[key] = error
        table = self._tables[key]
        if isinstance(table, SimulationError):
            raise table
        return table

    def keep(self, table: FloatArray, values: Mapping[str, float], seed: int) -> None:
        """A prediction (t, s) of the base model that was made elsewhere; one that is there already stays.

        Raises:
            RunError: the folder can't be written to.
        """
        key = self._key({"values": dict(values), "effects": (), "seed": seed, "numerics": ""})
        if self._kept(key) is None:
            self._write(key, table)

    @contextmanager
    def helped(self, helpers: Helpers) -> Iterator[None]:
        """While the block runs, others simulate, too."""
        self._helpers = helpers
        try:
            yield
        finally:
            self._helpers, self._planned = None, {}

    def ahead(self, work: Callable[[Simulate], object]) -> None:
        """Have the helpers make what some work will ask for, from the last on; the first ones are made here.

        Args:
            work: asks its argument for simulations, as it would ask this, and gets zeros.
        """
        if self._helpers is None:
            return
        asked: dict[str, Arguments] = {}

        def noted(values: Mapping[str, float], *, purpose: str = "", **others: Any) -> FloatArray:
            what = {"values": dict(values), "effects": (), "seed": 0, "numerics": "", **others}
            asked.setdefault(self._key(what), what)
            return np.zeros(self.experiment.layout.shape)

        work(noted)
        drawings = {*self.experiment.guesses, *self.experiment.redrawn}
        shares: list[dict[str, Arguments]] = []
        latest: dict[object, dict[str, Arguments]] = {}
        for key, what in asked.items():
            if key in self._tables or key in self._planned or self._kept(key) is not None:
                continue
            # What only draws a simulation otherwise is left to one process: on a GPU no second one is quite the same.
            drawn = what["numerics"] in drawings
            kind = self._key({**what, "numerics": ""}) if drawn else (*sorted(what["effects"]), what["numerics"])
            if kind not in latest or (len(latest[kind]) == self._helpers.together and not drawn):
                latest[kind] = {}
                shares.append(latest[kind])
            latest[kind][key] = what
        with suppress(BrokenExecutor):  # helpers that died cost nothing but their help
            for jobs in reversed(shares):
                self._planned |= dict.fromkeys(jobs, _Plan(jobs, self._helpers.submit(list(jobs.values()))))

    def _key(self, what: Arguments) -> str:
        effects = sorted(f"{name} {self.sources.get(name, '')}".rstrip() for name in what["effects"])
        return digest({**self.identity, **what, "effects": effects})

    def _found(self, key: str, what: Arguments, purpose: str) -> FloatArray:
        """What is kept, or will be by a helper; else made here, with all that goes with it."""
        plan, kept = self._planned.pop(key, None), self._kept(key)
        if kept is not None and plan is None:
            return kept
        self.told(purpose)
        if plan is not None and plan.future.cancel():
            self._planned = {name: other for name, other in self._planned.items() if other is not plan}
            return self._make(key, plan.jobs)
        if plan is not None:
            wait([plan.future])
            if (kept := self._kept(key)) is not None:
                self.made += 1
                return kept
        # Whatever went wrong there, it will be met here, too, and said.
        return self._make(key, {key: what})

    def _make(self, key: str, jobs: Mapping[str, Arguments]) -> FloatArray:
        """New simulations by key, kept; the one with this key is returned."""
        if len(jobs) > 1 and self._helpers is not None:
            self._helpers.prepare(list(jobs.values()))
        made = self._predicted(key, jobs[key])
        for other in (name for name in jobs if name != key):
            # whoever asks for it meets the error
            with suppress(SimulationError):
                if self._kept(other) is None:
                    self._predicted(other, jobs[other])
        return made

    def _predicted(self, key: str, what: Arguments) -> FloatArray:
        made = self.experiment.predict(**what)
        self.made += 1
        self._write(key, made)
        return made

    def _kept(self, key: str) -> FloatArray | None:
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
