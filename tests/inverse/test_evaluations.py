"""The run database, and evaluations that come from it: what a kill, a full disk or a damaged file costs."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import random
import signal
import sqlite3
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from splatsoil.inverse.evaluations import EvaluationRecord, EvaluationStore, evaluate, writer_lock

from splatsoil.errors import RunError

MODEL = {"model": "analytic", "device": "cpu"}
RECORD = EvaluationRecord(
    key="k0",
    model=MODEL,
    parameters={"friction_angle": 36.000000000000014},
    seed=7,
    loss=0.1 + 0.2,
    blocks=[1.5, -2.0],
    extras={"rgb": 1e-5},
    seconds=3.25,
)


def filled(path: Path, count: int = 1) -> Path:
    with EvaluationStore(path) as store:
        for step in range(count):
            store.append(replace(RECORD, key=f"k{step}"))
    return path


def test_what_goes_in_comes_out_bit_for_bit(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with EvaluationStore(path) as store:
        store.append(replace(RECORD, key="k1", loss=None, message="a particle left the grid"))
    with EvaluationStore(path, writable=False) as store:
        record, failed = store.records()
        assert replace(record, created="") == RECORD and record.created
        assert store.find("k0") == record and store.find("k2") is None
        assert (failed.status, failed.loss, failed.message) == ("failed", None, "a particle left the grid")
        with pytest.raises(RunError, match="cannot be written"):
            store.append(replace(RECORD, key="k2"))


@pytest.mark.parametrize(("loss", "message"), [(math.nan, ""), (None, ""), (math.inf, ""), (1.0, "failed")])
def test_a_loss_that_contradicts_its_message_is_refused(loss: float | None, message: str) -> None:
    with pytest.raises(ValueError):
        replace(RECORD, loss=loss, message=message)


def test_the_database_itself_refuses_a_nan_and_a_second_one_of_the_same(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with contextlib.closing(sqlite3.connect(path)) as database, pytest.raises(sqlite3.IntegrityError):
        database.execute("UPDATE evaluations SET loss = ?", (math.nan,))
    with EvaluationStore(path) as store, pytest.raises(RunError, match="can't be stored"):
        store.append(RECORD)


def test_readers_read_while_one_writes(tmp_path: Path) -> None:
    with EvaluationStore(tmp_path / "e.db") as writer, EvaluationStore(tmp_path / "e.db", writable=False) as reader:
        assert reader.records() == []
        writer.append(RECORD)
        assert len(reader.records()) == 1


def _text(path: Path) -> None:
    path.write_bytes(b"this is no database, just text that is long enough" * 40)


def _later(path: Path) -> None:
    with sqlite3.connect(filled(path)) as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (_text, "damaged or not a run database"),
        (_later, "layout 99"),
    ],
)
def test_a_file_that_is_not_ours_gets_one_sentence(tmp_path: Path, make: Callable[[Path], None], says: str) -> None:
    make(tmp_path / "e.db")
    for writable in (False, True):
        with pytest.raises(RunError, match=says):
            EvaluationStore(tmp_path / "e.db", writable=writable)


def test_what_is_not_there_or_empty(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run database"):
        EvaluationStore(tmp_path / "e.db", writable=False)
    assert not (tmp_path / "e.db").exists()
    (tmp_path / "e.db").touch()  # as a kill leaves it
    assert filled(tmp_path / "e.db").stat().st_size > 0


def test_writing_where_one_may_not(tmp_path: Path) -> None:
    """A file in the folder's place: refused to root as well, which permission bits are not."""
    blocker = tmp_path / "file"
    blocker.touch()
    with pytest.raises(RunError, match="cannot be made"):
        EvaluationStore(blocker / "e.db")
    with pytest.raises(RunError, match="cannot be written"), writer_lock(blocker / "run"):
        pass


def test_a_full_disk_is_said_and_costs_nothing_that_is_stored(tmp_path: Path) -> None:
    with EvaluationStore(filled(tmp_path / "e.db")) as store:
        # SQLite's own stand-in for a disk without room.
        pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
        store._connection.execute(f"PRAGMA max_page_count={pages}")
        with pytest.raises(RunError, match=r"full.*free some space"):
            for step in range(1, 200):
                store.append(replace(RECORD, key=f"k{step}"))
    with EvaluationStore(tmp_path / "e.db") as store:
        kept = [r.key for r in store.records()]
        assert kept == [f"k{step}" for step in range(len(kept))] and kept
        store.append(replace(RECORD, key="last"))


def run(problem: Any, count: int, file: Path, whole: int = 12) -> list[tuple]:
    """The first evaluations of a campaign, without their times."""
    jobs = [({"friction_angle": 20.0 + 30.0 * k / whole}, k) for k in range(whole)][:count]
    with EvaluationStore(file) as store:
        records = list(evaluate(problem, jobs, store, MODEL, batch_size=2))
        assert [(r.parameters, r.seed) for r in records] == jobs
        assert sorted(r.key for r in store.records()) == sorted(r.key for r in records)
    return [(r.key, r.loss, r.blocks, r.message) for r in records]


def test_what_is_stored_is_not_made_again(analytic: ModuleType, tmp_path: Path) -> None:
    problem = analytic.AnalyticProblem(fails_below=25.0)
    first = run(problem, 7, tmp_path / "e.db")
    assert {message[:13] for *_, message in first} == {"", "nothing holds"}
    assert run(problem, 12, tmp_path / "e.db")[:7] == first
    assert problem.calls == 12
    assert run(problem, 12, tmp_path / "other.db")[:7] == first


def _campaign(analytic: ModuleType, file: Path) -> None:
    run(analytic.AnalyticProblem(delay=0.02), 40, file, whole=40)


def test_killed_at_random_moments(analytic: ModuleType, tmp_path: Path) -> None:
    """No finished evaluation is lost, none is made twice, and the end is that of the uninterrupted campaign."""
    file, context, moments, kept = tmp_path / "killed.db", multiprocessing.get_context("fork"), random.Random(5), 0
    for _ in range(12):
        process = context.Process(target=_campaign, args=(analytic, file))
        process.start()
        time.sleep(moments.uniform(0.01, 0.12))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        with EvaluationStore(file) as store:
            count = len(store.records())
        assert count >= kept
        kept = count
    assert kept > 0
    problem = analytic.AnalyticProblem()
    records = run(problem, 40, file, whole=40)
    assert problem.calls == 40 - kept
    assert records == run(analytic.AnalyticProblem(), 40, tmp_path / "whole.db", whole=40)
