"""Gravity: another planet, a drop tower, or a centrifuge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class Gravity(Effect):
    """Gravity times a factor; the Moon has 0.165, Mars 0.379."""

    name = "gravity"
    parameters = (
        Parameter("gravity_factor", "1", 0.05, 5.0, 1.0, off=1.0, meaningful=0.1, log=True, label="gravity over g"),
    )
    note = (
        "Weight of soil changes with gravity. Slow flow of dry, cohesionless soil looks the same under any gravity; "
        "forces, cohesion and rate effects do not."
    )
    source = "dimensional analysis; Slonaker et al. (2017), Phys. Rev. E 95, 052901 (intrusion under other gravity)"

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Multiply gravity."""
        x, y, z = (values["gravity_factor"] * g for g in settings.gravity)
        return replace(settings, gravity=(x, y, z))
