"""Chains on densities whose moments are known."""

from __future__ import annotations

import numpy as np
import pytest
from splatsoil.inverse.mcmc import sample

from splatsoil.errors import RunError

COVARIANCE = np.array([[0.04, 0.03], [0.03, 0.04]])


def bell(points: np.ndarray) -> np.ndarray:
    inside = np.all(np.abs(points) < 1.0, axis=1)
    square = np.einsum("ki,ij,kj->k", points, np.linalg.inv(COVARIANCE), points)
    return np.where(inside, -0.5 * square, -np.inf)


def test_a_bell_is_the_bell_and_the_same_seed_gives_the_same_bits() -> None:
    found = sample(bell, 2, seed=1)
    assert found.converged and np.all(found.r_hat < 1.01)
    np.testing.assert_allclose(np.cov(found.flat.T), COVARIANCE, rtol=0.15)
    np.testing.assert_allclose(found.flat.mean(axis=0), 0.0, atol=0.02)
    assert 0.2 < found.acceptance < 0.8
    again = sample(bell, 2, seed=1)
    assert again.samples.tobytes() == found.samples.tobytes()
    assert sample(bell, 2, seed=2).samples.tobytes() != found.samples.tobytes()


def test_ensembles_that_disagree_are_not_called_converged() -> None:
    def two_peaks(points: np.ndarray) -> np.ndarray:
        """So far apart that no walker crosses, of equal height."""
        x = np.abs(points[:, 0])
        return np.where(x < 1.0, -0.5 * ((x - 0.9) / 0.002) ** 2, -np.inf)

    found = sample(two_peaks, 1, max_steps=400, walkers=4, ensembles=3)
    assert not found.converged and found.steps == 400


def test_ensembles_of_one_middle_and_two_widths_are_not_called_converged() -> None:
    """Of means alone they agree: ranks about the median tell (Vehtari et al. 2021)."""
    from splatsoil.inverse.mcmc import _r_hat

    normal = np.random.default_rng(0).standard_normal((4, 200, 8, 1))
    assert _r_hat(normal)[0] < 1.01
    normal[0] *= 3.0
    assert _r_hat(normal)[0] > 1.05


def test_a_flat_density_fills_the_cube() -> None:
    found = sample(lambda p: np.where(np.abs(p[:, 0]) < 1.0, 0.0, -np.inf), 1, ensembles=2)
    assert found.flat.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.05)


def test_nothing_to_sample() -> None:
    with pytest.raises(RunError, match="zero everywhere"):
        sample(lambda p: np.full(len(p), -np.inf), 1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("beyond", [-2.0, 0.999])
def test_a_density_that_is_no_number_somewhere_is_said_to_be_none_there(value: float, beyond: float) -> None:
    """At the starts, and where walkers come later."""

    def broken(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] > beyond, value, bell(points))

    with pytest.raises(RunError, match=rf"is {value} at \(-?\d.*finite or −∞"):
        sample(broken, 2)
