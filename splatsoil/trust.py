"""Effects that are files: they are programs, which run because their user has named them on a command line.

A run folder names the effects it was fitted with, too, and may be a stranger's. So each file that was named on a
command line is remembered by its contents, in a folder of the user's, and no other one is run for a run folder's sake.
"""

from __future__ import annotations

import hashlib
import os
import shlex
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from splatsoil.errors import RunError

_named: set[str] = set()


def _folder() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "splatsoil" / "effects"


def _files(effects: Iterable[str]) -> dict[str, str]:
    """Of effects that are files, and can be read, the digests by their names."""
    out = {}
    for name in effects:
        if name.endswith(".py"):
            with suppress(OSError, ValueError):
                out[name] = hashlib.sha256(Path(name).read_bytes()).hexdigest()
    return out


def trust(effects: Iterable[str]) -> None:
    """Remember files among effects that the user has named, in this process where nothing can be kept."""
    for digest in _files(effects).values():
        _named.add(digest)
        with suppress(OSError, RuntimeError):  # no home, or one that can't be written to
            _folder().mkdir(parents=True, exist_ok=True)
            (_folder() / digest).touch()


def check_trusted(effects: Iterable[str], run: Path) -> None:
    """See that no file among a run folder's effects is run that the user hasn't named.

    Raises:
        RunError: one is.
    """
    for name, digest in _files(effects).items():
        known = digest in _named
        with suppress(OSError, RuntimeError):
            known = known or (_folder() / digest).is_file()
        if not known:
            again = shlex.join(["splatsoil", "element", "--with", name])
            raise RunError(
                f"{run}: an effect of its model is a program, {name}, which you haven't run before; read it, and if "
                f"you trust it, name it yourself: {again}"
            )
