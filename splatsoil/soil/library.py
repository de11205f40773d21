"""Finding effects: built in, installed by other packages (entry points), or in a user's own file."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Iterable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from splatsoil.errors import ParameterError, did_you_mean
from splatsoil.parameters import Parameter
from splatsoil.soil import effects as builtin
from splatsoil.soil.effect import Effect

ENTRY_POINT_GROUP = "splatsoil.effects"


@cache
def library() -> dict[str, Effect]:
    """All built-in and installed effects by name, in alphabetical order."""
    found: dict[str, Effect] = {}
    for info in pkgutil.iter_modules(builtin.__path__):
        for effect in _effects_of(importlib.import_module(f"{builtin.__name__}.{info.name}")):
            found[effect.name] = effect
    for point in entry_points(group=ENTRY_POINT_GROUP):
        effect = _checked(point.load(), f"entry point {point.name} = {point.value}")
        found[effect.name] = effect
    return dict(sorted(found.items()))


def find_effects(names: Iterable[str | Effect]) -> tuple[Effect, ...]:
    """Effects by name, or from ``path/to/file.py`` (every Effect subclass the file defines); effects stay themselves.

    Raises:
        ParameterError: an unknown name, a file without effects, or an effect named twice.
    """
    chosen: list[Effect] = []
    for name in names:
        if isinstance(name, Effect):
            chosen.append(name)
        elif name.endswith(".py"):
            chosen.extend(_effects_of(_load_file(Path(name))))
        elif name in library():
            chosen.append(library()[name])
        else:
            hint = did_you_mean(name, library())
            raise ParameterError(f"effect {name!r} is unknown{hint}; known are {', '.join(library())}")
    repeated = {e.name for e in chosen if sum(o.name == e.name for o in chosen) > 1}
    if repeated:
        raise ParameterError(f"effect named twice: {', '.join(sorted(repeated))}")
    return tuple(chosen)


def _effects_of(module: ModuleType) -> list[Effect]:
    return [
        _checked(member, module.__file__ or module.__name__)
        for _, member in inspect.getmembers(module, inspect.isclass)
        if issubclass(member, Effect) and member is not Effect and member.__module__ == module.__name__
    ]


def _checked(kind: Any, where: str) -> Effect:
    """An instance of an effect's class, after a look at what the plug asks for."""
    if not (inspect.isclass(kind) and issubclass(kind, Effect)):
        raise ParameterError(f"{where}: {kind!r} is no subclass of splatsoil.soil.effect.Effect")
    what = f"{where}: effect {kind.__name__}"
    if not isinstance(getattr(kind, "name", None), str):
        raise ParameterError(f"{what} has no name; give the class an attribute name = '...'")
    parameters = getattr(kind, "parameters", ())
    if not parameters or not all(isinstance(p, Parameter) for p in parameters):
        raise ParameterError(f"{what} has no parameters; give the class a tuple of splatsoil.parameters.Parameter")
    if parameters[0].off is None:
        raise ParameterError(
            f"{what}: its first parameter, {parameters[0].name}, measures its size and needs a value off=... at which "
            "the effect does nothing"
        )
    strange = [name for name in kind.shapes if name not in {p.name for p in parameters if p.off is None}]
    if strange:
        raise ParameterError(f"{what}: {', '.join(strange)} among its shapes is none of its parameters without off=...")
    if kind.shapes and kind.observe is not Effect.observe:
        # Calibrations pin the sizes of such effects in their default shape.
        raise ParameterError(f"{what} changes what cameras report: it cannot have shapes; leave them at their defaults")
    return kind()


def _load_file(path: Path) -> ModuleType:
    try:
        source = path.read_bytes()
    except OSError as error:
        raise ParameterError(f"effect file {path} cannot be read ({error.strerror})") from error
    return _loaded(path.resolve(), hashlib.sha256(source).hexdigest())


@cache
def _loaded(path: Path, digest: str) -> ModuleType:
    """The module in a file; once for each content, so that the same effects are the same kernels."""
    name = f"splatsoil_effect_{path.stem}_{digest[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ParameterError(f"effect file {path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ParameterError(f"effect file {path} cannot be imported: {type(error).__name__}: {error}") from error
    if not _effects_of(module):
        raise ParameterError(f"effect file {path} defines no subclass of splatsoil.soil.effect.Effect")
    return module
