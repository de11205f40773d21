"""A prediction in formats that other programs read: VTK series, USD, CSV tables and splats.

One simulation is replayed, and every writer is handed each exported moment in turn, so that no more than one of them is
held in memory.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from splatsoil.errors import ParameterError
from splatsoil.export.replay import Moment, Writer, replay
from splatsoil.model import Model

__all__ = ["Moment", "Writer", "check_installed", "make_writers", "replay"]

#: A format's writer, which takes an empty folder, the model, and its frames that come.
_WRITERS: Mapping[str, Callable[[], Any]] = {
    "vtk": lambda: import_module("splatsoil.export.vtk").VtkWriter,
    "usd": lambda: import_module("splatsoil.export.usd").UsdWriter,
    "csv": lambda: import_module("splatsoil.export.tables").CsvWriter,
    "ply": lambda: import_module("splatsoil.export.splats").SplatWriter,
}
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
        (folder / name).mkdir(parents=True)
        writers.append(_WRITERS[name]()(folder / name, model, frames))
    return writers
