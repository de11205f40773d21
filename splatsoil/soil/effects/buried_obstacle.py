"""Buried obstacle: a fixed stone beneath the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from splatsoil.measurement import Measurement
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class BuriedObstacle(Effect):
    """A fixed, rough sphere in the bed; smaller than a grid cell it is not seen by the solver."""

    name = "buried_obstacle"
    parameters = (
        Parameter(
            "obstacle_radius", "m", 0.0, 0.2, 0.0, off=0.0, meaningful=0.02, sign=1, label="radius of the obstacle"
        ),
        Parameter("obstacle_x", "m", -1.0, 1.0, 0.0, meaningful=0.02, label="obstacle, x from the middle"),
        Parameter("obstacle_y", "m", -1.0, 1.0, 0.0, meaningful=0.02, label="obstacle, y from the middle"),
        Parameter("obstacle_height", "m", -0.2, 1.0, 0.04, meaningful=0.01, label="obstacle, height above the floor"),
    )
    shapes = ("obstacle_x", "obstacle_y")
    note = (
        "A stone or root that the tool's bow wave meets: a sphere that does not move and to which soil sticks, placed "
        "from the middle of the bed and its floor. The tool itself passes through it."
    )
    source = "rigid inclusion by definition"

    def for_measurement(self, measurement: Measurement) -> Effect:
        """The effect with a place that lies within the bed."""
        half = (0.5 * measurement.bed.extents[:2]).tolist()
        return self.bounded({name: (-h, h) for name, h in zip(self.shapes, half, strict=True)})

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Place the sphere."""
        names = ("obstacle_x", "obstacle_y", "obstacle_height", "obstacle_radius")
        x, y, height, radius = (values[n] for n in names)
        return replace(settings, obstacle=(x, y, height, radius))
