"""Effects beside each other: against ridge regression with every effect in it, and on data drawn with them."""

from __future__ import annotations

import numpy as np
import pytest
from splatsoil.inverse.criticism.joint import Joint, dispersion, precision_of
from splatsoil.inverse.criticism.noise import Noise
from splatsoil.inverse.criticism.refit import Known, refit
from splatsoil.inverse.criticism.score import Scorer

from splatsoil.experiment.base import Calibration, Candidate
from splatsoil.parameters import Parameter

FEATURES = 80
SIZES = {"a": 0.2, "b": 0.05, "c": 0.6, "d": 0.0}


def candidate(name: str) -> Candidate:
    parameter = Parameter(name, "1", -9.0, 9.0, 0.0, off=0.0, meaningful=SIZES.get(name, 0.1))
    return Candidate(name, "physics", (parameter,), name)


@pytest.fixture(scope="module")
def columns() -> np.ndarray:
    """Directions, the second one half like the first."""
    out = np.random.default_rng(7).normal(size=(FEATURES, 4))
    out[:, 1] += out[:, 0]
    return out


def scorer(columns: np.ndarray, calibration: Calibration | None = None) -> Scorer:
    directions = {name: columns[:, [k]] for k, name in enumerate("abcd")}
    noise = Noise(np.eye(FEATURES), np.ones((FEATURES, 1), dtype=bool))
    nothing = np.zeros((FEATURES, 0))
    return Scorer.of(noise, nothing, directions, [candidate(n) for n in "abcd"], calibration=calibration)


def ridge(columns: np.ndarray, residual: np.ndarray, tested: int, precision: np.ndarray) -> tuple[float, float]:
    """The oracle: least squares over all effects, each with its prior, and with the tested one held at off."""

    def solve(chosen: list[int]) -> tuple[float, np.ndarray]:
        matrix = np.vstack([columns[:, chosen], np.sqrt(precision[np.ix_(chosen, chosen)])])
        target = np.concatenate([residual, np.zeros(len(chosen))])
        found, *_ = np.linalg.lstsq(matrix, target, rcond=None)
        return float(np.sum((target - matrix @ found) ** 2)), found

    others = [k for k in range(4) if k != tested and SIZES["abcd"[k]] > 0.0]
    free = np.diag([0.0 if k == tested else precision[k, k] for k in range(4)])
    without, _ = solve(others)
    matrix = np.vstack([columns[:, [tested, *others]], np.sqrt(free[np.ix_([tested, *others], [tested, *others])])])
    target = np.concatenate([residual, np.zeros(1 + len(others))])
    found, *_ = np.linalg.lstsq(matrix, target, rcond=None)
    return without - float(np.sum((target - matrix @ found) ** 2)), float(found[0])


@pytest.mark.parametrize("tested", range(4))
def test_a_score_is_that_of_least_squares_with_the_other_effects_in_trivial_sizes(
    columns: np.ndarray, tested: int
) -> None:
    residual = np.random.default_rng(1).normal(size=FEATURES) + columns @ [0.3, -0.1, 0.4, 0.2]
    with np.errstate(divide="ignore"):
        precision = np.diag([min(SIZES[n] ** -2.0, 1e18) if SIZES[n] else 1e18 for n in "abcd"])
    fall, estimate = ridge(columns, residual, tested, precision)
    score = scorer(columns).score(residual)["abcd"[tested]]
    assert score.statistic == pytest.approx(fall, rel=1e-4)
    assert score.estimate == pytest.approx(estimate, rel=1e-4)


def test_a_little_of_one_effect_is_not_read_as_another(columns: np.ndarray) -> None:
    """Each of 300 data sets holds a trivial amount of the first effect, which the second resembles."""
    generator = np.random.default_rng(2)
    bench, amounts = scorer(columns), SIZES["a"] * generator.normal(size=300)
    noise = generator.normal(size=(300, FEATURES))
    found = [bench.score(noise[k] + amounts[k] * columns[:, 0])["b"] for k in range(300)]
    assert np.std([s.z for s in found]) == pytest.approx(1.0, abs=0.15)
    naive = (noise + amounts[:, None] * columns[:, 0]) @ columns[:, 1] / np.linalg.norm(columns[:, 1])
    assert np.std(naive) > 1.3, "the case must be one in which it matters"


