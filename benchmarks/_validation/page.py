"""What a part of a benchmark reports, and the page of several parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

    @property
    def verdict(self) -> str:
        """For people."""
        return "–" if self.held is None else "holds" if self.held else "**fails**"


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        title: of the part.
        before: what is compared and with what, markdown.
        rows: the comparisons.
        after: how to read them, markdown.
        figure: its picture; None when it has none.
    """

    title: str
    before: str
    rows: tuple[Row, ...]
    after: str = ""
    figure: Figure | None = field(default=None, compare=False)

    def data(self) -> dict[str, Any]:
        """Everything but the picture."""
        return {**asdict(Section(self.title, self.before, self.rows, self.after)), "figure": self.figure is not None}

    @classmethod
    def restored(cls, data: Mapping[str, Any]) -> Section:
        """The inverse of :meth:`data`, without the picture."""
        rows = tuple(Row(**row) for row in data["rows"])
        return cls(data["title"], data["before"], rows, data["after"])


def percent(found: float, expected: float) -> str:
    """Relative deviation, signed."""
    deviation = 100.0 * (found / expected - 1.0)
    return f"{deviation:+.2f} %" if abs(deviation) < 1.0 else f"{deviation:+.1f} %"


def text(sections: Iterable[tuple[Section, str]]) -> str:
    """Markdown of sections, each with its picture's file name or none: how many rows hold, which fail, tables."""
    parts = list(sections)
    judged = [(s, row) for s, _ in parts for row in s.rows if row.held is not None]
    failed = [f"- {s.title}: {row.case}: {row.found} ({row.expected})" for s, row in judged if not row.held]
    found = [f"{len(judged) - len(failed)} of {len(judged)} comparisons hold." + (" What fails:" if failed else "")]
    found += ["\n".join(failed)]
    for section, picture in parts:
        found += [f"### {section.title}", section.before, table(section.rows)]
        found += [f"![{section.title}]({picture})" if picture else "", section.after]
    return "\n\n".join(part.strip() for part in found if part)


def table(rows: Sequence[Row]) -> str:
    """Markdown table."""
    lines = ["| case | found | expected | verdict |", "|---|---|---|---|"]
    lines += [f"| {r.case} | {r.found} | {r.expected} | {r.verdict} |" for r in rows]
    return "\n".join(lines)
