"""Laws that the library is not told of, read from a free strength."""

from __future__ import annotations

import math

import numpy as np
import pytest
from splatsoil.inverse.criticism.diagnosis import Diagnosis, diagnose
from splatsoil.inverse.criticism.free_strength import FreeStrength, Range, coordinates, hats, ranges
from splatsoil.inverse.criticism.outside import Shape
from splatsoil.inverse.criticism.record import record
from splatsoil.inverse.criticism.refit import optimum
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.states import States
from splatsoil.experiment.triaxial import Curve, TriaxialExperiment
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.matching import cone_slope

STRAINS = np.concatenate([np.linspace(0.01, 0.03, 3), np.linspace(0.05, 0.25, 11)])
SLOW = [(pressure, 1e-5) for pressure in (1e3, 3e3, 1e4, 5e4)]
FAST = [(pressure, rate) for pressure in (2e3, 2e4) for rate in (1e-2, 3.0, 30.0, 300.0)]


def series(effects: tuple[str, ...], values: dict[str, float], tests: list[tuple[float, float]]) -> list[Curve]:
    """Specimens of a known law at several pressures and rates, with readings as a laboratory's."""
    generator, out = np.random.default_rng(0), []
    for pressure, rate in tests:
        test = triaxial(
            Law(find_effects(effects)),
            values,
            confining=pressure,
            strains=-np.log(1.0 - STRAINS),
            young=2e7,
            void_ratio=0.8,
            strain_rate=rate,
        )
        ratio = (test.q / test.p)[0, 1:] + 0.005 * generator.normal(size=STRAINS.size)
        volume = 1.0 - np.exp(-test.volume_strain[0, 1:]) + 0.0005 * generator.normal(size=STRAINS.size)
        out.append(Curve(f"{pressure:g} Pa, {rate:g} 1/s", STRAINS, volume, ratio, pressure, rate))
    return out


def criticised(curves: list[Curve]) -> tuple[TriaxialExperiment, Diagnosis]:
    """Diagnosed with a library in which nothing acts on friction."""
    experiment = TriaxialExperiment(curves, candidates=("dilatancy",))
    simulate = Simulations(experiment)
    values = optimum(experiment, simulate, {p.name: p.default for p in experiment.parameters})
    return experiment, diagnose(experiment, values, simulate=simulate)


def shape(found: Diagnosis, argument: str) -> Shape:
    assert found.strength is not None
    return next(s for s in found.strength.shapes if s.argument == argument)


def test_a_hidden_rate_law_is_read_as_one() -> None:
    experiment, found = criticised(series(("rate_dependence",), {"friction_angle": 31.0, "rate_gain": 0.6}, FAST))
    assert found.verdict == "outside the library" and found.strength is not None
    assert found.strength.readings == ("rate-like",)
    assert found.strength.explained > 0.9
    told = shape(found, "inertial number")
    # mu(I) = mu_s (1 + r / (1 + I0 / I)), relative to the slow end.
    truth = np.log(1.0 + 0.6 / (1.0 + 0.279 / told.at))
    assert told.change == pytest.approx(truth[-1] - truth[0], abs=3.0 * told.std)
    assert told.std < 0.1
    sentences = record(experiment, found)["sentences"]
    assert any("looks rate-like" in s for s in sentences)


def test_a_hidden_cohesion_is_read_as_strength_under_little_pressure() -> None:
    _, found = criticised(series(("cohesion",), {"friction_angle": 33.0, "cohesion": 300.0}, SLOW))
    assert found.strength is not None and found.strength.readings == ("cohesion-like",)
    told = shape(found, "pressure")
    # Coulomb in triaxial compression: the cone's slope gains c cot(phi) / p of itself.
    gain = 300.0 / (math.tan(math.radians(33.0)) * told.at)
    truth = np.log1p(gain)
    assert told.change == pytest.approx(truth[-1] - truth[0], abs=3.0 * told.std + 0.05)
    assert all(s.argument != "inertial number" for s in found.strength.shapes), "one rate tells nothing of rates"


def test_a_hidden_softening_is_read_as_one() -> None:
    values = {"friction_angle": 31.0, "softening_angle": 8.0, "softening_strain": 0.15}
    _, found = criticised(series(("softening",), values, SLOW))
    assert found.strength is not None and found.strength.readings == ("softening-like",)
    told = shape(found, "plastic strain")
    excess = cone_slope(39.0) / cone_slope(31.0) - 1.0
    truth = np.log1p(excess * np.exp(-told.at / 0.15))
    assert told.change == pytest.approx(truth[-1] - truth[0], abs=3.0 * told.std + 0.02)


def test_what_is_no_strength_is_not_called_one() -> None:
    curves = series(("dilatancy",), {"friction_angle": 33.0, "dilatancy_angle": 10.0}, SLOW)
    experiment = TriaxialExperiment(curves, candidates=("cohesion",))
    simulate = Simulations(experiment)
    values = optimum(experiment, simulate, {p.name: p.default for p in experiment.parameters})
    found = diagnose(experiment, values, simulate=simulate)
    assert found.verdict == "outside the library" and found.strength is not None
    assert found.strength.readings == () and found.strength.explained < 0.5
    assert any("other than strength" in s for s in record(experiment, found)["sentences"])


def test_nothing_is_read_where_the_model_is_adequate() -> None:
    _, found = criticised(series((), {"friction_angle": 33.0}, FAST))
    assert found.verdict == "adequate" and found.strength is None


def test_the_law_with_hats_is_the_law_times_their_function() -> None:
    span = Range("pressure", math.log(1e3), math.log(1e5))
    effect = FreeStrength.over([span])
    heights = dict(zip((p.name for p in effect.parameters), (0.3, 0.1, 0.0, -0.1, -0.2), strict=True))
    for confining in (500.0, 4e3, 2e5):
        test = triaxial(
            Law([effect]), {"friction_angle": 33.0, **heights}, confining=confining, strains=[0.2], void_ratio=0.8
        )
        p, q = float(test.p[0, -1]), float(test.q[0, -1])
        factor = math.exp(float(np.interp(math.log(p), np.linspace(span.low, span.high, 5), list(heights.values()))))
        # At failure sqrt(J2) = q / sqrt(3).
        assert q / math.sqrt(3.0) / p == pytest.approx(factor * cone_slope(33.0), rel=2e-3)


def test_hats_sum_to_one_and_ranges_hold_what_was_visited() -> None:
    span = Range("plastic strain", 0.0, 2.0)
    assert np.allclose(hats(span, np.linspace(-1.0, 3.0, 21)).sum(axis=1), 1.0)
    generator = np.random.default_rng(0)
    pressure = np.exp(generator.uniform(math.log(100.0), math.log(2000.0), 4000))
    still = States(pressure, np.full(4000, 5.0), generator.uniform(0.0, 1.0, 4000), np.full(4000, 1 / 4000))
    found = {r.argument: r for r in ranges(still)}
    assert set(found) == {"pressure", "plastic strain"}
    assert found["pressure"].low == pytest.approx(math.log(100.0), abs=0.15)
    assert found["plastic strain"].high == pytest.approx(0.98, abs=0.01)
    moving = States(pressure, np.exp(generator.uniform(0.0, 3.0, 4000)), still.strain, still.weight)
    assert {r.argument for r in ranges(moving)} == {"pressure", "inertial number", "plastic strain"}
    inertial = coordinates(moving)["inertial number"]
    assert np.allclose(np.exp(inertial), moving.rate * 1e-3 / np.sqrt(moving.pressure / 2500.0))
