"""Layering: below a depth the soil is another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import warp as wp

from splatsoil.measurement import Measurement
from splatsoil.parameters import FloatArray, Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength


@wp.func
def layered(strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int) -> Strength:
    """Multiply friction by one plus the layer's excess where the soil came from below the depth."""
    result = strength
    if state.depth > values[row, column + 1]:
        result.slope = strength.slope * (1.0 + values[row, column])
    return result


class Layering(Effect):
    """Friction angle and density that differ by these amounts in soil that was below a depth at the start."""

    name = "layering"
    parameters = (
        Parameter(
            "layer_friction", "deg", -15.0, 15.0, 0.0, off=0.0, meaningful=1.5, label="friction angle of the layer"
        ),
        Parameter("layer_depth", "m", 0.005, 1.0, 0.05, meaningful=0.01, log=True, label="depth of the layer"),
        Parameter(
            "layer_density", "1", 0.7, 1.4, 1.0, off=1.0, meaningful=0.05, label="density of the layer, relative"
        ),
    )
    shapes = ("layer_depth",)
    note = (
        "A firmer or weaker, heavier or lighter layer begins below a depth under the undisturbed surface; its soil "
        "keeps its properties wherever the tool takes it."
    )
    source = "soil profile by definition; Terzaghi, Peck & Mesri (1996), Soil Mechanics in Engineering Practice, ch. 1"
    strength = layered

    def for_measurement(self, measurement: Measurement) -> Effect:
        """The effect with a layer that begins within the bed."""
        return self.bounded({"layer_depth": (self.parameters[1].lower, float(measurement.bed.extents[2]))})

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Excess of the slope over the upper soil's, depth."""
        return settings.relative_slope(values["layer_friction"], "layer_friction"), values["layer_depth"]

    def density(self, depth: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """The layer's relative density below its depth."""
        return np.where(depth > values["layer_depth"], values["layer_density"], 1.0)
