"""Output of commands: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, TextIO

from splatsoil.errors import NoAnswer
from splatsoil.report.text import amount, interval

if TYPE_CHECKING:
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.measurement import Measurement

Report = Callable[[str, float], None]
"""Takes a description and the completed share of the stage, 0 to 1."""
Stage = Callable[[str], Report]
"""Begins a stage by its name."""

_stdout: ContextVar[TextIO | None] = ContextVar("stdout", default=None)


@contextmanager
def only_json() -> Iterator[None]:
    """Redirect stdout to stderr, except for ``print_json``."""
    token = _stdout.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _stdout.reset(token)


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout, also inside ``only_json``.

    Raises:
        ValueError: the data contains NaN or infinity.
    """
    print(json.dumps(data, indent=1, allow_nan=False), file=_stdout.get() or sys.stdout, flush=True)


def places(run: RunFolder) -> dict[str, str]:
    """The run folder and its set, for JSON output."""
    return {"run": str(run.path), "set": str(run.description["measurement"]["folder"])}


def print_result(
    config: Any,
    data: Mapping[str, Any],
    show: Callable[[], object] = lambda: None,
    *,
    last: str = "",
    run: RunFolder | None = None,
    none: str = "",
) -> int:
    """Print a command's result, and return the exit code.

    Args:
        config: the command's options.
        data: the result as one JSON object.
        show: prints it.
        last: the line after that.
        run: whose folder and set the object names.
        none: why there is no answer; printed first.
    """
    if config.json:
        print_json({"ok": not none, **({"error": none} if none else {}), **data, **(places(run) if run else {})})
    else:
        if none:
            print(none)
        show()
        if last:
            print(last)
    return NoAnswer.code if none else 0


def print_remarks(measurement: Measurement) -> None:
    """Print remarks on a set on stderr."""
    from splatsoil.measurement import remarks

    for remark in remarks(measurement):
        print(f"remark {remark.about}: {remark.text}", file=sys.stderr)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    left: Collection[str] | None = None,
    faint: Collection[int] = (),
) -> None:
    """Print a table.

    Args:
        title: above it.
        columns: headings; empty for rows of name and value.
        rows: texts.
        left: left-aligned columns; the first if not given.
        faint: numbers of dimmed rows.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), title_justify="left", show_header=bool(columns), box=SIMPLE_HEAD)
    for column in columns:
        aligned_left = column in (columns[:1] if left is None else left)
        table.add_column(escape(column), justify="left" if aligned_left else "right", no_wrap=column == columns[0])
    for number, row in enumerate(rows):
        table.add_row(*map(escape, row), style="dim" if number in faint else None)
    Console(highlight=False).print(table)


def print_parameters(
    title: str,
    result: Mapping[str, Any],
    value: str,
    more: Mapping[str, Callable[[Mapping[str, Any]], str]],
    *paragraphs: str,
) -> None:
    """Print a table of a result's parameters with their ± and interval, its notes, and sentences.

    Args:
        title: above it.
        result: with ``parameters`` by name, and ``notes``.
        value: key of the estimate.
        more: further columns.
        paragraphs: the sentences.
    """
    print_table(
        title,
        ("parameter", value, "5 to 95 %", *more),
        (
            (name, amount(p[value], p["std"], p["unit"]), interval(p), *(column(p) for column in more.values()))
            for name, p in result["parameters"].items()
        ),
        left=("parameter", ""),
    )
    print_text(notes=result["notes"])
    print_text(*paragraphs)


def print_text(*paragraphs: str, style: str = "", notes: Iterable[str] = ()) -> None:
    """Print wrapped sentences, then notes."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    for paragraph in paragraphs:
        console.print(Text(paragraph), style=style)
    for note in notes:
        console.print(Text.assemble(("note", "yellow"), f" {note}"))


def print_rows(rows: Iterable[tuple[str, str]]) -> None:
    """Print labels and wrapped texts in two columns."""
    from rich.console import Console

    for label, words in rows:
        lines = textwrap.wrap(words, max(Console().width - 22, 20))
        print(*(f"  {name:<18}  {line}" for name, line in zip_longest([label], lines, fillvalue="")), sep="\n")


@contextmanager
def stages(*, quiet: bool = False) -> Iterator[Stage]:
    """Context manager: progress on stderr, one line for each stage.

    Yields a function that begins a stage and ends the previous one. If stderr is no terminal, a line is printed at the
    beginning of a stage and at every 10 %. ``quiet`` prints nothing.
    """
    if quiet:
        yield lambda name: lambda what, share: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _logged
        return
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        # Stages have few and unequal steps, so the rate is averaged over the whole stage.
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(*columns, console=console, speed_estimate_period=3600.0) as bar:

        def finish() -> None:
            for task in bar.task_ids[-1:]:
                bar.update(task, completed=1.0, what="")
                bar.stop_task(task)

        def begin(name: str) -> Report:
            finish()
            task = bar.add_task(escape(name), total=1.0, what="")
            return lambda what, share: bar.update(task, completed=share, what=escape(what))

        yield begin
        finish()


def by_frame(report: Report, share: float = 1.0) -> Callable[[int, int], None]:
    """Progress function of a simulation (frame, last frame) that is a share of a stage."""
    return lambda frame, last: report(f"frame {frame}", share * frame / max(last, 1))


def _logged(name: str) -> Report:
    """Progress of a stage as log lines."""
    print(name, file=sys.stderr, flush=True)
    tenth = 0

    def report(what: str, share: float) -> None:
        nonlocal tenth
        if int(10.0 * share + 1e-9) > tenth:
            tenth = int(10.0 * share + 1e-9)
            print(f"{name}: {100.0 * share:.0f} %, {what}", file=sys.stderr, flush=True)

    return report
