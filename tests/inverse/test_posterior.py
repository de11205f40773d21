"""Posteriors whose closed form is known, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest
from splatsoil.benchmarks._agents import density_of
from splatsoil.inverse.bayesopt import sobol
from splatsoil.inverse.mcmc import sample
from splatsoil.inverse.posterior import Density, Posterior, summarise
from splatsoil.inverse.posterior_files import corner_figure

from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace(
    [Parameter("friction_angle", "deg", 20.0, 50.0, 35.0), Parameter("cohesion", "Pa", 0.0, 1e3, 0.0)]
)
TRUTH, SLOPE, NOISE = 0.2, 10.0, 1.0


def line(second: float = 0.0, seed: int = 0, truth: tuple[float, float] = (TRUTH, 0.0)) -> Density:
    """30 features of which one grows with the first parameter, and another with the second by ``second``."""
    rng = np.random.default_rng(seed)
    points = sobol(64, 2, 0)
    directions = np.linalg.qr(rng.normal(size=(30, 2)))[0].T
    slopes = np.array([SLOPE, second])
    features = (slopes * points + NOISE * rng.normal(size=points.shape)) @ directions
    observed = (slopes * truth) @ directions
    return density_of(SPACE, points, features, observed, 0.0)


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    density = line()
    return Posterior(density, sample(density, 2))


def test_a_linear_model_has_its_closed_form(posterior: Posterior) -> None:
    """Observed SLOPE·x + chance with std NOISE: x is normal about the truth with std NOISE / SLOPE."""
    assert posterior.unit[:, 0].mean() == pytest.approx(TRUTH, abs=0.05)
    assert posterior.unit[:, 0].std() == pytest.approx(NOISE / SLOPE, rel=0.35)


def test_what_no_feature_depends_on_is_said_to_be_undetermined(posterior: Posterior) -> None:
    result = summarise(posterior, list(SPACE))
    angle, cohesion = result["parameters"]["friction_angle"], result["parameters"]["cohesion"]
    assert angle["verdict"] == "determined" and angle["contraction"] < 0.3
    assert cohesion["verdict"] == "not determined" and cohesion["contraction"] > 0.9
    assert any("cohesion is not determined" in note for note in result["notes"])
    assert angle["low"] < angle["low_50"] < angle["median"] < angle["high_50"] < angle["high"]
    assert result["chains"]["converged"]
    titles = [axis.get_title() for axis in corner_figure(posterior, list(SPACE)).axes if axis.get_title()]
    assert len(titles) == 2 and titles[1] == "cohesion: not identified"
    assert titles[0].startswith("friction angle: ") and " to " in titles[0]
    # Densities integrate to the prior's.
    assert np.mean(cohesion["histogram"]["density"]) == pytest.approx(1.0, abs=0.01)


def test_there_is_nothing_outside_of_the_bounds() -> None:
    assert list(np.isfinite(line()(np.array([[0.0, 0.0], [1.1, 0.0], [0.0, -1.01]])))) == [True, False, False]


def test_a_posterior_that_crowds_at_a_bound_says_so() -> None:
    density = line(truth=(1.1, 0.0))
    result = summarise(Posterior(density, sample(density, 2)), list(SPACE))
    assert result["parameters"]["friction_angle"]["at_bound"] == ["upper"]
    assert any("crowds at its upper bound" in note for note in result["notes"])
