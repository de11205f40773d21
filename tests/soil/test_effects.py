"""Every effect on strength in an element test, against its closed form."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from splatsoil.envs.together import attempt

from splatsoil.errors import ParameterError
from splatsoil.soil.element import ElementTest, isotropic_compression, simple_shear, triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

ANGLE, PRESSURE = 33.0, 1.0e4
STRAINS = np.linspace(0.01, 0.6, 60)


def sheared(name: str, values: Mapping[str, float], **options: object) -> ElementTest:
    """Simple shear under constant stress, with the matching for which tau = sigma_z tan(phi)."""
    return simple_shear(
        Law(find_effects([name])),
        {"friction_angle": ANGLE, **values},
        confining=PRESSURE,
        strains=STRAINS,
        matching=Matching.SIMPLE_SHEAR,
        **options,  # type: ignore[arg-type]
    )


def ratio(test: ElementTest) -> np.ndarray:
    """Friction tau / p at the records."""
    return test.shear_stress[0, 1:] / test.p[0, 1:]


def friction(angle: float) -> float:
    return math.tan(math.radians(angle))


def test_dilatancy_gains_the_volume_of_an_exponential_decay() -> None:
    test = sheared("dilatancy", {"dilatancy_angle": 10.0, "dilatancy_strain": 0.2})
    plastic = test.plastic_strain[0, 1:]
    np.testing.assert_allclose(
        -test.volume_strain[0, 1:], friction(10.0) * 0.2 * (1.0 - np.exp(-plastic / 0.2)), atol=1e-4
    )
    assert plastic[-1] == pytest.approx(0.6, rel=0.01)


def test_dilatancy_angle_is_that_of_the_triaxial_test() -> None:
    """d eps_v / d eps_1 = -2 sin psi / (1 - sin psi) at failure, and the strength stays that of the friction angle."""
    values = {"friction_angle": ANGLE, "dilatancy_angle": 12.0, "dilatancy_strain": 2.0}
    strains = np.linspace(0.001, 0.011, 11)
    test = triaxial(Law(find_effects(["dilatancy"])), values, confining=1e5, strains=strains, young=1e9)
    sine, phi = math.sin(math.radians(12.0)), math.sin(math.radians(ANGLE))
    assert test.q[0, -1] == pytest.approx(2e5 * phi / (1.0 - phi), rel=1e-3)
    slope = np.diff(test.volume_strain[0, 5:7]) / np.diff(strains[4:6])
    assert slope == pytest.approx(-2.0 * sine / (1.0 - sine), rel=0.02)


def test_dilation_at_constant_volume_raises_the_pressure() -> None:
    """K d(eps_e) = p: undrained, b g_d (1 - exp) of plastic volume is taken up by elastic compression."""
    young, poisson = 1.0e7, 0.2
    bulk, shear = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
    test = sheared("dilatancy", {"dilatancy_angle": 5.0, "dilatancy_strain": 0.1}, constant_volume=True, young=young)
    plastic = test.plastic_strain[0, 1:]
    gained = bulk * friction(5.0) * 0.1 * (1.0 - np.exp(-plastic / 0.1))
    np.testing.assert_allclose(test.p[0, 1:], PRESSURE + gained, rtol=2e-3)
    np.testing.assert_allclose(ratio(test)[-20:], friction(ANGLE), rtol=1e-3)
    np.testing.assert_allclose(plastic + test.shear_stress[0, 1:] / shear, STRAINS, rtol=2e-3)


def test_loose_soil_loses_its_volume_in_shear() -> None:
    test = sheared("compaction", {"looseness": 0.04, "compaction_strain": 0.2})
    plastic = test.plastic_strain[0, 1:]
    np.testing.assert_allclose(test.volume_strain[0, 1:], 0.04 * (1.0 - np.exp(-plastic / 0.2)), atol=2e-4)


def test_loose_soil_gives_way_under_pressure() -> None:
    """p / K up to the pressure of compaction, (V / 10) ln(p / p_c) beyond it."""
    law, young = Law(find_effects(["compaction"])), 5.0e7
    pressures = np.array([1e4, 2e4, 5e4, 1e5])
    values = {"looseness": 0.05, "compaction_pressure": 2e4}
    test = isotropic_compression(law, values, confining=5e3, pressures=pressures, young=young, largest_step=2e-5)
    bulk = young / (3.0 * (1.0 - 0.4))
    expected = (pressures - 5e3) / bulk + 0.005 * np.log(np.maximum(pressures / 2e4, 1.0))
    np.testing.assert_allclose(test.volume_strain[0, 1:], expected, rtol=5e-3)


@pytest.mark.parametrize("inertial_number", [0.01, 0.279, 3.0])
def test_friction_follows_the_inertial_number(inertial_number: float) -> None:
    """mu(I) of glass beads: mu_s = tan 20.9 deg, mu_2 = tan 32.8 deg, I0 = 0.279, d = 1 mm, rho_s = 2500 kg/m^3."""
    low, high = friction(20.9), friction(32.8)
    rate = inertial_number * math.sqrt(PRESSURE / 2500.0) / 1e-3
    law = Law(find_effects(["rate_dependence"]))
    test = simple_shear(
        law,
        {"friction_angle": 20.9, "rate_gain": high / low - 1.0},
        confining=PRESSURE,
        strains=[0.05],
        strain_rate=rate,
        matching=Matching.SIMPLE_SHEAR,
    )
    rate *= math.sqrt(PRESSURE / test.p[0, -1])
    expected = low + (high - low) / (0.279 / inertial_number + 1.0)
    assert ratio(test)[-1] == pytest.approx(expected, rel=2e-3)


def test_viscosity_adds_stress_in_proportion_to_the_rate() -> None:
    test = sheared("viscosity", {"viscosity": 20.0}, strain_rate=30.0)
    np.testing.assert_allclose(test.shear_stress[0, 1:], friction(ANGLE) * test.p[0, 1:] + 20.0 * 30.0, rtol=1e-3)


def test_viscous_soil_sheared_back_resists_the_other_way() -> None:
    """Bingham's law: the stress opposes the flow, whichever way that goes, by as much."""
    test = simple_shear(
        Law(find_effects(["viscosity"])),
        {"friction_angle": ANGLE, "viscosity": 20.0},
        confining=PRESSURE,
        strains=[0.05, 0.0],
        strain_rate=30.0,
        matching=Matching.SIMPLE_SHEAR,
    )
    expected = friction(ANGLE) * test.p[0, 1:] + 20.0 * 30.0
    np.testing.assert_allclose(test.shear_stress[0, 1:], [expected[0], -expected[1]], rtol=2e-3)


