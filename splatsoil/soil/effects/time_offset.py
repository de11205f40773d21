"""Time offset: the clocks of video and tool motion disagree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect


class TimeOffset(Effect):
    """Pictures show soil and tool a little later (or earlier) than their frame number says."""

    name = "time_offset"
    parameters = (
        Parameter("time_offset", "s", -0.04, 0.04, 0.0, off=0.0, meaningful=0.002, label="time offset of the video"),
    )
    note = (
        "The video runs late against the tool's motion: a picture shows the moment this much after its frame number. "
        "Between simulated frames, soil is interpolated linearly and the tool as its motion says."
    )
    source = "definition"

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Add the offset."""
        return replace(observation, time_offset=observation.time_offset + values["time_offset"])
