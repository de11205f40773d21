"""Types shared by the law and by the effects that change the soil's strength."""

from __future__ import annotations

import warp as wp


@wp.struct
class SoilState:
    """State of the soil at a stress point, as seen by an effect on strength.

    Attributes:
        pressure: mean stress in Pa, positive in compression.
        shear_rate: sqrt(2 dev(D):dev(D)) in 1/s; the rate of engineering shear strain in simple shear.
        opening: logarithmic volume by which the soil has come apart in tension (>= 0).
        plastic_strain: plastic shear strain gone through so far, in the same measure as the shear rate.
        dilated: logarithmic volume gained (+) or lost (-) by plastic shear so far.
        depth: how far below the surface this soil was at the start, m.
        lode: cosine of three times the Lode angle; 1 in triaxial compression, -1 in extension.
    """

    pressure: float
    shear_rate: float
    opening: float
    plastic_strain: float
    dilated: float
    depth: float
    lode: float


@wp.struct
class Strength:
    """Drucker-Prager strength sqrt(J2) <= intercept + slope * p, and the plastic flow that goes with it.

    Attributes:
        slope: friction, sqrt(J2)/p.
        intercept: sqrt(J2) at zero pressure in Pa.
        intercept_per_cohesion: intercept that a Mohr-Coulomb cohesion of 1 Pa gives at this friction angle.
        dilation: volume gained per plastic shear strain; negative where shear makes the soil denser.
        mobilised: share of the slope that shear has mobilised so far. With none of slope a, plastic shear strain costs
            the volume a / (1 + a / sqrt 3) (Rowe 1962, at no stress ratio), with all of it none.
        viscosity: sqrt(J2) beyond the strength per plastic shear rate, Pa s.
        crush_pressure: pressure above which the skeleton gives way and the soil becomes denser, Pa; none when zero.
        crush_hardening: growth of that pressure per volume lost, Pa.
    """

    slope: float
    intercept: float
    intercept_per_cohesion: float
    dilation: float
    mobilised: float
    viscosity: float
    crush_pressure: float
    crush_hardening: float
