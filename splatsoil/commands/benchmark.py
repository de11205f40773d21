"""``splatsoil benchmark``: benchmarks of splatsoil."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from dataclasses import dataclass

from splatsoil.commands._output import print_result
from splatsoil.errors import ParameterError
from splatsoil.options import argument, option


@dataclass(frozen=True)
class Config:
    """List the benchmarks, or run one.

    splatsoil benchmark NAME --help lists a benchmark's options.
    """

    name: str = argument("Of the benchmark; without one they are listed.", default="")
    arguments: tuple[str, ...] = argument("The benchmark's own arguments.", default=())
    json: bool = option(False, "List as one JSON object; as an argument of a benchmark, it is the benchmark's own.")


def run(config: Config) -> int:
    """Run a module of ``splatsoil.benchmarks`` as a script; ParameterError for an unknown name."""
    import splatsoil.benchmarks

    found = sorted(info.name for info in pkgutil.iter_modules(splatsoil.benchmarks.__path__))
    known = {name.replace("_", "-"): f"splatsoil.benchmarks.{name}" for name in found if not name.startswith("_")}
    if config.name in known:
        return _execute(config.name, known[config.name], config.arguments)
    if config.name:
        raise ParameterError(f"benchmark {config.name!r} is unknown; there are {', '.join(known)}")
    texts = {name: importlib.import_module(module).__doc__ or "" for name, module in known.items()}
    titles = {name: text.strip().splitlines()[0] for name, text in texts.items()}
    lines = [f"{name:<16}{title}" for name, title in titles.items()]
    return print_result(config, {"benchmarks": titles}, last="\n".join(lines))


def _execute(name: str, module: str, arguments: tuple[str, ...]) -> int:
    """Run a module's ``main``; returns its exit code."""
    before = sys.argv
    sys.argv = [f"splatsoil benchmark {name}", *arguments]
    try:
        return int(importlib.import_module(module).main(list(arguments)))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = before
