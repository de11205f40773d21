"""Initial state of the soil: geostatic stress."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from splatsoil.mpm.grid import GridShape
from splatsoil.mpm.presets import Resolution
from splatsoil.soil.law import Law
from splatsoil.soil.settings import Settings

FloatArray = npt.NDArray[np.floating]


def at_rest(
    law: Law,
    base: Settings,
    values: Mapping[str, float],
    x: FloatArray,
    shape: GridShape,
    resolution: Resolution,
    bulk: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Elastic volume strain, depth below the surface in m and relative density, each (n,), of particles at rest.

    Args:
        law: the soil's.
        base: settings of the experiment, before any effect.
        values: parameters by name.
        x: particles (n, 3), m.
        shape: the grid, whose columns tell what lies above.
        resolution: lengths and density.
        bulk: modulus, Pa.
    """
    plan = np.array(shape.nodes[:2]) - 1
    index = np.clip(((x[:, :2] - shape.lower[:2]) / shape.cell[:2]).astype(int), 0, plan - 1)
    column = index[:, 0] * plan[1] + index[:, 1]
    top = np.full(plan[0] * plan[1], -np.inf)
    np.maximum.at(top, column, x[:, 2])
    depth = top[column] + 0.5 * resolution.spacing - x[:, 2]
    found = law.density(depth, values)
    above = depth if found is None else _integral(law, depth, values)
    weight = resolution.density * abs(law.settings(base, values).gravity[2])
    return -weight * above / bulk, depth, np.ones(len(x)) if found is None else found


def _integral(law: Law, depth: FloatArray, values: Mapping[str, float]) -> FloatArray:
    """Relative density times depth, summed from the surface down to each depth (n,) in m."""
    levels = np.linspace(0.0, float(depth.max()), 257)
    density = law.density(levels, values)
    assert density is not None
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(levels))])
    return np.interp(depth, levels, sums)
