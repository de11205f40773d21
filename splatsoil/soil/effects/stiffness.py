"""Stiffness: the elastic moduli differ from the preset's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class Stiffness(Effect):
    """Both elastic moduli times a factor; four times the stiffness takes twice the time."""

    name = "stiffness"
    parameters = (
        Parameter("stiffness_factor", "1", 0.1, 20.0, 1.0, off=1.0, meaningful=2.0, log=True, label="stiffness factor"),
    )
    note = (
        "Elastic strain of the soil's skeleton. Dry sand is far stiffer than the presets, whose softness buys long "
        "time steps; what changes with this factor is numerics before it is soil."
    )
    numerical = True
    source = "isotropic elasticity; stiffness of sand: Hardin & Black (1966), J. Soil Mech. Found. Div. 92(2)"

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Multiply the factor."""
        return replace(settings, stiffness=settings.stiffness * values["stiffness_factor"])
