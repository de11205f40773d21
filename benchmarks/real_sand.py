"""Real sand through its laboratory tests, from some of them to the others: the numbers of docs/real-sand.md."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import warp as wp
from splatsoil.benchmarks._common import here
from splatsoil.benchmarks._validation import plates, sand
from splatsoil.benchmarks._validation.page import table

MEASURED = "SPLATSOIL_MEASURED"
"""Environment variable that names the folder of measured data."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of every part that is asked for."""
    parser = argparse.ArgumentParser(prog="splatsoil benchmark real-sand", description=__doc__)
    parser.add_argument("--measured", type=Path, help=f"folder of measured data; default: {MEASURED}")
    parser.add_argument("--only", choices=("triaxial", "plates"), help="one part; both by default")
    parser.add_argument("--pictures", type=Path, help="folder for the parts' pictures")
    parser.add_argument("--device", type=here, default="cpu")
    options = parser.parse_args(arguments)
    known = os.environ.get(MEASURED)
    measured = options.measured or (Path(known) if known else None)
    if measured is None:
        parser.error(f"the data are not part of the product: name their folder by --measured or {MEASURED}")
    wp.config.log_level = wp.LOG_ERROR
    parts = {"triaxial": lambda: sand.validate(measured), "plates": lambda: plates.validate(measured, options.device)}
    for name, validate in parts.items():
        if options.only in (None, name):
            section = validate()
            print(f"## {section.title}\n\n{section.before}\n\n{table(section.rows)}\n", flush=True)
            if options.pictures is not None and section.figure is not None:
                options.pictures.mkdir(parents=True, exist_ok=True)
                section.figure.savefig(options.pictures / f"real-sand-{name}.png", dpi=110)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
