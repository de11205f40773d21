"""The soil against exact answers and laboratories: the tables of docs/validation.md; for real sand see `real-sand`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from splatsoil.benchmarks._common import parser_of
from splatsoil.benchmarks._parts import part_options, run_parts
from splatsoil.benchmarks._validation import blades, columns, cuts, element, inclines
from splatsoil.benchmarks._validation.page import Section

from splatsoil.files import code_digest
from splatsoil.quiet import hush


def parts(device: str) -> dict[str, Callable[[], Section]]:
    """All parts by name, in the page's order."""
    return {
        "element": element.validate,
        "columns": lambda: columns.validate(device),
        "cuts": lambda: cuts.validate(device),
        "blades": lambda: blades.validate(device),
        "inclines": lambda: inclines.validate(device),
    }


def key(name: str) -> Mapping[str, Any]:
    """Digest of all code that a part's numbers may depend on."""
    folder = Path(__file__).parent / "_validation"
    return {"code": code_digest(("soil", "mpm"), [folder / "scene.py", folder / f"{name}.py"])}


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that are asked for and not done yet, and write all that are done into a page."""
    parser = parser_of(__doc__)
    part_options(parser, "runs/validation")
    options = parser.parse_args(arguments)
    hush()
    return run_parts(options, parts(options.device), key, "validation")


if __name__ == "__main__":
    raise SystemExit(main())
