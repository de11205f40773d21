"""Illumination by sun and sky.

Gaussians carry albedo, in units of the colour of level, open, sunlit soil. Linear radiance is albedo times irradiance,

    E = ambient · V_sky + (1 − ambient) · max(n·l, 0)/l_z · V_sun + R      (per channel)

with n the surface's normal and l the direction to the sun. V_sky is the visible share of a uniform sky, weighted by the
cosine, V_sun the visible share of the sun, and R the interreflection from soil and tool. E is 1 on level ground, so
that exposure and white balance are part of the albedo. All of this is in linear colour; sums in sRGB would be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError
from splatsoil.scene import kernels

SOIL_REFLECTANCE = 0.4
"""Reflectance of dry sand (0.35 to 0.45 in the visible), for interreflection.

Photographs without a calibration target do not tell it; interreflection is a tenth of the irradiance in a deep trench.
"""

_TOOL_LIGHT = 0.5
"""Irradiance on the side of the tool that a shaded point sees, over that of level ground."""


@dataclass(frozen=True)
class Light:
    """Sun and sky over a scene.

    Attributes:
        direction: unit vector (3,) towards the sun, world frame, z > 0.
        ambient: (3,) share of the light on level, open ground that comes from the sky; red, green, blue.
        level: (3,) linear colour that level, open, sunlit soil shows on average; the exposure is in it.
    """

    direction: FloatArray
    ambient: FloatArray
    level: FloatArray = field(default_factory=lambda: np.full(3, SOIL_REFLECTANCE))

    def __post_init__(self) -> None:
        direction = np.array(self.direction, dtype=np.float64).reshape(3)
        ambient = np.broadcast_to(np.asarray(self.ambient, dtype=np.float64), (3,)).copy()
        level = np.broadcast_to(np.asarray(self.level, dtype=np.float64), (3,)).copy()
        length = float(np.linalg.norm(direction))
        if not length > 0.0 or not direction[2] / length > 1e-3:
            raise ParameterError(f"the sun must stand above the horizon; its direction is {direction.tolist()}")
        if not np.all((ambient >= 0.0) & (ambient <= 1.0)):
            raise ParameterError(f"ambient shares lie between 0 and 1, not {ambient.tolist()}")
        if not np.all(level > 0.0):
            raise ParameterError(f"the level soil's colour must be positive, not {level.tolist()}")
        if abs(length - 1.0) > 1e-12:  # one that is normalised already keeps its bits
            direction /= length
        for name, value in (("direction", direction), ("ambient", ambient), ("level", level)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def from_angles(cls, azimuth: float, elevation: float, ambient: npt.ArrayLike, **options: Any) -> Light:
        """A light from the sun's azimuth (degrees from +x towards +y) and elevation (degrees above the horizon)."""
        return cls(np.array(towards(azimuth, elevation)), np.asarray(ambient, dtype=np.float64), **options)

    @property
    def azimuth(self) -> float:
        """Degrees from +x towards +y."""
        return math.degrees(math.atan2(self.direction[1], self.direction[0]))

    @property
    def elevation(self) -> float:
        """Degrees above the horizon."""
        return math.degrees(math.asin(min(1.0, float(self.direction[2]))))

    def changed(self, azimuth: float = 0.0, elevation: float = 0.0, ambient: float = 0.0) -> Light:
        """The light with its sun turned and raised, degrees, and another sky's share; held where the sun stands 1 to 90
        degrees above the horizon and shares lie in [0, 1]."""
        return Light.from_angles(
            self.azimuth + azimuth,
            min(max(self.elevation + elevation, 1.0), 90.0),
            np.clip(self.ambient + ambient, 0.0, 1.0),
            level=self.level,
        )

    def reflectance(self, colour: npt.ArrayLike) -> FloatArray:
        """Reflectance (3,) of a surface of a linear colour, seen in sun and sky as ``level`` is."""
        return SOIL_REFLECTANCE * np.asarray(colour, dtype=np.float64) / float(self.level.mean())

    def kernel_form(self, tool: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Any:
        """This in the kernels' form, with the tool's linear colour (3,)."""
        out = kernels.Illumination()
        out.sun, out.ambient = wp.vec3(*self.direction), wp.vec3(*self.ambient)
        out.ground, out.side = wp.vec3(*self.reflectance(self.level)), wp.vec3(*self.tool_radiosity(tool))
        out.tool = wp.vec3(*np.asarray(tool, dtype=np.float64))
        return out

    def tool_radiosity(self, tool: npt.ArrayLike) -> FloatArray:
        """Radiosity (3,) of the side of a tool of this linear colour that a shaded point sees."""
        return _TOOL_LIGHT * self.reflectance(tool)


def towards(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """Unit vector of an azimuth (degrees from +x towards +y) and an elevation (degrees above the horizon)."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)


def linear(srgb: Tensor) -> Tensor:
    """sRGB values in [0, 1] to linear ones (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(colour: Tensor) -> Tensor:
    """Linear values, not negative, to sRGB; values above 1 stay above 1."""
    return torch.where(colour <= 0.0031308, colour * 12.92, 1.055 * colour.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
