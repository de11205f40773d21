"""The emulator on features whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from splatsoil.inverse.emulator import HUBER, MAD, Emulator, error_scale, moderated
from splatsoil.inverse.process import Process
from splatsoil.inverse.surrogate import sobol

DIRECTIONS = np.linalg.qr(np.random.default_rng(0).normal(size=(40, 3)))[0]
CHANCE = 0.3


def scores(points: np.ndarray) -> np.ndarray:
    x, y = points.T
    return np.stack([5.0 * x + x**2, 3.0 * y + x * y, np.sin(2.0 * x)], axis=1)


def simulated(points: np.ndarray, seed: int) -> np.ndarray:
    """40 features along three directions, with chance along the first."""
    rng = np.random.default_rng(seed)
    return scores(points) @ DIRECTIONS.T + CHANCE * rng.normal(size=(len(points), 1)) * DIRECTIONS[:, 0]


@pytest.fixture(scope="module")
def emulator() -> Emulator:
    points = np.concatenate([sobol(24, 2, 0), np.zeros((6, 2))])
    return Emulator(points, simulated(points, 1))


def test_features_elsewhere_are_predicted_within_the_quoted_variance(emulator: Emulator) -> None:
    points = np.random.default_rng(3).uniform(-0.9, 0.9, (300, 2))
    truth = scores(points) @ DIRECTIONS.T
    mean, variance = emulator.predict(points)
    z = (emulator.project(truth) - mean) / np.sqrt(variance)
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.sqrt(np.mean((emulator.features(points) - truth) ** 2)) < 0.1 * truth.std()


def test_chance_is_the_scatter_between_seeds(emulator: Emulator) -> None:
    assert np.sqrt(np.trace(emulator.chance)) == pytest.approx(CHANCE, rel=0.4)


def test_chance_is_neither_too_large_nor_too_small_on_average() -> None:
    """One feature along a line with noise of variance 1, eight evaluations: 1 over many such worlds."""
    points = np.linspace(-0.95, 0.95, 8)[:, None]
    found = []
    for seed in range(60):
        noise = np.random.default_rng([seed, 11]).normal(size=(8, 1))
        found.append(Emulator(points, 3.0 * points + noise, seed=seed).chance[0, 0])
    # the mean of 60 scatters by 0.08
    assert np.mean(found) == pytest.approx(1.0, abs=0.25)


def test_a_new_observation_scores_as_evaluations_did() -> None:
    """Sixteen evaluations along a line, whose chance is much of what 400 features vary by: scores of many new
    ones at the same points agree with what the emulator expects there, and are not smaller."""
    points, rng = np.linspace(-1.0, 1.0, 16)[:, None], np.random.default_rng(12)
    slope = rng.normal(size=400)
    emulator = Emulator(points, points * slope + rng.normal(size=(16, 400)))
    new = np.mean([emulator.project(points * slope + rng.normal(size=(16, 400))) for _ in range(50)], axis=0)
    expected, _ = emulator.predict(points)
    assert emulator.count == 1
    # Without shrinking it is 0.85.
    assert np.polyfit(expected[:, 0], new[:, 0], 1)[0] == pytest.approx(1.0, abs=0.06)


def test_the_scale_of_students_t_is_the_variance_that_the_evaluations_show() -> None:
    """Eight evaluations, noise of variance 1: five degrees of freedom or so, of whose χ² over five the middle is 0.87.
    The expectation of the variance, 5/3 as large, would count the doubt about it twice."""
    points = np.linspace(-0.95, 0.95, 8)[:, None]
    found = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 13])
        found.append(Emulator(points, points * rng.normal(size=300) + rng.normal(size=(8, 300)), seed=seed))
    assert np.median([emulator.chance_scale[0, 0] for emulator in found]) == pytest.approx(0.87, abs=0.3)


def test_chance_is_that_of_the_whole_range_however_quiet_repeats_are() -> None:
    """Sand may slide in lumps at some parameters and not where simulations happen to be repeated."""
    points = np.concatenate([sobol(40, 1, 0), np.zeros((8, 1))])
    quiet = np.repeat([1.0, 0.2], [40, 8])[:, None]
    features = 10.0 * points @ np.ones((1, 20)) + quiet * np.random.default_rng(5).normal(size=(48, 1)) @ np.ones(
        (1, 20)
    )
    emulator = Emulator(points, features)
    true = np.mean(quiet**2) * 20.0  # along the one direction (1, …, 1)
    assert emulator.count == 1 and emulator.chance[0, 0] == pytest.approx(true, rel=0.35)


def test_chance_knows_which_scores_scatter_together() -> None:
    rng = np.random.default_rng(6)
    points = sobol(64, 2, 0)
    scatter = rng.multivariate_normal([0.0, 0.0], [[1.0, 0.8], [0.8, 1.0]], 64)
    emulator = Emulator(points, np.stack([8.0 * points[:, 0], 5.0 * points[:, 1]], axis=1) + scatter)
    found = emulator.basis @ emulator.chance @ emulator.basis.T
    assert found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]) == pytest.approx(0.8, abs=0.15)


def test_left_out_points_are_predicted_and_covered(emulator: Emulator) -> None:
    assert emulator.left_out.skill[0] > 0.95
    assert 0.6 < np.sqrt(np.mean(emulator.left_out.z**2)) < 1.4
    assert emulator.left_out.coverage > 0.8


def test_basis_is_orthonormal_and_the_remainder_outside_it(emulator: Emulator) -> None:
    np.testing.assert_allclose(emulator.basis.T @ emulator.basis, np.eye(emulator.count), atol=1e-12)
    some = np.random.default_rng(4).normal(size=40)
    np.testing.assert_allclose(emulator.basis.T @ emulator.remainder(some), 0.0, atol=1e-12)
    again = emulator.centre + emulator.project(some) @ emulator.basis.T + emulator.remainder(some)
    np.testing.assert_allclose(again, some, atol=1e-12)


def test_leaving_out_in_closed_form_is_leaving_out() -> None:
    """Against scikit-learn, trained anew without each group, hyperparameter draw by draw."""
    points = np.concatenate([sobol(7, 1, 2), np.zeros((2, 1))])
    values = np.sin(2.0 * points[:, 0]) + 0.05 * np.random.default_rng(5).normal(size=9)
    process = Process(points, values, seed=0)
    errors, stds = (process.scale * found for found in process.left_out)
    for group in (np.array([3]), np.array([7, 8])):
        rest = np.setdiff1d(np.arange(9), group)
        found, variances = [], []
        for length, noise, mean in zip(
            process.settings.lengths[:, 0], process.settings.noise[:, 0], process.settings.mean, strict=True
        ):
            other = GaussianProcessRegressor(RBF(length, "fixed"), alpha=noise + 1e-8, optimizer=None)
            other.fit(process.x[rest], process.y[rest] - mean)
            predicted, std = other.predict(process.x[group], return_std=True)
            found.append(process.y[group] - mean - predicted)
            variances.append(std**2 + noise + 1e-8)
        np.testing.assert_allclose(errors[group], process.scale * np.mean(found, axis=0), atol=1e-6)
        total = np.mean(variances, axis=0) + np.var(found, axis=0)
        np.testing.assert_allclose(stds[group], process.scale * np.sqrt(total), rtol=1e-5)


@pytest.mark.parametrize("noise", [0.1, 3.0])
def test_degrees_of_freedom_are_what_the_fit_does_not_follow(noise: float) -> None:
    """Twenty evaluations of a straight line: by how much the fit at a point follows the outcome there, summed up."""
    points = np.linspace(-1.0, 1.0, 20)[:, None]
    generator = np.random.default_rng(3)
    process = Process(points, points[:, 0] + noise * generator.normal(size=20), 1)
    settings, outcomes, nudge = process.settings, process.y, 1e-3
    fitted, _ = process.predict(points)
    followed = 0.0
    for k in range(20):
        nudged = outcomes + nudge * (np.arange(20) == k)
        process.weights = np.einsum("dij,dj->di", process.inverse, nudged - settings.mean[:, None])
        followed += float(process.predict(points)[0][k] - fitted[k]) / (nudge * process.scale)
    assert process.freedom() == pytest.approx(20.0 - followed - 1.0, abs=0.05)
    assert 12.0 < process.freedom() < 18.0  # two of a line, a few of bends that can't be excluded


def test_features_that_are_all_chance_have_no_skill() -> None:
    points = sobol(32, 1, 0)
    emulator = Emulator(points, np.random.default_rng(6).normal(size=(32, 10)))
    # Of ten components of pure chance, some look predictable by chance; none is.
    assert emulator.count <= 3
    assert emulator.left_out.skill.max() < 0.5


@pytest.mark.parametrize(
    ("points", "features", "says"),
    [
        (np.zeros((3, 1)), np.ones((3, 5)), "too few"),
        (np.zeros((9, 1)), np.ones((9, 5)), "the same"),
        (np.zeros((9, 1)), np.full((9, 5), np.nan), "not finite"),
        (np.zeros((9, 1)), np.ones((8, 5)), "need features"),
        (np.zeros((9, 1)), np.ones((9, 0)), "need features"),
    ],
)
def test_what_cannot_be_emulated_is_refused(points: np.ndarray, features: np.ndarray, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Emulator(points, features)


def test_robust_scores_are_hubers_by_scipy() -> None:
    """Some features are far off; SciPy minimises the same loss by other means, with the size found here."""
    rng = np.random.default_rng(12)
    points = rng.uniform(-1.0, 1.0, (14, 1))
    emulator = Emulator(points, points @ rng.normal(size=(1, 80)) + 0.05 * rng.normal(size=(14, 80)))
    observed = emulator.features(np.array([[0.4]]))[0] + 0.1 * rng.normal(size=80)
    observed[:9] += 4.0
    found = emulator.project_robustly(observed)
    off = observed - emulator.centre
    size = HUBER * MAD * float(np.median(np.abs(off - emulator.basis @ found)))
    expected = least_squares(
        lambda s: off - emulator.basis @ s, np.zeros(emulator.count), loss="huber", f_scale=size, xtol=1e-12
    ).x
    np.testing.assert_allclose(found, expected, atol=1e-4)
    (true,), _ = emulator.predict(np.array([[0.4]]))
    assert np.abs(found - true).max() < 0.3 * np.abs(emulator.project(observed) - true).max()


@pytest.mark.parametrize("freedom", [4.0, 8.0])
def test_variances_are_drawn_together_as_far_as_they_are_the_same(freedom: float) -> None:
    """What differs by sampling only comes out as one; an inverse-gamma prior's mean squared error is the least."""
    rng = np.random.default_rng(13)

    def sampled(true: np.ndarray) -> np.ndarray:
        return true * rng.chisquare(freedom, len(true)) / freedom

    alike = moderated(sampled(np.full(3000, 2.0)), freedom)
    assert alike.mean() == pytest.approx(2.0, rel=0.05) and alike.std() < 0.15 * alike.mean()
    prior, common = 5.0, 3.0
    true = common * prior / rng.chisquare(prior, 20_000)
    found = moderated(sampled(true), freedom)
    # the weight of what is common follows from the prior's degrees of freedom
    own = sampled(true)
    np.testing.assert_allclose(moderated(own, freedom), (prior * common + freedom * own) / (prior + freedom), rtol=0.12)
    assert np.mean(np.log(found / true) ** 2) < np.mean(np.log(own / true) ** 2)