def test_softening_goes_from_peak_to_residual() -> None:
    test = sheared("softening", {"softening_angle": 8.0, "softening_strain": 0.1})
    residual, peak = friction(ANGLE), friction(ANGLE + 8.0)
    plastic = test.plastic_strain[0, 1:]
    np.testing.assert_allclose(ratio(test), residual + (peak - residual) * np.exp(-plastic / 0.1), rtol=3e-3)


def test_envelope_is_a_power_law_of_pressure() -> None:
    law = Law(find_effects(["pressure_dependence"]))
    values = {"friction_angle": ANGLE, "pressure_exponent": 0.1, "pressure_reference": 1000.0}
    for pressure in (300.0, 1000.0, 1.0e5):
        test = simple_shear(
            law, values, confining=pressure, strains=[0.05], matching=Matching.SIMPLE_SHEAR, young=500.0 * pressure
        )
        p = test.p[0, -1]
        assert test.shear_stress[0, -1] == pytest.approx(friction(ANGLE) * 1000.0 * (p / 1000.0) ** 0.9, rel=1e-3)


def test_a_layer_has_its_own_friction_angle_below_its_depth() -> None:
    values = {"layer_friction": 6.0, "layer_depth": 0.05}
    np.testing.assert_allclose(ratio(sheared("layering", values, depth=0.04))[-1], friction(ANGLE), rtol=1e-3)
    np.testing.assert_allclose(ratio(sheared("layering", values, depth=0.06))[-1], friction(ANGLE + 6.0), rtol=1e-3)


def test_friction_grows_with_the_logarithm_of_density() -> None:
    """50 deg per log density: at 0.1 m and 0.5 / m it is 50 ln 1.05 deg more, to the first order in the slope."""
    test = sheared("density_gradient", {"density_gradient": 0.5, "density_friction": 50.0}, depth=0.1)
    assert ratio(test)[-1] == pytest.approx(friction(ANGLE + 50.0 * math.log(1.05)), rel=5e-3)
    law = Law(find_effects(["density_gradient", "layering"]))
    density = law.density(
        np.array([0.0, 0.1, 0.2]), {"density_gradient": 0.5, "layer_density": 1.2, "layer_depth": 0.15}
    )
    np.testing.assert_allclose(density, [1.0, 1.05, 1.2 * 1.1])


def test_cohesion_matches_mohr_coulomb_in_extension_too() -> None:
    """q = 6 (c cos phi + p sin phi) / (3 + sin phi) in extension, for a cone matched there."""
    law = Law(find_effects(["cohesion"]))
    values = {"friction_angle": ANGLE, "cohesion": 500.0}
    test = triaxial(law, values, confining=PRESSURE, strains=[-0.02], matching=Matching.EXTENSION)
    sine, cosine = math.sin(math.radians(ANGLE)), math.cos(math.radians(ANGLE))
    assert -test.q[0, -1] == pytest.approx(6.0 * (500.0 * cosine + test.p[0, -1] * sine) / (3.0 + sine), rel=1e-3)


