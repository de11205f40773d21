"""Score tests against ordinary least squares, and against their own promises on drawn data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from splatsoil.inverse.criticism.noise import Noise
from splatsoil.inverse.criticism.score import Score, Scorer

from splatsoil.experiment.base import Candidate
from splatsoil.parameters import Parameter

FEATURES = 60


def candidate(name: str, sign: int = 0, count: int = 1, meaningful: float = 0.1) -> Candidate:
    parameters = tuple(
        Parameter(
            f"{name}{i}",
            "1",
            0.0 if sign else -9.0,
            9.0,
            0.0,
            off=0.0,
            meaningful=meaningful,
            sign=sign if i == 0 else 0,
        )
        for i in range(count)
    )
    return Candidate(name, "physics", parameters, parameters[0].name)


@pytest.fixture(scope="module")
def case() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(3)
    root = np.tril(generator.normal(size=(FEATURES, FEATURES))) * 0.1 + np.diag(generator.uniform(0.5, 2.0, FEATURES))
    return {
        "covariance": root @ root.T,
        "root": root,
        "nuisance": generator.normal(size=(FEATURES, 2)),
        "columns": generator.normal(size=(FEATURES, 5)),
        "residual": generator.normal(size=FEATURES),
    }


def noise(case: dict[str, np.ndarray]) -> Noise:
    return Noise(case["covariance"], np.ones((FEATURES, 1), dtype=bool))


def fall_of_chi2(case: dict[str, np.ndarray], columns: np.ndarray) -> tuple[float, np.ndarray]:
    """The oracle: least squares with and without the columns, beside nuisances that are wholly free."""
    white = np.linalg.inv(case["root"])
    target = white @ case["residual"]

    def chi2(matrix: np.ndarray) -> tuple[float, np.ndarray]:
        found, *_ = np.linalg.lstsq(white @ matrix, target, rcond=None)
        return float(np.sum((target - white @ matrix @ found) ** 2)), found

    without, _ = chi2(case["nuisance"])
    with_it, found = chi2(np.concatenate([case["nuisance"], columns], axis=1))
    return without - with_it, found[case["nuisance"].shape[1] :]


@pytest.mark.parametrize("count", [1, 3])
def test_a_score_is_the_fall_of_chi2_and_the_estimate_of_least_squares(case: dict[str, np.ndarray], count: int) -> None:
    columns = case["columns"][:, :count]
    scorer = Scorer.of(noise(case), 1e4 * case["nuisance"], {"a": columns}, [candidate("a", count=count)])
    score = scorer.score(case["residual"])["a"]
    fall, estimate = fall_of_chi2(case, columns)
    assert score.statistic == pytest.approx(fall, rel=1e-5)
    assert list(score.steps.values()) == pytest.approx(list(estimate), rel=1e-4)


def test_an_effect_of_one_sign_is_not_found_on_the_other_side(case: dict[str, np.ndarray]) -> None:
    direction = case["columns"][:, :1]
    scorer = Scorer.of(noise(case), np.zeros((FEATURES, 0)), {"a": direction}, [candidate("a", sign=1)])
    right = scorer.score(direction[:, 0] * 3.0)["a"]
    wrong = scorer.score(direction[:, 0] * -3.0)["a"]
    assert right.adjusted < 1e-6 and right.estimate == pytest.approx(3.0)
    assert wrong.adjusted == 1.0 and wrong.statistic == 0.0 and wrong.z < -5.0


def test_what_a_nuisance_can_do_is_not_read_as_an_effect(case: dict[str, np.ndarray]) -> None:
    nuisance, direction = case["nuisance"][:, :1], case["columns"][:, :1]
    shifted = nuisance[:, 0] * 40.0
    kept = Scorer.of(noise(case), 1e3 * nuisance, {"a": direction}, [candidate("a")]).score(shifted)["a"]
    naive = Scorer.of(noise(case), np.zeros((FEATURES, 0)), {"a": direction}, [candidate("a")]).score(shifted)["a"]
    assert kept.adjusted > 0.5
    assert naive.adjusted < 0.05, "the case must be one in which leaving the projection out is wrong"


def test_a_direction_inside_the_nuisances_has_nothing_left(case: dict[str, np.ndarray]) -> None:
    direction = case["nuisance"][:, :1]
    score = Scorer.of(noise(case), 1e4 * direction, {"a": direction}, [candidate("a")]).score(case["residual"])["a"]
    assert score.survival < 1e-4


def test_given_the_true_effect_its_shadow_disappears(case: dict[str, np.ndarray]) -> None:
    true = case["columns"][:, :1]
    shadow = true + 0.3 * case["columns"][:, 1:2]
    scorer = Scorer.of(noise(case), np.zeros((FEATURES, 0)), {"a": true, "b": shadow}, [candidate("a"), candidate("b")])
    residual = 3.0 * true[:, 0]
    assert scorer.score(residual)["b"].adjusted < 1e-6
    assert scorer.score(residual, given="a")["b"].z == pytest.approx(0.0, abs=1e-6)
    assert scorer.confusion()[0, 1] > 0.8


def drawn_scores(
    case: dict[str, np.ndarray], count: int, size: float = 0.0, meaningful: float = 0.1
) -> tuple[list[dict[str, Score]], Scorer]:
    candidates = [candidate(name, sign=k % 2, meaningful=meaningful) for k, name in enumerate("abcde")]
    directions = {name: case["columns"][:, [k]] for k, name in enumerate("abcde")}
    scorer = Scorer.of(noise(case), 1e3 * case["nuisance"], directions, candidates)
    generator = np.random.default_rng(5)
    draws = case["root"] @ generator.standard_normal((FEATURES, count))
    draws += case["nuisance"] @ generator.normal(size=(2, count)) * 50.0
    if size:
        draws += size * scorer.score(np.zeros(FEATURES))["b"].detectable * directions["b"]
    return [scorer.score(draws[:, k]) for k in range(count)], scorer


def test_false_alarms_come_at_the_nominal_rate() -> None:
    generator = np.random.default_rng(4)
    root = np.eye(FEATURES)
    case = {
        "root": root,
        "covariance": root,
        "nuisance": generator.normal(size=(FEATURES, 2)),
        "columns": generator.normal(size=(FEATURES, 5)),
    }
    rates = []
    for meaningful in (0.0, 0.1):
        found, _ = drawn_scores(case, 1000, meaningful=meaningful)
        rates.append(np.mean([min(s.adjusted for s in scores.values()) < 0.05 for scores in found]))
    # Five binomial standard deviations around 5 %; less where something small might be there, and isn't.
    assert 0.016 < rates[0] < 0.085
    assert rates[1] < rates[0]


def test_what_is_too_small_to_matter_is_not_missing_however_well_it_is_seen() -> None:
    generator = np.random.default_rng(6)
    direction = 20.0 * generator.normal(size=(FEATURES, 1))
    plain = Noise(np.eye(FEATURES), np.ones((FEATURES, 1), dtype=bool))
    scorer = Scorer.of(plain, np.zeros((FEATURES, 0)), {"a": direction}, [candidate("a")])

    def rate(size: float) -> tuple[float, float]:
        found = [scorer.score(size * direction[:, 0] + generator.standard_normal(FEATURES))["a"] for _ in range(1000)]
        return float(np.mean([s.adjusted < 0.05 for s in found])), float(np.mean([s.z for s in found]))

    largest, seen = rate(0.1)
    assert seen > 10.0
    # One of two tails is far away.
    assert 0.005 < largest < 0.05
    assert rate(0.09)[0] < 0.005
    assert 0.75 < rate(scorer.score(np.zeros(FEATURES))["a"].detectable)[0] < 0.9


def test_with_several_parameters_the_nearest_trivial_sizes_are_the_null(case: dict[str, np.ndarray]) -> None:
    columns, target = case["columns"][:, :2], np.array([0.3, -0.9])
    root = np.linalg.inv(case["root"])
    scorer = Scorer.of(noise(case), np.zeros((FEATURES, 0)), {"a": columns}, [candidate("a", count=2)])
    score = scorer.score(columns @ target)["a"]
    ends = np.linspace(-0.1, 0.1, 201)
    grid = np.stack(np.meshgrid(ends, ends), axis=-1).reshape(-1, 2)
    nearest = np.min(np.sum((root @ (columns @ (target - grid).T)) ** 2, axis=0))
    assert score.p == pytest.approx(chi2.sf(nearest, 2), rel=1e-3)
    assert score.p > chi2.sf(score.statistic, 2)


def test_an_effect_of_the_smallest_detectable_size_is_found_four_times_in_five(case: dict[str, np.ndarray]) -> None:
    found, _ = drawn_scores(case, 500, size=1.0)
    assert 0.75 < np.mean([scores["b"].adjusted < 0.05 for scores in found]) < 0.92


def test_the_same_seed_gives_the_same_p(case: dict[str, np.ndarray]) -> None:
    first, second = (drawn_scores(case, 3)[0][0]["a"] for _ in range(2))
    assert first == second
