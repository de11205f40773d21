"""Critical state: friction and dilatancy follow the density that the soil has at each moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import asin, degrees
from typing import ClassVar

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.matching import Matching, cone_slope
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength

CRUSHING = 10.0
"""Q of quartz and feldspar: logarithm of the pressure in kPa that lets the densest sand crush instead of dilate."""
CRITICAL = 1.0
"""R: the dilatancy index is 0 at a relative density of R / (Q - ln p)."""
MOST = 5.0
"""Of Q - ln p: dilatancy does not grow further below 150 kPa (Bolton 1987)."""
LARGEST = 4.0
"""Of the dilatancy index."""
DILATANCY = 0.3
"""Volume gained per axial strain, per unit of the index."""
DEGREES = {Matching.COMPRESSION: 3.0, Matching.EXTENSION: 3.0, Matching.PLANE_STRAIN: 5.0, Matching.SIMPLE_SHEAR: 5.0}
"""Friction angle above the critical one per unit of the index: triaxial and plane strain."""


@wp.func
def of_density(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Friction and dilation by the dilatancy index at the present density and pressure."""
    result = strength
    density = values[row, column] - state.dilated / values[row, column + 1]
    scale = wp.min(wp.static(CRUSHING) - wp.log(wp.max(state.pressure, 1.0) / 1000.0), wp.static(MOST))
    index = wp.min(density * scale - wp.static(CRITICAL), wp.static(LARGEST))
    growth = values[row, column + 2] * index / (1.0 + values[row, column + 3] * index)
    result.slope = strength.slope * (1.0 + growth)
    result.dilation = strength.dilation + values[row, column + 4] * index / (1.0 + values[row, column + 5] * index)
    return result


class CriticalState(Effect):
    """Bolton's index I_R = I_D (Q - ln p) - R: phi = phi_critical + 3 I_R (plane strain 5 I_R), dilation 0.3 I_R.

    The friction angle is the critical one. The relative density I_D follows the volume: dense soil dilates and softens,
    loose soil contracts and hardens, until I_R is 0. Below 150 kPa that is at I_D = 0.2, where the effect is off.
    """

    name = "critical_state"
    parameters = (
        Parameter("relative_density", "1", 0.0, 1.0, 0.2, off=0.2, meaningful=0.05, label="relative density"),
        Parameter(
            "volume_range", "1", 0.1, 0.4, 0.2, meaningful=0.03, label="log volume between loosest and densest packing"
        ),
    )
    shapes = ("volume_range",)
    note = (
        "Dense soil is stronger and dilates, until shear has loosened it to its critical state; loose soil contracts "
        "until it is there. One density makes peak, softening and volume change."
    )
    source = "Bolton (1986), Géotechnique 36(1), and (1987), 37(2); state: Been & Jefferies (1985), Géotechnique 35(2)"
    conflicts: ClassVar[Mapping[str, str]] = {
        "dilatancy": "both say how shear changes the volume",
        "softening": "both say how friction falls from its peak",
        "compaction": "both say how loose soil becomes denser in shear",
    }
    laboratory = True
    strength = of_density

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Relative density, volume range, and a and b of a I_R / (1 + b I_R) for the slope's growth and the dilation.

        Both curves are right at an index of 1 and of 4; dilation is so everywhere but in simple shear.
        """
        degrees = DEGREES[settings.matching]
        growth = [settings.relative_slope(degrees * index, "relative_density") for index in (1.0, LARGEST)]
        dilation = [_dilation(index, settings.matching) for index in (1.0, LARGEST)]
        return values["relative_density"], values["volume_range"], *_curve(*growth), *_curve(*dilation)


def _curve(one: float, four: float) -> tuple[float, float]:
    """a and b of the curve a I / (1 + b I) through its values at 1 and at `LARGEST`."""
    bend = (LARGEST * one - four) / (LARGEST * (four - one))
    return one * (1.0 + bend), bend


def _dilation(index: float, matching: Matching) -> float:
    """Volume gained per plastic shear strain: the slope at sin psi = D / (2 + D) with D the gain per axial strain."""
    gain = DILATANCY * index
    return cone_slope(degrees(asin(gain / (2.0 + gain))), matching)
