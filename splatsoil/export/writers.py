"""The formats by name, and what each needs."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from splatsoil.errors import ParameterError
from splatsoil.export.replay import Writer
from splatsoil.model import Model


def _vtk(folder: Path, model: Model, frames: tuple[int, ...]) -> Writer:
    from splatsoil.export.vtk import VtkWriter

    return VtkWriter(folder, model)


def _usd(folder: Path, model: Model, frames: tuple[int, ...]) -> Writer:
    from splatsoil.export.usd import UsdWriter

    return UsdWriter(folder, model, frames)


def _csv(folder: Path, model: Model, frames: tuple[int, ...]) -> Writer:
    from splatsoil.export.tables import CsvWriter

    return CsvWriter(folder, model)


def _ply(folder: Path, model: Model, frames: tuple[int, ...]) -> Writer:
    from splatsoil.export.splats import SplatWriter

    return SplatWriter(folder, model, (frames[0], frames[-1]))


FORMATS: Mapping[str, Callable[[Path, Model, tuple[int, ...]], Writer]] = {
    "vtk": _vtk,
    "usd": _usd,
    "csv": _csv,
    "ply": _ply,
}
"""By name, what makes a format's writer of its folder, the model and the frames, which rise."""

_MODULES = {"vtk": "meshio", "usd": "pxr"}


def check_installed(formats: Iterable[str]) -> None:
    """See that packages are there before anything is simulated.

    Raises:
        ParameterError: one of a format isn't.
    """
    missing = [name for name in formats if name in _MODULES and importlib.util.find_spec(_MODULES[name]) is None]
    if missing:
        raise ParameterError(
            f"--to {' '.join(missing)}: needs packages that aren't installed; pip install 'splatsoil[export]'"
        )


def make_writers(folder: Path, formats: Iterable[str], model: Model, frames: tuple[int, ...]) -> list[Writer]:
    """A writer for each format, into a new folder of its name."""
    writers = []
    for name in formats:
        (folder / name).mkdir(parents=True)
        writers.append(FORMATS[name](folder / name, model, frames))
    return writers
