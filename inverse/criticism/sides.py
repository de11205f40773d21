"""Effects that show less on one side than on the other.

An effect without a sign is measured from both sides at once, and what is seen of it is stated for their mean. Friction
on the tool that soil already sticks to can't make soil stick any more: a size that would be seen where there is less
of it isn't where there is more.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Candidate, Experiment

from .evidence import Evidence
from .floor import Floor

FloatArray = npt.NDArray[np.float64]

LEAST = 0.1
"""Of what both sides show on the average, what counts as shown by either."""
CHANCE = 1.5
"""Variance of half the second difference of three simulations, in that of one: 1/4 + 1/4 + 1."""


def lopsided(experiment: Experiment, evidence: Evidence, floor: Floor) -> dict[str, float]:
    """How many times as much an effect shows on both sides' average as on the side that shows less, by name.

    1 where both are alike, or differ by no more than a standard deviation of chance. Where a step to one side changes
    features by e + g and one to the other by e - g, a score, which looks along g, sees 1 ± gᵀΣ⁻¹e/(gᵀΣ⁻¹g) of it.
    Effects that were switched on to one side have none.
    """
    solver, out = floor.noise.solver.beside(floor.free), dict[str, float]()
    part = floor.parts.get("chance")
    chance = None if part is None else part.covariance(experiment.layout, experiment.seen)
    middles = {v.seed: v.table for v in evidence.visits if not v.effects and v.values == evidence.values}
    for candidate in experiment.candidates:
        ends = _ends(candidate, evidence)
        if not ends:
            continue
        found = [(tables[max(tables)], tables[min(tables)], middles[seed]) for seed, tables in ends.items()]
        line = np.mean([0.5 * (high - low) for high, low, _ in found], axis=0)[experiment.seen]
        bend = np.mean([0.5 * (high + low) - middle for high, low, middle in found], axis=0)[experiment.seen]
        weights = solver.solve(line)
        whole = float(line @ weights)
        if whole > 0.0:
            doubt = 0.0 if chance is None else math.sqrt(CHANCE / len(found) * float(weights @ chance @ weights))
            share = max(abs(float(bend @ weights)) - doubt, 0.0) / whole
            out[candidate.name] = 1.0 / max(1.0 - share, LEAST)
    return out


def _ends(candidate: Candidate, evidence: Evidence) -> dict[int, dict[float, FloatArray]]:
    """What was simulated at the fit with nothing but an effect's size on, by seed and size, where that is on both
    sides."""
    rest = {**evidence.values, **{p.name: p.off for p in candidate.parameters if p.name != candidate.size}}
    out: dict[int, dict[float, FloatArray]] = {}
    for v in evidence.visits:
        if v.effects == (candidate.name,) and all(v.values.get(name, value) == value for name, value in rest.items()):
            out.setdefault(v.seed, {})[v.values[candidate.size]] = v.table
    return {seed: sides for seed, sides in out.items() if len(sides) == 2}
