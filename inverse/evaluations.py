"""The run database: every evaluation, kept from the moment it ends.

One SQLite file in write-ahead mode. One process writes (it holds ``writer.lock``, which the system releases however
the process ends); any number may read meanwhile. A failed simulation is a row with status ``failed`` and a message,
never a NaN.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from splatsoil.errors import RunError
from splatsoil.files import plain

#: Marks the file as ours (SQLite's ``application_id``: ASCII "SoIL") and its layout (``user_version``).
APPLICATION_ID = 0x536F494C
SCHEMA_VERSION = 1

SCHEMA = """
CREATE TABLE fits (
  key TEXT PRIMARY KEY,
  description TEXT NOT NULL,
  created TEXT NOT NULL
) STRICT;
CREATE TABLE evaluations (
  fit TEXT NOT NULL REFERENCES fits(key),
  step INTEGER NOT NULL,
  key TEXT NOT NULL,
  parameters TEXT NOT NULL,
  action TEXT NOT NULL,
  seed INTEGER NOT NULL,
  status TEXT NOT NULL CHECK (status IN ('ok', 'failed')),
  message TEXT NOT NULL,
  loss REAL,
  blocks TEXT NOT NULL,
  extras TEXT NOT NULL,
  seconds REAL NOT NULL,
  device TEXT NOT NULL,
  preset TEXT NOT NULL,
  version TEXT NOT NULL,
  measurement TEXT NOT NULL,
  created TEXT NOT NULL,
  PRIMARY KEY (fit, step),
  CHECK ((status = 'ok') = (loss IS NOT NULL))
) STRICT;
CREATE INDEX evaluations_by_key ON evaluations(key);
"""

COLUMNS = (
    "fit, step, key, parameters, action, seed, status, message, loss, blocks, extras, seconds, device, preset, "
    "version, measurement, created"
)


def digest(description: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a description: equal descriptions, equal digests, whatever the order of their keys."""
    text = json.dumps(plain(dict(description)), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class EvaluationRecord:
    """One simulate-and-compare, as stored.

    Attributes:
        fit: digest of what the whole fit shares (measurement, effects, preset, device, seed, version).
        step: its place in the fit, from 0.
        key: digest of everything that determines the result (the fit's description, parameters, seed).
        parameters: physical values by name.
        action: the same point in [-1, 1]^n.
        seed: the simulation's seed.
        status: ``ok`` or ``failed``.
        message: why it failed.
        loss: None exactly when it failed.
        blocks: block residuals.
        extras: further numbers worth keeping (raw RGB error, volume gain, ...).
        seconds: wall time it took.
        created: ISO time at which it ended, filled in on storing.
    """

    fit: str
    step: int
    key: str
    parameters: Mapping[str, float]
    action: tuple[float, ...]
    seed: int
    status: Literal["ok", "failed"]
    loss: float | None
    message: str = ""
    blocks: tuple[float, ...] = ()
    extras: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    device: str = "cpu"
    preset: str = ""
    version: str = ""
    measurement: str = ""
    created: str = ""

    def __post_init__(self) -> None:
        if self.status == "ok" and (self.loss is None or not math.isfinite(self.loss)):
            raise ValueError(f"an evaluation that is ok has a finite loss, not {self.loss}")
        if self.status == "failed" and self.loss is not None:
            raise ValueError("a failed evaluation has no loss")


class EvaluationStore:
    """Evaluations in an SQLite file.

    Args:
        path: the database; made if it is absent and ``writable``.
        writable: open for appending. Hold :func:`writer_lock` meanwhile.

    Raises:
        RunError: the file is absent (when only reading), damaged, not a run database, or can't be written.
    """

    def __init__(self, path: str | Path, *, writable: bool = True) -> None:
        self.path = Path(path)
        self.writable = writable
        fresh = not self.path.exists()
        if fresh and not writable:
            raise RunError(f"{self.path}: there is no run database; run `splatsoil fit` first")
        try:
            self._connection = self._connect()
            if fresh or self._is_blank():
                self._create()
            self._verify()
        except sqlite3.Error as error:
            raise self._explain(error) from error

    def _connect(self) -> sqlite3.Connection:
        if not self.writable:
            return sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro", uri=True, timeout=10.0)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.path.parent}: cannot be made ({error.strerror}); choose another folder") from error
        connection = sqlite3.connect(self.path, timeout=10.0)
        connection.execute("PRAGMA journal_mode=WAL")
        # An evaluation costs seconds to minutes; one fsync each is nothing, and a power cut then loses none.
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")
        return connection

    def _is_blank(self) -> bool:
        """True for a database without tables: a process killed between making the file and its first commit."""
        count = self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        return self.writable and count == 0

    def _create(self) -> None:
        self._connection.executescript(
            f"BEGIN; PRAGMA application_id={APPLICATION_ID}; PRAGMA user_version={SCHEMA_VERSION}; {SCHEMA} COMMIT;"
        )

    def _verify(self) -> None:
        application = self._connection.execute("PRAGMA application_id").fetchone()[0]
        if application != APPLICATION_ID:
            raise RunError(f"{self.path}: is an SQLite file, but not a run database; choose another run folder")
        version = self._connection.execute("PRAGMA user_version").fetchone()[0]
        if version != SCHEMA_VERSION:
            raise RunError(
                f"{self.path}: has layout {version}, this version reads {SCHEMA_VERSION}; choose another run folder"
            )
        state = self._connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if state != "ok":
            raise RunError(f"{self.path}: is damaged ({state}); move it away and fit again")

    def _explain(self, error: sqlite3.Error) -> RunError:
        text = str(error)
        if "readonly" in text or "unable to open" in text:
            return RunError(f"{self.path}: cannot be written ({text}); choose a run folder you may write to")
        if "full" in text or "disk I/O" in text:
            return RunError(
                f"{self.path}: cannot be written ({text}); free some space and run again, what is stored is kept"
            )
        if "locked" in text:
            return RunError(f"{self.path}: is locked by another process; wait for it or choose another run folder")
        return RunError(f"{self.path}: is damaged or not a run database ({text}); move it away and fit again")

    def register(self, fit: str, description: Mapping[str, Any]) -> None:
        """Note what a fit is before its first evaluation; a fit already known is left as it is."""
        self._write("INSERT OR IGNORE INTO fits VALUES (?, ?, ?)", (fit, json.dumps(plain(dict(description))), _now()))

    def append(self, record: EvaluationRecord) -> None:
        """Store one evaluation; when this returns, it is on the disk.

        Raises:
            RunError: the step is already stored, the fit unknown, or the disk refuses.
        """
        row = (
            record.fit,
            record.step,
            record.key,
            json.dumps(plain(dict(record.parameters))),
            json.dumps(plain(record.action)),
            record.seed,
            record.status,
            record.message,
            record.loss,
            json.dumps(plain(record.blocks)),
            json.dumps(plain(dict(record.extras))),
            record.seconds,
            record.device,
            record.preset,
            record.version,
            record.measurement,
            record.created or _now(),
        )
        self._write(f"INSERT INTO evaluations ({COLUMNS}) VALUES ({', '.join('?' * len(row))})", row)

    def records(self, fit: str | None = None) -> list[EvaluationRecord]:
        """Evaluations of one fit in the order of their steps, or of all fits in the order of their end."""
        if fit is None:
            return self._read(f"SELECT {COLUMNS} FROM evaluations ORDER BY created, step", ())
        return self._read(f"SELECT {COLUMNS} FROM evaluations WHERE fit = ? ORDER BY step", (fit,))

    def find(self, key: str) -> EvaluationRecord | None:
        """The evaluation with this key, whichever fit made it."""
        found = self._read(f"SELECT {COLUMNS} FROM evaluations WHERE key = ? ORDER BY created LIMIT 1", (key,))
        return found[0] if found else None

    def descriptions(self) -> dict[str, Any]:
        """What each fit in this database is, by its digest."""
        try:
            rows = self._connection.execute("SELECT key, description FROM fits ORDER BY created").fetchall()
        except sqlite3.Error as error:
            raise self._explain(error) from error
        return {key: json.loads(text) for key, text in rows}

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    def __enter__(self) -> EvaluationStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, statement: str, row: tuple[Any, ...]) -> None:
        try:
            with self._connection:
                self._connection.execute(statement, row)
        except sqlite3.IntegrityError as error:
            raise RunError(f"{self.path}: the evaluation can't be stored ({error})") from error
        except sqlite3.Error as error:
            raise self._explain(error) from error

    def _read(self, statement: str, row: tuple[Any, ...]) -> list[EvaluationRecord]:
        try:
            return [_record(values) for values in self._connection.execute(statement, row)]
        except sqlite3.Error as error:
            raise self._explain(error) from error


