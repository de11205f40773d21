"""The estimate from features: least squares in closed form, and a spread that means what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest
from splatsoil.inverse import feature_fit
from splatsoil.inverse.beside import Beside
from splatsoil.inverse.feature_fit import FeatureFit, by_features
from splatsoil.inverse.posterior import Data, likelihood_of
from splatsoil.inverse.surrogate import Surrogate

from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("a", "m", 0.0, 1.0, 0.5),))
POINTS = np.array([-0.9, -0.5, -0.2, 0.0, 0.15, 0.3, 0.6, 0.95])[:, None]
BLOCKS = 300


@pytest.fixture(scope="module")
def surrogate() -> Surrogate:
    """Of some loss: it tells the loss at the estimate, and has no say in where that is."""
    return Surrogate(POINTS, POINTS[:, 0] ** 2)


def data(truth: float, generator: np.random.Generator, *, chance: float = 0.3, wrong: float = 1.0) -> Data:
    """Features c + d x of a model that is off by what no parameter explains."""
    slope, missing = generator.normal(size=(2, BLOCKS))
    slope *= 3.0
    missing -= slope * (slope @ missing) / (slope @ slope)
    noise = chance * generator.normal(size=(len(POINTS), BLOCKS))
    return Data(SPACE, POINTS, slope * (truth - POINTS) + wrong * missing + noise, None, 0.0)


def test_linear_features_give_the_closed_form(surrogate: Surrogate) -> None:
    found = data(0.35, np.random.default_rng(1), chance=0.0)
    # the least squares of residuals that are linear in x, by regression of all of them at once
    design = np.stack([np.ones(len(POINTS)), POINTS[:, 0]], axis=1)
    (constant, gradient), *_ = np.linalg.lstsq(design, found.residuals, rcond=None)
    closed = -float(gradient @ constant) / float(gradient @ gradient)
    assert closed == pytest.approx(0.35, abs=1e-9)
    told = by_features(found, surrogate, surrogate.minimum())
    assert told is not None and told.minimum.estimate[0] == pytest.approx(closed, abs=0.01)


def test_the_spread_is_that_of_repeated_worlds(surrogate: Surrogate) -> None:
    """Over worlds with another chance, errors are as large as they are said to be."""
    errors, stds = [], []
    fallback = surrogate.minimum()
    for seed in range(12):
        generator = np.random.default_rng(seed)
        truth = float(generator.uniform(-0.6, 0.6))
        found = data(truth, generator, chance=3.0, wrong=0.0)
        # the observation has chance of its own, common to all evaluations
        found = replace(found, residuals=found.residuals + 3.0 * generator.normal(size=BLOCKS))
        told = by_features(found, surrogate, fallback, seed=seed)
        assert told is not None
        errors.append(float(told.minimum.estimate[0]) - truth)
        stds.append(float(told.minimum.std[0]))
    ratio = float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stds))))
    assert 0.5 < ratio < 1.7


@pytest.mark.slow
def test_intervals_after_a_few_evaluations_hold_what_they_say(surrogate: Surrogate) -> None:
    """Chance that is itself read off eight evaluations: normal intervals of its size hold too little."""
    errors, narrower = [], []
    for seed in range(50):
        generator = np.random.default_rng([seed, 5])
        truth = float(generator.uniform(-0.6, 0.6))
        found = data(truth, generator, chance=3.0, wrong=0.0)
        found = replace(found, residuals=found.residuals + 3.0 * generator.normal(size=BLOCKS))
        told = by_features(found, surrogate, surrogate.minimum(), seed=seed)
        if told is not None:
            freedom = likelihood_of(found, seed=seed).freedom
            errors.append(abs(float(told.minimum.estimate[0]) - truth) / (1.645 * float(told.minimum.std[0])))
            narrower.append(errors[-1] * (freedom / (freedom - 2.0)) ** 0.5)
    assert len(errors) > 40
    assert 0.8 <= np.mean(np.array(errors) < 1.0) <= 0.98
    assert np.mean(np.array(narrower) < 1.0) < 0.75


def test_features_that_are_chance_leave_the_word_to_the_loss(surrogate: Surrogate) -> None:
    generator = np.random.default_rng(3)
    found = Data(SPACE, POINTS, generator.normal(size=(len(POINTS), BLOCKS)), None, 0.0)
    assert by_features(found, surrogate, surrogate.minimum()) is None


def test_a_minimum_beyond_the_range_is_said_to_lie_on_the_bound(surrogate: Surrogate) -> None:
    told = by_features(data(1.6, np.random.default_rng(4), chance=0.1), surrogate, surrogate.minimum())
    assert told is not None and told.minimum.at_bound == ("upper",) and told.minimum.estimate[0] == pytest.approx(1.0)


VALLEY = ParameterSpace((Parameter("a", "m", 0.0, 1.0, 0.5), Parameter("b", "m", 0.0, 1.0, 0.5)))


def with_force(seed: int, off: float, *, share: float = 2.0) -> tuple[Data, np.ndarray]:
    """Pictures that see little but the sum of two parameters, and a force that sees the first; the truth in [-1, 1].

    The force's numbers are off by what they may be, and together by a multiple of that.
    """
    generator = np.random.default_rng([seed, 8])
    points = generator.uniform(-1.0, 1.0, size=(16, 2))
    truth = generator.uniform(-0.4, 0.4, size=2)
    along, across = generator.normal(size=(2, BLOCKS))
    seen = np.stack([along + 0.03 * across, along - 0.03 * across], axis=1)
    noise = 2.0 * generator.normal(size=(len(points), BLOCKS)) + 2.0 * generator.normal(size=BLOCKS)
    residuals = (truth - points) @ (5.0 * seen).T + noise
    pushes = np.array([[4.0, 0.0], [4.0, 0.0], [3.0, 0.0]]) * share
    own = 0.5 * generator.normal(size=(len(points), 3))
    beside = (truth - points) @ pushes.T + own + generator.normal(size=3) + off * np.array([1.0, 1.0, 0.75])
    return Data(VALLEY, points, residuals, None, 0.0, beside), truth


def told_of(data: Data) -> FeatureFit:
    surrogate = Surrogate(data.points, np.mean(data.residuals**2, axis=1))
    found = by_features(data, surrogate, surrogate.minimum())
    assert found is not None
    return found


def test_a_force_ends_the_valley_that_pictures_leave() -> None:
    off, stds, alone = [], [], []
    for seed in range(6):
        found, truth = with_force(seed, 0.0)
        told = told_of(found)
        assert told.pictures is not None and not told.denied
        off.append(told.minimum.estimate - truth)
        stds.append(told.minimum.std)
        alone.append(told.pictures.estimate - truth)

    def rms(values: list[np.ndarray]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    assert 0.4 < rms([o / s for o, s in zip(off, stds, strict=True)]) < 1.6
    assert rms([o[:1] for o in off]) < 0.5 * rms([o[:1] for o in alone])
    # Three numbers of variance 1 that all see the first parameter, by 8, 8 and 6 of it.
    assert np.mean(stds) == pytest.approx(1.0 / np.sqrt(8.0**2 + 8.0**2 + 6.0**2), rel=0.5)


def test_pictures_that_see_all_are_hardly_bent_by_a_force_that_knows_less(surrogate: Surrogate) -> None:
    clear = data(0.35, np.random.default_rng(1), chance=0.3)
    beside = 0.8 * (0.35 - POINTS) + np.array([[1.5]])
    told = by_features(replace(clear, beside=beside), surrogate, surrogate.minimum())
    assert told is not None and told.pictures is not None
    assert abs(told.minimum.estimate[0] - 0.35) < 3.0 * told.pictures.std[0]
    assert told.minimum.std[0] <= told.pictures.std[0] * 1.001


def test_agreement_is_a_chance() -> None:
    """Of worlds in which nothing is wrong, as many lie below a chance as it says."""
    chances = []
    for seed in range(60):
        generator = np.random.default_rng([seed, 12])
        middle, other = 0.1 * generator.normal(), 0.1 * generator.normal()
        beside = Beside.of(POINTS, 10.0 * (other - POINTS), seed=seed)
        assert beside is not None
        together = feature_fit._together(np.array([middle]), np.array([[100.0]]), beside, POINTS, seed)
        assert together.estimate[0] == pytest.approx(0.5 * (middle + other), abs=0.02)
        chances.append(together.agreement)
    assert kstest(chances, "uniform").pvalue > 0.01


def test_a_force_in_another_unit_is_not_counted() -> None:
    found, _ = with_force(2, 60.0)
    told = told_of(found)
    assert told.denied
    assert told.pictures is not None and np.array_equal(told.minimum.estimate, told.pictures.estimate)


def test_a_posterior_counts_the_force_as_the_fit_does() -> None:
    """Against the normal density in closed form: the force's share of the log likelihood."""
    found, truth = with_force(1, 0.0)
    both, alone = likelihood_of(found), likelihood_of(replace(found, beside=None))
    where = truth + np.array([[0.0, 0.0], [0.2, 0.0], [-0.3, 0.1], [0.0, 0.3]])
    more = np.diff(both.log_likelihood(where) - alone.log_likelihood(where))
    pushes = np.array([[8.0, 0.0], [8.0, 0.0], [6.0, 0.0]])
    assert found.beside is not None
    own = np.mean(found.beside - (truth - found.points) @ pushes.T, axis=0)
    # Of variance 1 by what they may be off, 0.25 by a simulation's chance, and a quarter or so by an emulator's doubt.
    closed = -0.5 * np.sum(((truth - where) @ pushes.T + own) ** 2, axis=1) / 1.5
    assert more == pytest.approx(np.diff(closed), rel=0.3)