def test_what_stands_along_the_other_effects_widens_the_scores(columns: np.ndarray) -> None:
    quiet = scorer(columns).score(3.0 * columns[:, 0])["a"]
    rest = columns[:, 2] * 8.0 + columns[:, 3] * 8.0
    rest -= columns[:, :1] @ np.linalg.lstsq(columns[:, :1], rest, rcond=None)[0]
    loud = scorer(columns).score(3.0 * columns[:, 0] + rest)["c"]
    assert quiet.dispersion == 1.0 and loud.dispersion > 5.0
    assert loud.std > 2.0 * scorer(columns).score(np.zeros(FEATURES))["c"].std


def test_dispersion_is_one_for_noise_and_grows_with_what_exceeds_it() -> None:
    assert dispersion(np.array([3.0]), 20)[0] == 1.0
    assert dispersion(np.array([130.0]), 20)[0] == pytest.approx(140.0 / 30.0)


def test_the_rest_is_white_where_effects_are_trivial(columns: np.ndarray) -> None:
    information = columns.T @ columns
    parts, precision = tuple(slice(k, k + 1) for k in range(4)), np.diag([0.0, 0.0, 9.0, 0.0])
    joint = Joint(information, np.array([SIZES[n] for n in "abcd"]), parts, precision)
    _, scores, told = joint.draw(np.random.default_rng(3), 4000)
    scores += 5.0 * information[0]  # any amount of the best one
    rest = joint.unexpected(scores, told) @ joint.rest(0).T
    assert np.cov(rest.T) == pytest.approx(np.eye(3), abs=0.1)
    assert np.abs(rest.mean(axis=0)).max() < 0.1


def test_a_calibration_takes_an_effect_out_of_the_running(columns: np.ndarray) -> None:
    residual = np.random.default_rng(4).normal(size=FEATURES) + 0.8 * columns[:, 0]
    said = Calibration(("a",), np.zeros(1), np.array([[1e-4]]))
    assert scorer(columns).score(residual)["a"].adjusted < 1e-3
    told = scorer(columns, said).score(residual)["a"]
    assert abs(told.estimate) < 0.02 and told.adjusted > 0.2
    agreed = scorer(columns, Calibration(("a",), np.array([0.8]), np.array([[1e-4]]))).score(residual)["a"]
    assert agreed.estimate == pytest.approx(0.8, abs=0.02) and agreed.std < 0.03


def test_a_refit_weighs_what_else_is_known(columns: np.ndarray) -> None:
    """Against the weighted mean of two measurements of one number."""
    parameter = Parameter("x", "1", -5.0, 5.0, 0.0)
    found = refit(
        lambda values: np.full((1, 1), values["x"]),
        lambda table: table.reshape(1, *table.shape[2:]) / 0.5,
        np.array([[1.0]]),
        [parameter],
        {"x": 0.0},
        np.zeros((1, 1)),
        np.ones((1, 1, 1)),
        chance=False,
        known=Known(np.array([[1.0 / 0.25]]), np.array([2.0])),
    )
    assert found.values["x"] == pytest.approx((1.0 * 4.0 + 2.0 * 16.0) / 20.0, abs=0.01)


def test_what_is_known_of_some_parameters_leaves_the_others_alone() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    said = Calibration(("p", "q"), np.array([0.5, -0.3]), covariance)
    precision, centre = precision_of(said, ["q", "unknown", "p"])
    assert precision[np.ix_([2, 0], [2, 0])] == pytest.approx(np.linalg.inv(covariance))
    assert not precision[1].any() and list(centre) == [-0.3, 0.0, 0.5]
    assert precision_of(None, ["p"])[0] == 0.0
