"""Counting of diagnoses whose truth is known: what was named, how often rightly, and as a table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from splatsoil.inverse.criticism.diagnosis import Diagnosis
from splatsoil.inverse.criticism.verdicts import Verdict

HALF, MOST = 0.6745, 1.6449
"""Standard deviations on either side that hold 50 % and 90 %."""


@dataclass(frozen=True)
class Tally:
    """One kind of truth.

    Attributes:
        name: what is hidden.
        count: experiments.
        named: in how many some effect was called missing.
        physics: in how many a physical one was.
        first: in how many the truth came first.
        held: in how many the class held the truth.
        members: mean size of the class where there was one.
        verdicts: how often each verdict was given.
        bias: mean error of the model's parameter in prior standard deviations, before and after adding.
        error: held-out error over each model's floor, before and after.
        inside: how many intervals of 50 % and of 90 % held the truth, angle and size, where the right effect was added.
        intervals: how many there were.
        simulations: of a diagnosis, on average.
        blind: in how many the smallest error of all refits would name some effect, and the truth; None if not asked.
    """

    name: str
    count: int
    named: int
    physics: int
    first: int
    held: int
    members: float
    verdicts: dict[str, int]
    bias: tuple[float, float]
    error: tuple[float, float]
    inside: tuple[int, int]
    intervals: int
    simulations: float
    blind: tuple[int, int] | None = None


@dataclass(frozen=True)
class Found:
    """What of a diagnosis is counted.

    Attributes:
        verdict: on the model.
        members: the equivalence class, the best first.
        fitted: the model's own parameter as it was fitted.
        values: parameters refitted with the best effect, empty where there is none.
        stds: theirs.
        error: held-out error over each model's floor, before and after that.
        scored: effects that the analysis knew.
        simulations: how many it took.
        blind: the effect with the smallest error of all refits, "" where that is the model as it is; None if not asked.
    """

    verdict: Verdict
    members: tuple[str, ...]
    fitted: float
    values: Mapping[str, float]
    stds: Mapping[str, float]
    error: tuple[float, float]
    scored: tuple[str, ...]
    simulations: int
    blind: str | None = None

    @classmethod
    def of(cls, diagnosis: Diagnosis, parameter: str) -> Found:
        """From a whole diagnosis; ``parameter`` is the model's own."""
        refits, members = diagnosis.confirmations, diagnosis.members
        values: Mapping[str, float] = {}
        stds: Mapping[str, float] = {}
        error = (math.nan, math.nan)
        if members:
            best = refits[members[0]]
            values, stds = best.values, best.stds
            error = (refits[""].held_out / refits[""].floor, best.held_out / best.floor)
        return cls(
            diagnosis.verdict,
            members,
            diagnosis.evidence.values[parameter],
            values,
            stds,
            error,
            tuple(diagnosis.scores),
            diagnosis.simulations,
        )

    @classmethod
    def from_json(cls, kept: Mapping[str, Any]) -> Found:
        """From what ``plain(asdict(...))`` was read back as."""
        error = [math.nan if e is None else float(e) for e in kept["error"]]
        told = {**kept, "members": tuple(kept["members"]), "error": tuple(error), "scored": tuple(kept["scored"])}
        return cls(**told)


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    if count == 0:
        return 0.0, 1.0
    share, scale = hits / count, 1.0 + z**2 / count
    middle = (share + z**2 / (2 * count)) / scale
    half = z * math.sqrt(share * (1.0 - share) / count + z**2 / (4 * count**2)) / scale
    return max(middle - half, 0.0), min(middle + half, 1.0)


