"""The element tests themselves: strength, elasticity, speed of convergence, and what they refuse."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from splatsoil.errors import ParameterError, SimulationError
from splatsoil.soil.element import drive, isotropic_compression, simple_shear, triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library


def test_before_failure_the_sample_is_elastic() -> None:
    young, poisson = 4.0e7, 0.3
    test = triaxial(Law(), {"friction_angle": 45.0}, confining=1e5, strains=[1e-3, 2e-3], young=young, poisson=poisson)
    np.testing.assert_allclose(test.q[0], [0.0, young * 1e-3, young * 2e-3], rtol=1e-3)
    np.testing.assert_allclose(test.volume_strain[0, 1:], (1.0 - 2.0 * poisson) * test.axial_strain[0, 1:], rtol=1e-3)
    assert test.void_ratio[0, 2] == pytest.approx(1.8 * math.exp(-test.volume_strain[0, 2]) - 1.0)


def test_a_loading_path_may_turn_back() -> None:
    """Unloading from failure is elastic: Young's modulus again."""
    test = triaxial(Law(), {"friction_angle": 30.0}, confining=1e5, strains=[0.02, 0.0195], young=1e8)
    assert test.q[0, 1] - test.q[0, 2] == pytest.approx(1e8 * 5e-4, rel=1e-3)


def test_isotropic_compression_follows_the_bulk_modulus() -> None:
    test = isotropic_compression(Law(), {}, confining=1e4, pressures=[2e4, 5e4, 1e4], young=3e7, poisson=0.25)
    np.testing.assert_allclose(test.p[0], [1e4, 2e4, 5e4, 1e4], rtol=1e-4)
    np.testing.assert_allclose(test.volume_strain[0], np.array([0.0, 1e4, 4e4, 0.0]) / 2e7, atol=2e-8)


def test_records_do_not_hang_on_the_size_of_steps() -> None:
    law = Law(find_effects(["dilatancy"]))
    values = {"friction_angle": 33.0, "dilatancy_angle": 10.0, "dilatancy_strain": 0.1}
    coarse, fine = (
        triaxial(law, values, confining=1e5, strains=[0.05, 0.1], largest_step=step) for step in (1e-3, 5e-5)
    )
    np.testing.assert_allclose(coarse.q, fine.q, rtol=1e-3)
    np.testing.assert_allclose(coarse.volume_strain, fine.volume_strain, atol=2e-4)


def test_a_stress_that_the_soil_cannot_bear_is_an_error() -> None:
    """At 35 deg and 10 kPa the strength is 36.90 kPa: under stress control, 36 kPa are reached and 38 kPa are not."""

    def loaded(axial: float) -> float:
        targets = np.array([[1e4, 1e4, axial, 0.0]])
        test = drive(Law(), {"friction_angle": 35.0}, targets, by_stress=(True, True, True), confining=1e4)
        return float(test.stress[0, -1, 2])

    assert loaded(3.6e4) == pytest.approx(3.6e4, rel=1e-3)
    with pytest.raises(SimulationError, match=r"1 of 1 parameter sets did not reach .* record 1 of 1 .*friction_angle"):
        loaded(3.8e4)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("values", "wrong", "says"),
    [
        ({}, {"confining": -1.0}, r"confining: -1.0 is not a positive number"),
        ({}, {"strains": [math.nan]}, r"strains: give at least one finite number"),
        ({}, {"poisson": 0.5}, r"poisson: 0.5"),
        ({"cohesion": 10.0}, {}, r"unknown parameter cohesion"),
        ([], {}, r"at least one set"),
        # more steps than a 32-bit number holds
        ({}, {"strains": [1e9]}, r"5e\+12 steps .* 10000000 are the most"),
        ({}, {"largest_step": 1e-12}, "steps"),
    ],
)
def test_meaningless_and_endless_tests_are_refused(values: Any, wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        triaxial(Law(), values, **{"confining": 1e4, "strains": [0.1], **wrong})


@pytest.mark.parametrize(
    "without",
    [("compaction", "critical_state"), ("dilatancy", "critical_state"), ("compaction", "dilatancy", "softening")],
)
def test_all_effects_on_strength_work_together_anywhere_between_their_bounds(without: tuple[str, ...]) -> None:
    """40 draws of every parameter of a law with all effects: each path ends on stresses that were asked for."""
    law = Law(find_effects(n for n, e in library().items() if e.strength is not None and n not in without))
    rng = np.random.default_rng(1)
    sets = []
    for _ in range(40):
        unit = {p: rng.random() for p in law.parameters}
        draw = {
            p.name: float(np.exp(np.log(p.lower) + u * np.log(p.upper / p.lower)))
            if p.log
            else p.lower + u * (p.upper - p.lower)
            for p, u in unit.items()
        }
        if "dilatancy_angle" in draw:
            draw["dilatancy_angle"] = min(draw["dilatancy_angle"], draw["friction_angle"])
        sets.append(draw)
    common = {"confining": 1e4, "depth": 0.05, "strain_rate": 1.0}
    pressed = triaxial(law, sets, strains=[0.02, 0.2], young=2e7, **common)  # type: ignore[arg-type]
    np.testing.assert_allclose(pressed.stress[..., :2], 1e4, rtol=1e-3)
    assert (pressed.q[:, -1] > 0.0).all() and np.isfinite(pressed.void_ratio).all()
    # hardening soil contracts by up to its slope: a step must be short against p / K
    common["largest_step"] = 2e-5
    turned = simple_shear(law, sets, strains=[0.3], young=2e7, **common)  # type: ignore[arg-type]
    np.testing.assert_allclose(turned.stress[:, -1, 2], 1e4, rtol=1e-3)


def test_loose_soil_has_settled_under_its_first_stress_before_the_test() -> None:
    """Ten times above the pressure of compaction, the next tenfold costs (V / 10) ln 10, as on the normal line."""
    law = Law(find_effects(["compaction"]))
    values = {"looseness": 0.1, "compaction_pressure": 1e3}
    test = isotropic_compression(law, values, confining=1e4, pressures=[1e5], young=5e8, largest_step=2e-5)
    elastic = 9e4 * 1.8 / 5e8
    assert test.volume_strain[0, -1] == pytest.approx(0.01 * math.log(10.0) + elastic, rel=0.01)
