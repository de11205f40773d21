"""Pressure dependence: the strength envelope is curved, friction is greater under little pressure."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def curved_strength(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Multiply friction by (p / p0)^-m, not below a hundredth nor above a thousand times p0."""
    result = strength
    ratio = wp.clamp(state.pressure / values[row, column + 1], 0.01, 1000.0)
    result.slope = strength.slope * wp.pow(ratio, -values[row, column])
    return result


class PressureDependence(Effect):
    """Power law sqrt(J2) = a p0 (p / p0)^(1 - m): the friction angle holds at the pressure p0."""

    name = "pressure_dependence"
    parameters = (
        Parameter("pressure_exponent", "1", 0.0, 0.3, 0.0, off=0.0, meaningful=0.03, sign=1, label="envelope exponent"),
        Parameter(
            "pressure_reference", "Pa", 100.0, 1e6, 1000.0, meaningful=100.0, log=True, label="reference pressure"
        ),
    )
    note = (
        "Grains dilate less and break more under pressure, so friction falls as pressure rises: soil near the surface "
        "is stronger than one angle for all depths says."
    )
    source = "De Mello (1977), Géotechnique 27(3), power-law envelope; Charles & Watts (1980), Géotechnique 30(4)"
    strength = curved_strength
