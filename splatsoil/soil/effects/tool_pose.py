"""Tool pose: the tool is seen at an offset from its recorded motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect

_AXES = ("x", "y", "z")


class ToolPose(Effect):
    """Shifts and turns the tool that is drawn, its shadow included; the soil is pushed by the motion as recorded."""

    name = "tool_pose"
    parameters = (
        *(
            Parameter(
                f"tool_{a}", "m", -0.02, 0.02, 0.0, off=0.0, meaningful=0.001, label=f"shift of the tool along {a}"
            )
            for a in _AXES
        ),
        Parameter("tool_turn", "deg", -5.0, 5.0, 0.0, off=0.0, meaningful=0.5, label="turn of the tool"),
    )
    note = (
        "The tool and its shadow are seen shifted (in the world's axes) or turned about the vertical against the "
        "recorded motion. Only the picture changes: the simulated soil is still pushed where the motion says."
    )
    source = "definition"

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Add shift and turn."""
        x, y, z = (old + values[f"tool_{a}"] for old, a in zip(observation.tool_shift, _AXES, strict=True))
        return replace(observation, tool_shift=(x, y, z), tool_turn=observation.tool_turn + values["tool_turn"])
