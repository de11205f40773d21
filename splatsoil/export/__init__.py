"""A prediction in formats that other programs read: VTK series, USD, CSV tables and splats.

One simulation is replayed, and every writer is handed each exported moment in turn, so that no more than one of them is
held in memory.
"""

from __future__ import annotations

import importlib.util
import pkgutil
from collections.abc import Iterable
from pathlib import Path

from splatsoil.errors import ParameterError
from splatsoil.export.replay import Moment, Writer, replay
from splatsoil.model import Model

__all__ = ["Moment", "Writer", "check_installed", "make_writers", "replay"]

#: A format's writer, which takes an empty folder, the model, and its frames that come.
_WRITERS = {
    "vtk": "splatsoil.export.vtk:VtkWriter",
    "usd": "splatsoil.export.usd:UsdWriter",
    "csv": "splatsoil.export.tables:CsvWriter",
    "ply": "splatsoil.export.splats:SplatWriter",
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
        writers.append(pkgutil.resolve_name(_WRITERS[name])(folder / name, model, frames))
    return writers
