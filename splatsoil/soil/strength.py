"""Types shared by the law and by the effects that change the soil's strength."""

from __future__ import annotations

import warp as wp


@wp.struct
class SoilState:
    """State of the soil at a stress point, as seen by an effect on strength.

    Attributes:
        pressure: mean stress in Pa, positive in compression.
        shear_rate: sqrt(2 dev(D):dev(D)) in 1/s.
        opening: logarithmic volume by which the soil has come apart in tension (>= 0).
    """

    pressure: float
    shear_rate: float
    opening: float


@wp.struct
class Strength:
    """Drucker-Prager strength sqrt(J2) <= intercept + slope * p.

    Attributes:
        slope: friction, sqrt(J2)/p.
        intercept: sqrt(J2) at zero pressure in Pa.
        intercept_per_cohesion: intercept that a Mohr-Coulomb cohesion of 1 Pa gives at this friction angle.
    """

    slope: float
    intercept: float
    intercept_per_cohesion: float
