"""Where the error of the paper's table comes from, measured: whole landscapes instead of searches.

One set of predictions (angles about the truth, several particle seeds) is held against three observations of the same
angle: the photographs; the model's own drawing of a run on the worlds' finer grid; the same on the model's grid. The
last has nothing wrong but chance and the loss itself; the second adds the grid, the first reconstruction and renderer.
The differences of their minima add up to the whole error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from splatsoil.benchmarks._paper import WAYS, Images, Look, Say, Sight, by_features, look, threads
from splatsoil.inverse.bayesopt import Surrogate

from splatsoil.comparison import Comparator
from splatsoil.errors import SimulationError
from splatsoil.mpm import Resolution
from splatsoil.parameters import ParameterSpace
from splatsoil.soil.settings import FRICTION_ANGLE

#: Half width of a landscape, degrees.
REACH = 8.0
#: Runs of the model that stand in for a world's, each with chance of its own.
STAND_INS = 4
#: Seeds of stand-ins, where no prediction's are.
FIRST = 900_001


def error_budget(sight: Sight, angle: float, say: Say) -> dict[str, Any]:
    """Mean minima of each loss on each kind of observation, and what follows.

    Returns:
        For each way: ``total`` = ``loss`` + ``grid`` + ``reconstruction``, degrees; ``chance``, the standard deviation
        of one landscape's minimum between particle seeds; ``world``, that between stand-ins, which differ by their
        particles only. One world was photographed, so ``reconstruction`` is known no better than to ``world``.
    """
    seeds, points = sight.protocol.scan
    limits = FRICTION_ANGLE.limits or (FRICTION_ANGLE.lower, FRICTION_ANGLE.upper)
    low, high = max(angle - REACH, limits[0]), min(angle + REACH, limits[1])
    space = ParameterSpace([replace(FRICTION_ANGLE, lower=low, upper=high, default=angle)])
    jobs = [(float(a), seed) for seed in range(1, seeds + 1) for a in np.linspace(low, high, points)]
    say(f"{angle:g}°: error budget, {len(jobs)} simulations and {2 * STAND_INS} stand-ins")
    observers = {"photographs": [sight.comparator], **_stand_ins(sight, angle)}
    every = [(kind, k, observer) for kind, mine in observers.items() for k, observer in enumerate(mine)]
    looks: list[list[Look] | None] = []
    with threads(sight.protocol.device) as workers:
        # A seed at a time: pictures and trajectories of all of them would fill a laptop's memory.
        for part in (jobs[k : k + points] for k in range(0, len(jobs), points)):
            waiting = [
                None if images is None else [workers.submit(look, o, images, True) for _, _, o in every]
                for images in sight.drawn(sight.model, part)
            ]
            looks += [None if futures is None else [future.result() for future in futures] for futures in waiting]
    out: dict[str, Any] = {"angle": angle, "range": [low, high], "seeds": seeds, "points": points}
    minima: dict[str, dict[str, list[list[float]]]] = {way: {} for way in WAYS}
    for place, (kind, _, observer) in enumerate(every):
        known = [(a, s, k[place]) for (a, s), k in zip(jobs, looks, strict=True) if k is not None]
        for way in WAYS[:2]:
            groups = [[(a, k.loss(way)) for a, s, k in known if s == seed] for seed in range(1, seeds + 1)]
            minima[way].setdefault(kind, []).append([minimum(space, g) for g in groups if len(g) > 3])
        angles, blocks = np.array([a for a, _, _ in known]), np.array([k.blocks for _, _, k in known])
        found = by_features(space, angles, blocks, observer.block_noise(), 0)
        minima["features"].setdefault(kind, []).append([] if found is None else [found["estimate"]])
    out["ways"] = {way: shares(mine, angle) for way, mine in minima.items()}
    return out


def shares(minima: Mapping[str, Sequence[Sequence[float]]], angle: float) -> dict[str, Any] | None:
    """The error's parts from the minima of each kind of observation, one list for each observation.

    None where a kind has none.
    """
    flat = {kind: [m for mine in found for m in mine] for kind, found in minima.items()}
    if not all(flat.get(kind) for kind in ("photographs", "grid", "same")):
        return None
    photographs, grid, same = (float(np.mean(flat[kind])) for kind in ("photographs", "grid", "same"))
    spreads = [np.var(mine, ddof=1) for found in minima.values() for mine in found if len(mine) > 1]
    means = [[float(np.mean(mine)) for mine in minima[kind] if len(mine)] for kind in ("grid", "same")]
    worlds = [np.var(mine, ddof=1) for mine in means if len(mine) > 1]
    return {
        "total": photographs - angle,
        "loss": same - angle,
        "grid": grid - same,
        "reconstruction": photographs - grid,
        "chance": float(np.mean(spreads)) ** 0.5 if spreads else None,
        "world": float(np.mean(worlds)) ** 0.5 if worlds else None,
        "minima": {kind: [list(mine) for mine in found] for kind, found in minima.items()},
    }


def minimum(space: ParameterSpace, scan: Sequence[tuple[float, float]]) -> float:
    """Where a landscape (angle, loss) is lowest, degrees."""
    points = space.to_unit(np.array([[a] for a, _ in scan]))
    return float(space.from_unit(Surrogate(points, [loss for _, loss in scan]).minimum().estimate)[0])


def _stand_ins(sight: Sight, angle: float) -> dict[str, list[Comparator]]:
    """Comparisons with the model's own drawings in place of photographs: on the worlds' grid, and on the model's."""
    protocol, model = sight.protocol, sight.model
    finer = Resolution.derive(model.measurement, protocol.preset("truth", protocol.truth_cells))
    jobs = [(angle, FIRST + k) for k in range(STAND_INS)]
    out = {}
    for kind, run in (("grid", model.variant(resolution=finer)), ("same", model)):
        drawn: list[Images] = []
        for images in sight.drawn(run, jobs):
            if images is None:
                raise SimulationError(f"the stand-in for the world at {angle:g}° failed")
            drawn.append(images)
        out[kind] = [sight.comparator.against(images) for images in drawn]
    return out


def budget_table(budgets: Sequence[Mapping[str, Any]]) -> list[str]:
    """The error budget as lines of Markdown."""
    lines = [
        "| true angle | way | error of the landscape | = loss | + grid | + reconstruction and renderer "
        "| chance of a search's particles | of a world's |",
        "|---" * 8 + "|",
    ]
    for entry in budgets:
        for way in WAYS:
            found = entry["ways"][way]
            if found is None:
                continue
            chances = " | ".join("–" if found[k] is None else f"± {found[k]:.2f}°" for k in ("chance", "world"))
            parts = " | ".join(f"{found[key]:+.2f}°" for key in ("total", "loss", "grid", "reconstruction"))
            lines.append(f"| {entry['angle']:g}° | {way} | {parts} | {chances} |")
    return lines
