"""Evidence against closed forms, emulators against what they emulate, noise against what it was drawn from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from splatsoil.inverse.criticism.checks import Expected, checks, passes
from splatsoil.inverse.criticism.design import MAX_SIZE, Prior, effect_runs, sizes
from splatsoil.inverse.criticism.diagnosis import diagnose
from splatsoil.inverse.criticism.emulator import BaseEmulator, IncrementEmulator
from splatsoil.inverse.criticism.evidence import Comparison
from splatsoil.inverse.criticism.noise import FACTORS, Noise, moderated, shrunk, trend_of

from splatsoil.experiment.base import Candidate, Run
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.parameters import Parameter, ParameterSpace

Make = Callable[..., EmulatedExperiment]
ANGLE = Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)


def linear_noise(slope: np.ndarray, observed: np.ndarray, points: np.ndarray) -> Noise:
    """Scores that grow with the one parameter, with unit noise and a discretisation error of the same size."""
    p = len(slope)
    return Noise(
        np.ones((1, p), dtype=bool),
        np.zeros(p),
        np.eye(p),
        observed,
        np.zeros(p),
        points * slope,
        points,
        1e-6 * np.eye(p),
        np.eye(p),
        np.eye(p),
        np.array([True, False]),
        0.5,
        0.5,
        {},
        np.zeros((len(points), len(points))),
    )


def test_evidence_is_the_integral_of_the_likelihood() -> None:
    slope, observed = np.array([3.0, -2.0]), np.array([1.0, 0.5])
    points = np.linspace(-1.0, 1.0, 12)[:, None]
    noise = linear_noise(slope, observed, points)
    prior = Prior(ParameterSpace([ANGLE]))
    found = Comparison.of(noise, prior, (), {}).evidence()
    grid = np.linspace(-1.0, 1.0, 2001)
    weights = np.exp(noise.log_prior)
    likelihood = np.array(
        [
            sum(
                w * multivariate_normal.pdf(observed, x * slope, np.diag(1.0 + f**2))
                for w, f in zip(weights, FACTORS, strict=True)
            )
            for x in grid
        ]
    )
    # The likelihood's constant is left out.
    wanted = np.log(likelihood.mean()) + np.log(2.0 * np.pi)
    base = found.models[""]
    whitening = 0.5 * np.log(np.linalg.det(noise.covariance(np.ones(2))))
    assert base.log_evidence - whitening == pytest.approx(wanted, abs=0.05)
    # In "something else" one of the factors at least is beyond two standard deviations, in both kinds or in one.
    weights = np.exp(noise.log_prior_discrepancy)
    assert weights.sum() == pytest.approx(1.0)
    assert np.array_equal(weights > 0.0, (np.log(FACTORS) >= 0.999 * 2.0 * noise.factor_std).any(axis=1))
    unit = grid @ likelihood / likelihood.sum()
    # Points are draws: a twentieth of the posterior's standard deviation.
    mean, std = base.moments("friction_angle")
    assert mean == pytest.approx(35.0 + 15.0 * unit, abs=0.05 * std)


def test_the_base_emulator_follows_curves_within_what_it_says() -> None:
    rng = np.random.default_rng(0)
    points, where = np.linspace(-0.95, 0.95, 14)[:, None], np.linspace(-0.9, 0.9, 40)[:, None]

    def truth(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.sin(2.0 * x), 4.0 * x**2, np.exp(x)], axis=1)

    z, spread = [], []
    for _ in range(20):
        scores = truth(points) + 0.1 * rng.standard_normal((14, 3))
        mean, variance = BaseEmulator.through(points, scores, np.full(3, 0.01)).predict(where)
        z.append((mean - truth(where)) / np.sqrt(variance))
        spread.append(variance.max())
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert max(spread) < 0.1**2


def test_an_increment_vanishes_with_its_size_and_is_found_where_it_was_simulated() -> None:
    rng = np.random.default_rng(1)
    angle, size = rng.uniform(-1.0, 1.0, (10, 1)), rng.uniform(1.0, 16.0, (10, 1))
    shape = np.zeros((10, 0))
    values = np.concatenate([0.5 * size * (1.0 + 0.3 * angle), 0.0 * size], axis=1)
    noise = np.full((10, 2), 0.04)
    emulator = IncrementEmulator.through((angle, size, shape), values + 0.2 * rng.standard_normal((10, 2)), noise)
    nothing, doubt = emulator.predict((angle, np.zeros((10, 1)), shape))
    assert np.allclose(nothing, 0.0) and np.allclose(doubt, 0.0)
    mean, variance = emulator.predict((angle, size, shape))
    assert np.all(np.abs(mean - values) < 4.0 * np.sqrt(variance + 0.04))


def test_a_trend_is_cubic_in_one_parameter_and_quadratic_in_two() -> None:
    x = np.linspace(-1.0, 1.0, 9)[:, None]
    assert np.allclose(trend_of(x, x) @ x**3, x**3, atol=1e-4)
    two = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    product = two[:, :1] * two[:, 1:]
    assert np.allclose(trend_of(two, two) @ product, product, atol=1e-4)


def test_shrinkage_lowers_the_error_of_a_covariance_from_few_samples() -> None:
    rng = np.random.default_rng(3)
    truth = np.diag(np.linspace(0.5, 2.0, 12)) + 0.1
    raw = better = 0.0
    for _ in range(50):
        rows = rng.multivariate_normal(np.zeros(12), truth, 8)
        raw += float(np.sum((rows.T @ rows / 8 - truth) ** 2))
        better += float(np.sum((shrunk(rows) - truth) ** 2))
    assert better < 0.7 * raw


@pytest.mark.parametrize(("prior", "share"), [(4.0, 0.6), (np.inf, 0.3)])
def test_moderated_variances_are_nearer_to_those_they_were_drawn_from(prior: float, share: float) -> None:
    """Variances drawn as Smyth's (2004) hierarchical model has them, then samples of three of each."""
    rng = np.random.default_rng(0)
    raw, better = 0.0, 0.0
    for _ in range(200):
        truth = 2.0 * (prior / rng.chisquare(prior, 8) if np.isfinite(prior) else np.ones(8))
        sample = truth * rng.chisquare(3, 8) / 3
        raw += float(np.sum(np.log(sample / truth) ** 2))
        better += float(np.sum(np.log(moderated(sample, 3) / truth) ** 2))
    assert better < share * raw


