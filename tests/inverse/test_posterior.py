"""Posteriors whose closed form is known, and what is said of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from splatsoil.inverse import emulator as emulator_module
from splatsoil.inverse.emulator import Emulator
from splatsoil.inverse.fitting import fit
from splatsoil.inverse.likelihood import Likelihood
from splatsoil.inverse.mcmc import sample
from splatsoil.inverse.posterior import Data, sample_posterior, summarise
from splatsoil.inverse.posterior_files import corner_figure
from splatsoil.inverse.posterior_run import Effort, run_posterior, setup_of
from splatsoil.inverse.surrogate import sobol

from splatsoil.errors import RunError
from splatsoil.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace(
    [Parameter("friction_angle", "deg", 20.0, 50.0, 35.0), Parameter("cohesion", "Pa", 0.0, 1e3, 0.0)]
)
TRUTH, SLOPE, NOISE = 0.2, 10.0, 1.0


def line(second: float = 0.0, seed: int = 0) -> Data:
    """Residuals of 30 features that grow with the first parameter, and with the second by ``second``."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([sobol(24, 2, 0), np.zeros((4, 2))])
    first, other = np.linalg.qr(rng.normal(size=(30, 2)))[0].T
    predicted = SLOPE * points[:, :1] * first + second * points[:, 1:] * other
    predicted = predicted + NOISE * rng.normal(size=(len(points), 1)) * first
    observed = SLOPE * TRUTH * first
    return Data(SPACE, points, observed - predicted)


@pytest.fixture(scope="module")
def posterior():  # type: ignore[no-untyped-def]
    return sample_posterior(line())


def test_a_linear_model_has_its_closed_form(posterior) -> None:  # type: ignore[no-untyped-def]
    """Observed SLOPE·x + chance with std NOISE: x is normal about the truth with std NOISE / SLOPE."""
    assert posterior.unit[:, 0].mean() == pytest.approx(TRUTH, abs=0.05)
    assert posterior.unit[:, 0].std() == pytest.approx(NOISE / SLOPE, rel=0.35)


def test_what_no_feature_depends_on_is_said_to_be_undetermined(posterior) -> None:  # type: ignore[no-untyped-def]
    told = summarise(posterior)
    angle, cohesion = told["parameters"]["friction_angle"], told["parameters"]["cohesion"]
    assert angle["verdict"] == "determined" and angle["contraction"] < 0.3
    assert cohesion["verdict"] == "not determined" and cohesion["contraction"] > 0.9
    assert any("cohesion is not determined" in note for note in told["notes"])
    assert angle["low"] < angle["low_50"] < angle["median"] < angle["high_50"] < angle["high"]
    assert told["misfit"]["std"] == 0.0 and told["chains"]["converged"]
    titles = [axis.get_title() for axis in corner_figure(posterior).axes if axis.get_title()]
    assert len(titles) == 2 and titles[1] == "cohesion: not identified"
    assert titles[0].startswith("friction angle: ") and " to " in titles[0]
    # Densities integrate to the prior's.
    assert np.mean(cohesion["histogram"]["density"]) == pytest.approx(1.0, abs=0.01)


def test_evidence_is_the_integral_of_the_likelihood(posterior) -> None:  # type: ignore[no-untyped-def]
    grid = np.linspace(-1.0, 1.0, 81)
    points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    logs = posterior.likelihood.log_likelihood(points)
    expected = logs.max() + np.log(np.mean(np.exp(logs - logs.max())))
    value, error = posterior.evidence
    assert value == pytest.approx(expected, abs=4.0 * error + 0.05)


def test_a_misfit_widens_the_posterior_and_is_said() -> None:
    right = line()
    wrong = replace(right, residuals=right.residuals + 3.0 * np.random.default_rng(9).normal(size=30))
    sharp, wide = (sample_posterior(d, evidence=False) for d in (right, wrong))
    assert wide.misfit.present and wide.likelihood.with_misfit
    assert wide.unit[:, 0].std() > 1.5 * sharp.unit[:, 0].std()
    assert any("no parameter has any say" in note for note in summarise(wide)["notes"])


