"""Tilt: the ground is not level, so gravity leans in the bed's frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from scipy.spatial.transform import Rotation

from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings


class Tilt(Effect):
    """Ground that falls towards +x (and +y) by these angles: gravity turns about y, then about x."""

    name = "tilt"
    parameters = (
        Parameter("tilt_x", "deg", -15.0, 15.0, 0.0, off=0.0, meaningful=1.0, label="slope falling towards +x"),
        Parameter("tilt_y", "deg", -15.0, 15.0, 0.0, off=0.0, meaningful=1.0, label="slope falling towards +y"),
    )
    note = (
        "The bed or the cameras' idea of level is tilted: gravity has a part along the ground, and soil moves downhill."
    )
    source = "statics of a rotated frame"

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Turn gravity."""
        turn = Rotation.from_euler("yx", [-values["tilt_x"], values["tilt_y"]], degrees=True)
        x, y, z = (float(g) for g in turn.apply(settings.gravity))
        return replace(settings, gravity=(x, y, z))
