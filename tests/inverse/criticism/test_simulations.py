"""Simulations shared out between processes: the same tables, each made once, whatever a helper does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism.evidence import gather
from splatsoil.inverse.criticism.simulations import Helpers, Simulations

from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.emulated import EmulatedExperiment

AT = {"angle": 0.5}


class Watched:
    """An experiment that notes who asks it for what, and minds being asked twice at a time."""

    def __init__(self, fails: Callable[[Mapping[str, float]], bool] = lambda values: False) -> None:
        self.inner, self.fails = emulated(3), fails
        self.calls: list[Mapping[str, float]] = []
        self.threads: set[int] = set()
        self.prepared: list[Sequence[Mapping[str, Any]]] = []
        self.busy = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def predict(self, values: Mapping[str, float], **others: Any) -> np.ndarray:
        assert not self.busy
        self.busy = True
        self.calls.append(values)
        self.threads.add(threading.get_ident())
        time.sleep(0.005)
        self.busy = False
        if self.fails(values):
            raise SimulationError("blew up")
        return self.inner.predict(values, **others)


@contextmanager
def helper(experiment: Watched, folder: Path, together: int = 1, mine: Watched | None = None) -> Iterator[Helpers]:
    """One, of whom nothing is heard but what it keeps in the folder."""
    theirs = Simulations(experiment, folder)

    def work(jobs: Sequence[Mapping[str, Any]]) -> None:
        experiment.prepared.append(jobs)
        for job in jobs:
            try:
                theirs(**job)
            except SimulationError:
                continue

    with ThreadPoolExecutor(1) as pool:
        yield Helpers(1, lambda jobs: pool.submit(work, jobs), together, mine.prepared.append if mine else len)


@pytest.mark.parametrize("batch", [1, 4])
def test_what_will_be_asked_for_is_made_by_both_and_only_once(batch: int, tmp_path: Path) -> None:
    alone = gather(emulated(3), Simulations(emulated(3)), AT, repeats=3)
    mine, theirs = Watched(), Watched()
    simulate = Simulations(mine, tmp_path)
    with helper(theirs, tmp_path, batch, mine) as helpers, simulate.helped(helpers):
        simulate.ahead(lambda ask: gather(mine, ask, AT, repeats=3))
        together = gather(mine, simulate, AT, repeats=3)
    assert mine.calls and theirs.calls
    assert len(mine.calls) + len(theirs.calls) == simulate.asked == simulate.made
    # What goes together is alike, and no more of it than is good; what is one by itself needs no preparing.
    for jobs in (*mine.prepared, *theirs.prepared):
        assert len({(*job["effects"], job["numerics"]) for job in jobs}) == 1 and len(jobs) <= batch
    assert (max(map(len, theirs.prepared)) > 1) is (batch > 1)
    assert all(len(jobs) > 1 for jobs in mine.prepared) and bool(mine.prepared) is (batch > 1)
    for name in ("mean", "repeats"):
        assert np.array_equal(getattr(alone, name), getattr(together, name))
    for name in ("slopes", "directions", "numerics"):
        assert getattr(alone, name).keys() == getattr(together, name).keys()
        assert all(np.array_equal(table, getattr(together, name)[key]) for key, table in getattr(alone, name).items())


def test_a_share_is_made_whole_by_who_takes_it_and_one_failure_in_it_is_no_other_ones(tmp_path: Path) -> None:
    mine = Watched(lambda values: values["angle"] == 2.0)
    simulate = Simulations(mine, tmp_path)
    shares: list[Sequence[Mapping[str, Any]]] = []

    def never(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        shares.append(jobs)
        return Future()

    angles = (1.0, 2.0, 3.0)
    with simulate.helped(Helpers(1, never, 4)):
        simulate.ahead(lambda ask: [ask({"angle": angle}) for angle in angles])
        assert [len(jobs) for jobs in shares] == [3]
        assert np.array_equal(simulate({"angle": 1.0}), emulated(3).predict({"angle": 1.0}))
        assert len(list(tmp_path.iterdir())) == 2, "the third is there, too"
        with pytest.raises(SimulationError, match="blew up"):
            simulate({"angle": 2.0})
        assert np.array_equal(simulate({"angle": 3.0}), emulated(3).predict({"angle": 3.0}))
    assert [call["angle"] for call in mine.calls] == [1.0, 2.0, 3.0, 2.0]


def drawn_otherwise(offset: float) -> EmulatedExperiment:
    """Three guesses and one numerics that only draw a simulation otherwise."""
    base = emulated(3)
    names = [name for name in base.slopes if name.startswith("effect")][:3]
    guessed = {f"guess {k}": base.slopes[name] + offset for k, name in enumerate(names)}
    return replace(base, guessed=guessed, redrawn=("grid",))


def test_all_drawings_of_a_simulation_are_one_share_whatever_is_best_made_at_a_time() -> None:
    experiment = drawn_otherwise(0.0)
    shares: list[list[str]] = []

    def never(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        shares.append([job["numerics"] for job in jobs])
        return Future()

    simulate = Simulations(experiment)
    with simulate.helped(Helpers(1, never, 2)):
        simulate.ahead(lambda ask: [ask(AT, numerics=name) for name in (*experiment.guesses, "step", "grid", "")])
    assert sorted(sorted(share) for share in shares) == [[""], ["grid", "guess 0", "guess 1", "guess 2"], ["step"]]


def test_guesses_are_told_from_their_own_mean() -> None:
    """What all of them differ by from another simulation, which is never quite the same on a GPU, is no colour."""
    one, other = (gather(drawn_otherwise(offset), Simulations(drawn_otherwise(offset)), AT) for offset in (0.0, 7.0))
    assert np.allclose(one.guesses, other.guesses)
    patterns = np.stack(list(drawn_otherwise(0.0).guessed.values()))
    assert np.allclose(one.guesses[0] - one.guesses[1], np.sqrt(1.5) * (patterns[0] - patterns[1]))


def test_nobody_waits_for_a_share_that_was_given_up(tmp_path: Path) -> None:
    def told(purpose: str) -> None:
        if purpose == "interrupted":
            raise RuntimeError("no")

    simulate = Simulations(Watched(), tmp_path, told=told)
    done: list[np.ndarray] = []
    with simulate.helped(Helpers(1, lambda jobs: Future(), 2)):
        simulate.ahead(lambda ask: [ask({"angle": 1.0}), ask({"angle": 2.0})])
        with pytest.raises(RuntimeError, match="no"):
            simulate({"angle": 1.0}, purpose="interrupted")
        other = threading.Thread(target=lambda: done.append(simulate({"angle": 2.0})), daemon=True)
        other.start()
        other.join(20.0)
    assert len(done) == 1 and np.array_equal(done[0], emulated(3).predict({"angle": 2.0}))


def test_a_few_that_somebody_waits_for_are_shared_out(tmp_path: Path) -> None:
    simulate, shares = Simulations(Watched(), tmp_path), list[int]()

    def counted(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        shares.append(len(jobs))
        return Future()

    with simulate.helped(Helpers(1, counted, 4)):
        simulate.ahead(lambda ask: [ask({"angle": angle}) for angle in (1.0, 2.0, 3.0)], apart=True)
    assert shares == [1, 1, 1]


def test_what_was_foreseen_in_vain_is_not_made(tmp_path: Path) -> None:
    """But for what a helper is at; and it can still be asked for."""
    mine, theirs = Watched(), Watched()
    simulate, begun, go_on = Simulations(mine, tmp_path), threading.Event(), threading.Event()

    def slow(values: Mapping[str, float]) -> bool:
        begun.set()
        return not go_on.wait(20.0)

    theirs.fails = slow
    with helper(theirs, tmp_path) as helpers, simulate.helped(helpers):
        simulate.ahead(lambda ask: [ask({"angle": angle}) for angle in (1.0, 2.0, 3.0)])
        assert begun.wait(20.0)
        simulate.forget()
        go_on.set()
        found = [simulate({"angle": angle}) for angle in (1.0, 3.0)]
    assert theirs.calls == [{"angle": 3.0}], "a helper begins at the far end"
    assert mine.calls == [{"angle": 1.0}]
    for angle, table in zip((1.0, 3.0), found, strict=True):
        assert np.array_equal(table, emulated(3).predict({"angle": angle}))


def test_threads_that_share_a_share_make_it_once(tmp_path: Path) -> None:
    mine = Watched()
    simulate = Simulations(mine, tmp_path)
    angles = [0.1 * k for k in range(6)]
    with simulate.helped(Helpers(5, lambda jobs: Future(), 6)):
        simulate.ahead(lambda ask: [ask({"angle": angle}) for angle in angles])
        found = simulate.side_by_side([partial(simulate, {"angle": angle}) for angle in angles])
    assert len(mine.calls) == 6
    for angle, table in zip(angles, found, strict=True):
        assert np.array_equal(table, emulated(3).predict({"angle": angle}))


def test_jobs_that_wait_for_simulations_run_side_by_side_and_come_back_in_order(tmp_path: Path) -> None:
    mine, theirs = Watched(), Watched()
    simulate = Simulations(mine, tmp_path)

    def job(start: float) -> Callable[[], float]:
        def run() -> float:
            found = [simulate({"angle": start + 0.1 * step})[0, 0] for step in range(4)]
            return float(simulate(AT)[0, 0] + sum(found))

        return run

    starts = (-2.0, 0.0, 2.0)
    with helper(theirs, tmp_path) as helpers, simulate.helped(helpers):
        together = simulate.side_by_side([job(start) for start in starts])
    simulate = Simulations(emulated(3))
    assert together == [job(start)() for start in starts]
    assert mine.calls and theirs.calls
    assert len(mine.calls) + len(theirs.calls) == 13  # what all three asked for was made once


@pytest.mark.parametrize("error", [None, RunError("a worker died 4 times")])
def test_a_helper_that_fails_or_dies_costs_nothing_but_its_help(tmp_path: Path, error: Exception | None) -> None:
    def dead(jobs: Sequence[Mapping[str, Any]]) -> Future[None]:
        done: Future[None] = Future()
        done.set_exception(error) if error else done.set_result(None)
        return done

    mine = Watched(lambda values: values["angle"] > 1.0)
    simulate = Simulations(mine, tmp_path)
    with simulate.helped(Helpers(1, dead)):
        simulate.ahead(lambda ask: [ask(AT), ask({"angle": 2.0})])
        assert np.array_equal(simulate(AT), emulated(3).predict(AT))
        for _ in range(2):
            with pytest.raises(SimulationError, match="blew up"):
                simulate({"angle": 2.0})
    assert len(mine.calls) == 2 and simulate.asked == 1


def test_the_failure_of_one_job_ends_the_others(tmp_path: Path) -> None:
    mine, theirs = Watched(), Watched()
    simulate = Simulations(mine, tmp_path)
    begun, ended = threading.Event(), []

    def broken() -> None:
        begun.wait()
        raise RuntimeError("no")

    def long() -> None:
        try:
            for step in range(1000):
                begun.set()
                simulate({"angle": 0.001 * step})
        except CancelledError:
            ended.append(True)
            raise

    with helper(theirs, tmp_path) as helpers, simulate.helped(helpers), pytest.raises(RuntimeError, match="no"):
        simulate.side_by_side([broken, long])
    assert ended and len(mine.calls) + len(theirs.calls) < 100