def test_features_that_scatter_count_less_unless_the_model_is_wrong() -> None:
    """Against the standard deviations that they were made with."""
    rng = np.random.default_rng(14)
    points = np.linspace(-1.0, 1.0, 24)[:, None]
    std = np.where(np.arange(300) < 100, 3.0, 0.5)
    features = points @ rng.normal(size=(1, 300)) + std * rng.normal(size=(24, 300))
    # observed as one more simulation would be: the model is right
    right = std * rng.normal(size=300)
    scale = error_scale(points, features, right)
    assert np.median(scale[:100]) / np.median(scale[100:]) == pytest.approx(6.0, rel=0.35)
    wrong = right + 20.0 * rng.normal(size=300)
    assert np.ptp(error_scale(points, features, wrong)) < 0.05
    # what does not scatter at all is compared as it is
    flat = error_scale(points, points @ rng.normal(size=(1, 300)), wrong)
    np.testing.assert_allclose(flat, 1.0, rtol=0.05)


@pytest.mark.parametrize("lumpy", [0.1, 0.45])
def test_a_right_model_has_no_error_beyond_chance_however_much_chance_differs(lumpy: float) -> None:
    """A true ratio of 6 between standard deviations; the mean over observations as simulations would be."""
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng([seed, 15])
        points = np.linspace(-1.0, 1.0, 24)[:, None]
        std = np.where(np.arange(300) < 300 * lumpy, 3.0, 0.5)
        features = points @ rng.normal(size=(1, 300)) + std * rng.normal(size=(24, 300))
        scale = error_scale(points, features, std * rng.normal(size=300), seed=seed)
        ratios.append(np.median(scale[std > 1.0]) / np.median(scale[std < 1.0]))
    assert np.mean(ratios) == pytest.approx(6.0, rel=0.2)


@pytest.mark.parametrize("m", [10, 16, 20])
def test_features_that_never_change_count_neither_for_more_nor_for_less(m: int) -> None:
    """Some are the same in all simulations, to the bit or to rounding; the rest is as if they weren't there."""
    rng = np.random.default_rng(16)
    points = np.linspace(-1.0, 1.0, m)[:, None]
    features = points @ rng.normal(size=(1, 300)) + 0.5 * rng.normal(size=(m, 300))
    features[:, :10], features[:, 10:20] = 7.0, 7.0 + 1e-15 * rng.normal(size=(m, 10))
    observed = 0.5 * rng.normal(size=300)
    observed[:20] = 7.0
    scale = error_scale(points, features, observed)
    assert np.all(np.isfinite(scale)) and scale.min() > 0.0
    without = error_scale(points, features[:, 20:], observed[20:])
    np.testing.assert_allclose(scale[20:] / scale[20:].mean(), without / without.mean(), rtol=0.05)
    emulator = Emulator(points, features, scale=scale)
    assert np.all(np.isfinite(emulator.project_robustly(observed)))
