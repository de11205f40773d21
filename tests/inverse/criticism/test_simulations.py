"""Simulations shared out between processes: the same tables, each made once, whatever a helper does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.inverse.criticism.simulations import Executor, Simulations

from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.features import Layout, Site

AT = {"angle": 0.5}


def table(values: Mapping[str, float], seed: int = 0, variant: str = "", effects: Sequence[str] = ()) -> np.ndarray:
    """(2, 1) another one for every simulation."""
    name = "".join(sorted(effects)) + variant
    return np.array([[values["angle"]], [100.0 * seed + sum(map(ord, name))]])


class Watched:
    """An experiment that notes what it is asked for, and by itself takes a moment for each."""

    layout = Layout((0.0, 1.0), (Site("camera", 0.0, 0.0),), "frame", "1", ("pushing",) * 2, np.full((2, 1), "trench"))
    albedo_draws, renderings = ("guess 1", "guess 2"), ("rounding",)

    def __init__(self, fails: Callable[[Mapping[str, float]], bool] = lambda values: False) -> None:
        self.fails = fails
        self.calls: list[Mapping[str, float]] = []
        self.prepared: list[Sequence[Mapping[str, Any]]] = []

    def predict(self, values: Mapping[str, float], **others: Any) -> np.ndarray:
        self.calls.append(values)
        time.sleep(0.005)
        if self.fails(values):
            raise SimulationError("blew up")
        return table(values, **others)


def simulations(experiment: Watched, folder: Path | None = None) -> Simulations:
    return Simulations(experiment, folder)  # type: ignore[arg-type]


@contextmanager
def helper(experiment: Watched, folder: Path, together: int = 1, mine: Watched | None = None) -> Iterator[Executor]:
    """One, of whom nothing is heard but what it keeps in the folder."""
    theirs = simulations(experiment, folder)

    def work(jobs: Sequence[Mapping[str, Any]]) -> None:
        experiment.prepared.append(jobs)
        for job in jobs:
            try:
                theirs(**job)
            except SimulationError:
                continue

    with ThreadPoolExecutor(1) as pool:
        yield Executor(lambda jobs: pool.submit(work, jobs), together, mine.prepared.append if mine else len)


def everything(ask: Callable[..., np.ndarray]) -> list[np.ndarray]:
    """Work that asks for simulations of several kinds, some of them twice."""
    base = [ask({"angle": 0.1 * k}, seed=k) for k in range(6)]
    effects = [ask({"angle": 0.1 * k}, effects=("cohesion",), seed=k) for k in range(6)]
    fine = [ask({"angle": 0.1 * k}, variant="fine") for k in range(3)]
    drawn = [ask(AT, variant=name) for name in ("", "guess 1", "guess 2", "rounding")]
    return [*base, *effects, *fine, *drawn, ask({"angle": 0.1}, seed=1)]


@pytest.mark.parametrize("batch", [1, 4])
def test_what_will_be_asked_for_is_made_by_both_and_only_once(batch: int, tmp_path: Path) -> None:
    mine, theirs = Watched(), Watched()
    simulate = simulations(mine, tmp_path)
    with helper(theirs, tmp_path, batch, mine) as helpers, simulate.using(helpers):
        simulate.prefetch(everything)
        together = everything(simulate)
    assert mine.calls and theirs.calls
    assert len(mine.calls) + len(theirs.calls) == simulate.requested == simulate.simulated == 19
    # What goes together is alike, and no more of it than is good; what is one by itself needs no preparing.
    drawings = {*Watched.albedo_draws, *Watched.renderings}
    for jobs in (*mine.prepared, *theirs.prepared):
        assert len({(*job["effects"], "" if job["variant"] in drawings else job["variant"]) for job in jobs}) == 1
        assert len(jobs) <= batch or {job["variant"] for job in jobs} == drawings
    assert all(len(jobs) > 1 for jobs in mine.prepared)
    assert any(len(jobs) == 4 for jobs in (*mine.prepared, *theirs.prepared)) is (batch == 4)
    assert all(np.array_equal(a, b) for a, b in zip(everything(simulations(Watched())), together, strict=True))


def test_what_is_kept_is_read_and_not_made_again(tmp_path: Path) -> None:
    first, again = simulations(Watched(), tmp_path), simulations(Watched(), tmp_path)
    reported: list[str] = []
    again.report = reported.append
    kept = everything(first)
    assert all(np.array_equal(a, b) for a, b in zip(kept, everything(again), strict=True))
    assert (first.simulated, again.simulated, again.requested, reported) == (19, 0, 19, [])
    again({"angle": 9.0}, purpose="another")
    assert (again.simulated, reported) == (1, ["another"])


def test_a_share_is_made_whole_by_who_takes_it_and_one_failure_in_it_is_no_other_ones(tmp_path: Path) -> None:
    mine = Watched(lambda values: values["angle"] == 2.0)
    simulate = simulations(mine, tmp_path)
    shares: list[Sequence[Mapping[str, Any]]] = []

    def never(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        shares.append(jobs)
        return Future()

    angles = (1.0, 2.0, 3.0)
    with simulate.using(Executor(never, 4)):
        simulate.prefetch(lambda ask: [ask({"angle": angle}) for angle in angles])
        assert [len(jobs) for jobs in shares] == [3]
        assert np.array_equal(simulate({"angle": 1.0}), table({"angle": 1.0}))
        assert len(list(tmp_path.iterdir())) == 2, "the third is there, too"
        with pytest.raises(SimulationError, match="blew up"):
            simulate({"angle": 2.0})
        assert np.array_equal(simulate({"angle": 3.0}), table({"angle": 3.0}))
    assert [call["angle"] for call in mine.calls] == [1.0, 2.0, 3.0, 2.0]
    assert simulate.requested == simulate.simulated == 2


def test_all_drawings_of_a_simulation_are_one_share_whatever_is_best_made_at_a_time() -> None:
    shares: list[list[str]] = []

    def never(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        shares.append([job["variant"] for job in jobs])
        return Future()

    simulate = simulations(Watched())
    with simulate.using(Executor(never, 2)):
        simulate.prefetch(lambda ask: [ask(AT, variant=n) for n in ("guess 1", "guess 2", "fine", "rounding", "")])
    assert sorted(sorted(share) for share in shares) == [[""], ["fine"], ["guess 1", "guess 2", "rounding"]]


@pytest.mark.parametrize("error", [None, RunError("a worker died 4 times")])
def test_a_worker_that_fails_or_dies_costs_nothing(tmp_path: Path, error: Exception | None) -> None:
    def dead(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        done: Future[None] = Future()
        done.set_exception(error) if error else done.set_result(None)
        return done

    mine = Watched(lambda values: values["angle"] > 1.0)
    simulate = simulations(mine, tmp_path)
    with simulate.using(Executor(dead)):
        simulate.prefetch(lambda ask: [ask(AT), ask({"angle": 2.0})])
        assert np.array_equal(simulate(AT), table(AT))
        for _ in range(2):
            with pytest.raises(SimulationError, match="blew up"):
                simulate({"angle": 2.0})
    assert len(mine.calls) == 2 and simulate.requested == 1


def test_what_decides_a_simulation_and_nothing_else_makes_it_another(tmp_path: Path) -> None:
    """Effects in whatever order; another file of the same name: only what it is on in is made anew."""
    simulate = Simulations(Watched(), tmp_path, sources={"own": "one"})  # type: ignore[arg-type]
    for effects in (("tilt", "own"), ("own", "tilt"), ("tilt",), ()):
        simulate(AT, effects=effects, purpose="any")
    assert simulate.simulated == 3
    simulate(AT, effects=("tilt",), seed=1)
    simulate(AT, effects=("tilt",), variant="fine")
    simulate({"angle": 0.6}, effects=("tilt",))
    assert simulate.simulated == 6
    other = Simulations(Watched(), tmp_path, sources={"own": "other"})  # type: ignore[arg-type]
    for effects in (("tilt", "own"), ("tilt",), ()):
        other(AT, effects=effects)
    assert other.simulated == 1


def test_what_was_made_elsewhere_is_kept_and_not_made_again(tmp_path: Path) -> None:
    experiment = Watched()
    simulations(experiment, tmp_path).store(table(AT, 7), AT, 7)
    later = simulations(experiment, tmp_path)
    later.store(table(AT, 8), AT, 7)
    assert np.array_equal(later(AT, seed=7), table(AT, 7)), "the first one stays"
    assert experiment.calls == [] and (later.simulated, later.requested) == (0, 1)
