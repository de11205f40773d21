"""``splatsoil benchmark information``: the sigmas it counts, its table and page, and all of it on few particles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from splatsoil.benchmarks.information import precision_of, sigmas

from splatsoil.cli import main as command_line
from splatsoil.files import read_json

PAGE = Path(__file__).parents[2] / "docs" / "information.md"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def covariance_of(rng: np.random.Generator, p: int) -> np.ndarray:
    root = rng.standard_normal((p, p))
    return root @ root.T + np.eye(p)


def length(change: np.ndarray, covariance: np.ndarray, free: np.ndarray | None = None) -> float:
    return sigmas(change[None], precision_of(covariance, free), covariance)[0]


def test_sigmas_are_the_likelihood_ratio_of_a_known_change(rng: np.random.Generator) -> None:
    """Of normal data, twice the logarithm of the densities' ratio at the change."""
    covariance, change = covariance_of(rng, 6), rng.standard_normal(6)
    noise = multivariate_normal(np.zeros(6), covariance)
    expected = np.sqrt(2.0 * (noise.logpdf(np.zeros(6)) - noise.logpdf(change)))
    assert length(change, covariance) == pytest.approx(expected, rel=1e-6)
    same = np.repeat(change[None], 4, axis=0)
    assert sigmas(same, precision_of(covariance), covariance)[0] == pytest.approx(expected, rel=1e-6)


def test_a_change_like_that_of_the_angle_is_nothing_and_one_orthogonal_to_it_is_whole(rng: np.random.Generator) -> None:
    covariance, angle, other = covariance_of(rng, 5), rng.standard_normal(5), rng.standard_normal(5)
    assert length(-3.0 * angle, covariance, angle) == pytest.approx(0.0, abs=1e-5)
    precision = np.linalg.inv(covariance)
    apart = other - angle * (angle @ precision @ other) / (angle @ precision @ angle)
    assert length(apart, covariance, angle) == pytest.approx(length(apart, covariance), rel=1e-6)
    assert length(apart + 2.0 * angle, covariance, angle) == pytest.approx(length(apart, covariance), rel=1e-6)


def test_chance_of_the_simulations_adds_nothing(rng: np.random.Generator) -> None:
    """Lengths of means of three changes, each with as much chance as noise, would be 40 / 3 too long, squared."""
    covariance, change = covariance_of(rng, 40), 4.0 * np.eye(40)[0]
    precision = precision_of(covariance)
    chance = rng.multivariate_normal(np.zeros(40), covariance, size=(2000, 3))
    squares = [sigmas(50.0 * change + own, precision, covariance)[0] ** 2 for own in chance]
    assert np.mean(squares) == pytest.approx((50.0 * length(change, covariance)) ** 2, rel=0.02)
    assert sigmas(np.stack([change, -change]), precision, covariance)[0] == 0.0


def test_chance_alone_passes_its_limit_in_one_of_twenty(rng: np.random.Generator) -> None:
    noise, chance = covariance_of(rng, 40), covariance_of(rng, 40)
    drawn = rng.multivariate_normal(np.zeros(40), chance, size=(2000, 3))
    found = [sigmas(own, precision_of(noise), chance) for own in drawn]
    assert np.mean([value > least for value, least in found]) == pytest.approx(0.05, abs=0.025)


@pytest.mark.slow
def test_all_of_it_with_one_effect_and_a_second_call_simulates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, page = tmp_path / "out", tmp_path / "page.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    words = ["benchmark", "information", "--effects", "gravity", "--seeds", "2", "--out", str(out)]
    assert command_line(words) == 0
    assert "gravity" in capsys.readouterr().err
    result = read_json(out / "result.json")
    found = result["rows"][0]["sigmas"]
    assert [row["effect"] for row in result["rows"]] == ["gravity"]
    assert found["soil"] > found["angle"] >= found["observation"] >= found["discretisation"] >= 0.0
    assert found["reconstructed"] > found["angle"]
    assert command_line([*words, "--page", str(page)]) == 0
    assert "base" not in capsys.readouterr().err
    assert "gravity, 1.4" in page.read_text(encoding="utf-8")
