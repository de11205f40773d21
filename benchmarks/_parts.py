"""Benchmarks of several parts: each part is a table, kept in a folder when it ends, and written into a page."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatsoil.benchmarks._common import FloatArray, markdown, parser_of, sentence, stamp, with_section, write_figure

from splatsoil.errors import ParameterError, SplatsoilError
from splatsoil.files import check_folder, plain, read_json, write_bytes, write_json, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        case: what was computed or measured.
        found: the number, with its unit.
        expected: the reference or the target, and how near the two must be.
        held: whether they are; None for a number that is only reported.
    """

    case: str
    found: str
    expected: str = ""
    held: bool | None = None

    @classmethod
    def near(
        cls, case: str, found: float, expected: float, share: float, form: str = "{:.2f}", *, inside: bool = True
    ) -> Row:
        """A number that must lie within a share of what is expected; outside of it in a control."""
        wanted = f"{'' if inside else 'outside '}{form.format(expected)} ± {100.0 * share:g} %"
        held = (abs(found / expected - 1.0) <= share) is inside
        return cls(case, f"{form.format(found)} ({percent(found, expected)})", wanted, held)

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """For people, with the verdict."""
        verdict = "–" if self.held is None else "holds" if self.held else "**fails**"
        return self.case, self.found, self.expected, verdict


@dataclass(frozen=True)
class Section:
    """One part of a page.

    Attributes:
        title: of the part.
        rows: the comparisons.
        figure: its picture; None when it has none.
    """

    title: str
    rows: Sequence[Row]
    figure: Figure | None = field(default=None, compare=False)


def percent(found: float, expected: float) -> str:
    """Relative deviation, signed."""
    deviation = 100.0 * (found / expected - 1.0)
    return f"{deviation:+.2f} %" if abs(deviation) < 1.0 else f"{deviation:+.1f} %"


def curves_of(curves: Mapping[str, tuple[FloatArray, FloatArray]], xlabel: str, ylabel: str) -> tuple[Figure, Axes]:
    """A figure of curves (x, y) by their names, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.5), layout="constrained")
    axes = figure.subplots()
    for name, (x, y) in curves.items():
        axes.plot(x, y, label=name, linewidth=1)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend(fontsize=7, ncols=3)
    return figure, axes


def parts_parser(module_doc: str | None, out: str) -> argparse.ArgumentParser:
    """An argument parser with options that choose parts, and say where results go."""
    parser = parser_of(module_doc, out, page=True)
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure; all by default")
    parser.add_argument("--again", action="store_true", help="measure parts again that are in the folder")
    return parser


def run_parts(
    options: argparse.Namespace,
    parts: Mapping[str, Callable[[], Section]],
    key: Callable[[str], Mapping[str, Any]],
    mark: str,
) -> int:
    """Measure the parts that are asked for and not in the folder, print them, and write all that are there to a page.

    Args:
        options: of :func:`parts_parser`.
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
    chosen, made_by, kept = options.only or list(parts), stamp(options.device), dict[str, Any]()
    for name, measure in parts.items():
        file, known = options.out / f"{name}.json", plain({"device": options.device, **key(name)})
        part = read_json(file) if file.is_file() else {}
        if name in chosen and (options.again or part.get("key") != known):
            part = {"key": known, "made_by": made_by, **_measured(name, measure, options.out, mark)}
            write_json(file, part)
        if part.get("key") == known:
            kept[name] = part
            if name in chosen and not options.json:
                print(f"\n{_text(part)}", flush=True)
    if options.page and kept:
        _write_page(options.page, options.out, list(kept.values()), mark)
    if options.json:
        shown = {name: {k: kept[name][k] for k in ("title", "rows")} for name in chosen if name in kept}
        print(json.dumps({"ok": True, "made_by": made_by, "parts": shown}, indent=1))
    return 0


def _measured(name: str, measure: Callable[[], Section], out: Path, mark: str) -> dict[str, Any]:
    began, picture = time.monotonic(), f"{mark}-{name}.png".replace(" ", "-")
    try:
        section = measure()
    except SplatsoilError as error:
        raise type(error)(f"part {name}: {error}") from error
    if section.figure is not None:
        write_figure(out / picture, section.figure)
    seconds = time.monotonic() - began
    print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
    rows = [asdict(row) for row in section.rows]
    return {"title": section.title, "rows": rows, "picture": picture if section.figure else "", "seconds": seconds}


def _text(part: Mapping[str, Any]) -> str:
    table = markdown(("case", "found", "expected", "verdict"), [Row(**row).cells for row in part["rows"]])
    picture = [f"![{part['title']}]({part['picture']})"] if part["picture"] else []
    return "\n\n".join([f"### {part['title']}", table, *picture])


def _write_page(page: Path, out: Path, parts: Sequence[Mapping[str, Any]], mark: str) -> None:
    """How many rows hold, all tables and pictures, and what measured them."""
    judged = [row["held"] for part in parts for row in part["rows"] if row["held"] is not None]
    minutes = sum(part["seconds"] for part in parts) / 60.0
    newest = max((part["made_by"] for part in parts), key=lambda made: str(made["made"]))
    text = [f"{sum(judged)} of {len(judged)} comparisons hold.", *map(_text, parts)]
    text.append(f"Measured in {minutes:.0f} min, {sentence(newest)}.")
    for picture in filter(None, (part["picture"] for part in parts)):
        write_bytes(page.parent / picture, (out / picture).read_bytes())
    write_text(page, with_section(page, mark, "\n\n".join(text)))