def test_chains_of_another_likelihood_are_not_gone_on_with(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As an earlier version's, which compared the same features in other units: what is kept is sampled anew."""
    data = line()
    data = replace(data, residuals=data.residuals + NOISE * np.random.default_rng(2).normal(size=data.residuals.shape))
    kept = tmp_path / "chains.h5"
    with monkeypatch.context() as patch:
        patch.setattr(emulator_module, "error_scale", lambda points, *_, **__: np.geomspace(0.1, 10.0, 30))
        before = sample_posterior(data, file=kept, evidence=False)
    after, fresh = sample_posterior(data, file=kept, evidence=False), sample_posterior(data, evidence=False)
    assert np.array_equal(after.unit, fresh.unit) and not np.array_equal(after.unit, before.unit)


@pytest.mark.slow
def test_intervals_of_a_known_model_hold_what_they_promise() -> None:
    """Truths drawn from the prior, observations with chance: 90 % intervals hold 90 % of them."""
    data = line(second=5.0, seed=3)
    emulator = Emulator(data.points, -data.residuals)
    rng = np.random.default_rng(12)
    held = []
    for index in range(24):
        truth = rng.uniform(-1.0, 1.0, (1, 2))
        mean, variance = emulator.predict(truth)
        covariance = emulator.chance + np.diag(variance[0])
        scores = rng.multivariate_normal(mean[0], covariance)
        likelihood = Likelihood(emulator, emulator.centre + scores @ emulator.basis.T)
        chains = sample(likelihood, likelihood.lower, likelihood.upper, seed=index, ensembles=2, most_steps=400)
        low, high = np.quantile(chains.flat, [0.05, 0.95], axis=0)
        held.append((low <= truth[0]) & (truth[0] <= high))
    # 48 intervals: below 80 % or all of them is less likely than 2 % when 90 % is right.
    assert 0.8 <= np.mean(held) < 1.0


def test_too_few_evaluations(analytic: ModuleType) -> None:
    with pytest.raises(RunError, match="too few"):
        Data.from_records(SPACE, [])


def test_a_run_gets_its_posterior(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem(feature_noise=0.5)
    fit(problem, run, analytic.SETUP, budget=5)
    setup = setup_of(run.fit()["setup"])
    assert setup.description() == analytic.SETUP.description()
    problem.calls = 0
    result = run_posterior(problem, run, setup, effort=Effort(design=6, repeats=3, checks=2))
    assert problem.calls == 11 and result["evaluations"] == 16
    angle = result["parameters"]["friction_angle"]
    assert angle["low"] < 36.0 < angle["high"] and angle["verdict"] == "determined"
    # The feature is the angle itself, with a chance of half a degree.
    assert 0.3 < angle["std"] < 1.2
    assert len(result["checks"]) == 2 and np.mean([c["chi2"] for c in result["checks"]]) < 5.0
    kept = json.loads((tmp_path / "posterior.json").read_text())
    assert kept == json.loads(json.dumps(result))
    for name in ("posterior.nc", "chains.h5", *result["figures"]):
        assert (tmp_path / "posterior" / name).stat().st_size > 1000
    arviz = pytest.importorskip("arviz")
    data = arviz.from_netcdf(tmp_path / "posterior" / "posterior.nc")
    drawn = data.posterior["friction_angle"].to_numpy()
    assert drawn.shape[0] == 4 and drawn.mean() == pytest.approx(angle["mean"], abs=1e-6)
    assert float(arviz.rhat(data)["friction_angle"]) < 1.02


@pytest.mark.slow
def test_a_posterior_made_again_simulates_nothing_and_says_the_same(analytic: ModuleType, tmp_path: Path) -> None:
    run = analytic.prepare(tmp_path)
    problem = analytic.AnalyticProblem(feature_noise=0.5)
    fit(problem, run, analytic.SETUP, budget=5)
    effort = Effort(design=6, repeats=3, checks=2)
    first = run_posterior(problem, run, analytic.SETUP, effort=effort)
    problem.calls = 0
    again = run_posterior(problem, run, analytic.SETUP, effort=effort)
    assert problem.calls == 0 and again["parameters"] == first["parameters"]
    assert again["evidence"] == first["evidence"]
