"""The soil against exact answers and laboratories: the table of docs/validation.md; for real sand see `real-sand`."""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import warp as wp
from splatsoil.benchmarks._common import here
from splatsoil.benchmarks._validation import (
    basics,
    blades,
    columns,
    costs,
    cuts,
    element,
    inclines,
    refinement,
)
from splatsoil.benchmarks._validation.page import Section, page, table

from splatsoil.errors import SplatsoilError
from splatsoil.files import code_digest, plain, read_json, write_bytes, write_json, write_text


def parts(device: str) -> dict[str, Callable[[], Section]]:
    """All parts by name, in the page's order."""
    return {
        "element": element.validate,
        "costs": costs.validate,
        "basics": lambda: basics.validate(device),
        "columns": lambda: columns.validate(device),
        "cuts": lambda: cuts.validate(device),
        "blades": lambda: blades.validate(device),
        "inclines": lambda: inclines.validate(device),
        "refinement": lambda: refinement.validate(device),
    }


#: Files of ``_validation`` that a part's numbers hang on, beside its own and ``scene.py``.
BESIDE = {"basics": ("columns",), "refinement": ("blades", "columns")}


def digest(name: str) -> str:
    """Of all code that a part's numbers may hang on."""
    folder = Path(__file__).parent / "_validation"
    return code_digest(("soil", "mpm"), [folder / f"{file}.py" for file in ("scene", name, *BESIDE.get(name, ()))])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts that are asked for and not done yet, and write the page of all that are done."""
    parser = argparse.ArgumentParser(prog="splatsoil benchmark validate", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to run; all by default")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/validation"), help="results of the parts, to resume from"
    )
    parser.add_argument("--page", type=Path, help="write the page (.md) here and its pictures beside it")
    parser.add_argument("--device", type=here, default="cpu")
    parser.add_argument("--again", action="store_true", help="run parts that are done already")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_ERROR
    todo = parts(options.device)
    unknown = sorted(set(options.only or ()) - set(todo))
    if unknown:
        parser.error(f"part {unknown[0]!r} is not among {', '.join(todo)}")
    done = {}
    for name, validate in todo.items():
        if not options.only or name in options.only:
            done[name] = _part(name, validate, options.out, options.device, options.again, options.json)
    if options.json:
        from splatsoil.commands._output import print_json

        print_json({"ok": True, "parts": plain({name: section["section"] for name, section in done.items()})})
    if options.page:
        _write_page(options.page, options.out, list(todo), options.device)
    return 0


def _part(
    name: str, validate: Callable[[], Section], out: Path, device: str, again: bool, quiet: bool
) -> Mapping[str, Any]:
    """A part's result: from disk where the same code made it, else run and written."""
    file, code = out / f"{name}.json", digest(name)
    if file.is_file() and not again:
        stored = read_json(file)
        if stored.get("code") == code and stored.get("device") == device:
            return stored
    before = time.monotonic()
    try:
        section = validate()
    except SplatsoilError as error:
        raise type(error)(f"part {name}: {error}") from error
    if section.figure is not None:
        stream = io.BytesIO()
        section.figure.savefig(stream, format="png", dpi=110)
        write_bytes(out / f"validation-{name}.png", stream.getvalue())
    result = {"code": code, "device": device, "section": section.data(), "seconds": time.monotonic() - before}
    write_json(file, result)
    if not quiet:
        print(f"\n{section.title}\n\n{table(section.rows)}")
        print(f"{name}: {result['seconds']:.0f} s", file=sys.stderr, flush=True)
    return result


def _write_page(file: Path, out: Path, names: Sequence[str], device: str) -> None:
    """The page of all parts on disk that this code made on this device, and their pictures beside it."""
    found = {}
    for name in names:
        stored = read_json(out / f"{name}.json") if (out / f"{name}.json").is_file() else {}
        if stored.get("code") == digest(name) and stored.get("device") == device:
            data = stored["section"]
            found[name] = (Section.restored(data), bool(data["figure"]))
            if data["figure"]:
                write_bytes(file.parent / f"validation-{name}.png", (out / f"validation-{name}.png").read_bytes())
    command = "splatsoil benchmark validate --page docs/validation.md"
    write_text(file, page(found, command, device))


if __name__ == "__main__":
    raise SystemExit(main())
