"""The likelihood: Student's t by SciPy, and intervals after a handful of evaluations that hold what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t
from splatsoil.inverse.emulator import Emulator
from splatsoil.inverse.likelihood import Likelihood

GRID = np.linspace(-1.0, 1.0, 2001)[:, None]


@pytest.fixture(scope="module")
def likelihood() -> Likelihood:
    """Two components in two parameters, few points, and an observation."""
    generator = np.random.default_rng(2)
    points = generator.uniform(-1.0, 1.0, (14, 2))
    features = points @ generator.normal(size=(2, 30)) + 0.2 * generator.normal(size=(14, 30))
    return Likelihood(Emulator(points, features), 0.3 * generator.normal(size=30), 0.01)


def test_it_is_students_t(likelihood: Likelihood) -> None:
    where = np.random.default_rng(3).uniform(-1.0, 1.0, (20, 2))
    mean, scale = likelihood.covariance(where)
    expected = [
        multivariate_t(m, s, likelihood.freedom).logpdf(likelihood.scores) for m, s in zip(mean, scale, strict=True)
    ]
    np.testing.assert_allclose(likelihood.log_likelihood(where), expected, rtol=1e-9)
    # two parameters and a mean are taken from fourteen evaluations at least
    assert 3.0 <= likelihood.freedom <= 11.0


@pytest.mark.slow
def test_intervals_after_a_few_evaluations_hold_what_they_say() -> None:
    """Eight evaluations of hundreds of features, most of whose variance is chance; the observation has chance of its
    own. Intervals as if chance were known hold less, and estimates lean towards neither end nor middle."""
    told, narrower, truths, found = [], [], [], []
    points = np.array([-0.9, -0.5, -0.2, 0.0, 0.15, 0.3, 0.6, 0.95])[:, None]
    for seed in range(100):
        generator = np.random.default_rng([seed, 5])
        slope = generator.normal(size=300)
        truth = float(generator.uniform(-0.6, 0.6))
        features, (observed,) = (
            x * slope + generator.normal(size=(len(x), 300)) for x in (points, np.array([[truth]]))
        )
        likelihood = Likelihood(Emulator(points, features, seed=seed), observed)
        mean, scale = likelihood.covariance(GRID)
        normal = [multivariate_normal(m, s).logpdf(likelihood.scores) for m, s in zip(mean, scale, strict=True)]
        told.append(holds(likelihood(GRID), truth))
        narrower.append(holds(np.array(normal), truth))
        truths.append(truth)
        found.append(np.average(GRID[:, 0], weights=np.exp(likelihood(GRID))))
    assert 0.83 <= np.mean(told) <= 0.97
    assert np.mean(narrower) < np.mean(told)
    # Of 100, the slope scatters by 0.03; without shrinking the evaluations' scores it is 0.7.
    assert np.polyfit(truths, found, 1)[0] == pytest.approx(1.0, abs=0.09)
    assert np.std(np.subtract(found, truths)) < 0.105


def holds(logs: np.ndarray, truth: float) -> bool:
    """Whether the central 90 % of a density on the grid hold the truth."""
    share = np.cumsum(np.exp(logs - logs.max()))
    low, high = np.interp([0.05, 0.95], share / share[-1], GRID[:, 0])
    return bool(low <= truth <= high)


def test_of_many_evaluations_it_is_the_normal() -> None:
    generator = np.random.default_rng(4)
    points = generator.uniform(-1.0, 1.0, (120, 1))
    slope = generator.normal(size=20)
    features, (observed,) = (x * slope + 0.3 * generator.normal(size=(len(x), 20)) for x in (points, np.zeros((1, 1))))
    likelihood = Likelihood(Emulator(points, features), observed)
    assert likelihood.freedom > 100.0
    where = np.linspace(-0.2, 0.2, 9)[:, None]
    mean, scale = likelihood.covariance(where)
    normal = [multivariate_normal(m, s).logpdf(likelihood.scores) for m, s in zip(mean, scale, strict=True)]
    told = likelihood.log_likelihood(where)
    np.testing.assert_allclose(told - told.max(), np.array(normal) - np.max(normal), rtol=0.1, atol=0.05)
