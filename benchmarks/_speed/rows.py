"""What a part of the benchmark reports: samples, rows, and the table made of them."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

BUSY = 0.9
"""A row on several cores is judged when the process had this share of them, or more."""


@dataclass(frozen=True)
class Sample:
    """Repetitions of one measurement.

    Attributes:
        values: one a repetition, in the row's unit.
        label: what was measured, where the row needs to tell.
        cores: least number of cores that a repetition had on the average; None where the time is that of one thread.
    """

    values: tuple[float, ...]
    label: str = ""
    cores: float | None = None

    @property
    def median(self) -> float:
        """Of the repetitions."""
        return statistics.median(self.values)

    @property
    def spread(self) -> float:
        """Half of what lies between the least and the largest."""
        return 0.5 * (max(self.values) - min(self.values))

    def scaled(self, factor: float, label: str = "") -> Sample:
        """The same in another unit."""
        return Sample(tuple(factor * v for v in self.values), label or self.label, self.cores)

    def inverted(self, amount: float, label: str = "") -> Sample:
        """How much of ``amount`` is done in a unit of time, from times."""
        return Sample(tuple(amount / v for v in self.values), label or self.label, self.cores)


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: was measured.
        unit: of both samples.
        ours: splatsoil's; None where it could not be measured.
        other: somebody else's, or ours by another way; None where there is none.
        faster: whether ``more`` or ``less`` of the unit is faster.
        target: words for what was asked for; empty: nothing was.
        met: whether it was reached; None: not judged.
        note: what a reader must know.
    """

    what: str
    unit: str = ""
    ours: Sample | None = None
    other: Sample | None = None
    faster: str = "less"
    target: str = ""
    met: bool | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """How many times as fast ours is."""
        if self.ours is None or self.other is None:
            return None
        ours, other = self.ours.median, self.other.median
        return other / ours if self.faster == "less" else ours / other

    @property
    def verdict(self) -> str:
        """For people."""
        return "–" if self.met is None else "met" if self.met else "**not met**"


@dataclass(frozen=True)
class Group:
    """What one part measured.

    Attributes:
        title: of the part.
        rows: the comparisons.
        notes: sentences beneath the table.
    """

    title: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = field(default_factory=tuple)

    def data(self) -> dict[str, Any]:
        """In JSON's types, with what follows from the numbers."""
        told = asdict(self)
        for row, entry in zip(self.rows, told["rows"], strict=True):
            entry["ratio"], entry["verdict"] = row.ratio, row.verdict.strip("*")
            for name in ("ours", "other"):
                sample = getattr(row, name)
                if sample is not None:
                    entry[name] |= {"median": sample.median, "spread": sample.spread}
        return told

    @classmethod
    def restored(cls, data: Mapping[str, Any]) -> Group:
        """The inverse of :meth:`data`."""

        def sample(entry: Mapping[str, Any] | None) -> Sample | None:
            return None if entry is None else Sample(tuple(entry["values"]), entry["label"], entry["cores"])

        plain = ("what", "unit", "faster", "target", "met", "note")
        rows = tuple(
            Row(**{k: row[k] for k in plain}, ours=sample(row["ours"]), other=sample(row["other"]))
            for row in data["rows"]
        )
        return cls(data["title"], rows, tuple(data["notes"]))


def at_least(row_value: float | None, wanted: float) -> bool | None:
    """Whether a number reaches a target; None where there is no number."""
    return None if row_value is None else row_value >= wanted


def judged(ours: Sample, wanted: float, faster: str, cores: int = 1) -> bool | None:
    """Whether the median reaches a target; None where it did not and other programs had much of the cores meanwhile."""
    held = ours.median >= wanted if faster == "more" else ours.median <= wanted
    busy = ours.cores is not None and ours.cores < BUSY * cores
    return None if busy and not held else held


def had(sample: Sample, count: int) -> str:
    """How much of the cores a row on several had, where it wasn't all."""
    if sample.cores is None or sample.cores >= 0.95 * count:
        return ""
    return f"other programs left {sample.cores:.1f} of {count} cores"


def missing(what: str, why: str, target: str = "") -> Row:
    """A row that can't run here."""
    return Row(what, target=target, note=f"not measured: {why}")


def number(value: float) -> str:
    """Three figures, without an exponent."""
    if value == 0.0:
        return "0"
    digits = max(0, 2 - int(f"{abs(value):e}".split("e")[1]))
    return f"{value:.{digits}f}"


def told(sample: Sample | None, unit: str) -> str:
    """Median, spread and unit, and the label, for a cell of the table."""
    if sample is None:
        return ""
    spread = f" ± {number(sample.spread)}" if len(sample.values) > 1 else ""
    label = f" ({sample.label})" if sample.label else ""
    return f"{number(sample.median)}{spread} {unit}{label}".replace("  ", " ")


def table(rows: Sequence[Row]) -> str:
    """Markdown table."""
    lines = ["| what | ours | the other | times as fast | target | verdict |", "|---|---|---|---|---|---|"]
    for row in rows:
        ratio = "" if row.ratio is None else f"{number(row.ratio)} ×"
        what = f"{row.what}: {row.note}" if row.note else row.what
        cells = (what, told(row.ours, row.unit), told(row.other, row.unit), ratio, row.target, row.verdict)
        lines.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return "\n".join(lines)


def text(groups: Iterable[Group], heading: str = "###") -> str:
    """All parts in Markdown, each with a heading."""
    parts = []
    for group in groups:
        parts += [f"{heading} {group.title}", table(group.rows)]
        if group.notes:
            parts.append("\n".join(f"- {note}" for note in group.notes))
    return "\n\n".join(parts)
