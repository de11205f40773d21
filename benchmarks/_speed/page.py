"""The page: a section for each kind of device, which a run replaces, in whatever else is written around them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from splatsoil.benchmarks._speed.machine import sentence
from splatsoil.benchmarks._speed.rows import Group, text

from splatsoil.errors import RunError

TITLES = {"cpu": "CPU", "cuda": "GPU"}
EMPTY = "Not measured yet."

START = """# How fast?

Speed, measured side by side by `splatsoil benchmark speed`. *Ours* and *the other* are medians, ± half of what lies
between the least and the largest repetition; a number that stands alone is of one repetition. Times on one core are CPU
times, which other programs disturb less than the clock's. The other solvers are extras, `pip install
'splatsoil[independent,speed]'`; gsplat is taken where it is installed; a row whose other is missing says so.
{}
"""


def begin(kind: str) -> str:
    """The line before a section."""
    return f"<!-- {kind}: written by the command, what stands here is overwritten -->"


def end(kind: str) -> str:
    """The line after it."""
    return f"<!-- {kind}: end -->"


def fresh() -> str:
    """A page with all its sections empty."""
    parts = [f"\n## {TITLES[kind]}\n\n{begin(kind)}\n{EMPTY}\n{end(kind)}" for kind in TITLES]
    return START.format("\n".join(parts))


def section(groups: Iterable[Group], machine: Mapping[str, Any], command: str, seconds: float) -> str:
    """What stands between a section's two lines."""
    made = (
        f"Made with `{command}` in {seconds / 60.0:.1f} min on {str(machine['made'])[:10]}: {sentence(dict(machine))}"
    )
    return f"{made}\n\n{text(groups)}"


def replaced(page: str, kind: str, new: str) -> str:
    """The page with one section replaced.

    Raises:
        RunError: the page has no place for the section.
    """
    return between(page, begin(kind), end(kind), new)


def between(page: str, first: str, last: str, new: str) -> str:
    """The page with what stands between two lines replaced.

    Raises:
        RunError: the page has no such lines, or several.
    """
    pattern = re.compile(f"{re.escape(first)}\n.*?{re.escape(last)}", re.DOTALL)
    found = pattern.search(page)
    if found is None or page.count(first) != 1 or page.count(last) != 1:
        raise RunError(f"the page has no lines {first!r} and {last!r}, once each, to write between; write another page")
    return f"{page[: found.start()]}{first}\n{new}\n{last}{page[found.end() :]}"


def current(file: Path) -> str:
    """The page as it stands, or a fresh one.

    Raises:
        RunError: it can't be read, or is no page of this benchmark.
    """
    if not file.exists():
        return fresh()
    try:
        page = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{file}: cannot be read as text ({error}); choose another page") from error
    for kind in TITLES:
        if begin(kind) not in page or end(kind) not in page:
            raise RunError(f"{file}: is no page of this benchmark (no section {kind}); choose another file")
    return page
