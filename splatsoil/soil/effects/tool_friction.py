"""Tool friction: the Coulomb coefficient between soil and tool differs from the one noted with the experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class ToolFriction(Effect):
    """Replaces the tool's friction coefficient by the noted one plus a change."""

    name = "tool_friction"
    parameters = (
        Parameter(
            "tool_friction_change", "1", -0.3, 0.6, 0.0, off=0.0, meaningful=0.1, label="change of tool friction"
        ),
    )
    note = "Coulomb friction between tool and soil, as a change from the coefficient in experiment.json."
    source = "Coulomb (1785)"

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Add the change to the tool's coefficient; it cannot fall below zero."""
        change = values["tool_friction_change"]
        return replace(settings, tool_friction=max(settings.tool_friction + change, 0.0))