def test_stiffness_multiplies_the_moduli() -> None:
    law = Law(find_effects(["stiffness"]))
    test = isotropic_compression(
        law, [{"stiffness_factor": f} for f in (1.0, 4.0)], confining=1e4, pressures=[5e4], young=5e7
    )
    np.testing.assert_allclose(test.volume_strain[:, -1], 4e4 * 3.0 * 0.6 / 5e7 / np.array([1.0, 4.0]), rtol=1e-3)


def test_tilt_and_gravity_turn_and_scale_the_weight() -> None:
    base = Settings(friction_angle=ANGLE)
    tilted = Law(find_effects(["tilt"])).settings(base, {"tilt_x": 10.0})
    assert tilted.gravity == pytest.approx(
        (9.81 * math.sin(math.radians(10.0)), 0.0, -9.81 * math.cos(math.radians(10.0)))
    )
    across = Law(find_effects(["tilt"])).settings(base, {"tilt_y": 10.0})
    assert across.gravity[1] == pytest.approx(9.81 * math.sin(math.radians(10.0)))
    moon = Law(find_effects(["gravity", "tilt"])).settings(base, {"gravity_factor": 0.165, "tilt_x": -5.0})
    assert math.hypot(*moon.gravity) == pytest.approx(0.165 * 9.81)
    assert moon.gravity[0] < 0.0


def strength_effects() -> list[str]:
    return [name for name, effect in library().items() if effect.strength is not None]


@pytest.mark.parametrize("name", strength_effects())
def test_off_values_change_nothing(name: str) -> None:
    """At its size's off value, whatever its other parameters are, an effect leaves every stress as it was."""
    plain = triaxial(Law(), {"friction_angle": ANGLE}, confining=PRESSURE, strains=[0.002, 0.03])
    effect = library()[name]
    for extreme in ("lower", "upper"):
        others = {p.name: getattr(p, extreme) for p in effect.parameters[1:] if p.off is None}
        off = triaxial(Law([effect]), {"friction_angle": ANGLE, **others}, confining=PRESSURE, strains=[0.002, 0.03])
        np.testing.assert_allclose(off.stress, plain.stress, rtol=2e-5)


def test_all_effects_on_strength_work_together_in_any_order() -> None:
    names = [n for n in library() if n != "compaction"]
    sizes = {"cohesion": 200.0, "dilatancy_angle": 8.0, "rate_gain": 0.5, "viscosity": 5.0, "softening_angle": 4.0}
    values = sizes | {"pressure_exponent": 0.05, "layer_friction": 2.0, "density_gradient": 0.5}
    one, other = Law(find_effects(names)), Law(find_effects(names[::-1]))
    assert one.update is other.update
    np.testing.assert_array_equal(
        np.sort(one.table(Settings(ANGLE), [values])), np.sort(other.table(Settings(ANGLE), [values]))
    )
    test = triaxial(one, values, confining=PRESSURE, strains=[0.1])
    assert np.isfinite(test.q).all() and test.q[0, -1] > 0.0


def test_combinations_without_meaning_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"compaction and dilatancy cannot both be on: soil is either"):
        Law(find_effects(["dilatancy", "compaction"]))
    dilating = Law(find_effects(["dilatancy"]))
    with pytest.raises(ParameterError, match=r"dilatancy_angle: 24 deg exceeds the friction angle of 22 deg"):
        dilating.table(Settings(ANGLE), [{"friction_angle": 22.0, "dilatancy_angle": 24.0}])
    with pytest.raises(ParameterError, match=r"tool_friction: -0.1 is not a friction coefficient"):
        Settings(ANGLE, tool_friction=-0.1)
    with pytest.raises(ParameterError, match=r"layer_friction: 60 deg on top .* outside \[0, 90\)"):
        Settings(ANGLE).relative_slope(60.0, "layer_friction")


def test_a_parameter_belongs_to_one_effect() -> None:
    class Twin(type(library()["cohesion"])):  # type: ignore[misc]
        name = "twin"

    with pytest.raises(ParameterError, match=r"two effects have a parameter named cohesion"):
        Law([library()["cohesion"], Twin()])


def test_a_search_takes_a_combination_without_meaning_for_a_failed_simulation() -> None:
    """A fit of dilatancy draws angles of dilation above small friction angles: both lie within their bounds."""
    law = Law(find_effects(["dilatancy"]))

    class Problem:
        block_count = 3

        def evaluate(self, parameters: Mapping[str, float], seed: int) -> object:
            law.table(Settings(ANGLE), [parameters])
            raise AssertionError("the combination was taken")

    found = attempt(Problem(), {"friction_angle": 21.0, "dilatancy_angle": 24.0}, 0)  # type: ignore[arg-type]
    assert found.loss is None
    assert "24 deg exceeds the friction angle of 21 deg" in found.message
