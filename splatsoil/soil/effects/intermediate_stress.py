"""Intermediate stress: friction that is the same angle in compression and extension, as in sand, not the same cone."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength

MOST = 1.5
"""Of the slope, for which the surface is found: 80 degrees in triaxial compression."""


@wp.func
def matsuoka_nakai(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Multiply friction by what the surface through the cone's compression meridian has at this Lode angle.

    With x = sqrt(J2) / p, I1 I2 = k I3 is (k - 9) - (k - 3) x^2 + k c x^3 2 / (3 sqrt 3) = 0, c the cosine of three
    times the Lode angle; its root is found for 1 / x.
    """
    result = strength
    slope = wp.clamp(strength.slope, 1.0e-3, wp.static(MOST))
    cubic = wp.static(2.0 / (3.0 * 3.0**0.5))
    k = (9.0 - 3.0 * slope * slope) / (1.0 - slope * slope + cubic * slope * slope * slope)
    linear = (k - 3.0) / (k - 9.0)
    turn = -0.5 * cubic * k / (k - 9.0) * state.lode * wp.pow(3.0 / linear, 1.5)
    inverse = 2.0 * wp.sqrt(linear / 3.0) * wp.cos(wp.acos(wp.clamp(turn, -1.0, 1.0)) / 3.0)
    result.slope = strength.slope * (1.0 + values[row, column] * (1.0 / (inverse * slope) - 1.0))
    return result


class IntermediateStress(Effect):
    """Matsuoka and Nakai's surface I1 I2 = k I3 through the cone in triaxial compression; a share of the way to it.

    At a share of 1 the friction angle is the same in triaxial compression and extension, and a little more between.
    """

    name = "intermediate_stress"
    parameters = (
        Parameter(
            "intermediate_share", "1", 0.0, 1.0, 0.0, off=0.0, meaningful=0.25, sign=1, label="share of Matsuoka-Nakai"
        ),
    )
    note = (
        "The cone that agrees with a triaxial test is too strong where soil is squeezed from two sides: under a "
        "plate, before a blade, in a shear box. Sand has about one friction angle in all of them."
    )
    source = "Matsuoka & Nakai (1974), Proc. JSCE 232; its root: Panteghini & Lagioia (2014), Géotechnique 64(12)"
    laboratory = True
    strength = matsuoka_nakai
