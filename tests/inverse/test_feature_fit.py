"""The estimate from features: least squares in closed form, and a spread that means what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatsoil.inverse.feature_fit import by_features
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
    assert told is not None and told.estimate[0] == pytest.approx(closed, abs=0.01)


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
        errors.append(float(told.estimate[0]) - truth)
        stds.append(float(told.std[0]))
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
            errors.append(abs(float(told.estimate[0]) - truth) / (1.645 * float(told.std[0])))
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
    assert told is not None and told.at_bound == ("upper",) and told.estimate[0] == pytest.approx(1.0)
