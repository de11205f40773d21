"""What is hidden from a diagnosis: kinds of truths, how one is drawn, judged and kept."""

from __future__ import annotations

import sys
import time
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from splatsoil.benchmarks._tally import Found, Tally, tally
from splatsoil.inverse.executors import in_order

from splatsoil.experiment.base import Candidate
from splatsoil.files import plain, read_json, write_json

FIRST_SEED = 1000
"""Of the truths' chance; an analysis uses seeds below."""


@dataclass(frozen=True)
class Kind:
    """What is hidden.

    Attributes:
        name: of the row.
        times: size of each effect, in smallest detectable ones.
        effects: how many at once.
        among: from which they are drawn: those of physics, those of observation, or one by its name.
        dropped: whether they are taken out of the analysis's library.
        shuffled: whether the library's traces are shuffled among the places, so that none is the truth's.
        twin: whether the library has the first effect twice.
        beyond: size of a pattern that no effect has, in noise.
    """

    name: str
    times: float = 0.0
    effects: int = 0
    among: str = "physics"
    dropped: bool = False
    shuffled: bool = False
    twin: bool = False
    beyond: float = 0.0

    @property
    def foreign(self) -> bool:
        """Whether the analysis knows nothing of the truth, so that any name is wrong."""
        return self.dropped or self.shuffled

    @property
    def number(self) -> int:
        """For seeds and file names: kinds that come and go change no others."""
        return zlib.crc32(self.name.encode())


NOTHING = Kind("nothing")


@dataclass(frozen=True)
class Truth:
    """One experiment's.

    Attributes:
        angle: friction angle, degrees.
        sizes: of the effects, by name, in their units.
        seed: of its chance and noise.
    """

    angle: float
    sizes: Mapping[str, float]
    seed: int


def draw(
    kind: Kind,
    number: int,
    seed: int,
    candidates: Sequence[Candidate],
    least: Mapping[str, float],
    angles: tuple[float, float],
) -> Truth:
    """A sealed truth.

    Args:
        kind: of what.
        number: of the experiment.
        seed: of all truths.
        candidates: effects that there are. One whose bounds don't reach the size asked for isn't drawn.
        least: their smallest detectable sizes.
        angles: range of the friction angle, degrees.
    """
    rng = np.random.default_rng([seed, kind.number, number])
    angle = float(rng.uniform(*angles))
    possible: dict[str, list[float]] = {}
    for candidate in candidates:
        measure = candidate.measure
        if kind.among in (candidate.kind, candidate.name) and candidate.name in least:
            far = [
                float(measure.off or 0.0) + side * kind.times * least[candidate.name]
                for side in ([measure.sign] if measure.sign else [-1, 1])
            ]
            if inside := [value for value in far if measure.lower <= value <= measure.upper]:
                possible[candidate.name] = inside
    chosen: Iterable[str] = (
        rng.choice(sorted(possible), min(kind.effects, len(possible)), replace=False) if possible else []
    )
    sizes = {str(name): float(rng.choice(possible[str(name)])) for name in chosen}
    return Truth(angle, sizes, int(rng.integers(FIRST_SEED, 2**20)))


def kept(keep: Path, kind: Kind, number: int, make: Callable[[], tuple[Truth, Found]]) -> tuple[Truth, Found]:
    """What was judged, from the folder if it is there; else made, and kept there."""
    file = keep / "judged" / f"{kind.number:08x}-{number}.json"
    if file.is_file():
        told = read_json(file)
        return Truth(**told["truth"]), Found.from_json(told["found"])
    truth, found = make()
    write_json(file, plain({"kind": kind.name, "truth": asdict(truth), "found": asdict(found)}))
    return truth, found


def judge_all(
    pool: Executor,
    judge: Callable[..., tuple[Truth, Found]],
    jobs: Sequence[tuple[Kind, int]],
    arguments: Callable[[Kind, int], tuple[object, ...]],
) -> dict[Kind, list[tuple[Truth, Found]]]:
    """Judge every (kind, number), with a line on stderr for each; ``arguments`` are those of ``judge`` for one."""
    began, rows = time.perf_counter(), dict[Kind, list[tuple[Truth, Found]]]()
    told = in_order(pool, judge, [arguments(kind, number) for kind, number in jobs])
    for done, ((kind, number), (truth, found)) in enumerate(zip(jobs, told, strict=True), 1):
        rows.setdefault(kind, []).append((truth, found))
        hidden = ", ".join(f"{name} {size:.3g}" for name, size in truth.sizes.items()) or "nothing"
        said = f"{found.verdict} {', '.join(found.members)}".rstrip()
        seconds = time.perf_counter() - began
        line = f"{seconds:6.0f} s  {done} of {len(jobs)}: {kind.name}, {number + 1}: {hidden}; {said}"
        print(line, file=sys.stderr, flush=True)
    return rows


def count_up(
    kind: Kind, judged: Sequence[tuple[Truth, Found]], candidates: Sequence[Candidate], parameter: str
) -> Tally:
    """A row; ``parameter`` is the model's own. Truths of which the analysis knows nothing count as none."""
    return tally(
        kind.name,
        [{} if kind.foreign else truth.sizes for truth, _ in judged],
        [found for _, found in judged],
        [truth.angle for truth, _ in judged],
        {c.name: c.kind for c in candidates},
        parameter,
        {c.name: c.measure.name for c in candidates},
    )


def hidden_and_named(rows: Mapping[Kind, Sequence[tuple[Truth, Found]]]) -> list[tuple[str, str]]:
    """(hidden, named first) of all experiments with one effect of the library or with nothing."""
    return [
        (next(iter(truth.sizes), NOTHING.name), found.members[0] if found.verdict == "missing" else NOTHING.name)
        for kind, judged in rows.items()
        for truth, found in judged
        if len(truth.sizes) < 2 and not kind.foreign
    ]
