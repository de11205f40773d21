"""Parameters and the maps between dictionaries, vectors and the unit cube."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from splatsoil.errors import ParameterError
from splatsoil.parameters import Parameter, ParameterSpace

ANGLE = Parameter("friction_angle", "deg", 20.0, 50.0, 34.0, meaningful=1.0)
COHESION = Parameter("cohesion", "Pa", 1.0, 10_000.0, 100.0, off=0.0, log=True)
RATIO = Parameter("ratio", "1", -1.0, 1.0, 0.0, label="some ratio")
SPACE = ParameterSpace([ANGLE, COHESION, RATIO])


def test_unit_cube_by_hand() -> None:
    """-1 and 1 are the bounds, 0 the middle: arithmetic on a linear scale, geometric on a logarithmic one."""
    np.testing.assert_allclose(SPACE.from_unit([-1, -1, -1]), [20, 1, -1])
    np.testing.assert_allclose(SPACE.from_unit([0, 0, 0]), [35, 100, 0])
    np.testing.assert_allclose(SPACE.from_unit([1, 1, 1]), [50, 10_000, 1])
    np.testing.assert_allclose(SPACE.to_unit([42.5, 10.0, 0.25]), [0.5, -0.5, 0.25])


def test_there_and_back() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (4, 5, 3))
    physical = SPACE.from_unit(points)
    assert physical.shape == points.shape
    np.testing.assert_allclose(SPACE.to_unit(physical), points, atol=1e-12)
    for vector in physical.reshape(-1, 3):
        np.testing.assert_allclose(SPACE.to_vector(SPACE.to_dict(vector)), vector)


def test_points_outside_the_cube_are_clipped_to_it() -> None:
    np.testing.assert_allclose(SPACE.from_unit([-3, 7, 1.0 + 1e-9]), [20, 10_000, 1])
    upper = SPACE.from_unit([1, 1, 1])
    assert SPACE.to_dict(upper) == {"friction_angle": 50.0, "cohesion": 10_000.0, "ratio": 1.0}, "no rounding outside"


def test_dictionaries() -> None:
    assert SPACE.names == ("friction_angle", "cohesion", "ratio") and len(SPACE) == 3
    assert [p.name for p in SPACE] == list(SPACE.names)
    values = {"ratio": 0.5, "friction_angle": 30, "cohesion": 7.0, "other": 3.0}
    np.testing.assert_array_equal(SPACE.to_vector(values), [30, 7, 0.5])
    with pytest.raises(ParameterError, match="no value given for cohesion"):
        SPACE.to_vector({"friction_angle": 30.0, "ratio": 0.0})
    with pytest.raises(ParameterError, match=r"expected 3 values .* got 2"):
        SPACE.to_dict([1.0, 2.0])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 19.9, 50.1])
def test_values_out_of_bounds_or_not_finite_are_refused(value: float) -> None:
    with pytest.raises(ParameterError, match="friction_angle"):
        ANGLE.check(value)
    with pytest.raises(ParameterError, match="friction_angle"):
        SPACE.to_vector({"friction_angle": value, "cohesion": 1.0, "ratio": 0.0})


def test_rounding_at_a_bound_is_forgiven() -> None:
    assert ANGLE.check(50.0 + 1e-12) == 50.0
    assert ANGLE.check(np.float32(20.0)) == 20.0


def test_parameters_that_make_no_sense_are_refused() -> None:
    for change, says in (
        ({"lower": 60.0}, "not an interval"),
        ({"upper": math.inf}, "not an interval"),
        ({"default": 19.0}, "lies outside"),
        ({"lower": -1.0, "log": True}, "positive lower bound"),
    ):
        with pytest.raises(ParameterError, match=says):
            replace(ANGLE, **change)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="at least one"):
        ParameterSpace([])
    with pytest.raises(ParameterError, match="repeat"):
        ParameterSpace([ANGLE, ANGLE])
