"""The library of effects as a table: what each is, its parameters, and its source."""

from __future__ import annotations

from splatsoil.benchmarks._common import markdown, parser_of, sized

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.library import library

TIMES_MEANINGFUL = 5.0


def table() -> str:
    """Markdown table of the whole library."""
    head = ("effect", "what it is", "parameters: default; bounds; smallest meaningful", "source")
    rows = [
        (f"`{name}`", effect.note, "<br>".join(map(_described, effect.parameters)), effect.source)
        for name, effect in library().items()
    ]
    return markdown(head, rows)


def _described(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit}"
    sign = {1: ", only larger", -1: ", only smaller"}.get(p.sign, "")
    off = "shape" if p.off is None else f"off at {p.off:g}{sign}"
    scale = ", log" if p.log else ""
    return f"`{p.name}`: {p.default:g}{unit} ({off}); {p.lower:g} … {p.upper:g}{scale}; {p.meaningful:g}"


def acting(effect: Effect) -> dict[str, float]:
    """The effect's size at five times its smallest meaningful one."""
    return {effect.size: sized(effect.parameters[0], TIMES_MEANINGFUL)}


def strong() -> list[str]:
    """Names of effects on strength that act together: of those that exclude each other, the first."""
    effects, chosen = library(), list[str]()
    for name, effect in effects.items():
        excluded = {*effect.conflicts, *(n for n in chosen if name in effects[n].conflicts)}
        if effect.strength is not None and not excluded.intersection(chosen):
            chosen.append(name)
    return chosen


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser_of(__doc__).parse_args(arguments)
    print(table())
    return 0
