"""Part ``refinement``: what changes with the grid, the step and the particles' seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from splatsoil.benchmarks._validation.blades import Blade
from splatsoil.benchmarks._validation.columns import ANGLE, PARTICLES, WAY, collapse, column
from splatsoil.benchmarks._validation.page import Row, Section, percent

from splatsoil.soil.matching import Matching

SEEDS = 5
CHANGE = 0.1
"""Largest change of an answer that counts as refined."""


def runout(
    device: str, *, particles: float = PARTICLES, seed: int = 0, transport: float = WAY, young: float = 5e5
) -> float:
    """Run-out of an axisymmetric column of height R0; eight times the particles halve the cell."""
    scene = column(
        1.0,
        ANGLE,
        planar=False,
        matching=Matching.PLANE_STRAIN,
        particles=particles,
        seed=seed,
        transport=transport,
        young=young,
    )
    return collapse(scene, 1.0, False, device)[0]


def _change(case: str, found: float, base: float, unit: str) -> Row:
    held = abs(found / base - 1.0) <= CHANGE
    return Row(case, f"{found:.3g} {unit} ({percent(found, base)})".replace("  ", " "), "± 10 %", held)


def validate(device: str) -> Section:
    """A column and a blade, each changed one piece at a time."""
    rows = []
    runs = [runout(device, seed=seed) for seed in range(SEEDS)]
    base, chance = float(np.mean(runs)), float(np.std(runs, ddof=1))
    rows.append(Row(f"column a = 1, run-out: mean of {SEEDS} seeds", f"{base:.3f}, scatter {chance:.3f}", "reported"))
    rows.append(_change("half the cell (8 times the particles)", runout(device, particles=8.0 * PARTICLES), base, ""))
    rows.append(_change("half the step of the particles", runout(device, transport=0.5 * WAY), base, ""))
    rows.append(_change("double step", runout(device, transport=2.0 * WAY), base, ""))
    rows.append(_change("4 times as stiff", runout(device, young=2e6), base, ""))
    blade = Blade(0.08)
    forces = [replace(blade, seed=seed).force(device) for seed in range(SEEDS)]
    base, chance = float(np.mean(forces)), float(np.std(forces, ddof=1))
    rows.append(
        Row(
            f"blade, upright, smooth, φ = 35°: mean of {SEEDS} seeds",
            f"{base:.1f} N/m, scatter {chance:.1f}",
            "reported",
        )
    )
    rows.append(_change("half the cell", replace(blade, cells=2.0 * blade.cells).force(device), base, "N/m"))
    return Section(
        "Grid, step and seed",
        "The column and the blade of the parts above, one piece of the numerics changed at a time. See "
        "[numerics.md](numerics.md) for the ploughed beds.",
        tuple(rows),
        "Hourglass modes are damped over the same way in all rows, as in the presets, whatever the step.",
    )
