"""Settings of one simulation, which effects may change."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatsoil.errors import CombinationError, ParameterError
from splatsoil.parameters import Parameter
from splatsoil.soil.matching import Matching, cone_slope

FRICTION_ANGLE = Parameter(
    name="friction_angle",
    unit="deg",
    lower=20.0,
    upper=50.0,
    default=35.0,
    meaningful=1.0,
    label="friction angle",
    limits=(20.0, 55.0),
)


@dataclass(frozen=True)
class Settings:
    """Numbers of one simulation that effects may change.

    Attributes:
        friction_angle: Mohr-Coulomb friction angle in degrees.
        matching: stress state in which the Drucker-Prager cone agrees with Mohr-Coulomb.
        gravity: acceleration (3,) in m/s^2.
        tool_friction: Coulomb coefficient between soil and tool.
        wall_friction: Coulomb coefficient at the bed's side walls.
        floor_friction: Coulomb coefficient at the bed's floor.
        stiffness: factor on the elastic moduli.
        tool_adhesion: shear stress between soil and tool that needs no pressure, Pa.
        obstacle: a fixed sphere: x and y of its centre from the middle of the bed, height above the floor, radius, m.
    """

    friction_angle: float
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    tool_friction: float = 0.3
    wall_friction: float = 0.0
    floor_friction: float = 0.6
    matching: Matching = Matching.COMPRESSION
    stiffness: float = 1.0
    tool_adhesion: float = 0.0
    obstacle: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        FRICTION_ANGLE.check(self.friction_angle)
        for name in ("tool_friction", "wall_friction", "floor_friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ParameterError(f"{name}: {value} is not a friction coefficient; give a number >= 0")
        if not (math.isfinite(self.tool_adhesion) and self.tool_adhesion >= 0.0):
            raise ParameterError(f"tool_adhesion: {self.tool_adhesion} is not a shear stress in Pa; give a number >= 0")
        if not (math.isfinite(self.stiffness) and self.stiffness > 0.0):
            raise ParameterError(f"stiffness: {self.stiffness} is not a positive factor")
        if not (all(math.isfinite(v) for v in self.obstacle) and self.obstacle[3] >= 0.0):
            raise ParameterError(f"obstacle: {self.obstacle} is not a centre and a radius in m")
        if not all(math.isfinite(g) for g in self.gravity):
            raise ParameterError(f"gravity: {self.gravity} is not finite")

    def relative_slope(self, change: float, name: str) -> float:
        """Growth of the cone's slope, relative to its own, when the friction angle changes by ``change`` degrees.

        Raises:
            CombinationError: the changed angle is outside [0, 90); ``name`` is the parameter to blame.
        """
        angle = self.friction_angle + change
        if not 0.0 <= angle < 90.0:
            raise CombinationError(
                f"{name}: {change:g} deg on top of a friction angle of {self.friction_angle:g} deg gives {angle:g} "
                "deg, outside [0, 90); take a smaller change"
            )
        return cone_slope(angle, self.matching) / cone_slope(self.friction_angle, self.matching) - 1.0
