"""The soil against exact answers, laboratories and real sand: the tables of docs/validation.md."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from splatsoil.benchmarks._common import parser_of
from splatsoil.benchmarks._parts import part_options, run_parts
from splatsoil.benchmarks._validation import blades, columns, cuts, element, inclines, plates, sand
from splatsoil.benchmarks._validation.page import Section

from splatsoil.files import code_digest
from splatsoil.quiet import hush

MEASURED = "SPLATSOIL_MEASURED"
"""Environment variable that names the folder of measured data."""


def parts(measured: Path | None, device: str) -> dict[str, Callable[[], Section]]:
    """All parts by name, in the page's order; those on real sand only where there are data."""
    result: dict[str, Callable[[], Section]] = {
        "element": element.validate,
        "columns": lambda: columns.validate(device),
        "cuts": lambda: cuts.validate(device),
        "blades": lambda: blades.validate(device),
        "inclines": lambda: inclines.validate(device),
    }
    if measured is not None:
        result["sand"] = lambda: sand.validate(measured)
        result["plates"] = lambda: plates.validate(measured, device)
    return result


def key(name: str) -> Mapping[str, Any]:
    """Digest of all code that a part's numbers may depend on."""
    folder = Path(__file__).parent / "_validation"
    package = ("soil", "mpm", "experiment") if name == "sand" else ("soil", "mpm")
    return {"code": code_digest(package, [folder / "scene.py", folder / f"{name}.py"])}


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that are asked for and not done yet, and write all that are done into a page."""
    parser = parser_of(__doc__)
    parser.add_argument("--measured", type=Path, help=f"folder of measured data; default: {MEASURED}, else none")
    part_options(parser, "runs/validation")
    options = parser.parse_args(arguments)
    hush()
    known = os.environ.get(MEASURED)
    measured = options.measured or (Path(known) if known else None)
    return run_parts(options, parts(measured, options.device), key, "validation")


if __name__ == "__main__":
    raise SystemExit(main())
