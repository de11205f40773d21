"""What a run folder holds, read for showing. Only files: this knows nothing of how a fit is made."""

from __future__ import annotations

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
    read_kept,
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
        truth: true values of the latest fit's parameters by name, where the set is simulated and says them.
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
    fits = {file.stem: read_kept(file, FIT_FORMAT) for file in sorted((path / "fits").glob("*.json"))}
    return RunData(
        folder=path,
        run=run,
        fit=fit,
        fits=fits or {str(fit["name"]): fit},
        comparison=_comparison(path / "comparison", fit),
        before=_before(path / "before"),
        misfit=_misfit(path / "comparison" / "misfit.json", fit),
        diagnosis=_diagnosis(path / "diagnoses", fits or {str(fit["name"]): fit}, fit),
        posterior=_posterior(path / "posterior.json", fit),
        history=_history(path / "history.json"),
        reconstruction=_reconstruction(path / "reconstruction"),
        surface=_surface(path / "reconstruction" / "surface.npz"),
        truth=true_values(run["measurement"]["folder"], fit["parameters"]),
    )


#: Parameters under the names that other simulators give them in ``truth.json``.
ELSEWHERE = {"friction_angle": "phi", "tool_friction": "tool_mu"}


def true_values(folder: str | Path, names: Iterable[str]) -> dict[str, float]:
    """What the ``truth.json`` of a simulated set says of parameters, in their units; only those that it says."""
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


def _comparison(folder: Path, fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """The comparison, unless it was made at another estimate."""
    if not (folder / "comparison.json").is_file():
        return None
    data = read_kept(folder / "comparison.json", COMPARISON_FORMAT)
    same = data["fit"] == fit["name"] and data["parameters"] == estimates(fit)
    return data if same else None


def _misfit(path: Path, fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """The latest fit against something else, unless that was another estimate."""
    if not path.is_file():
        return None
    data = read_kept(path, MISFIT_FORMAT)
    return data if data["fit"] == fit["name"] and data["values"] == estimates(fit) else None


def _before(folder: Path) -> dict[str, Any] | None:
    path = folder / "comparison.json"
    return read_kept(path, COMPARISON_FORMAT) if path.is_file() else None


def _diagnosis(folder: Path, fits: Mapping[str, Any], fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """The diagnosis of the latest fit or, where it has none, of the model that it was made from."""
    found = {}
    for name, other in fits.items():
        path = folder / f"{name}.json"
        if path.is_file():
            data = read_kept(path, DIAGNOSIS_FORMAT)
            if data["values"] == estimates(other):
                found[name] = data
    if fit["name"] in found:
        return found[str(fit["name"])]
    mine = set(fit["setup"]["effects"]) if "setup" in fit else set()
    smaller = [d for d in found.values() if set(d["model"]) < mine]
    return max(smaller, key=lambda d: len(d["model"]), default=None)


def _posterior(path: Path, fit: Mapping[str, Any]) -> dict[str, Any] | None:
    """The posterior, unless it was sampled for another fit."""
    if not path.is_file():
        return None
    data = read_kept(path, POSTERIOR_FORMAT)
    return data if data["fit"] == fit["name"] and data["values"] == estimates(fit) else None


def _history(path: Path) -> list[dict[str, Any]]:
    return list(read_kept(path, HISTORY_FORMAT)["models"]) if path.is_file() else []


def _reconstruction(folder: Path) -> dict[str, Any] | None:
    path = folder / "reconstruction.json"
    return read_kept(path, RECONSTRUCTION_FORMAT) if path.is_file() else None


def _surface(path: Path) -> Surface | None:
    if not path.is_file():
        return None
    remedy = f"delete the folder {path.parent}; `splatsoil fit` makes it anew"
    return Surface(**read_npz(path, ("x", "y", "height"), remedy=remedy))
