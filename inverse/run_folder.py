"""The run folder of a measurement set.

| file | contents |
|---|---|
| `run.json` | measurement (name, folder, hash), relative path to it, preset, seed, version |
| `reconstruction/` | Gaussians, surface, metrics |
| `evaluations.db` | every evaluation (SQLite) |
| `features/` | light and albedo, features of simulations |
| `fits/NAME.json` | each finished fit (`base`, `cohesion`, ...), `fit.json` is the latest |
| `comparison/` | pictures and losses at the latest estimate |
| `design/` | the proposed next stroke |
| `report.html` | the report |
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from splatsoil.errors import RunError
from splatsoil.files import check_folder, write_json
from splatsoil.run_files import RUN_FORMAT, read_description, read_fit
from splatsoil.trust import check_trusted

from .evaluations import EvaluationStore, writer_lock


@dataclass(frozen=True)
class RunFolder:
    """Paths and description of a run.

    Attributes:
        path: the folder.
        description: contents of ``run.json``.
    """

    path: Path
    description: Mapping[str, Any]

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open an existing run.

        Raises:
            RunError: there is none, or it isn't a run folder.
        """
        folder = Path(path)
        if not folder.is_dir():
            make = f"splatsoil fit SET --run {shlex.quote(str(folder))}"
            raise RunError(f"{folder}: there is no such run folder; `{make}` makes one")
        return cls(folder, read_description(folder))

    @classmethod
    def prepare(
        cls, path: str | Path, *, measurement: Mapping[str, str], preset: str, seed: int, version: str
    ) -> RunFolder:
        """Open the run folder of an experiment, or make it.

        Args:
            path: the folder; made if absent. A folder with other files is refused.
            measurement: ``name``, ``folder`` and ``hash`` of the measurement set.
            preset: resolution of reconstruction and solver.
            seed: seed of reconstruction and fits.
            version: of this package.

        Raises:
            RunError: the folder belongs to another experiment, isn't a run, or can't be written.
        """
        folder = Path(path)
        if not (folder / "run.json").exists():
            if folder.exists() and (not folder.is_dir() or not all(_is_leftover(p) for p in folder.iterdir())):
                raise RunError(f"{folder}: exists and isn't a run folder; choose another --run")
            description = {
                "format": RUN_FORMAT,
                "measurement": dict(measurement),
                "way": _way(folder, measurement["folder"]),
                "preset": preset,
                "seed": seed,
                "version": version,
                "created": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            write_json(folder / "run.json", description)
            return cls(folder, description)
        run = cls.open(folder)
        noted = run.description
        if noted["measurement"]["hash"] != measurement["hash"]:
            what = f"another measurement set ({noted['measurement']['name']}), or the set has changed"
            raise RunError(f"{folder}: belongs to {what}; choose another --run")
        for name, value in (("preset", preset), ("seed", seed)):
            if noted[name] != value:
                raise RunError(f"{folder}: belongs to {name} {noted[name]}, not {value}; choose another --run")
        return run.moved(measurement["folder"])

    def moved(self, measurement: str | Path) -> RunFolder:
        """The run with a new folder of its measurement set, which is stored in ``run.json``.

        Raises:
            RunError: the run can't be written to.
        """
        if str(measurement) == self.description["measurement"]["folder"]:
            return self
        noted = {**self.description["measurement"], "folder": str(measurement)}
        description = {**self.description, "measurement": noted, "way": _way(self.path, measurement)}
        with self.lock():
            write_json(self.path / "run.json", description)
        return replace(self, description=description)

    def measurement_places(self) -> tuple[Path, ...]:
        """Candidate folders of the measurement set: the stored one, the same relative path, and next to the run."""
        noted, here = Path(self.description["measurement"]["folder"]), self.path.resolve()
        # runs of earlier versions have no relative path
        way = str(self.description.get("way", noted))
        return tuple(dict.fromkeys(Path(os.path.normpath(p)) for p in (noted, here / way, here.parent / noted.name)))

    @property
    def reconstruction(self) -> Path:
        """Folder of the reconstruction."""
        return self.path / "reconstruction"

    @property
    def comparison(self) -> Path:
        """Folder of pictures and losses at the estimate."""
        return self.path / "comparison"

    @property
    def report(self) -> Path:
        """The report."""
        return self.path / "report.html"

    def lock(self) -> AbstractContextManager[None]:
        """Context manager: be the only process that writes into the run."""
        return writer_lock(self.path)

    def check_writable(self) -> None:
        """Check that the run can be written to.

        Raises:
            RunError: it can't, or another process is writing.
        """
        for folder in (self.path, self.comparison, self.path / "features"):
            check_folder(folder)
        with self.lock():
            pass

    def evaluations(self, *, writable: bool = False) -> EvaluationStore:
        """Context manager: the database of evaluations."""
        return EvaluationStore(self.path / "evaluations.db", writable=writable)

    def write_fit(self, name: str, fit: Mapping[str, Any]) -> Path:
        """Write a finished fit as ``fits/NAME.json`` and ``fit.json``."""
        write_json(self.path / "fits" / f"{name}.json", dict(fit))
        return write_json(self.path / "fit.json", dict(fit))

    def fit(self) -> dict[str, Any]:
        """The latest finished fit.

        Raises:
            RunError: there is none, it is damaged, or one of its effects is a file that the user hasn't named.
        """
        fit = read_fit(self.path)
        check_trusted(fit["setup"]["effects"], self.path)
        return fit


def _is_leftover(path: Path) -> bool:
    """Whether a killed process may have left this file before it wrote ``run.json``."""
    return path.name in ("writer.lock", "writer.lock-journal") or path.match(".run.json.*.tmp")


def _way(run: Path, measurement: str | Path) -> str:
    """Relative path from a run folder to its set: both may be moved together."""
    return os.path.relpath(Path(measurement).resolve(), run.resolve())
