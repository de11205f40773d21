"""Blur: the video is out of focus, or compressed more than the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect


class Blur(Effect):
    """A Gaussian blur of linear colour. Its influence grows with the square of sigma: a derivative at 0 is 0."""

    name = "blur"
    parameters = (Parameter("blur", "px", 0.0, 5.0, 0.0, off=0.0, meaningful=0.3, sign=1, label="blur of the video"),)
    note = "Lens out of focus: Gaussian blur of the video's linear colour by this standard deviation."
    source = "discrete Gaussian kernel: Lindeberg (1990), IEEE PAMI 12(3), sec. III-C"

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Add the blur's variance to what is there."""
        return replace(observation, blur=(observation.blur**2 + values["blur"] ** 2) ** 0.5)
