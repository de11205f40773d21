"""Gauss-Newton with few simulations against SciPy's least squares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from splatsoil.inverse.criticism.refit import Refit, mended, refit

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter

PARAMETERS = (Parameter("a", "1", 0.0, 10.0, 2.0), Parameter("b", "1", -5.0, 5.0, 0.0))
PLACES = np.linspace(0.0, 1.0, 24).reshape(6, 4)


def model(values: Mapping[str, float]) -> np.ndarray:
    return values["a"] * np.exp(-2.0 * PLACES) + np.sin(values["b"]) * PLACES + 0.05 * values["a"] ** 2 * PLACES**2


def start_of(values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    middle = model(values)
    slopes = [(model({**values, n: values[n] + 0.1}) - middle) / 0.1 for n in ("a", "b")]
    return middle, np.stack(slopes, axis=-1)


def white(table: np.ndarray) -> np.ndarray:
    """By an error of 0.05."""
    return table.reshape(PLACES.size, -1).squeeze() / 0.05


def refitted(
    predict: Callable[[Mapping[str, float]], np.ndarray], observed: np.ndarray, start: Mapping[str, float], **how: Any
) -> Refit:
    """From a start whose derivatives are known."""
    middle, slopes = start_of(start)
    return refit(predict, white, observed, PARAMETERS, start, middle, slopes, **{"chance": False, **how})


def test_it_ends_where_least_squares_does() -> None:
    observed = model({"a": 7.0, "b": 1.0}) + 0.05 * np.random.default_rng(0).normal(size=PLACES.shape)
    start = {"a": 2.0, "b": 0.0}
    found = refitted(model, observed, start, most=12)
    oracle = least_squares(lambda p: ((model({"a": p[0], "b": p[1]}) - observed) / 0.05).ravel(), [2.0, 0.0])
    assert found.chi2 == pytest.approx(2.0 * oracle.cost, rel=0.05)
    assert found.values["a"] == pytest.approx(oracle.x[0], abs=0.1)
    assert found.simulations <= 12
    assert np.array_equal(found.prediction, model(found.values))


@pytest.mark.parametrize(("least", "ended"), [(1e9, True), (3.0, True), (-np.inf, False)])
def test_steps_end_once_two_in_a_row_bring_too_little(least: float, ended: bool) -> None:
    """Each simulation has a chance of its own, half as large as what is weighed by."""
    generator = np.random.default_rng(0)
    observed = model({"a": 7.0, "b": 1.0})
    start = {"a": 2.0, "b": 0.0}
    left = [np.sum(white(observed - model(start)) ** 2)]

    def chancy(values: Mapping[str, float]) -> np.ndarray:
        table = model(values) + 0.025 * generator.normal(size=PLACES.shape)
        left.append(np.sum(white(observed - table) ** 2))
        return table

    found = refitted(chancy, observed, start, chance=True, most=8, least=least)
    best = np.minimum.accumulate(left)
    assert found.chi2 == best[-1]
    brought = (best[:-1] - np.array(left[1:])) / np.maximum(1.0, best[1:] / (PLACES.size - 2))
    idle = brought < least
    twice = np.flatnonzero(idle[1:] & idle[:-1]).tolist()
    assert twice == ([len(brought) - 2] if ended else [])
    if least == 3.0:
        assert 2 < found.simulations < 8
        assert found.chi2 < 0.01 * left[0], "what goes well goes on"


def test_bounds_hold_and_failed_simulations_only_cost() -> None:
    observed = model({"a": 14.0, "b": 0.0})

    def brittle(values: Mapping[str, float]) -> np.ndarray:
        if values["a"] > 9.99:
            raise SimulationError("blew up")
        return model(values)

    start = {"a": 6.0, "b": 0.0}
    found = refitted(brittle, observed, start, most=6)
    assert 6.0 < found.values["a"] < 9.99
    assert found.chi2 < np.sum(white(observed - model(start)) ** 2)


def test_a_long_step_tells_the_slope_and_a_short_one_hardly_anything() -> None:
    generator = np.random.default_rng(1)
    slopes, change = generator.normal(size=(3, 2, 2)), generator.normal(size=(3, 2))
    widths = np.array([0.1, 0.2])
    long, short = np.array([5.0, 0.0]), np.array([1e-4, 0.0])
    fresh = mended(slopes, change, long, widths, chance=True)
    assert np.allclose(fresh @ long, change, atol=0.01)
    assert np.array_equal(fresh[..., 1], slopes[..., 1])
    exact = mended(slopes, change, short, widths, chance=False)
    assert np.allclose(exact @ short, change), "without chance the last step tells"
    assert np.allclose(mended(slopes, slopes @ short + 0.01, short, widths, chance=True), slopes, atol=2e-4)


def test_slopes_from_two_steps_with_noise_are_the_weighted_mean_of_both() -> None:
    """Against the least squares of a line through the middle that both differences were taken from."""
    widths, moved, first, second = 0.3, 0.2, 0.7, 0.5
    told, wide = np.array([moved]), np.array([widths])
    ours = mended(np.full((1, 1, 1), first / widths), np.full((1, 1), second), told, wide, chance=True)
    line = np.linalg.lstsq(np.array([[widths], [moved]]), np.array([first, second]), rcond=None)[0]
    assert ours.item() == pytest.approx(line.item())
