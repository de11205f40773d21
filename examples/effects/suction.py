"""An effect of one's own: suction that grows with depth, as in sand above a water table."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def held_by_suction(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Runs at every stress point in every step; ``values[row, column + i]`` is number i of ``columns``."""
    result = strength
    cohesion = values[row, column] * state.depth
    result.intercept = strength.intercept + cohesion * strength.intercept_per_cohesion
    return result


class Suction(Effect):
    """Pore water under tension holds the grains together: apparent cohesion = suction * tan(phi_b)."""

    name = "suction"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        # the first parameter is the effect's size, and at its off value the effect does nothing
        Parameter("suction_gradient", "Pa/m", 0.0, 5e4, 0.0, off=0.0, meaningful=2e3, sign=1),
        # others only shape the effect: no off value, and a default that makes sense
        Parameter("suction_angle", "deg", 5.0, 40.0, 15.0, meaningful=2.0),
    )
    note = "Sand above a water table: dry at the surface, damper and held together by suction further down."
    source = "Fredlund, Morgenstern & Widger (1978), Canadian Geotechnical Journal 15(3)"
    strength = held_by_suction

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """What the function above reads: cohesion per metre of depth."""
        return [values["suction_gradient"] * math.tan(math.radians(values["suction_angle"]))]
