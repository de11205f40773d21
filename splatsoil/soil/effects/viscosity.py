"""Viscosity: shear stress that grows in proportion to the shear rate."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def viscous(strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int) -> Strength:
    """Add the viscosity."""
    result = strength
    result.viscosity = strength.viscosity + values[row, column]
    return result


class Viscosity(Effect):
    """Bingham's overstress: flowing soil carries sqrt(J2) = yield strength + viscosity * plastic shear rate."""

    name = "viscosity"
    parameters = (Parameter("viscosity", "Pa s", 0.0, 500.0, 0.0, off=0.0, meaningful=10.0, sign=1),)
    note = "Wet soil or mud resists shear the more, the faster it is sheared, whatever the pressure."
    source = "Bingham (1922), Fluidity and Plasticity; overstress: Perzyna (1966), Adv. Appl. Mech. 9"
    strength = viscous
