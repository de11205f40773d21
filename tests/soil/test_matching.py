"""The cone against the closed forms of soil mechanics."""

from __future__ import annotations

import pytest

from splatsoil.errors import ParameterError
from splatsoil.soil.matching import Matching, cone_slope


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


@pytest.mark.parametrize("angle", [-1.0, 90.0, float("nan")])
def test_meaningless_angles_are_refused(angle: float) -> None:
    with pytest.raises(ParameterError, match="friction angle"):
        cone_slope(angle)
