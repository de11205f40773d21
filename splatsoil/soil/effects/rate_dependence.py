"""Rate dependence: friction grows with the inertial number, the mu(I) law of dense granular flow."""

from __future__ import annotations

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def rate_strength(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Multiply friction by 1 + r / (1 + I0 / I), with I = shear rate * d / sqrt(p / rho_s)."""
    result = strength
    # (I / I0)^2 p, so that pressure zero needs no division: friction is at its greatest there
    flow = state.shear_rate * values[row, column + 2] / values[row, column + 1]
    inertia = wp.sqrt(values[row, column + 3]) * flow
    root = wp.sqrt(wp.max(state.pressure, 0.0))
    result.slope = strength.slope * (1.0 + values[row, column] * inertia / wp.max(inertia + root, 1.0e-12))
    return result


class RateDependence(Effect):
    """Friction from mu_s at rest to mu_2 = mu_s (1 + r) in fast flow; glass beads: r = 0.69, I0 = 0.279."""

    name = "rate_dependence"
    parameters = (
        Parameter("rate_gain", "1", 0.0, 2.0, 0.0, off=0.0, meaningful=0.1, sign=1, label="gain of friction by rate"),
        Parameter("rate_inertial_number", "1", 0.01, 1.0, 0.279, meaningful=0.05, log=True, label="inertial number I0"),
        Parameter("rate_grain_size", "m", 1e-5, 2e-2, 1e-3, meaningful=2e-4, log=True, label="grain diameter"),
        Parameter("rate_grain_density", "kg/m^3", 1000.0, 5000.0, 2500.0, meaningful=100.0, label="grain density"),
    )
    shapes = ("rate_inertial_number",)
    note = (
        "Grains that are sheared fast for the pressure on them collide more: friction rises from its value at rest to "
        "a second one in fast flow, as the inertial number says."
    )
    source = "Jop, Forterre & Pouliquen (2006), Nature 441, eq. 2; constants of glass beads there"
    strength = rate_strength
