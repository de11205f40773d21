"""The cone against the closed forms of soil mechanics."""

from __future__ import annotations

import math

import pytest

from splatsoil.errors import ParameterError
from splatsoil.soil.matching import Matching, cone_intercept, cone_slope


@pytest.mark.parametrize(
    ("matching", "slope"),
    [
        (Matching.COMPRESSION, 0.819),
        (Matching.EXTENSION, 0.556),
        (Matching.PLANE_STRAIN, 0.574),
        (Matching.SIMPLE_SHEAR, 0.700),
    ],
)
def test_slopes_at_35_degrees(matching: Matching, slope: float) -> None:
    assert cone_slope(35.0, matching) == pytest.approx(slope, abs=6e-4)


@pytest.mark.parametrize("angle", [25.0, 30.0, 35.0, 40.0, 45.0])
@pytest.mark.parametrize("cohesion", [0.0, 300.0])
def test_compression_matching_meets_mohr_coulomb_in_triaxial_compression(angle: float, cohesion: float) -> None:
    """sigma1 = sigma3 N + 2 c sqrt(N) with N = tan^2(45 + phi/2) must lie on the cone."""
    flow = math.tan(math.radians(45.0 + angle / 2.0)) ** 2
    lateral = 1.0e4
    axial = lateral * flow + 2.0 * cohesion * math.sqrt(flow)
    pressure, root_j2 = (axial + 2.0 * lateral) / 3.0, (axial - lateral) / math.sqrt(3.0)
    assert root_j2 == pytest.approx(cone_intercept(angle, cohesion) + cone_slope(angle) * pressure, rel=1e-12)


@pytest.mark.parametrize("angle", [-1.0, 90.0, float("nan")])
def test_meaningless_angles_are_refused(angle: float) -> None:
    with pytest.raises(ParameterError, match="friction angle"):
        cone_slope(angle)
