"""Height fields against planes and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from splatsoil.reconstruction import HeightField


def over(nx: int, ny: int, f) -> HeightField:
    x, y = 0.3 + 0.01 * np.arange(nx), -0.2 + 0.02 * np.arange(ny)
    return HeightField(x, y, f(*np.meshgrid(x, y)))


def test_a_plane_is_sampled_exactly_and_held_constant_beyond():
    plane = over(12, 9, lambda x, y: 0.1 + 0.3 * x - 0.2 * y)
    inside = np.array([[0.337, -0.111], [0.3, -0.2], [0.41, -0.04]])
    np.testing.assert_allclose(plane.sample(inside), 0.1 + 0.3 * inside[:, 0] - 0.2 * inside[:, 1], atol=1e-12)
    np.testing.assert_allclose(plane.sample(np.array([[0.0, -0.1]])), 0.1 + 0.3 * 0.3 + 0.2 * 0.1, atol=1e-12)


def test_the_spline_extends_a_plane_and_keeps_a_crest():
    plane = over(12, 9, lambda x, y: 0.1 + 0.3 * x - 0.2 * y)
    outside = np.array([[0.29, -0.21], [0.42, -0.03]])
    np.testing.assert_allclose(plane.smooth(outside), 0.1 + 0.3 * outside[:, 0] - 0.2 * outside[:, 1], atol=1e-9)
    wave = over(40, 9, lambda x, y: np.sin(2 * np.pi * (x - 0.3) / 0.1))
    crest = np.array([[0.3 + 0.125, -0.1]])
    assert abs(wave.smooth(crest)[0] - 1.0) < 2e-3
    assert wave.sample(crest)[0] < 0.96


def test_rmse_and_bias_against_another_grid():
    fine = over(40, 30, lambda x, y: 0.3 * x)
    coarse = HeightField.over(np.array([0.3, -0.2]), np.array([0.69, 0.38]), 0.05)
    xs, _ = np.meshgrid(coarse.x, coarse.y)
    shifted = HeightField(
        coarse.x, coarse.y, 0.3 * xs + np.where(np.arange(xs.size).reshape(xs.shape) % 2, 0.003, -0.001)
    )
    odd = np.arange(xs.size) % 2 == 1
    expected = np.where(odd, 0.003, -0.001)
    assert shifted.bias(fine) == pytest.approx(expected.mean(), abs=1e-12)
    assert shifted.rmse(fine) == pytest.approx(np.sqrt((expected**2).mean()), abs=1e-12)


def test_cells_fill_the_rectangle_and_unknown_cells_do_not_count():
    field = HeightField.over(np.array([1.0, 2.0, 0.0]), np.array([1.8, 2.5, 0.3]), 0.007, height=0.1)
    assert field.x[0] - field.cell[0] / 2 == pytest.approx(1.0)
    assert field.y[-1] + field.cell[1] / 2 == pytest.approx(2.5)
    holed = field.height.copy()
    holed[3, 4] = np.nan
    other = HeightField(field.x, field.y, holed + 0.002)
    assert other.bias(field) == pytest.approx(0.002)


def test_normals_of_a_slope():
    slope = over(12, 9, lambda x, y: 0.5 * x)
    np.testing.assert_allclose(
        slope.normals, np.broadcast_to(np.array([-0.5, 0, 1]) / 1.25**0.5, (9, 12, 3)), atol=1e-9
    )
