"""The JSON files of a run folder: formats, schemas and reading."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

from splatsoil.errors import RunError
from splatsoil.files import ANEW, read_json

RUN_FORMAT = "splatsoil-run/1"
FIT_FORMAT = "splatsoil-fit/2"
COMPARISON_FORMAT = "splatsoil-comparison/1"
DIAGNOSIS_FORMAT = "splatsoil-diagnosis/3"
MISFIT_FORMAT = "splatsoil-misfit/3"
POSTERIOR_FORMAT = "splatsoil-posterior/2"
DESIGN_FORMAT = "splatsoil-design/2"
HISTORY_FORMAT = "splatsoil-history/2"
RECONSTRUCTION_FORMAT = "splatsoil-reconstruction/1"


def _is_name(value: Any) -> bool:
    """Whether it is a plain file name, without a path."""
    return isinstance(value, str) and value not in ("", ".", "..") and not set(value) & set("/\\\0")


def _is_effect(value: Any) -> bool:
    """Whether it is the name of an effect, or empty, and not a program."""
    return value == "" or (_is_name(value) and not value.endswith(".py"))


def _are_pictures(frames: Any) -> bool:
    """Whether the frames of a comparison name their pictures by plain file names."""
    kinds = ("observed", "predicted", "difference")
    return frames is None or (
        isinstance(frames, list)
        and all(isinstance(f, dict) and all(_is_name(f[kind]) for kind in kinds if kind in f) for f in frames)
    )


EACH = "*"
"""In a schema: every key."""
NUMBER = (int, float)
ESTIMATE = {"estimate": NUMBER, "std": NUMBER, "unit": str}

SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    RUN_FORMAT: {"measurement": {"name": str, "folder": str, "hash": str}, "preset": str, "seed": int},
    FIT_FORMAT: {
        "name": _is_name,
        "parameters": {EACH: {**ESTIMATE, "title": str}},
        "setup": {"effects": [str], "preset": str},
        "minimum": {EACH: {"estimate": NUMBER, "low": NUMBER, "high": NUMBER}},
        "history": [{"parameters": {EACH: NUMBER}, "seed": int, "status": str}],
    },
    COMPARISON_FORMAT: {"fit": str, "parameters": dict, "frames": _are_pictures},
    DIAGNOSIS_FORMAT: {
        "fit": str,
        "values": dict,
        "model": list,
        "models": [{"name": _is_effect, "probability": NUMBER}],
    },
    MISFIT_FORMAT: {"fit": str, "values": dict},
    POSTERIOR_FORMAT: {"fit": str, "values": dict},
    HISTORY_FORMAT: {"models": [{"model": _is_name, "effects": [str], "parameters": {EACH: ESTIMATE}}]},
}
"""Schema by format: for each key a type (or several), a schema, a list of one schema for its elements, or a
predicate."""


def read_format(path: str | Path, tag: str, *, remedy: str = ANEW) -> dict[str, Any]:
    """Read a file of a run folder and check its format.

    Args:
        path: the file.
        tag: its format.
        remedy: advice to the user if the check fails.

    Raises:
        RunError: the file is missing, unreadable, damaged, or of another format.
    """
    data = read_json(path, remedy=remedy)
    if not isinstance(data, dict) or data.get("format") != tag:
        raise RunError(f"{path}: isn't of format {tag}; {remedy}")
    place = _violation(data, SCHEMAS.get(tag, {}))
    if place is not None:
        raise RunError(f"{path}: is damaged, it lacks {place.removeprefix('.')}; {remedy}")
    return data


def read_description(folder: Path) -> dict[str, Any]:
    """The description of a run folder, ``run.json``.

    Raises:
        RunError: it isn't a run folder, is of another version, or has links that lead out of it.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise RunError(f"{folder}: has no run.json, so it isn't a run folder; name one made by `splatsoil fit`")
    _check_links(folder)
    return read_format(path, RUN_FORMAT, remedy="choose another run folder")


def _check_links(folder: Path) -> None:
    """RunError for a link that leads out of the run folder."""
    root = folder.resolve()
    for place, folders, files in os.walk(root):
        for entry in (Path(place) / name for name in (*folders, *files)):
            if entry.is_symlink() and not _resolved(entry).is_relative_to(root):
                raise RunError(
                    f"{entry}: is a link that leads out of the run folder; put what it stands for there instead"
                )


def _resolved(path: Path) -> Path:
    """Target of a link; its name alone if it leads in a circle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return Path(path.name)


def read_fit(folder: Path) -> dict[str, Any]:
    """A run's latest finished fit, ``fit.json``.

    Raises:
        RunError: there is none, or it is damaged.
    """
    path = folder / "fit.json"
    if not path.is_file():
        raise RunError(f"{folder}: no fit has been finished here; `splatsoil fit` goes on where it stopped")
    return read_format(path, FIT_FORMAT, remedy="delete it; `splatsoil fit` makes it again")


def _violation(data: Any, schema: Any, place: str = "") -> str | None:
    """The first place where data violates a schema; None if it is valid."""
    if isinstance(schema, list):
        if not isinstance(data, list):
            return place
        parts = [(str(number), item, schema[0]) for number, item in enumerate(data)]
    elif isinstance(schema, Mapping):
        if not isinstance(data, dict):
            return place
        wanted = dict.fromkeys(data, schema[EACH]) if EACH in schema else schema
        parts = [(key, data.get(key), inner) for key, inner in wanted.items()]
    elif isinstance(schema, FunctionType):
        return None if schema(data) else place
    else:
        return None if isinstance(data, schema) else place
    found = (_violation(item, inner, f"{place}.{key}") for key, item, inner in parts)
    return next((where for where in found if where is not None), None)
