"""Tool adhesion: soil clings to the tool, whatever the pressure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class ToolAdhesion(Effect):
    """Shear stress c_a between tool and soil in contact, beside Coulomb friction; it does not pull."""

    name = "tool_adhesion"
    parameters = (Parameter("tool_adhesion", "Pa", 0.0, 2000.0, 0.0, off=0.0, meaningful=50.0, sign=1),)
    note = (
        "Damp or clayey soil clings to metal: sliding along the tool takes a shear stress even without pressure. It "
        "acts along the surface only; soil that leaves the tool is not held back."
    )
    source = "Reece (1964), Proc. Inst. Mech. Eng. 179(3F), term c_a; McKyes (1985), Soil Cutting and Tillage, ch. 2"

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Add the adhesion."""
        return replace(settings, tool_adhesion=settings.tool_adhesion + values["tool_adhesion"])
