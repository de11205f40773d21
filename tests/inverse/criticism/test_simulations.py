"""Simulations shared out between processes: the same tables, each made once, whatever a worker does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from splatsoil.inverse.criticism.simulations import Executor, Simulations

from splatsoil.errors import RunError, SimulationError
from splatsoil.experiment.base import Run
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
        self.prepared: list[Sequence[Run]] = []

    def predict(self, run: Run) -> np.ndarray:
        self.calls.append(run.values)
        time.sleep(0.005)
        if self.fails(run.values):
            raise SimulationError("blew up")
        return table(**vars(run))


def simulations(experiment: Watched, folder: Path | None = None) -> Simulations:
    return Simulations(experiment, folder)  # type: ignore[arg-type]


@contextmanager
def worker(experiment: Watched, folder: Path, batch: int = 1, mine: Watched | None = None) -> Iterator[Executor]:
    """One that reports nothing but what it stores in the folder."""
    theirs = simulations(experiment, folder)

    def work(runs: Sequence[Run]) -> None:
        experiment.prepared.append(runs)
        for run in runs:
            try:
                theirs(run)
            except SimulationError:
                continue

    with ThreadPoolExecutor(1) as pool:
        yield Executor(lambda runs: pool.submit(work, runs), batch, mine.prepared.append if mine else len)


def at(angle: float) -> Run:
    return Run({"angle": angle})


#: Runs of several kinds, some of them twice.
RUNS = [
    *(Run({"angle": 0.1 * k}, seed=k) for k in range(6)),
    *(Run({"angle": 0.1 * k}, ("cohesion",), k) for k in range(6)),
    *(Run({"angle": 0.1 * k}, variant="fine") for k in range(3)),
    *(Run(AT, variant=name) for name in ("", "guess 1", "guess 2", "rounding")),
    Run({"angle": 0.1}, seed=1),
]


@pytest.mark.parametrize("batch", [1, 4])
def test_what_will_be_asked_for_is_made_by_both_and_only_once(batch: int, tmp_path: Path) -> None:
    mine, theirs = Watched(), Watched()
    simulate = simulations(mine, tmp_path)
    with worker(theirs, tmp_path, batch, mine) as executor, simulate.using(executor):
        simulate.prefetch(RUNS)
        shared = [simulate(run) for run in RUNS]
    assert mine.calls and theirs.calls
    assert len(mine.calls) + len(theirs.calls) == simulate.requested == simulate.simulated == 19
    # A batch has one kind of simulation, and its size at most; a single simulation needs no preparation.
    renderings = {*Watched.albedo_draws, *Watched.renderings}
    for runs in (*mine.prepared, *theirs.prepared):
        assert len({(*run.effects, "" if run.variant in renderings else run.variant) for run in runs}) == 1
        assert len(runs) <= batch or {run.variant for run in runs} == renderings
    assert all(len(runs) > 1 for runs in mine.prepared)
    assert any(len(runs) == 4 for runs in (*mine.prepared, *theirs.prepared)) is (batch == 4)
    alone = simulations(Watched())
    assert all(np.array_equal(alone(run), table) for run, table in zip(RUNS, shared, strict=True))


def test_what_is_kept_is_read_and_not_made_again(tmp_path: Path) -> None:
    first, again = simulations(Watched(), tmp_path), simulations(Watched(), tmp_path)
    reported: list[str] = []
    again.report = reported.append
    assert all(np.array_equal(first(run), again(run)) for run in RUNS)
    assert (first.simulated, again.simulated, again.requested, reported) == (19, 0, 19, [])
    again(at(9.0), "another")
    again(Run(AT, ("tilt", "blur")))
    assert (again.simulated, reported) == (2, ["another", "tilt, blur"])


def test_a_share_is_made_whole_by_who_takes_it_and_one_failure_in_it_is_no_other_ones(tmp_path: Path) -> None:
    mine = Watched(lambda values: values["angle"] == 2.0)
    simulate = simulations(mine, tmp_path)
    shares: list[Sequence[Run]] = []

    def never(runs: Sequence[Run]) -> Future[None]:
        shares.append(runs)
        return Future()

    angles = (1.0, 2.0, 3.0)
    with simulate.using(Executor(never, 4)):
        simulate.prefetch(at(angle) for angle in angles)
        assert [len(runs) for runs in shares] == [3]
        assert np.array_equal(simulate(at(1.0)), table({"angle": 1.0}))
        assert len(list(tmp_path.iterdir())) == 2, "the third is there, too"
        with pytest.raises(SimulationError, match="blew up"):
            simulate(at(2.0))
        assert np.array_equal(simulate(at(3.0)), table({"angle": 3.0}))
    assert [call["angle"] for call in mine.calls] == [1.0, 2.0, 3.0, 2.0]
    assert simulate.requested == simulate.simulated == 2


def test_all_drawings_of_a_simulation_are_one_share_whatever_is_best_made_at_a_time() -> None:
    shares: list[list[str]] = []

    def never(runs: Sequence[Run]) -> Future[None]:
        shares.append([run.variant for run in runs])
        return Future()

    simulate = simulations(Watched())
    with simulate.using(Executor(never, 2)):
        simulate.prefetch(Run(AT, variant=name) for name in ("guess 1", "guess 2", "fine", "rounding", ""))
    assert sorted(sorted(share) for share in shares) == [[""], ["fine"], ["guess 1", "guess 2", "rounding"]]


@pytest.mark.parametrize("error", [None, RunError("a worker died 4 times")])
def test_a_worker_that_fails_or_dies_costs_nothing(tmp_path: Path, error: Exception | None) -> None:
    def dead(runs: Sequence[Run]) -> Future[None]:
        done: Future[None] = Future()
        done.set_exception(error) if error else done.set_result(None)
        return done

    mine = Watched(lambda values: values["angle"] > 1.0)
    simulate = simulations(mine, tmp_path)
    with simulate.using(Executor(dead)):
        simulate.prefetch([Run(AT), at(2.0)])
        assert np.array_equal(simulate(Run(AT)), table(AT))
        for _ in range(2):
            with pytest.raises(SimulationError, match="blew up"):
                simulate(at(2.0))
    assert len(mine.calls) == 2 and simulate.requested == 1


def test_what_decides_a_simulation_and_nothing_else_makes_it_another(tmp_path: Path) -> None:
    """Effects in whatever order; another file of the same name: only what it is on in is made anew."""
    simulate = Simulations(Watched(), tmp_path, sources={"own": "one"})  # type: ignore[arg-type]
    for effects in (("tilt", "own"), ("own", "tilt"), ("tilt",), ()):
        simulate(Run(AT, effects), "any")
    assert simulate.simulated == 3
    simulate(Run(AT, ("tilt",), 1))
    simulate(Run(AT, ("tilt",), variant="fine"))
    simulate(Run({"angle": 0.6}, ("tilt",)))
    assert simulate.simulated == 6
    other = Simulations(Watched(), tmp_path, sources={"own": "other"})  # type: ignore[arg-type]
    for effects in (("tilt", "own"), ("tilt",), ()):
        other(Run(AT, effects))
    assert other.simulated == 1


def test_what_was_made_elsewhere_is_kept_and_not_made_again(tmp_path: Path) -> None:
    experiment = Watched()
    simulations(experiment, tmp_path).store(table(AT, 7), Run(AT, seed=7))
    later = simulations(experiment, tmp_path)
    later.store(table(AT, 8), Run(AT, seed=7))
    assert np.array_equal(later(Run(AT, seed=7)), table(AT, 7)), "the first one stays"
    assert experiment.calls == [] and (later.simulated, later.requested) == (0, 1)
