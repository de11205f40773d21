"""The Drucker-Prager cone sqrt(J2) <= k + a p of a friction angle and a cohesion (p positive in compression)."""

from __future__ import annotations

import math
from enum import StrEnum

from splatsoil.errors import ParameterError


class Matching(StrEnum):
    """Stress state in which the Drucker-Prager cone agrees with Mohr-Coulomb (Chen & Mizuno 1990, ch. 5)."""

    COMPRESSION = "compression"
    EXTENSION = "extension"
    PLANE_STRAIN = "plane_strain"
    SIMPLE_SHEAR = "simple_shear"


def cone_slope(friction_angle: float, matching: Matching = Matching.COMPRESSION) -> float:
    """Slope a = sqrt(J2) / p of the cone.

    Args:
        friction_angle: Mohr-Coulomb friction angle in degrees, in [0, 90).
        matching: where the cone touches Mohr-Coulomb; plane strain is the non-associated one (zero dilation).

    Raises:
        ParameterError: the angle is outside [0, 90).
    """
    return _factor(friction_angle, matching) * math.sin(math.radians(friction_angle))


def cone_intercept(friction_angle: float, cohesion: float, matching: Matching = Matching.COMPRESSION) -> float:
    """Intercept k of the cone in Pa for a cohesion in Pa; the same factor as the slope, with cos for sin."""
    return _factor(friction_angle, matching) * cohesion * math.cos(math.radians(friction_angle))


def _factor(friction_angle: float, matching: Matching) -> float:
    if not 0.0 <= friction_angle < 90.0:
        raise ParameterError(f"friction angle {friction_angle} deg lies outside [0, 90)")
    sine = math.sin(math.radians(friction_angle))
    if matching is Matching.COMPRESSION:
        return 2.0 * math.sqrt(3.0) / (3.0 - sine)
    if matching is Matching.EXTENSION:
        return 2.0 * math.sqrt(3.0) / (3.0 + sine)
    if matching is Matching.PLANE_STRAIN:
        return 1.0
    return 1.0 / math.cos(math.radians(friction_angle))
