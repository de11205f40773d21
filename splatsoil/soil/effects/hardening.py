"""Hardening: friction is mobilised by shear, from none in the undisturbed soil."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength

REFERENCE = 1.0e5
"""Pressure in Pa at which the strain is stated."""
FAILURE_RATIO = 0.9
"""Strength over the hyperbola's asymptote."""


@wp.func
def mobilised(strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int) -> Strength:
    """Hyperbola of the plastic shear strain."""
    result = strength
    half = values[row, column] * wp.sqrt(wp.max(state.pressure, 0.0) / wp.static(REFERENCE))
    if half > 0.0:
        share = state.plastic_strain / (wp.static(FAILURE_RATIO) * (half + state.plastic_strain))
        result.mobilised = strength.mobilised * wp.min(share, 1.0)
    return result


class Hardening(Effect):
    """Friction g / (0.9 (A + g)) of its full value after a plastic shear strain g, with A = A_100 sqrt(p / 100 kPa).

    All is mobilised at g = 9 A. The secant modulus grows with the square root of pressure. Until then shear makes the
    soil denser, at first as Rowe's stress-dilatancy says, then in proportion to what is not mobilised.
    """

    name = "hardening"
    parameters = (
        Parameter(
            "hardening_strain",
            "1",
            0.0,
            0.1,
            0.0,
            off=0.0,
            meaningful=0.003,
            sign=1,
            label="strain that mobilises half of friction",
        ),
    )
    note = (
        "Soil is not rigid until it fails: grains must move before they lock. The stress under a tool grows with its "
        "way, the more slowly the higher the pressure, and loose soil becomes denser meanwhile."
    )
    source = (
        "Kondner (1963), J. Soil Mech. Found. Div. 89(1); exponent, failure ratio: Duncan & Chang (1970), "
        "J. Soil Mech. Found. Div. 96(5); volume: Rowe (1962), Proc. R. Soc. A 269"
    )
    laboratory = True
    strength = mobilised
