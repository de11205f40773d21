"""Simulations that criticism asks for, each made once and kept, so that an interruption costs one."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.inverse.evaluations import digest

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.files import read_npy, write_bytes

FloatArray = npt.NDArray[np.float64]
Simulate = Callable[..., FloatArray]

POLL = 0.05
"""Seconds between looks for a table that another process makes."""


def _unprepared(jobs: Sequence[Mapping[str, Any]]) -> None:
    """Nothing is done for all of them at once."""


@dataclass(frozen=True)
class Helpers:
    """Other processes that simulate the same experiment and keep what they make in the same folder.

    Attributes:
        count: of them.
        submit: simulations' keyword arguments to a future that is done when they are kept, or could not be made.
        together: how many simulations are best made by one at a time.
        prepare: has this process do for simulations what is best done for all of them at once.
    """

    count: int
    submit: Callable[[Sequence[Mapping[str, Any]]], Future[Any]]
    together: int = 1
    prepare: Callable[[Sequence[Mapping[str, Any]]], object] = _unprepared


@dataclass(frozen=True)
class _Plan:
    """Simulations that a helper will make, unless this process is there first, or that this process makes now."""

    jobs: Mapping[str, Mapping[str, Any]]
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
        told: Callable[[str], None] | None = None,
        sources: Mapping[str, str] | None = None,
    ) -> None:
        self.experiment, self.folder = experiment, folder
        self.identity, self.told = dict(identity or {}), told
        self.sources = dict(sources or {})
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
                self._tables[key] = self._find(key, what, purpose)
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
        if self.folder is None:
            self._tables.setdefault(key, table)
        elif self._kept(key) is None:
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
        asked: list[dict[str, Any]] = []

        def noted(values: Mapping[str, float], *, purpose: str = "", **others: Any) -> FloatArray:
            asked.append({"values": dict(values), "effects": (), "seed": 0, "numerics": "", **others})
            return np.zeros(self.experiment.layout.shape)

        work(noted)
        drawings = {*self.experiment.guesses, *self.experiment.redrawn}
        known = {*self._tables, *self._planned}
        new = {key: what for what in asked if (key := self._key(what)) not in known and self._kept(key) is None}
        shares: list[dict[str, dict[str, Any]]] = []
        latest: dict[object, dict[str, dict[str, Any]]] = {}
        for key, what in new.items():
            # What only draws a simulation otherwise is left to one process: on a GPU no second one is quite the same.
            drawn = what["numerics"] in drawings
            kind = self._key({**what, "numerics": ""}) if drawn else (*sorted(what["effects"]), what["numerics"])
            if kind not in latest or (len(latest[kind]) == self._helpers.together and not drawn):
                latest[kind] = {}
                shares.append(latest[kind])
            latest[kind][key] = what
        for jobs in reversed(shares):
            plan = _Plan(jobs, self._helpers.submit(list(jobs.values())))
            self._planned |= dict.fromkeys(jobs, plan)

    def _key(self, what: Mapping[str, Any]) -> str:
        effects = sorted(f"{name} {self.sources.get(name, '')}".rstrip() for name in what["effects"])
        return digest({**self.identity, **what, "effects": effects})

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{key[:32]}.npy"

    def _kept(self, key: str) -> FloatArray | None:
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        table: FloatArray = read_npy(path)
        return table if table.shape == self.experiment.layout.shape else None

    def _find(self, key: str, what: Mapping[str, Any], purpose: str) -> FloatArray:
        plan, kept = self._planned.pop(key, None), self._kept(key)
        if kept is not None and plan is None:
            return kept
        if self.told is not None:
            self.told(purpose)
        if plan is not None and plan.future.cancel():
            self._planned = {name: other for name, other in self._planned.items() if other is not plan}
            return self._make(key, plan.jobs)
        # Tables are there one by one, before the whole share is.
        while plan is not None and kept is None and not plan.future.done():
            wait([plan.future], timeout=POLL)
            kept = self._kept(key)
        kept = self._kept(key) if kept is None else kept
        if kept is None:
            # Whatever went wrong there, it will be met here, too, and said.
            return self._make(key, {key: what})
        self.made += 1
        return kept

    def _make(self, key: str, jobs: Mapping[str, Mapping[str, Any]]) -> FloatArray:
        """New simulations, made here and kept; the one named is returned.

        Args:
            key: its name.
            jobs: arguments of ``predict`` by name, its own among them.
        """
        if len(jobs) > 1 and self._helpers is not None:
            self._helpers.prepare(list(jobs.values()))
        made = self._predicted(key, jobs[key])
        for other in (name for name in jobs if name != key):
            # whoever asks for it meets the error
            with suppress(SimulationError):
                if self._kept(other) is None:
                    self._predicted(other, jobs[other])
        return made

    def _predicted(self, key: str, what: Mapping[str, Any]) -> FloatArray:
        """A simulation made here and now, and kept."""
        made = self.experiment.predict(
            what["values"], effects=tuple(what["effects"]), seed=what["seed"], numerics=what["numerics"]
        )
        self.made += 1
        self._write(key, made)
        return made

    def _write(self, key: str, table: FloatArray) -> None:
        path = self._path(key)
        if path is not None:
            stream = io.BytesIO()
            np.save(stream, table, allow_pickle=False)
            write_bytes(path, stream.getvalue())
