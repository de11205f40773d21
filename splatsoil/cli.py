"""The command line, made of the modules of ``splatsoil.commands``.

A module there is a command of the same name (``import_`` for ``import``). It has a frozen dataclass ``Config`` whose
fields are its options (see `splatsoil.options`; its docstring is the help; a field ``json`` makes the command print one
JSON object and nothing else on stdout) and a function ``run(config) -> int`` that returns the exit code.
``INTERRUPTED`` is the message after Ctrl-C, before the command line that continues: a text, or a function of the
options. Slow imports belong inside ``run``.

Exit codes: that of ``run``; 2 for a user's error (one line on stderr, no traceback), 3 if the data give no answer (the
first line on stdout says why), 130 after Ctrl-C.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import splatsoil.commands
from splatsoil import __version__
from splatsoil.batches import full_memory
from splatsoil.commands._options import parse, program_page, same_again
from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import NoAnswer, SetWarning, SplatsoilError, did_you_mean
from splatsoil.files import check_paths
from splatsoil.trust import trust

DESCRIPTION = "Soil properties from photographs of a tool moving through it."


def commands() -> dict[str, Any]:
    """The modules of all subcommands by name."""
    found = [info.name for info in pkgutil.iter_modules(splatsoil.commands.__path__) if not info.name.startswith("_")]
    return {name.rstrip("_").replace("_", "-"): importlib.import_module(f"splatsoil.commands.{name}") for name in found}


def after_interrupt(name: str, command: Any, config: Any) -> str:
    """The message after Ctrl-C: what is stored, and the command line that continues."""
    text = getattr(command, "INTERRUPTED", "start again with")
    return f"{text if isinstance(text, str) else text(config)}: {same_again(name, config)}"


@contextmanager
def _printing_remarks() -> Iterator[None]:
    """Print each warning about a set once, as a remark; others as Python does."""
    printed: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", SetWarning)
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
            if not issubclass(category, SetWarning):
                others(message, category, *rest)
            elif str(message) not in printed:
                printed.add(str(message))
                print(f"remark {message}", file=sys.stderr)

        warnings.showwarning = show  # type: ignore[assignment]
        yield


def _page_or_hint(name: str, known: dict[str, Any]) -> int:
    """Exit code without a known command: the help page or an error."""
    if name in ("", "-h", "--help"):
        page = program_page({name: command.Config for name, command in known.items()}, DESCRIPTION)
        print(page, file=sys.stdout if name else sys.stderr)
        return 0 if name else 2
    hint = did_you_mean(name, known)
    print(f"splatsoil: there is no command {name!r}{hint}; splatsoil --help lists them", file=sys.stderr)
    return 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; a command's help and usage errors leave by SystemExit (0, 2)."""
    name, *words = list(sys.argv[1:] if arguments is None else arguments) or [""]
    if name == "--version":
        print(f"splatsoil {__version__}")
        return 0
    known = commands()
    if name not in known:
        return _page_or_hint(name, known)
    command = known[name]
    config: Any
    if name == "benchmark" and words and not words[0].startswith("-"):
        # Further arguments are the benchmark's own.
        config = command.Config(words[0], tuple(words[1:]))
    else:
        config = parse(name, command.Config, words)
    trust(getattr(config, "effects", ()))
    wants_json = bool(getattr(config, "json", False))
    with only_json() if wants_json else nullcontext(), _printing_remarks():
        places: dict[str, str] = {}
        try:
            check_paths(vars(config).values())
            return command.run(config)
        except NoAnswer as error:  # a result
            message, code, places = str(error), error.code, error.places
            print(message)
        except SplatsoilError as error:
            message, code = " ".join(str(error).split()), error.code
            print(f"splatsoil: {message}", file=sys.stderr)
        except RuntimeError as error:
            if not (memory := full_memory(error)):
                raise
            message, code = f"{memory} is full; choose a coarser --preset, or another --device", SplatsoilError.code
            print(f"splatsoil: {message}", file=sys.stderr)
        except KeyboardInterrupt:
            message, code = f"interrupted; {after_interrupt(name, command, config)}", 130
            print(f"\nsplatsoil: {message}", file=sys.stderr)
        if wants_json:
            print_json({"ok": False, "error": message, **places})
        return code
