"""What a part of the validation reports, and the page made of all parts."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from splatsoil import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        case: what was computed.
        found: the solver's number, with its unit.
        expected: the reference's, and how near the two must be.
        held: whether they are; None for a number that is only reported.
    """

    case: str
    found: str
    expected: str
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


INTRODUCTION = """# Is the soil right?

The soil law and the solver against exact answers and laboratories; [real-sand.md](real-sand.md) is about real sand. A
row *holds* when its number lies within what its third column allows: what was asked for where there is an exact answer,
our own estimate of a source's scatter, or of what a grid does, where there is a fit to experiments or a bound (columns,
cuts, blades, incline). Negative controls show that each of these estimates can be missed. Rows that fail stay on the
page, with the reason as far as it is known. A dash marks a number that is reported and not judged.
"""


def percent(found: float, expected: float) -> str:
    """Relative deviation, signed."""
    deviation = 100.0 * (found / expected - 1.0)
    return f"{deviation:+.2f} %" if abs(deviation) < 1.0 else f"{deviation:+.1f} %"


def page(parts: Mapping[str, tuple[Section, bool]], command: str, device: str) -> str:
    """Markdown of the whole page; each part with whether it has a picture ``validation-NAME.png``."""
    sections = [section for section, _ in parts.values()]
    judged = [row for section in sections for row in section.rows if row.held is not None]
    failed = [(section, row) for section in sections for row in section.rows if row.held is False]
    text = [INTRODUCTION]
    text.append(
        f"Made with `{command}` by splatsoil {__version__} (NumPy {np.__version__}, Warp {wp.__version__}, "
        f"{platform.machine()}, {device}). {len(judged) - len(failed)} of {len(judged)} comparisons hold."
    )
    if failed:
        text.append(
            "What fails:\n\n" + "\n".join(f"- {s.title}: {r.case}: {r.found} ({r.expected})" for s, r in failed)
        )
    for name, (section, picture) in parts.items():
        text.append(f"## {section.title}\n\n{section.before}")
        text.append(table(section.rows))
        if picture:
            text.append(f"![{section.title}](validation-{name}.png)")
        if section.after:
            text.append(section.after)
    return "\n\n".join(part.strip() for part in text) + "\n"


def table(rows: Sequence[Row]) -> str:
    """Markdown table."""
    lines = ["| case | found | expected | verdict |", "|---|---|---|---|"]
    lines += [f"| {r.case} | {r.found} | {r.expected} | {r.verdict} |" for r in rows]
    return "\n".join(lines)
