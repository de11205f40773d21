"""Compaction: loose soil loses volume when it shears, and its skeleton gives way under pressure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength

COMPRESSION_DECADES = 10.0
"""Logarithm of the pressure, over the one where crushing begins, that would press all looseness out."""


@wp.func
def compacting(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Take away volume in proportion to what the soil still has to lose; limit the pressure it can bear so loose."""
    result = strength
    looseness = values[row, column]
    left = looseness + state.dilated
    if left > 0.0:
        result.dilation = strength.dilation - left / values[row, column + 1]
        steep = wp.static(COMPRESSION_DECADES) / looseness
        crush = values[row, column + 2] * wp.exp(-steep * state.dilated)
        result.crush_pressure = crush
        result.crush_hardening = steep * crush
    return result


class Compaction(Effect):
    """Volume V that the soil can lose; sheared by g it has lost V (1 - exp(-g / g_c)).

    Isotropic pressure above p_c costs the volume (V / 10) ln(p / p_c), the straight line of a normal compression.
    """

    name = "compaction"
    parameters = (
        Parameter(
            "looseness", "1", 0.0, 0.1, 0.0, off=0.0, meaningful=0.01, sign=1, label="volume that loose soil can lose"
        ),
        Parameter("compaction_strain", "1", 0.1, 3.0, 0.4, meaningful=0.1, log=True, label="strain of compaction"),
        Parameter("compaction_pressure", "Pa", 1e2, 1e7, 2e4, meaningful=1e3, log=True, label="pressure of compaction"),
    )
    shapes = ("compaction_strain",)
    note = (
        "Soil looser than its critical state collapses into its voids when it is sheared, and under more pressure than "
        "it ever bore. Berms stay small, trenches deep, and the tool leaves a hollow."
    )
    source = "Wood (1990), Soil Behaviour and Critical State Soil Mechanics, ch. 4 and 6"
    conflicts: ClassVar[Mapping[str, str]] = {"dilatancy": "soil is either looser or denser than its critical state"}
    strength = compacting
