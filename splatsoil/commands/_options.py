"""Parser, help page and command line of a command, from the fields of its dataclass (see `splatsoil.options`)."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import shlex
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NoReturn

from splatsoil.errors import ParameterError, SplatsoilError, did_you_mean
from splatsoil.options import JSON, argument, option

Preset = Literal["tiny", "small", "paper", "fine"]

#: Texts of common options.
SET = "Folder of the measurement set."
PRESET = "Resolution; tiny only tries the commands, small suits a laptop."
DEVICE = "Where to compute: auto, cpu, cuda:0, …"
SEED = "Of random numbers; one seed gives one result on one processor."
BUDGET = "Evaluations; 10 for each free parameter if not given."
ACTING = "Effects that act, or files that define some."
VALUES = "Parameters of the effects."

#: Order of commands in the help.
ORDER = {
    "all at once": ("run",),
    "into a measurement set": ("import", "check", "simulate"),
    "step by step": ("reconstruct", "fit", "compare", "diagnose", "add", "report"),
    "more of a run": ("posterior", "design", "export", "view"),
    "by themselves": ("element", "benchmark"),
}
#: Common options, listed after a command's own.
COMMON = {"device": 1, "json": 2}
#: Default number of evaluations for each free parameter.
EVALUATIONS = 10

MAX_COLUMNS = 100
"""Maximum width of a help page."""
KINDS = {int: "N", float: "X", Path: "PATH", str: "NAME"}
"""Placeholders of values in the help, by type."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    set: Path = argument(SET)
    parameters: tuple[str, ...] = option(
        (), "Free parameters; friction angle and those of effects that are on if not given."
    )
    effects: tuple[str, ...] = option(
        (), "Effects of the model, by name, or files that define some.", name="with", metavar="EFFECT"
    )
    budget: int | None = option(None, BUDGET, expert=True)
    preset: Preset = option("small", PRESET)
    device: str = option("auto", DEVICE)
    seed: int = option(0, SEED, expert=True)
    run: Path | None = option(None, "Run folder; runs/NAME-PRESET, with the seed if it is not 0, if not given.")
    json: bool = option(False, JSON)

    def folder(self, name: str) -> Path:
        """The run folder for a measurement set of this name."""
        if self.run is not None:
            return self.run
        return Path("runs") / (f"{name}-{self.preset}" + (f"-seed{self.seed}" if self.seed else ""))


@dataclass(frozen=True)
class RunOptions:
    """Options of a command on a run folder."""

    run: Path = argument("The run folder.")
    set: Path | None = option(None, "Where the measurement set is now, if it has moved; later commands know it, too.")
    json: bool = option(False, JSON)


@dataclass(frozen=True)
class ComputingOptions(RunOptions):
    """Options of a command that simulates the model of a run folder."""

    device: str = option("auto", DEVICE)


def check_evaluations(budget: int | None) -> None:
    """ParameterError for a fit of too few evaluations."""
    if budget is not None and budget < 2:
        raise ParameterError(f"--budget: a fit needs at least 2 evaluations, not {budget}")


def check_seed(seed: int) -> None:
    """ParameterError for an invalid seed."""
    if not 0 <= seed < 2**63:
        raise ParameterError(f"--seed: must be 0 or more and less than 2^63, not {seed}")


def command_line(command: str, *words: object) -> str:
    """A command line, quoted for a shell."""
    return shlex.join(["splatsoil", command, *map(str, words)])


def same_again(command: str, config: Any) -> str:
    """The command line of a command's options, without defaults."""
    places: list[object] = []
    options: list[object] = []
    for field in _fields(config):
        value = getattr(config, field.name)
        words = value if isinstance(value, tuple) else (value,)
        if field.metadata.get("positional"):
            places += words
        elif value != field.default:
            options += [_flag(field), *(() if value is True else words)]
    return command_line(command, *places, *options)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line on stderr."""
        command = self.prog.removeprefix("splatsoil ")
        message = " ".join(str(SplatsoilError(message)).split())  # words as they were given may act on a terminal
        print(f"splatsoil: {command}: {message}; {self.prog} --help lists its options", file=sys.stderr)
        raise SystemExit(2)


class _Tuple(argparse.Action):
    """Several values of different types."""

    def __init__(
        self, option_strings: Sequence[str], dest: str, *, kinds: Sequence[Callable[[str], Any]], **settings: Any
    ) -> None:
        super().__init__(option_strings, dest, nargs=len(kinds), **settings)
        self.kinds = kinds

    def __call__(self, parser: Any, namespace: Any, values: Any, *_: Any) -> None:
        try:
            setattr(namespace, self.dest, tuple(kind(word) for kind, word in zip(self.kinds, values, strict=True)))
        except ValueError as error:
            raise argparse.ArgumentError(self, str(error)) from None


def parse(command: str, config: type, words: Sequence[str]) -> Any:
    """A dataclass of options from a command's arguments; ``--help`` exits with 0, usage errors with 2."""
    parser = parser_of(command, config)
    found, unknown = parser.parse_known_intermixed_args(list(words))
    if unknown:
        hint = did_you_mean(unknown[0], map(_flag, _fields(config)))
        parser.error(f"unrecognized argument: {unknown[0]}{hint}")
    return config(**{name: tuple(value) if isinstance(value, list) else value for name, value in vars(found).items()})


