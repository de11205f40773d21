"""Benchmarks of several parts: each part is a section, kept in a folder when it ends, and written into a page."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from splatsoil.benchmarks._common import sentence, stamp, with_section, write_figure
from splatsoil.benchmarks._validation.page import Section, table, text

from splatsoil.commands._output import only_json, print_json
from splatsoil.errors import ParameterError, SplatsoilError
from splatsoil.files import check_folder, plain, read_json, write_bytes, write_json, write_text


def part_options(parser: argparse.ArgumentParser, out: str) -> None:
    """Options that choose parts, and say where results go."""
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure; all by default")
    parser.add_argument("--again", action="store_true", help="measure parts again that are in the folder")
    parser.add_argument("--out", type=Path, default=Path(out), help="folder of the parts, to continue from")
    parser.add_argument("--page", type=Path, help="write the parts into their place on this page (.md)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def run_parts(
    options: argparse.Namespace,
    parts: Mapping[str, Callable[[], Section]],
    key: Callable[[str], Mapping[str, Any]],
    mark: str,
) -> int:
    """Measure the parts that are asked for and not in the folder, print them, and write all that are there to a page.

    Args:
        options: of :func:`part_options`, with ``device``.
        parts: by name, in the page's order.
        key: what a part's result depends on, JSON-able; a kept part with another key is measured again.
        mark: name of the place on the page, and the beginning of the names of its pictures.

    Returns:
        Exit code 0.

    Raises:
        ParameterError: an unknown part.
        RunError: the page has no place for the parts.
        SplatsoilError: a part failed; its name comes first, and parts measured before are kept.
    """
    unknown = sorted(set(options.only or ()) - set(parts))
    if unknown:
        raise ParameterError(f"part {unknown[0]!r} is not among {', '.join(parts)}")
    if options.page:
        with_section(options.page, mark, "")  # a page without a place fails now, not at the end
    check_folder(options.out)
    made_by, kept = stamp(options.device), {}
    with only_json() if options.json else nullcontext():
        for name, measure in parts.items():
            file, known = options.out / f"{name}.json", plain({"device": options.device, **key(name)})
            stored = read_json(file) if file.is_file() else {}
            if not options.only or name in options.only:
                if options.again or stored.get("key") != known:
                    stored = {"key": known, "made_by": made_by, **_measured(name, measure, options.out, mark)}
                    write_json(file, stored)
                if not options.json:
                    print(f"\n{stored['section']['title']}\n\n{table(Section.restored(stored['section']).rows)}")
            if stored.get("key") == known:
                kept[name] = stored
        if options.page and kept:
            _write_page(options.page, options.out, kept, mark)
        if options.json:
            print_json({"ok": True, "made_by": made_by, "parts": {n: kept[n]["section"] for n in options.only or kept}})
    return 0


def _measured(name: str, measure: Callable[[], Section], out: Path, mark: str) -> dict[str, Any]:
    began = time.monotonic()
    try:
        section = measure()
    except SplatsoilError as error:
        raise type(error)(f"part {name}: {error}") from error
    if section.figure is not None:
        write_figure(out / f"{mark}-{name}.png", section.figure)
    seconds = time.monotonic() - began
    print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
    return {"section": plain(section.data()), "seconds": seconds}


def _write_page(page: Path, out: Path, kept: Mapping[str, Mapping[str, Any]], mark: str) -> None:
    made = max((entry["made_by"] for entry in kept.values()), key=lambda made: str(made["made"]))
    sections = []
    for name, entry in kept.items():
        picture = f"{mark}-{name}.png" if entry["section"]["figure"] else ""
        if picture:
            write_bytes(page.parent / picture, (out / picture).read_bytes())
        sections.append((Section.restored(entry["section"]), picture))
    minutes = sum(entry["seconds"] for entry in kept.values()) / 60.0
    write_text(page, with_section(page, mark, f"{text(sections)}\n\nMeasured in {minutes:.0f} min, {sentence(made)}."))
