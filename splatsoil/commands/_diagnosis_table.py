"""A diagnosis on the terminal."""

from __future__ import annotations

from math import isfinite
from typing import Any

COLUMNS = ("effect", "verdict", "z", "p", "estimate", "smallest detectable", "predicted fall", "achieved")
#: Characters that all columns need, and those left out where there are fewer: `diagnosis.json` and the page have them.
WIDE, WIDE_ONLY = 110, ("z", "predicted fall", "achieved")


def show(result: dict[str, Any]) -> None:
    """The verdict, why, and the table of effects."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.inverse.criticism.words import amount

    def known(value: float | None, std: float, unit: str) -> str:
        return "nothing is seen" if value is None or not isfinite(value) else amount(value, std, unit)

    console = Console(highlight=False)
    columns = COLUMNS if console.width >= WIDE else [c for c in COLUMNS if c not in WIDE_ONLY]
    table = Table(title=f"effects that are off, in {escape(str(result['fit']))}", title_justify="left", box=SIMPLE_HEAD)
    for column in columns:
        worded = column in ("effect", "verdict")
        table.add_column(column, justify="left" if worded else "right", no_wrap=column != "smallest detectable")
    for e in result["effects"]:
        cells = {
            "effect": escape(e["name"]),
            "verdict": e["verdict"],
            "z": f"{e['z']:.1f}",
            "p": f"{e['p']:.2g}",
            "estimate": known(e["estimate"], e["std"] or 0.0, e["unit"]),
            "smallest detectable": known(e["mde"], 0.0, e["unit"]),
            "predicted fall": f"{e['predicted_fall']:.4g}",
            "achieved": f"{e['achieved_fall']:.4g}" if "achieved_fall" in e else "",
        }
        table.add_row(*(cells[column] for column in columns))
    console.print(table)
    if columns != COLUMNS:
        console.print(f"Wider terminals, the page and diagnosis.json also have: {', '.join(WIDE_ONLY)}.")
    console.print(f"[bold]{result['verdict']}[/bold]")
    for sentence in result["sentences"]:
        console.print(escape(sentence))
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    console.print(
        f"{result['simulations']} simulations, {result['simulated_now']} of them new, {result['seconds']:.0f} s"
    )