def test_variances_far_apart_stay_as_they_are() -> None:
    sizes = np.array([1e-6, 1.0, 1e6])
    np.testing.assert_allclose(moderated(sizes, 3), sizes, rtol=0.3, atol=0.1)


def test_sizes_are_log_uniform_from_the_meaningful_one_on_both_sides(candidate: Callable[..., Candidate]) -> None:
    cube = np.random.default_rng(0).uniform(size=(4000, 1))
    one = sizes(candidate("one"), cube)[:, 0]
    assert one.min() >= 1.0 and one.max() <= MAX_SIZE
    assert np.median(one) == pytest.approx(4.0, rel=0.1)
    two = sizes(candidate("two", sign=0), cube)[:, 0]
    assert np.mean(two > 0.0) == pytest.approx(0.5, abs=0.05) and np.abs(two).min() >= 1.0


def test_runs_of_an_effect_lie_in_bounds_and_differ(make: Make) -> None:
    experiment = make()
    runs = effect_runs(experiment.candidates[0], Prior.of(experiment, {"friction_angle": 35.0}), 6, 3)
    assert len({r.seed for r in runs}) == 6
    for run in runs:
        assert isinstance(run, Run) and run.effects == ("one",)
        assert 20.0 <= run.values["friction_angle"] <= 50.0 and 1.0 <= run.values["one_size"] <= 16.0


def test_checks_find_a_block_that_is_off_and_hardly_ever_one_that_is_not(make: Make) -> None:
    experiment = make()
    shape = experiment.layout.shape
    rng = np.random.default_rng(4)
    chance = rng.standard_normal((12, *shape)) / np.sqrt(12.0)
    expected = Expected(np.full(shape, 0.5), chance, np.zeros((0, *shape)))
    mask = np.ones(shape, dtype=bool)
    false = sum(not passes(checks(experiment, expected.replicate(rng), expected, mask, seed=k)) for k in range(40))
    assert false <= 6
    residual = expected.replicate(rng)
    left = np.array([s.channel == "left" for s in experiment.layout.sites])
    residual[4:, left] += 3.0
    found = checks(experiment, residual, expected, mask)
    assert not passes(found)
    assert (found[0].stage, found[0].channel) == ("withdrawal", "left") and found[0].ratio > 2.0
    weak = checks(experiment, 0.4 * experiment.observed, expected, mask)
    assert [check.amplitude for check in weak] == pytest.approx([0.6] * len(weak))


def test_a_size_that_is_called_detectable_is_found_and_noise_hides_more(make: Make) -> None:
    quiet, loud = (diagnose(make(discretisation=n), {"friction_angle": 35.0}) for n in (0.3, 4.0))
    large, small = loud.detectable["two"], quiet.detectable["two"]
    assert small is not None and (large is None or small <= large)
    named = [
        diagnose(make({"two_size": 2.0 * small}, seed=k, discretisation=0.3), {"friction_angle": 35.0}, seed=k).members
        for k in range(4)
    ]
    assert named.count(("two",)) >= 3
