"""Density gradient: packing, and with it weight and friction, grow with depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import warp as wp

from splatsoil.parameters import FloatArray, Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def denser_below(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Multiply friction by what the density at this soil's depth makes of it."""
    result = strength
    denser = wp.log(1.0 + values[row, column] * state.depth)
    result.slope = strength.slope * (1.0 + values[row, column + 1] * denser)
    return result


class DensityGradient(Effect):
    """Bulk density rho (1 + g z) at depth z, and a friction angle that grows with the logarithm of density.

    Bolton's dilatancy index gives 3 deg per unit of I_R = 10 I_D - 1 at a bed's low pressures (triaxial). Sand between
    its loosest and densest packing changes the logarithm of density by about 0.25, so I_D = 1 makes 30 deg / 0.25 =
    120 deg; half of it, because only initial packing counts here and shear undoes it, is the default.
    """

    name = "density_gradient"
    parameters = (
        Parameter("density_gradient", "1/m", -0.9, 2.0, 0.0, off=0.0, meaningful=0.1, label="growth of density"),
        Parameter("density_friction", "deg", 0.0, 150.0, 60.0, meaningful=10.0, label="friction per log density"),
    )
    note = (
        "Soil that was rained in, or drove over, is denser further down: heavier, and stronger because it interlocks."
    )
    source = "Bolton (1986), Géotechnique 36(1), index I_R for triaxial strain"
    strength = denser_below

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Gradient, and the relative growth of the slope per logarithm of density."""
        degree = settings.relative_slope(1.0, "density_friction")
        return values["density_gradient"], values["density_friction"] * degree

    def density(self, depth: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """The relative density."""
        return 1.0 + values["density_gradient"] * depth
