"""Softening: friction falls from a peak to its residual value as the soil is sheared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import warp as wp

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def softened(strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int) -> Strength:
    """Multiply friction by one plus an excess that decays exponentially with plastic shear strain."""
    result = strength
    excess = values[row, column] * wp.exp(-state.plastic_strain / values[row, column + 1])
    result.slope = strength.slope * (1.0 + excess)
    return result


class Softening(Effect):
    """The friction angle is the residual one; undisturbed soil has ``softening_angle`` more."""

    name = "softening"
    parameters = (
        Parameter(
            "softening_angle",
            "deg",
            0.0,
            15.0,
            0.0,
            off=0.0,
            meaningful=1.0,
            sign=1,
            label="friction angle above residual",
        ),
        Parameter("softening_strain", "1", 0.02, 20.0, 0.3, meaningful=0.1, log=True, label="strain of softening"),
    )
    shapes = ("softening_strain",)
    note = (
        "Undisturbed dense soil is stronger than disturbed soil: friction starts at its peak and decays to the "
        "residual angle with plastic shear strain. Slip bands form; steep faces stand until they move."
    )
    source = "Potts, Dounias & Vaughan (1990), Géotechnique 40(1) (peak to residual over plastic shear strain)"
    strength = softened

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Excess of the slope over the residual one, strain."""
        return settings.relative_slope(values["softening_angle"], "softening_angle"), values["softening_strain"]
