"""Light: sun and sky differ from those estimated from the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect


class LightChange(Effect):
    """Turns the sun and changes the sky's share; level, open ground keeps its brightness, slopes and shadows change."""

    name = "light"
    parameters = (
        Parameter("sun_azimuth_change", "deg", -20.0, 20.0, 0.0, off=0.0, meaningful=1.0, label="turn of the sun"),
        Parameter("sun_elevation_change", "deg", -15.0, 15.0, 0.0, off=0.0, meaningful=1.0, label="rise of the sun"),
        Parameter("sky_share_change", "1", -0.3, 0.3, 0.0, off=0.0, meaningful=0.02, label="change of the sky's share"),
    )
    note = (
        "The sun stands elsewhere, or the sky gives more of the light, than the photographs of the undisturbed bed let "
        "one estimate; positive azimuth turns the sun from +x towards +y."
    )
    source = "definition; light model in splatsoil.scene.light"

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Add turn, rise and share."""
        return replace(
            observation,
            sun_azimuth=observation.sun_azimuth + values["sun_azimuth_change"],
            sun_elevation=observation.sun_elevation + values["sun_elevation_change"],
            sky_share=observation.sky_share + values["sky_share_change"],
        )
