"""Evaluations of the loss, each stored in an SQLite file as soon as it ends.

The key of an evaluation is a digest of everything that decides it, so an interrupted run finds it again. One process
writes; it holds ``writer.lock``, which the system releases when the process ends. Any number of processes may read. A
failed simulation is a row with a message and no loss.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from splatsoil.envs.problem import Job, Problem
from splatsoil.envs.together import evaluate_together

from splatsoil.errors import RunError
from splatsoil.files import digest, plain

#: Marks the file as ours (SQLite's ``application_id``: ASCII "SoIL") and its layout (``user_version``).
APPLICATION_ID = 0x536F494C
LAYOUT = 2

#: ``model`` is what decides an evaluation besides parameters and seed, as JSON: measurement, device, version, ...
SCHEMA = """
CREATE TABLE evaluations (
  key TEXT PRIMARY KEY,
  model TEXT NOT NULL,
  parameters TEXT NOT NULL,
  seed INTEGER NOT NULL,
  loss REAL,
  message TEXT NOT NULL,
  blocks TEXT NOT NULL,
  extras TEXT NOT NULL,
  seconds REAL NOT NULL,
  created TEXT NOT NULL,
  CHECK ((loss IS NULL) = (message <> ''))
) STRICT;
"""


@dataclass(frozen=True)
class EvaluationRecord:
    """One simulation and its loss, as stored.

    Attributes:
        key: digest of everything that decides it.
        model: what decides it besides parameters and seed.
        parameters: physical values by name.
        seed: the simulation's seed.
        loss: None where it failed.
        message: why it failed; empty where it did not.
        blocks: block residuals.
        extras: further numbers.
        seconds: wall time it took.
        created: ISO time of storing.
    """

    key: str
    model: Mapping[str, Any]
    parameters: Mapping[str, float]
    seed: int
    loss: float | None
    message: str = ""
    blocks: Sequence[float] = ()
    extras: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    created: str = ""

    def __post_init__(self) -> None:
        if (self.loss is None) != bool(self.message) or not math.isfinite(self.loss or 0.0):
            raise ValueError(f"an evaluation has a finite loss or a message, not {self.loss} and {self.message!r}")

    @property
    def status(self) -> str:
        """``ok`` or ``failed``."""
        return "failed" if self.loss is None else "ok"


COLUMNS = [column.name for column in fields(EvaluationRecord)]
JSON = {"model", "parameters", "blocks", "extras"}


class EvaluationStore:
    """Evaluations in an SQLite file; a context manager.

    Args:
        path: the database; made if it is absent and ``writable``.
        writable: open for appending. Hold :func:`writer_lock` meanwhile.

    Raises:
        RunError: the file is absent (when only reading), damaged, not a run database, or can't be written.
    """

    def __init__(self, path: str | Path, *, writable: bool = True) -> None:
        self.path = Path(path)
        if not writable and not self.path.exists():
            raise RunError(f"{self.path}: there is no run database; run `splatsoil fit` first")
        with self._explained():
            self._connection = self._connect(writable)
            # Without tables it is new, or its process was killed before the first commit.
            if writable and self._one("SELECT count(*) FROM sqlite_master") == 0:
                self._connection.executescript(
                    f"BEGIN; PRAGMA application_id={APPLICATION_ID}; PRAGMA user_version={LAYOUT}; {SCHEMA}COMMIT;"
                )
            self._verify()

    def _connect(self, writable: bool) -> sqlite3.Connection:
        if not writable:
            return sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro", uri=True, timeout=10.0)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.path.parent}: cannot be made ({error.strerror}); choose another folder") from error
        connection = sqlite3.connect(self.path, timeout=10.0)
        connection.execute("PRAGMA journal_mode=WAL")
        # One fsync for each evaluation: a power cut loses none.
        connection.execute("PRAGMA synchronous=FULL")
        return connection

    def _verify(self) -> None:
        if self._one("PRAGMA application_id") != APPLICATION_ID:
            raise RunError(f"{self.path}: is an SQLite file, but not a run database; choose another run folder")
        if (layout := self._one("PRAGMA user_version")) != LAYOUT:
            raise RunError(f"{self.path}: has layout {layout}, this version reads {LAYOUT}; choose another run folder")
        if (state := self._one("PRAGMA quick_check(1)")) != "ok":
            raise RunError(f"{self.path}: is damaged ({state}); move it away and fit again")

    def _one(self, query: str) -> Any:
        return self._connection.execute(query).fetchone()[0]

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn SQLite's errors into sentences."""
        try:
            yield
        except sqlite3.IntegrityError as error:
            raise RunError(f"{self.path}: the evaluation can't be stored ({error})") from error
        except sqlite3.Error as error:
            text, sentence = str(error), "is damaged or not a run database ({}); move it away and fit again"
            if "readonly" in text or "unable to open" in text:
                sentence = "cannot be written ({}); choose a run folder you may write to"
            elif "full" in text or "disk I/O" in text:
                sentence = "cannot be written ({}); free some space and run again, what is stored is kept"
            elif "locked" in text:
                sentence = "is locked by another process ({}); wait for it or choose another run folder"
            raise RunError(f"{self.path}: {sentence.format(text)}") from error

    def append(self, record: EvaluationRecord) -> None:
        """Store one evaluation on the disk.

        Raises:
            RunError: it is already stored, or the disk refuses.
        """
        stored = replace(record, created=record.created or datetime.now(UTC).isoformat(timespec="microseconds"))
        row = [json.dumps(plain(getattr(stored, c))) if c in JSON else getattr(stored, c) for c in COLUMNS]
        insert = f"INSERT INTO evaluations ({', '.join(COLUMNS)}) VALUES ({', '.join('?' * len(row))})"
        with self._explained(), self._connection:
            self._connection.execute(insert, row)

    def find(self, key: str) -> EvaluationRecord | None:
        """The evaluation with this key."""
        found = self._read("WHERE key = ?", key)
        return found[0] if found else None

    def records(self) -> list[EvaluationRecord]:
        """All evaluations, in order of time."""
        return self._read("ORDER BY created, rowid")

    def _read(self, which: str, *values: str) -> list[EvaluationRecord]:
        query = f"SELECT {', '.join(COLUMNS)} FROM evaluations {which}"
        with self._explained():
            rows = self._connection.execute(query, values).fetchall()
        named = ({c: json.loads(v) if c in JSON else v for c, v in zip(COLUMNS, row, strict=True)} for row in rows)
        return [EvaluationRecord(**values) for values in named]

    def __enter__(self) -> EvaluationStore:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()


