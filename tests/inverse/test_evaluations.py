from __future__ import annotations

import math
import os
import signal
import sqlite3
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest
from splatsoil.inverse.evaluations import EvaluationRecord, EvaluationStore, digest, writer_lock

from splatsoil.errors import RunError

RECORD = EvaluationRecord(
    fit="f",
    step=0,
    key="k0",
    parameters={"friction_angle": 36.000000000000014},
    action=(0.1,),
    seed=7,
    status="ok",
    loss=0.1 + 0.2,
    blocks=(1.5, -2.0),
    extras={"rgb": 1e-5},
    seconds=3.25,
    preset="tiny",
    version="1",
    measurement="m",
)


def filled(path: Path, count: int = 1) -> Path:
    with EvaluationStore(path) as store:
        store.register("f", {"what": "a test"})
        for step in range(count):
            store.append(replace(RECORD, step=step, key=f"k{step}"))
    return path


def test_what_goes_in_comes_out_bit_for_bit(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with EvaluationStore(path, writable=False) as store:
        (record,) = store.records("f")
        assert replace(record, created="") == RECORD
        assert record.created
        assert store.find("k0") == record
        assert store.find("k1") is None
        assert store.descriptions() == {"f": {"what": "a test"}}


def test_a_failure_is_a_row_with_a_message_and_no_loss(tmp_path: Path) -> None:
    failed = replace(RECORD, status="failed", loss=None, message="a particle left the grid")
    with EvaluationStore(tmp_path / "e.db") as store:
        store.register("f", {})
        store.append(failed)
        (record,) = store.records()
    assert (record.status, record.loss, record.message) == ("failed", None, "a particle left the grid")
    raw = sqlite3.connect(tmp_path / "e.db").execute("SELECT loss, status FROM evaluations").fetchall()
    assert raw == [(None, "failed")]


@pytest.mark.parametrize(("status", "loss"), [("ok", math.nan), ("ok", None), ("ok", math.inf), ("failed", 1.0)])
def test_a_loss_that_contradicts_its_status_is_refused(status: str, loss: float | None) -> None:
    with pytest.raises(ValueError):
        replace(RECORD, status=status, loss=loss)


def test_the_database_itself_refuses_a_nan(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    connection = sqlite3.connect(path)
    with pytest.raises(sqlite3.IntegrityError):
        connection.execute("UPDATE evaluations SET loss = ?", (math.nan,))


def test_a_step_is_stored_once(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with EvaluationStore(path) as store, pytest.raises(RunError, match="can't be stored"):
        store.append(replace(RECORD, key="other"))


def test_readers_read_while_one_writes(tmp_path: Path) -> None:
    path = tmp_path / "e.db"
    with EvaluationStore(path) as writer:
        writer.register("f", {})
        with EvaluationStore(path, writable=False) as reader:
            assert reader.records() == []
            writer.append(RECORD)
            assert len(reader.records()) == 1


def test_digests_know_contents_and_not_order() -> None:
    assert digest({"a": 1, "b": [1, 2]}) == digest({"b": [1, 2], "a": 1})
    assert digest({"a": 1.0}) != digest({"a": 1.0 + 2**-52})


@pytest.mark.parametrize(
    ("contents", "says"),
    [(b"this is no database, just text that is long enough" * 40, "damaged or not a run database")],
)
def test_a_file_that_is_no_database_gets_one_sentence(tmp_path: Path, contents: bytes, says: str) -> None:
    path = tmp_path / "e.db"
    path.write_bytes(contents)
    for writable in (True, False):
        with pytest.raises(RunError, match=says):
            EvaluationStore(path, writable=writable)
    assert path.read_bytes() == contents


def test_a_damaged_database_gets_one_sentence(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db", 200)
    data = bytearray(path.read_bytes())
    for start in range(4096, len(data), 4096):
        data[start : start + 512] = b"\xff" * 512
    path.write_bytes(data)
    with pytest.raises(RunError, match="damaged"):
        EvaluationStore(path)


def test_somebody_elses_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "e.db"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE theirs (x)")
    connection.close()
    with pytest.raises(RunError, match="not a run database"):
        EvaluationStore(path)


def test_a_later_layout_is_refused(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()
    with pytest.raises(RunError, match="layout 99"):
        EvaluationStore(path)


def test_reading_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run database"):
        EvaluationStore(tmp_path / "e.db", writable=False)
    assert not (tmp_path / "e.db").exists()


def test_an_empty_file_left_by_a_kill_becomes_a_database(tmp_path: Path) -> None:
    (tmp_path / "e.db").touch()
    assert filled(tmp_path / "e.db").stat().st_size > 0


def test_writing_where_one_may_not(tmp_path: Path) -> None:
    """A file in the folder's place: refused to root as well, which permission bits are not."""
    blocker = tmp_path / "file"
    blocker.touch()
    with pytest.raises(RunError, match="cannot be made"):
        EvaluationStore(blocker / "e.db")
    with pytest.raises(RunError, match="cannot be written"), writer_lock(blocker / "run"):
        pass


def test_a_database_opened_for_reading_is_not_written(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    with EvaluationStore(path, writable=False) as store, pytest.raises(RunError, match="cannot be written"):
        store.append(replace(RECORD, step=1, key="k1"))


@pytest.mark.skipif(os.geteuid() == 0, reason="permission bits don't hold root back")
def test_a_read_only_database_gets_one_sentence(tmp_path: Path) -> None:
    path = filled(tmp_path / "e.db")
    path.chmod(0o444)
    with pytest.raises(RunError, match="cannot be written"):
        filled(path)


def test_a_full_disk_is_said_and_costs_nothing_that_is_stored(tmp_path: Path) -> None:
    with EvaluationStore(tmp_path / "evaluations.db", writable=True) as store:
        store.register("f", {})
        store.append(RECORD)
        # SQLite's own stand-in for a disk without room.
        pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
        store._connection.execute(f"PRAGMA max_page_count={pages}")
        with pytest.raises(RunError, match=r"full.*free some space"):
            for step in range(1, 200):
                store.append(replace(RECORD, step=step, key=f"k{step}"))
    with EvaluationStore(tmp_path / "evaluations.db", writable=True) as store:
        kept = [r.step for r in store.records("f")]
        assert kept == list(range(len(kept))) and kept
        store.append(replace(RECORD, step=len(kept), key="last"))


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    with writer_lock(tmp_path), pytest.raises(RunError, match="another process is writing"), writer_lock(tmp_path):
        pass
    with writer_lock(tmp_path):
        pass


def test_a_killed_writer_leaves_what_it_stored_and_no_lock(tmp_path: Path) -> None:
    script = """
        import sys, time
        from dataclasses import replace
        from splatsoil.inverse.evaluations import *
        record = EvaluationRecord("f", 0, "k", {"a": 1.0}, (0.0,), 1, "ok", 0.5)
        with writer_lock(sys.argv[1]), EvaluationStore(sys.argv[1] + "/e.db") as store:
            store.register("f", {})
            for step in range(10_000):
                store.append(replace(record, step=step, key=f"k{step}"))
                print(step, flush=True)
        """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    seen = -1
    for line in process.stdout:
        seen = int(line)
        if seen >= 20:
            break
    with pytest.raises(RunError, match="another process is writing"), writer_lock(tmp_path):
        pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with writer_lock(tmp_path), EvaluationStore(tmp_path / "e.db") as store:
        records = store.records("f")
    assert len(records) >= seen + 1
    assert [r.step for r in records] == list(range(len(records)))
