"""Exposure: the video is brighter or darker than the photographs, drifts, or holds stray light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect


class Exposure(Effect):
    """Linear colour times gain · exp(drift · time), plus an offset; the same for all cameras and channels."""

    name = "exposure"
    parameters = (
        Parameter("exposure_gain", "1", 0.5, 2.0, 1.0, off=1.0, meaningful=0.02, log=True, label="exposure gain"),
        Parameter("exposure_drift", "1/s", -0.2, 0.2, 0.0, off=0.0, meaningful=0.005, label="drift of log exposure"),
        Parameter("exposure_offset", "1", -0.05, 0.05, 0.0, off=0.0, meaningful=0.002, label="stray light"),
    )
    note = (
        "Exposure time, aperture or lamps changed (gain on linear colour, not on sRGB values), change during the video "
        "(drift from time 0 on), or light strays into the lens (offset, of linear white)."
    )
    source = "radiometric camera model: Szeliski (2022), Computer Vision, sec. 2.3; sRGB: IEC 61966-2-1"

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Multiply the gain, add drift and offset."""
        return replace(
            observation,
            gain=observation.gain * values["exposure_gain"],
            drift=observation.drift + values["exposure_drift"],
            offset=observation.offset + values["exposure_offset"],
        )