def tally(
    name: str,
    truths: Sequence[Mapping[str, float]],
    found: Sequence[Found],
    angles: Sequence[float],
    kinds: Mapping[str, str],
    parameter: str = "angle",
    sizes_of: Mapping[str, str] | None = None,
) -> Tally:
    """Open the truths and count; ``parameter`` is the model's own, ``sizes_of`` the effects' where named otherwise."""
    verdicts = {"adequate": 0, "missing": 0, "outside the library": 0}
    named = physics = first = held = 0
    sizes, before, after, errors = [], [], [], []
    misses: list[float] = []
    for truth, told, angle in zip(truths, found, angles, strict=True):
        verdicts[told.verdict] += 1
        before.append(abs(told.fitted - angle))
        if told.verdict != "missing":
            continue
        named += 1
        physics += kinds[told.members[0]] == "physics"
        first += told.members[0] in truth
        held += any(m in truth for m in told.members)
        sizes.append(len(told.members))
        after.append(abs(told.values[parameter] - angle))
        if [name for name in truth if name in told.scored] == [told.members[0]]:
            known = {parameter: angle, **{(sizes_of or {}).get(n, n): size for n, size in truth.items()}}
            misses += [abs(told.values[key] - value) / told.stds[key] for key, value in known.items()]
        errors.append(told.error)
    error = tuple(np.mean(errors, axis=0)) if errors else (math.nan, math.nan)
    blind = [(f.blind, f.blind in truth) for truth, f in zip(truths, found, strict=True) if f.blind is not None]
    return Tally(
        name,
        len(found),
        named,
        physics,
        first,
        held,
        float(np.mean(sizes)) if sizes else 0.0,
        verdicts,
        (float(np.mean(before)), float(np.mean(after)) if after else math.nan),
        (float(error[0]), float(error[1])),
        (sum(miss < HALF for miss in misses), sum(miss < MOST for miss in misses)),
        len(misses),
        float(np.mean([told.simulations for told in found])) if found else 0.0,
        (sum(bool(name) for name, _ in blind), sum(right for _, right in blind)) if blind else None,
    )


def entry(row: Tally) -> dict[str, Any]:
    """A row with its intervals."""
    intervals = {"named_interval": wilson(row.named, row.count), "held_interval": wilson(row.held, row.count)}
    return {**row.__dict__, **intervals}


def table(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    lines = [
        "| hidden | experiments | some effect named | a physical one | truth first | class holds it | mean class "
        "| adequate / missing / outside | error over floor, before → after | angle's error, before → after "
        "| truth inside 50 % / 90 % | simulations | the smallest error names: some effect, the truth |",
        "|" + "---|" * 13,
    ]
    for row in result["rows"]:
        low, high = row["named_interval"]
        first, last = row["held_interval"]
        n = row["count"]
        verdicts = " / ".join(str(row["verdicts"][v]) for v in ("adequate", "missing", "outside the library"))
        lines.append(
            f"| {row['name']} | {n} | {100 * row['named'] / n:.0f} % ({100 * low:.0f}–{100 * high:.0f}) "
            f"| {100 * row['physics'] / n:.0f} % | {100 * row['first'] / n:.0f} % "
            f"| {100 * row['held'] / n:.0f} % ({100 * first:.0f}–{100 * last:.0f}) | {row['members']:.1f} | {verdicts} "
            f"| {_pair(row['error'])} | {_pair(row['bias'])} | {_inside(row['inside'], row['intervals'])} "
            f"| {row['simulations']:.0f} | {_blind(row['blind'], n)} |"
        )
    return "\n".join(lines)


def confusion(pairs: Sequence[tuple[str, str]], nothing: str = "nothing") -> str:
    """What was hidden against what was named first, as Markdown; ``nothing`` comes first."""
    named = sorted({name for _, name in pairs}, key=lambda name: (name != nothing, name))
    counts = Counter(pairs)
    lines = ["| hidden \\ named | " + " | ".join(named) + " |", "|" + "---|" * (1 + len(named))]
    for hidden in sorted({hidden for hidden, _ in pairs}, key=lambda name: (name != nothing, name)):
        cells = [str(counts[hidden, name] or "–") for name in named]
        lines.append(f"| {hidden} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _pair(values: Sequence[float | None]) -> str:
    return " → ".join("–" if v is None or not math.isfinite(v) else f"{v:.2f}" for v in values)


def _blind(hits: Sequence[int] | None, count: int) -> str:
    return "–" if hits is None else ", ".join(f"{100 * h / count:.0f} %" for h in hits)


def _inside(hits: Sequence[int], count: int) -> str:
    return "–" if not count else " / ".join(f"{100 * h / count:.0f}" for h in hits) + f" % of {count}"
