"""A diagnosis on the terminal."""

from __future__ import annotations

from typing import Any


def show(result: dict[str, Any]) -> None:
    """The table of models, the verdict, and why; the parameters where ``result`` has them."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from splatsoil.report.words import LITTLE, averaged_sentence, estimate, model_label, probability, verdict

    console = Console(highlight=False)
    table = Table(title=f"models compared with {escape(str(result['fit']))}", title_justify="left", box=SIMPLE_HEAD)
    for column in ("model", "probability", "size", "smallest detectable"):
        table.add_column(column, justify="left" if column == "model" else "right", no_wrap=True)
    for model in result["models"]:
        table.add_row(
            escape(model_label(model["name"])),
            probability(model["probability"]),
            estimate(model["estimate"], model["std"], model["unit"]),
            estimate(model["detectable"], None, model["unit"]),
            style="dim" if model["probability"] < LITTLE else None,
        )
    console.print(table)
    console.print(f"[bold]{escape(verdict(result))}[/bold]")
    if "estimates" in result:
        console.print(escape(averaged_sentence(result["estimates"])))
    for sentence in result["sentences"]:
        console.print(escape(sentence))
    for note in result["notes"]:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    console.print(
        f"{result['simulations']} simulations, {result['simulated_now']} of them new, {result['seconds']:.0f} s"
    )
