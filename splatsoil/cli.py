"""The command line: assembles the modules of ``splatsoil.commands`` and handles what they have in common.

A module there is a command of the same name (``import_`` of ``import``, a word of Python's own). It has a frozen
dataclass ``Config`` (its docstring is the help; a field ``json`` makes the command print one JSON object and nothing
else on stdout), a function ``run(config) -> int`` that returns the exit code, and optionally ``interrupted(config) ->
str``, a sentence on what is kept and how to go on. Whatever is slow to import belongs inside ``run``.

Exit codes: what ``run`` returns; 2 for a mistake of the user's (one line on stderr, no traceback), 3 where all was done
and the data give no answer (the first line on stdout says why), 130 after Ctrl-C.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import tyro

import splatsoil.commands
from splatsoil import __version__
from splatsoil.commands._help import answer
from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import NoAnswer, SetWarning, SplatsoilError
from splatsoil.trust import trust

DESCRIPTION = "Soil properties from photographs of a tool moving through it."


@dataclass(frozen=True)
class Command:
    """A subcommand.

    Attributes:
        config: the dataclass of its options.
        run: acts on them and returns the exit code.
        interrupted: says what Ctrl-C left and how to go on.
    """

    config: type
    run: Callable[[Any], int]
    interrupted: Callable[[Any], str]


def commands() -> dict[str, Command]:
    """All subcommands by name."""
    out = {}
    for info in pkgutil.iter_modules(splatsoil.commands.__path__):
        if not info.name.startswith("_"):
            module = importlib.import_module(f"splatsoil.commands.{info.name}")
            interrupted = getattr(module, "interrupted", lambda _: "start the command again")
            out[info.name.rstrip("_").replace("_", "-")] = Command(module.Config, module.run, interrupted)
    return out


@contextmanager
def _saying_remarks() -> Iterator[None]:
    """Print warnings about a set as its remarks, each once; all others are Python's."""
    said: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", SetWarning)
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
            if not issubclass(category, SetWarning):
                others(message, category, *rest)
            elif str(message) not in said:
                said.add(str(message))
                print(f"remark {message}", file=sys.stderr)

        warnings.showwarning = show  # type: ignore[assignment]
        yield


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; help and usage errors leave by SystemExit (0 and 2)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"splatsoil {__version__}")
        return 0
    known = commands()
    config: Any
    its_own = words[:1] == ["benchmark"] and len(words) > 1 and not words[1].startswith("-")
    if not its_own:
        answer(words, {name: command.config for name, command in known.items()}, DESCRIPTION)
    if its_own:
        # What follows a benchmark's name is its own, options too.
        config = known["benchmark"].config(words[1], tuple(words[2:]))
    else:
        config = tyro.extras.subcommand_cli_from_dict(
            {name: command.config for name, command in known.items()},
            prog="splatsoil",
            description=DESCRIPTION,
            args=words,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    command = next(c for c in known.values() if isinstance(config, c.config))
    trust(getattr(config, "effects", ()))
    wants_json = bool(getattr(config, "json", False))
    with only_json() if wants_json else nullcontext(), _saying_remarks():
        try:
            return command.run(config)
        except SplatsoilError as error:
            message = " ".join(str(error).split())
            if isinstance(error, NoAnswer):  # a result
                print(message)
            else:
                print(f"splatsoil: {message}", file=sys.stderr)
            if wants_json:
                print_json({"ok": False, "error": message})
            return error.code
        except KeyboardInterrupt:
            message = f"interrupted; {command.interrupted(config)}"
            print(f"\nsplatsoil: {message}", file=sys.stderr)
            if wants_json:
                print_json({"ok": False, "error": message})
            return 130
