"""Progress on stderr: one line a stage, with what it is doing, how much is done and how long the rest will take.

Where stderr is no terminal (a log), a line is printed when a stage begins and at every tenth of it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Report = Callable[[str, float], None]
Stage = Callable[[str], Report]


@contextmanager
def stages(*, quiet: bool = False) -> Iterator[Stage]:
    """A function that begins a stage by its name and returns that stage's report (what, share done from 0 to 1).

    A stage ends when the next begins. ``quiet`` draws nothing.
    """
    if quiet:
        yield lambda name: lambda what, share: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        # Stages have few and unequal steps: the rate over all of the stage is the steadiest guess.
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _logged
        return
    with Progress(*columns, console=console, speed_estimate_period=3600.0) as bar:
        current: list[TaskID] = []

        def finish() -> None:
            for task in current:
                bar.update(task, completed=1.0, what="")
                bar.stop_task(task)
            current.clear()

        def begin(name: str) -> Report:
            finish()
            task = bar.add_task(escape(name), total=1.0, what="")
            current.append(task)

            def report(what: str, share: float) -> None:
                bar.update(task, completed=share, what=escape(what))

            return report

        yield begin
        finish()


def _logged(name: str) -> Report:
    """A stage as lines of a log."""
    print(name, file=sys.stderr, flush=True)
    tenth = 0

    def report(what: str, share: float) -> None:
        nonlocal tenth
        if int(10.0 * share + 1e-9) > tenth:
            tenth = int(10.0 * share + 1e-9)
            print(f"{name}: {100.0 * share:.0f} %, {what}", file=sys.stderr, flush=True)

    return report