def _record(row: tuple[Any, ...]) -> EvaluationRecord:
    return EvaluationRecord(
        fit=row[0],
        step=row[1],
        key=row[2],
        parameters=json.loads(row[3]),
        action=tuple(json.loads(row[4])),
        seed=row[5],
        status=row[6],
        message=row[7],
        loss=row[8],
        blocks=tuple(json.loads(row[9])),
        extras=json.loads(row[10]),
        seconds=row[11],
        device=row[12],
        preset=row[13],
        version=row[14],
        measurement=row[15],
        created=row[16],
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


@contextmanager
def writer_lock(folder: str | Path) -> Iterator[None]:
    """Be the one process that writes into ``folder``.

    An exclusive transaction on an empty SQLite file: works wherever SQLite does, and the operating system lets it go
    when the process ends, killed or not.

    Raises:
        RunError: another process is writing there, or the folder can't be written.
    """
    path = Path(folder) / "writer.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(path, timeout=0.0, isolation_level=None)
    except (OSError, sqlite3.Error) as error:
        raise RunError(f"{folder}: cannot be written ({error}); choose a run folder you may write to") from error
    try:
        try:
            connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            if "locked" in str(error):
                raise RunError(
                    f"{folder}: another process is writing into this run folder; wait for it or choose another --run"
                ) from error
            raise RunError(f"{folder}: cannot be written ({error}); choose a run folder you may write to") from error
        yield
    finally:
        connection.close()
