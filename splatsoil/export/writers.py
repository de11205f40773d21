"""The formats by name, and what each needs."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

from splatsoil.errors import ParameterError
from splatsoil.export.replay import Writer
from splatsoil.model import Model

FORMATS = {
    "vtk": ("vtk", "VtkWriter"),
    "usd": ("usd", "UsdWriter"),
    "csv": ("tables", "CsvWriter"),
    "ply": ("splats", "SplatWriter"),
}
"""By name, a format's module here, which is loaded when it is used, and its writer."""

_PACKAGES = {"vtk": "meshio", "usd": "pxr"}


def check_installed(formats: Iterable[str]) -> None:
    """See that packages are there before anything is simulated.

    Raises:
        ParameterError: one of a format isn't.
    """
    missing = [name for name in formats if name in _PACKAGES and importlib.util.find_spec(_PACKAGES[name]) is None]
    if missing:
        raise ParameterError(
            f"--to {' '.join(missing)}: needs packages that aren't installed; pip install 'splatsoil[export]'"
        )


def make_writers(folder: Path, formats: Iterable[str], model: Model, frames: tuple[int, ...]) -> list[Writer]:
    """A writer for each format, into a new folder of its name; frames rise."""
    writers = []
    for name in formats:
        module, kind = FORMATS[name]
        (folder / name).mkdir(parents=True)
        writer = getattr(importlib.import_module(f"splatsoil.export.{module}"), kind)
        writers.append(writer(folder / name, model, frames))
    return writers
