"""Dilatancy: dense soil gains volume when it shears, until it has reached the critical state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import warp as wp

from splatsoil.errors import CombinationError
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.matching import cone_slope
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def dilating(strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int) -> Strength:
    """Add the dilation, which decays exponentially with plastic shear strain."""
    result = strength
    result.dilation = strength.dilation + values[row, column] * wp.exp(-state.plastic_strain / values[row, column + 1])
    return result


class Dilatancy(Effect):
    """Angle of dilation psi at first, matched to Drucker-Prager like the friction angle; volume gained b g_d in all.

    The volume after a plastic shear strain g is b g_d (1 - exp(-g / g_d)) with b the cone's slope at psi.
    """

    name = "dilatancy"
    parameters = (
        Parameter("dilatancy_angle", "deg", 0.0, 25.0, 0.0, off=0.0, meaningful=2.0, sign=1, label="angle of dilation"),
        Parameter(
            "dilatancy_strain", "1", 0.02, 20.0, 0.3, meaningful=0.1, log=True, label="strain to the critical state"
        ),
    )
    shapes = ("dilatancy_strain",)
    note = (
        "Grains of dense soil must climb over each other: shear gains volume at the angle of dilation, less and less "
        "as the soil nears its critical state. Berms become taller, trenches shallower."
    )
    source = "Vermeer & de Borst (1984), Heron 29(3); critical state: Schofield & Wroth (1968)"
    strength = dilating

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Slope of the plastic potential, strain."""
        angle = values["dilatancy_angle"]
        if angle > settings.friction_angle:
            raise CombinationError(
                f"dilatancy_angle: {angle:g} deg exceeds the friction angle of {settings.friction_angle:g} deg; such a "
                "soil would give out energy as it shears, so take a smaller one"
            )
        return cone_slope(angle, settings.matching), values["dilatancy_strain"]
