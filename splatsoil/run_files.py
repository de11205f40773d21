"""The JSON files of a run folder: their formats, and what each must hold for others to be understood."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatsoil.errors import RunError
from splatsoil.files import ANEW, read_json

RUN_FORMAT = "splatsoil-run/1"
FIT_FORMAT = "splatsoil-fit/2"
COMPARISON_FORMAT = "splatsoil-comparison/1"
DIAGNOSIS_FORMAT = "splatsoil-diagnosis/2"
MISFIT_FORMAT = "splatsoil-misfit/2"
POSTERIOR_FORMAT = "splatsoil-posterior/2"
DESIGN_FORMAT = "splatsoil-design/1"
HISTORY_FORMAT = "splatsoil-history/1"
RECONSTRUCTION_FORMAT = "splatsoil-reconstruction/1"

EACH = "*"
"""Stands for every key there is, in a shape."""
NUMBER = (int, float)
ESTIMATE = {"estimate": NUMBER, "std": NUMBER, "unit": str}

SHAPES: Mapping[str, Mapping[str, Any]] = {
    RUN_FORMAT: {"measurement": {"name": str, "folder": str, "hash": str}, "preset": str, "seed": int},
    FIT_FORMAT: {
        "name": str,
        "parameters": {EACH: {**ESTIMATE, "title": str}},
        "setup": {"effects": [str], "preset": str},
        "minimum": {EACH: {"estimate": NUMBER, "low": NUMBER, "high": NUMBER}},
        "history": [{"parameters": {EACH: NUMBER}, "seed": int, "level": str, "status": str}],
    },
    COMPARISON_FORMAT: {"fit": str, "parameters": dict},
    DIAGNOSIS_FORMAT: {"values": dict, "model": list, "models": [{"name": str, "probability": NUMBER}]},
    MISFIT_FORMAT: {"fit": str, "values": dict},
    POSTERIOR_FORMAT: {"fit": str, "values": dict},
    HISTORY_FORMAT: {"models": [{"model": str, "effects": [str], "parameters": {EACH: ESTIMATE}}]},
}
"""By format: of each key a type (or several), a shape of its own, or a list of one, which each element must be of."""


def read_kept(path: str | Path, tag: str, *, remedy: str = ANEW) -> dict[str, Any]:
    """Read a file of a run folder that is to be of a format.

    Args:
        path: the file.
        tag: its format.
        remedy: what helps where it is something else.

    Raises:
        RunError: it is missing, can't be read, or is something else or damaged.
    """
    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != tag:
        raise RunError(f"{path}: isn't of format {tag}; {remedy}")
    place = _astray(data, SHAPES.get(tag, {}))
    if place is not None:
        raise RunError(f"{path}: is damaged, it lacks {place.removeprefix('.')}; {remedy}")
    return data


def read_description(folder: Path) -> dict[str, Any]:
    """What a run folder is for, from its ``run.json``.

    Raises:
        RunError: it isn't a run folder, or is one of another version.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise RunError(f"{folder}: has no run.json, so it isn't a run folder; name one made by `splatsoil fit`")
    return read_kept(path, RUN_FORMAT, remedy="choose another run folder")


def read_fit(folder: Path) -> dict[str, Any]:
    """A run's latest finished fit, from its ``fit.json``.

    Raises:
        RunError: no fit has been finished, or what is kept of it is damaged.
    """
    path = folder / "fit.json"
    if not path.is_file():
        raise RunError(f"{folder}: no fit has been finished here; `splatsoil fit` goes on where it stopped")
    return read_kept(path, FIT_FORMAT, remedy="delete it; `splatsoil fit` makes it anew")


def _astray(data: Any, shape: Any, place: str = "") -> str | None:
    """The first place where data isn't of a shape; None where all of it is."""
    if isinstance(shape, list):
        if not isinstance(data, list):
            return place
        parts = [(str(number), item, shape[0]) for number, item in enumerate(data)]
    elif isinstance(shape, Mapping):
        if not isinstance(data, dict):
            return place
        wanted = dict.fromkeys(data, shape[EACH]) if EACH in shape else shape
        parts = [(key, data.get(key), inner) for key, inner in wanted.items()]
    else:
        return None if isinstance(data, shape) else place
    found = (_astray(item, inner, f"{place}.{key}") for key, item, inner in parts)
    return next((where for where in found if where is not None), None)
