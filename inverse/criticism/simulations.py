"""Simulations that criticism asks for, each made once and kept, so that an interruption costs one."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from splatsoil.inverse.evaluations import digest

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Experiment
from splatsoil.files import read_npy, write_bytes
from splatsoil.soil.effect import Effect

FloatArray = npt.NDArray[np.float64]
Simulate = Callable[..., FloatArray]
T = TypeVar("T")

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
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path | None = None,
        identity: Mapping[str, Any] | None = None,
        told: Callable[[str], None] | None = None,
    ) -> None:
        self.experiment, self.folder = experiment, folder
        self.identity, self.told = dict(identity or {}), told
        self.made = 0
        """Simulations made, not read."""
        self._tables: dict[str, Future[FloatArray]] = {}
        self._planned: dict[str, _Plan] = {}
        self._helpers: Helpers | None = None
        # One simulation at a time in this process, whatever the number of its threads.
        self._here, self._guard = Lock(), Lock()
        self._stopped = False

    @property
    def asked(self) -> int:
        """Different simulations that were needed, and could be made."""
        return sum(table.done() and table.exception() is None for table in self._tables.values())

    def __call__(
        self,
        values: Mapping[str, float],
        *,
        effects: tuple[str | Effect, ...] = (),
        seed: int = 0,
        numerics: str = "",
        purpose: str = "",
    ) -> FloatArray:
        """(t, s) predicted features. Threads may call it side by side.

        Raises:
            SimulationError: the simulation could not go on.
            RunError: what is kept of it is damaged.
        """
        what = {"values": dict(values), "effects": effects, "seed": seed, "numerics": numerics}
        key = self._key(what)
        with self._guard:
            table, mine = self._tables.get(key), key not in self._tables
            if table is None:
                table = self._tables[key] = Future()
        if mine:
            try:
                table.set_result(self._find(key, what, purpose))
            except BaseException as error:
                table.set_exception(error)
        return table.result()

    @contextmanager
    def helped(self, helpers: Helpers) -> Iterator[None]:
        """While the block runs, others simulate, too."""
        self._helpers = helpers
        try:
            yield
        finally:
            self._helpers, self._planned = None, {}

    def ahead(self, work: Callable[[Simulate], object], *, apart: bool = False) -> None:
        """Have the helpers make what some work will ask for, from the last on; the first ones are made here.

        Args:
            work: asks its argument for simulations, as it would ask this, and gets zeros.
            apart: share out what is best made together, too: for a few that somebody waits for.
        """
        if self._helpers is None:
            return
        asked: list[dict[str, Any]] = []

        def noted(values: Mapping[str, float], *, purpose: str = "", **others: Any) -> FloatArray:
            asked.append({"values": dict(values), "effects": (), "seed": 0, "numerics": "", **others})
            return np.zeros(self.experiment.layout.shape)

        work(noted)
        drawings = {*self.experiment.guesses, *self.experiment.redrawn}
        with self._guard:
            known = {*self._tables, *self._planned}
        new = {key: what for what in asked if (key := self._key(what)) not in known and self._kept(key) is None}
        together = 1 if apart else self._helpers.together
        shares: list[dict[str, dict[str, Any]]] = []
        latest: dict[object, dict[str, dict[str, Any]]] = {}
        for key, what in new.items():
            # What only draws a simulation otherwise is left to one process: on a GPU no second one is quite the same.
            drawn = what["numerics"] in drawings
            kind = self._key({**what, "numerics": ""}) if drawn else (*_names(what["effects"]), what["numerics"])
            if kind not in latest or (len(latest[kind]) == together and not drawn):
                latest[kind] = {}
                shares.append(latest[kind])
            latest[kind][key] = what
        for jobs in reversed(shares):
            plan = _Plan(jobs, self._helpers.submit(list(jobs.values())))
            with self._guard:
                self._planned |= dict.fromkeys(jobs, plan)

    def forget(self) -> None:
        """Helpers don't make what they were told `ahead` and haven't begun with."""
        with self._guard:
            for plan in self._planned.values():
                plan.future.cancel()
            self._planned = {key: plan for key, plan in self._planned.items() if not plan.future.cancelled()}

    def side_by_side(self, jobs: Iterable[Callable[[], T]]) -> list[T]:
        """Results of jobs that wait for simulations, in order, as many at a time as there are processes."""
        if self._helpers is None:
            return [job() for job in jobs]
        pool = ThreadPoolExecutor(1 + self._helpers.count)
        try:
            return [future.result() for future in [pool.submit(job) for job in jobs]]
        except BaseException:
            self._stopped = True
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def _key(self, what: Mapping[str, Any]) -> str:
        return digest({**self.identity, **what, "effects": _names(what["effects"])})

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{key[:32]}.npy"

    def _kept(self, key: str) -> FloatArray | None:
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        table: FloatArray = read_npy(path)
        return table if table.shape == self.experiment.layout.shape else None

    def _find(self, key: str, what: Mapping[str, Any], purpose: str) -> FloatArray:
        plan, mine = self._taken(key)
        try:
            kept = self._kept(key)
            if kept is not None and plan is None:
                return kept
            if self._stopped:
                raise CancelledError
            with self._guard:
                self.made += 1
            if self.told is not None:
                self.told(purpose)
            if plan is None or mine:
                return self._made(key, {key: what} if plan is None else plan.jobs)
            # Tables are there one by one, before the whole share is.
            while kept is None and not plan.future.done():
                wait([plan.future], timeout=POLL)
                kept = self._kept(key)
            kept = self._kept(key) if kept is None else kept
            return self._made(key, {key: what}) if kept is None else kept
        finally:
            if plan is not None and mine:
                plan.future.set_result(None)  # whatever came of it, nobody waits for it any more

    def _taken(self, key: str) -> tuple[_Plan | None, bool]:
        """What a simulation is planned with, if it is, and whether this thread is to make all of that now."""
        with self._guard:
            plan = self._planned.pop(key, None)
            if plan is None or not plan.future.cancel():
                return plan, False
            future: Future[Any] = Future()
            future.set_running_or_notify_cancel()
            plan = _Plan(plan.jobs, future)
            self._planned |= dict.fromkeys(self._planned.keys() & plan.jobs.keys(), plan)
            return plan, True

    def _made(self, key: str, jobs: Mapping[str, Mapping[str, Any]]) -> FloatArray:
        """New simulations, made here, or by a helper while this process is at another one; the one named is returned.

        Args:
            key: its name.
            jobs: arguments of ``predict`` by name, its own among them.
        """
        free = self._here.acquire(blocking=False)
        named = all(isinstance(e, str) for what in jobs.values() for e in what["effects"])
        if not free and self._helpers is not None and named:
            wait([self._helpers.submit(list(jobs.values()))])
            kept = self._kept(key)
            if kept is not None:
                return kept
        if not free:
            # Whatever went wrong there, it will be met here, too, and said.
            self._here.acquire()
        try:
            if len(jobs) > 1 and self._helpers is not None:
                self._helpers.prepare(list(jobs.values()))
            made = self._predicted(key, jobs[key])
            for other in (name for name in jobs if name != key):
                if self._stopped:
                    break
                # whoever asks for it meets the error
                with suppress(SimulationError):
                    if self._kept(other) is None:
                        self._predicted(other, jobs[other])
        finally:
            self._here.release()
        return made

    def _predicted(self, key: str, what: Mapping[str, Any]) -> FloatArray:
        """A simulation made here and now, and kept."""
        made = self.experiment.predict(
            what["values"], effects=tuple(what["effects"]), seed=what["seed"], numerics=what["numerics"]
        )
        path = self._path(key)
        if path is not None:
            stream = io.BytesIO()
            np.save(stream, made, allow_pickle=False)
            write_bytes(path, stream.getvalue())
        return made


def _names(effects: Iterable[str | Effect]) -> list[str]:
    """Of effects, in an order of their own."""
    return sorted(e if isinstance(e, str) else e.name for e in effects)
