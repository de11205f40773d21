"""Effects that show less on one side than on the other.

An effect without a sign is measured from both sides at once, and what is seen of it is stated for their mean. Friction
on the tool that soil already sticks to can't make soil stick any more: a size that would be seen where there is less
of it isn't where there is more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Candidate, Experiment

from .dilution import reliable
from .evidence import Evidence, Visit
from .floor import Floor
from .noise import Solver

FloatArray = npt.NDArray[np.float64]

LEAST = 0.01
"""Share of what is seen of both sides that counts as seen of either: a side of nothing but chance shows no less."""


def lopsided(experiment: Experiment, evidence: Evidence, floor: Floor) -> dict[str, float]:
    """How many times as far an effect's size is known by both sides together as by the side that shows less, by name:
    1 where both are alike, and at most ten. Effects that were switched on to one side have none."""
    solver, out = floor.noise.solver.beside(floor.free), dict[str, float]()
    for candidate in experiment.candidates:
        ends = [v for v in evidence.visits if v.effects == (candidate.name,) and _alone(candidate, v)]
        sizes = sorted({v.values[candidate.size] for v in ends})
        if len(sizes) != 2:
            continue
        off = float(candidate.measure.off or 0.0)
        sides = [
            [_slope(evidence, v, v.values[candidate.size] - off) for v in ends if v.values[candidate.size] == size]
            for size in sizes
        ]
        both = [0.5 * (low + high) for low, high in zip(*sides, strict=True)]
        whole, *parts = (_information(side, experiment, solver) for side in (both, *sides))
        if whole > 0.0:
            out[candidate.name] = math.sqrt(max(1.0, 1.0 / max(min(parts) / whole, LEAST)))
    return out


def _alone(candidate: Candidate, visit: Visit) -> bool:
    """Whether nothing but the size of an effect is on."""
    others = (p for p in candidate.parameters if p.name != candidate.size)
    return all(visit.values.get(p.name, p.off) == p.off for p in others)


def _slope(evidence: Evidence, end: Visit, offset: float) -> FloatArray:
    """(t, s) derivative to one side, by one seed."""
    middle = next(v for v in evidence.visits if not v.effects and v.seed == end.seed and v.values == evidence.values)
    return np.asarray((end.table - middle.table) / offset)


def _information(seeds: Sequence[FloatArray], experiment: Experiment, solver: Solver) -> float:
    """Of a derivative (t, s) by one seed or two, without what of it is chance."""
    mean, doubt = np.mean(seeds, axis=0), 0.5 * (seeds[0] - seeds[-1])
    size, chance = (np.atleast_1d(np.sum(solver.whiten(table[experiment.seen]) ** 2)) for table in (mean, doubt))
    return float((reliable(size, chance) * size)[0])
