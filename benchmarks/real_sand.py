"""Real sand through its laboratory tests, from some of them to the others: the numbers of docs/real-sand.md."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from splatsoil.benchmarks._common import sources
from splatsoil.benchmarks._parts import parts_parser, run_parts
from splatsoil.benchmarks._validation import plates, sand

from splatsoil.quiet import hush

MEASURED = "SPLATSOIL_MEASURED"
"""Environment variable that names the folder of measured data."""
PARTS = {"triaxial": sand, "plates": plates}


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that are asked for and not done yet."""
    parser = parts_parser(__doc__, "runs/real-sand")
    parser.add_argument("--measured", type=Path, help=f"folder of measured data; default: {MEASURED}")
    options = parser.parse_args(arguments)
    measured = options.measured or Path(os.environ.get(MEASURED, ""))
    if measured == Path():
        parser.error(f"the data are not part of the product: name their folder by --measured or {MEASURED}")
    hush()
    code = sources("_validation/sand", "_validation/plates")
    parts = {name: partial(part.validate, options.device, measured) for name, part in PARTS.items()}
    return run_parts(options, parts, lambda _: {"code": code, "measured": str(measured)}, "real sand")