def evaluate(
    problem: Problem, jobs: Sequence[Job], store: EvaluationStore, model: Mapping[str, Any], *, batch_size: int = 1
) -> Iterator[EvaluationRecord]:
    """Evaluations of all jobs in order: stored ones, and new ones, which are stored first.

    Args:
        problem: simulates and compares; begun.
        jobs: different parameters and seeds.
        store: open for writing.
        model: what decides an evaluation besides parameters and seed.
        batch_size: number of simulations in a batch.

    Raises:
        RunError: the database can't be written.
    """
    keys = [digest({**model, "values": dict(parameters), "seed": seed}) for parameters, seed in jobs]
    known = {key: found for key in keys if (found := store.find(key)) is not None}
    fresh = [job for job, key in zip(jobs, keys, strict=True) if key not in known]
    parts = (fresh[k : k + batch_size] for k in range(0, len(fresh), batch_size))
    new = (evaluation for part in parts for evaluation in evaluate_together([problem] * len(part), part))
    for key, (parameters, seed) in zip(keys, jobs, strict=True):
        if key not in known:
            evaluation = next(new)
            known[key] = EvaluationRecord(
                key=key,
                model=model,
                parameters=dict(parameters),
                seed=seed,
                loss=evaluation.loss,
                message=evaluation.message,
                blocks=evaluation.blocks.tolist(),
                extras=dict(evaluation.extras),
                seconds=evaluation.seconds,
            )
            store.append(known[key])
        yield known[key]


@contextmanager
def writer_lock(folder: str | Path) -> Iterator[None]:
    """Be the only process that writes into ``folder``.

    The lock is an exclusive transaction on an empty SQLite file. The operating system releases it when the process
    ends.

    Raises:
        RunError: another process is writing there, or the folder can't be written.
    """
    path = Path(folder) / "writer.lock"
    connection: sqlite3.Connection | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(path, timeout=0.0, isolation_level=None)
        connection.execute("BEGIN EXCLUSIVE")
    except (OSError, sqlite3.Error) as error:
        if connection is not None:
            connection.close()
        if "locked" in str(error):
            raise RunError(
                f"{folder}: another process is writing into this run folder; wait for it or choose another --run"
            ) from error
        raise RunError(f"{folder}: cannot be written ({error}); choose a run folder you may write to") from error
    try:
        yield
    finally:
        connection.close()
