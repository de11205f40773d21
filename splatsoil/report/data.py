"""Contents of a run folder, read from its files alone."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatsoil.errors import RunError
from splatsoil.files import read_json, read_npz
from splatsoil.run_files import (
    COMPARISON_FORMAT,
    DIAGNOSIS_FORMAT,
    FIT_FORMAT,
    HISTORY_FORMAT,
    MISFIT_FORMAT,
    POSTERIOR_FORMAT,
    RECONSTRUCTION_FORMAT,
    read_description,
    read_fit,
    read_format,
)


@dataclass(frozen=True)
class Surface:
    """The reconstructed surface.

    Attributes:
        x: (nx,) cell centres in m.
        y: (ny,) cell centres in m.
        height: (ny, nx) in m.
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray


@dataclass(frozen=True)
class RunData:
    """Everything a report may show; what a run hasn't come to yet is None or empty.

    Attributes:
        folder: the run folder.
        run: ``run.json``.
        fit: ``fit.json``, the latest fit.
        fits: every finished fit by name.
        comparison: ``comparison/comparison.json`` when it belongs to the latest fit.
        before: the comparison of the model before the latest effect was added, from ``before/``.
        misfit: ``comparison/misfit.json`` when it belongs to the latest fit: it against something else.
        diagnosis: the latest fit's diagnosis.
        posterior: ``posterior.json`` when it was sampled for the latest fit.
        history: models tried by adding effects, the first one first.
        reconstruction: ``reconstruction/reconstruction.json``.
        surface: the reconstructed surface.
        truth: true values of the latest fit's parameters by name, where the set is simulated and has them.
    """

    folder: Path
    run: Mapping[str, Any]
    fit: Mapping[str, Any]
    fits: Mapping[str, Mapping[str, Any]]
    comparison: Mapping[str, Any] | None
    before: Mapping[str, Any] | None
    misfit: Mapping[str, Any] | None
    diagnosis: Mapping[str, Any] | None
    posterior: Mapping[str, Any] | None
    history: Sequence[Mapping[str, Any]]
    reconstruction: Mapping[str, Any] | None
    surface: Surface | None
    truth: Mapping[str, float]

    @property
    def judged(self) -> Mapping[str, Any] | None:
        """What judges the model: the latest fit's diagnosis or comparison, else the diagnosis of the smaller model."""
        own = self.diagnosis is not None and self.diagnosis["fit"] == self.fit["name"]
        return self.diagnosis if own or self.misfit is None else self.misfit


def load(folder: str | Path) -> RunData:
    """Read a run folder.

    Raises:
        RunError: it isn't one, has no finished fit, or a file in it is damaged.
    """
    path = Path(folder)
    run, fit = read_description(path), read_fit(path)
    fits = {file.stem: read_format(file, FIT_FORMAT) for file in sorted((path / "fits").glob("*.json"))}
    fits = fits or {str(fit["name"]): fit}
    history = _read(path / "history.json", HISTORY_FORMAT)
    return RunData(
        folder=path,
        run=run,
        fit=fit,
        fits=fits,
        comparison=kept_of(path / "comparison" / "comparison.json", COMPARISON_FORMAT, fit),
        before=_read(path / "before" / "comparison.json", COMPARISON_FORMAT),
        misfit=kept_of(path / "comparison" / "misfit.json", MISFIT_FORMAT, fit),
        diagnosis=_diagnosis(path / "diagnoses", fits, fit),
        posterior=kept_of(path / "posterior.json", POSTERIOR_FORMAT, fit),
        history=[] if history is None else history["models"],
        reconstruction=_read(path / "reconstruction" / "reconstruction.json", RECONSTRUCTION_FORMAT),
        surface=_surface(path / "reconstruction" / "surface.npz"),
        truth=true_values(run["measurement"]["folder"], fit["parameters"]),
    )


#: Parameters under the names that other simulators give them in ``truth.json``.
ELSEWHERE = {"friction_angle": "phi", "tool_friction": "tool_mu"}


def true_values(folder: str | Path, names: Iterable[str]) -> dict[str, float]:
    """True parameters by a simulated set's ``truth.json``, in their units; only those that it has."""
    try:
        said = read_json(Path(folder) / "truth.json")
    except RunError:  # measured sets have none
        return {}
    if not isinstance(said, dict):
        return {}
    known = {**said, **(said["parameters"] if isinstance(said.get("parameters"), dict) else {})}
    found = {name: known.get(name, known.get(ELSEWHERE.get(name, name))) for name in names}
    return {
        name: float(value)
        for name, value in found.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }


def estimates(fit: Mapping[str, Any]) -> dict[str, float]:
    """The fitted values by name."""
    return {name: float(entry["estimate"]) for name, entry in fit["parameters"].items()}


def read_picture(path: Path, made_by: str = "compare") -> tuple[bytes, str]:
    """A picture's bytes, and which of ``jpeg`` and ``png`` it is.

    Args:
        path: the file.
        made_by: command that draws it.

    Raises:
        RunError: it is missing, damaged, or neither JPEG nor PNG.
    """
    from PIL import Image

    try:
        contents = path.read_bytes()
        with Image.open(io.BytesIO(contents), formats=("JPEG", "PNG")) as image:
            image.load()
            return contents, str(image.format).lower()
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError, Image.DecompressionBombError) as error:
        fault = "there is no such picture" if isinstance(error, FileNotFoundError) else "is no whole JPEG or PNG image"
        raise RunError(f"{path}: {fault}; run `splatsoil {made_by}` again") from error


def _read(path: Path, tag: str) -> dict[str, Any] | None:
    """A file of a run folder, if it is there."""
    return read_format(path, tag) if path.is_file() else None


def kept_of(path: Path, tag: str, fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """A file of a run folder of a format, if it is there and was made at the estimate of this very fit.

    Raises:
        RunError: it is damaged.
    """
    data = _read(path, tag)
    if data is None or data["fit"] != fit["name"]:
        return None
    return data if data["parameters" if tag == COMPARISON_FORMAT else "values"] == estimates(fit) else None


def _diagnosis(folder: Path, fits: Mapping[str, Any], fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """The diagnosis of the latest fit or, where it has none, of the model that it was made from."""
    of_fits = {name: kept_of(folder / f"{name}.json", DIAGNOSIS_FORMAT, other) for name, other in fits.items()}
    found = {name: diagnosis for name, diagnosis in of_fits.items() if diagnosis is not None}
    smaller = [d for d in found.values() if set(d["model"]) < set(fit["setup"]["effects"])]
    return found.get(fit["name"]) or max(smaller, key=lambda d: len(d["model"]), default=None)


def _surface(path: Path) -> Surface | None:
    if not path.is_file():
        return None
    remedy = f"delete the folder {path.parent}; `splatsoil fit` makes it anew"
    return Surface(**read_npz(path, ("x", "y", "height"), remedy=remedy))