def parser_of(command: str, config: type) -> argparse.ArgumentParser:
    """The argument parser of a command."""
    fields, hints = _fields(config), typing.get_type_hints(config)
    places = [_shown(field) for field in fields if field.metadata.get("positional")]
    parser = _Parser(
        prog=f"splatsoil {command}",
        usage=" ".join(["%(prog)s", *places, "[options]"]),
        description=inspect.cleandoc(config.__doc__ or "").replace("%", "%%"),
        formatter_class=partial(argparse.HelpFormatter, max_help_position=26, width=_columns()),
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
    )
    expert = parser.add_argument_group("expert")
    for field in fields:
        about, required = field.metadata, field.default is dataclasses.MISSING
        settings = _settings(hints[field.name], about.get("metavar", ""))
        settings["help"] = (about.get("text", "") + _default(field.default)).replace("%", "%%")
        if about.get("positional"):
            many = ("+" if required else "*") if "nargs" in settings else None if required else "?"
            parser.add_argument(field.name, **settings | {"metavar": field.name.upper(), "nargs": many})
        else:
            group = expert if about.get("expert") else parser
            group.add_argument(_flag(field), dest=field.name, **settings)
    return parser


def _settings(hint: Any, metavar: str) -> dict[str, Any]:
    """Settings of argparse for a type."""
    inner, origin = typing.get_args(hint), typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return _settings(next(part for part in inner if part is not type(None)), metavar)
    if origin is Literal:
        return {"choices": inner}
    if origin is tuple and Ellipsis in inner:
        return {**_settings(inner[0], metavar), "nargs": "*"}
    if origin is tuple:
        return {"action": _Tuple, "kinds": inner, "metavar": tuple(metavar.split())}
    return {"action": "store_true"} if hint is bool else {"type": hint, "metavar": metavar or KINDS[hint]}


def program_page(configs: Mapping[str, type], description: str) -> str:
    """The help page with all commands."""
    lines = ["usage: splatsoil COMMAND …", "", description, "Start with: splatsoil run examples/plow-dry"]
    left = dict(configs)
    for title, names in (*ORDER.items(), ("others", tuple(configs))):
        mine = [name for name in names if name in left]
        lines += ["", title] if mine else []
        for name in mine:
            text = f"  {name:<13}{inspect.cleandoc(left.pop(name).__doc__ or '').splitlines()[0]}"
            lines += textwrap.wrap(text, _columns(), subsequent_indent=" " * 15)
    return "\n".join([*lines, "", "splatsoil COMMAND --help lists a command's options."])


def _columns() -> int:
    return min(shutil.get_terminal_size().columns, MAX_COLUMNS)


def _fields(config: Any) -> list[dataclasses.Field[Any]]:
    """A command's own options, then common ones."""
    return sorted(dataclasses.fields(config), key=lambda field: COMMON.get(field.name, 0))


def _flag(field: dataclasses.Field[Any]) -> str:
    return "--" + (field.metadata.get("name") or field.name.replace("_", "-"))


def _shown(field: dataclasses.Field[Any]) -> str:
    """A positional argument in the usage."""
    name = field.name.upper() + " …" * str(field.type).startswith("tuple")
    return name if field.default is dataclasses.MISSING else f"[{name}]"


def _default(value: Any) -> str:
    """The default value in the help, if there is one."""
    if value is dataclasses.MISSING or value is None or value is False or value in ((), ""):
        return ""
    words = value if isinstance(value, tuple) else (value,)
    return f" [{' '.join(f'{word:g}' if isinstance(word, float) else str(word) for word in words)}]"
