"""Cohesion: strength that remains without pressure (moisture, cementation, electrostatic attraction)."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def cohesive_strength(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Raise the intercept by the cohesion, with the factor that keeps the named matching exact."""
    result = strength
    result.intercept = strength.intercept + values[row, column] * strength.intercept_per_cohesion
    return result


class Cohesion(Effect):
    """Mohr-Coulomb cohesion c, matched to Drucker-Prager like the friction angle; the apex is at p = -k/a."""

    name = "cohesion"
    parameters = (Parameter("cohesion", "Pa", 0.0, 1500.0, 0.0, off=0.0, meaningful=50.0, sign=1),)
    note = "Strength that remains at zero pressure: damp or cemented soil stands in steep walls and tears in clods."
    source = "Chen & Mizuno (1990), Nonlinear Analysis in Soil Mechanics, eq. 5.27"
    strength = cohesive_strength
