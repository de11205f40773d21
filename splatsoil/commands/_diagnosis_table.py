"""A diagnosis on the terminal."""

from __future__ import annotations

from math import isfinite
from typing import Any


def show(result: dict[str, Any]) -> None:
    """The verdict, why, and the table of effects."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.inverse.criticism.words import amount

    def known(value: float | None, std: float, unit: str) -> str:
        return "nothing is seen" if value is None or not isfinite(value) else amount(value, std, unit)

    table = Table(title=f"effects that are off, in {escape(str(result['fit']))}", title_justify="left")
    for column in ("effect", "verdict", "z", "p", "estimate", "smallest detectable", "predicted fall", "achieved"):
        table.add_column(column, justify="left" if column in ("effect", "verdict") else "right")
    for e in result["effects"]:
        achieved = f"{e['achieved_fall']:.4g}" if "achieved_fall" in e else ""
        table.add_row(
            escape(e["name"]),
            e["verdict"],
            f"{e['z']:.1f}",
            f"{e['p']:.2g}",
            known(e["estimate"], e["std"] or 0.0, e["unit"]),
            known(e["mde"], 0.0, e["unit"]),
            f"{e['predicted_fall']:.4g}",
            achieved,
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(f"[bold]{result['verdict']}[/bold]")
    for sentence in result["sentences"]:
        console.print(escape(sentence))
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    console.print(
        f"{result['simulations']} simulations, {result['simulated_now']} of them new, {result['seconds']:.0f} s"
    )
