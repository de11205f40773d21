"""The soil against exact answers and laboratories: the tables of docs/validation.md; for real sand see `real-sand`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from splatsoil.benchmarks._parts import parts_parser, run_parts
from splatsoil.benchmarks._validation import blades, columns, cuts, element, inclines

from splatsoil.files import code_digest
from splatsoil.quiet import hush

PARTS = {"element": element, "columns": columns, "cuts": cuts, "blades": blades, "inclines": inclines}
"""In the page's order."""


def key(name: str) -> Mapping[str, Any]:
    """Digest of all code that a part's numbers may depend on."""
    own = (f"benchmarks/_validation/{module}.py" for module in ("scene", name))
    return {"code": code_digest(("soil", "mpm", *own))}


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that are asked for and not done yet, and write all that are done into a page."""
    options = parts_parser(__doc__, "runs/validation").parse_args(arguments)
    hush()
    parts = {name: partial(part.validate, options.device) for name, part in PARTS.items()}
    return run_parts(options, parts, key, "validation")
