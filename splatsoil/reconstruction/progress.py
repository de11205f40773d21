"""A progress bar on stderr for work that reports what it does and how much of it is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(*, quiet: bool = False) -> Iterator[Callable[[str, float], None]]:
    """A function (what, share) that draws a bar; one line a stage stays when it is done. `quiet` draws nothing."""
    if quiet:
        yield lambda what, share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    tasks: dict[str, TaskID] = {}
    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:

        def report(what: str, share: float) -> None:
            if what not in tasks:
                for earlier in tasks.values():
                    bar.update(earlier, completed=1.0)
                    bar.stop_task(earlier)
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share)

        yield report
        for task in tasks.values():
            bar.update(task, completed=1.0)
