"""Help pages: what a command does, the options that a first run needs, and the others."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

from tyro.conf import Positional

from splatsoil.commands._options import EXPERT, ORDER
from splatsoil.errors import did_you_mean

WIDEST = 100
"""Columns of a page, at most."""
INDENT = 26
"""Columns of an option's name; a longer one has a line of its own."""
KINDS = {int: "N", float: "X", Path: "PATH", str: "NAME"}


@dataclasses.dataclass(frozen=True)
class Option:
    """A line of a help page.

    Attributes:
        field: name in the ``Config``.
        shown: as it is typed.
        text: what it is.
        positional: whether it has no ``--name``.
    """

    field: str
    shown: str
    text: str
    positional: bool


def answer(words: Sequence[str], configs: Mapping[str, type], description: str) -> None:
    """Print the help page that is asked for and leave with 0, or leave with 2 where there is no such command; return
    where neither is so.

    Args:
        words: the command line.
        configs: dataclass of options by command.
        description: of the program.
    """
    command = words[0] if words else ""
    asked = any(word in ("-h", "--help") for word in words)
    if command in configs:
        if asked:
            _leave(command_page(command, configs[command]))
    elif asked or not command:
        print(program_page(configs, description), file=sys.stdout if asked else sys.stderr)
        raise SystemExit(0 if asked else 2)
    elif not command.startswith("-"):
        hint = did_you_mean(command, configs)
        print(f"splatsoil: there is no command {command!r}{hint}; splatsoil --help lists them", file=sys.stderr)
        raise SystemExit(2)


def _leave(page: str) -> NoReturn:
    print(page)
    raise SystemExit(0)


def program_page(configs: Mapping[str, type], description: str) -> str:
    """All commands, the first to try first."""
    lines = ["usage: splatsoil COMMAND …", "", description, "Start with: splatsoil run examples/plow-dry --preset tiny"]
    left = dict(configs)
    for title, names in (*ORDER.items(), ("others", tuple(configs))):
        mine = [name for name in names if name in left]
        lines += ["", title] if mine else []
        for name in mine:
            said = inspect.cleandoc(left.pop(name).__doc__ or "").split("\n\n")[0]
            lines += _entry(name, " ".join(said.split()), 15)
    return "\n".join([*lines, "", "splatsoil COMMAND --help lists a command's options."])


def command_page(name: str, config: type) -> str:
    """A command's options: positional ones, usual ones, and those that a first run does without."""
    options = options_of(config)
    places = [option for option in options if option.positional]
    groups = {
        "": places,
        "options": [o for o in options if not o.positional and o.field not in EXPERT],
        "expert": [o for o in options if not o.positional and o.field in EXPERT],
    }
    lines = [" ".join(["usage: splatsoil", name, *(o.shown for o in places), "[options]"]), ""]
    for paragraph in inspect.cleandoc(config.__doc__ or "").split("\n\n"):
        lines += textwrap.wrap(paragraph, _columns())
    for title, mine in groups.items():
        lines += ["", *([title] if title else [])] if mine else []
        for option in mine:
            lines += _entry(option.shown, option.text, INDENT)
    return "\n".join(lines)


def _entry(shown: str, text: str, indent: int) -> list[str]:
    """A name and what it is, in two columns."""
    wrapped = textwrap.wrap(text, max(_columns() - indent, 20)) or [""]
    first = f"  {shown:<{indent - 4}}"
    if len(first) > indent - 2:
        return [first, *(" " * indent + line for line in wrapped)]
    return [f"{first}  {wrapped[0]}".rstrip(), *(" " * indent + line for line in wrapped[1:])]


def _columns() -> int:
    return min(shutil.get_terminal_size().columns, WIDEST)


def options_of(config: type) -> list[Option]:
    """Those of a dataclass, as tyro reads them."""
    hints, texts = typing.get_type_hints(config, include_extras=True), _texts(config)
    out = []
    for field in dataclasses.fields(config):
        hint, extras = hints[field.name], []
        while typing.get_origin(hint) is typing.Annotated:
            hint, *more = typing.get_args(hint)
            extras += more
        positional = _is_positional(extras)
        settings = [extra for extra in extras if hasattr(extra, "metavar")]
        metavar = next((s.metavar for s in settings if s.metavar), None) or _metavar(hint)
        name = next((s.name for s in settings if s.name), None) or field.name.replace("_", "-")
        if positional:
            shown = metavar if any(s.metavar for s in settings) else name.upper() + " …" * metavar.endswith("…")
            shown = f"[{shown}]" if field.default is not dataclasses.MISSING else shown
        else:
            shown = f"--{name}" if hint is bool else f"--{name} {metavar}"
        out.append(Option(field.name, shown, texts.get(field.name, "") + _default(field.default), positional))
    return out


def _is_positional(extras: Sequence[Any]) -> bool:
    (marker,) = typing.get_args(Positional[int])[1:]
    return any(extra is marker for extra in extras)


def _metavar(hint: Any) -> str:
    """How a value of some type is shown: {a,b}, N, PATH, NAME …"""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return "{" + ",".join(map(str, inner)) + "}"
    if origin in (typing.Union, types.UnionType):
        return _metavar(next(part for part in inner if part is not type(None)))
    if origin is tuple:
        return f"{_metavar(inner[0])} …" if Ellipsis in inner else " ".join(map(_metavar, inner))
    return KINDS.get(hint, "")


def _default(value: Any) -> str:
    """The usual value, where it is one."""
    if value is dataclasses.MISSING or value is None or value is False or value in ((), ""):
        return ""
    words = value if isinstance(value, tuple) else (value,)
    return f" [{' '.join(f'{word:g}' if isinstance(word, float) else str(word) for word in words)}]"


def _texts(config: type) -> dict[str, str]:
    """The text beneath each field of a dataclass and of those that it extends."""
    out: dict[str, str] = {}
    for kind in reversed(config.__mro__[:-1]):
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                out[field.target.id] = " ".join(str(text.value.value).split())
    return out
