"""Every effect on strength in an element test, against its closed form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from splatsoil.errors import CombinationError, ParameterError
from splatsoil.measurement import Measurement
from splatsoil.soil.element import ElementTest, drive, isotropic_compression, simple_shear, triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.matching import Matching, cone_slope
from splatsoil.soil.packing import at_void_ratio
from splatsoil.soil.settings import Settings

ANGLE, PRESSURE = 33.0, 1.0e4
STRAINS = np.linspace(0.01, 0.6, 60)


def sheared(
    name: str,
    values: Mapping[str, float],
    strains: npt.ArrayLike = STRAINS,
    confining: float = PRESSURE,
    **options: object,
) -> ElementTest:
    """Simple shear under constant stress, with the matching for which tau = sigma_z tan(phi)."""
    law, given = Law(find_effects([name])), {"friction_angle": ANGLE, **values}
    fixed = {"confining": confining, "strains": strains, "matching": Matching.SIMPLE_SHEAR}
    return simple_shear(law, given, **fixed, **options)  # type: ignore[arg-type]


def ratio(test: ElementTest) -> np.ndarray:
    """Friction tau / p at the records."""
    return test.shear_stress[0, 1:] / test.p[0, 1:]


def friction(angle: float) -> float:
    return math.tan(math.radians(angle))


@pytest.mark.parametrize(
    ("name", "size", "lost"),
    [
        ("dilatancy", {"dilatancy_angle": 10.0}, -0.2 * math.tan(math.radians(10.0))),
        ("compaction", {"looseness": 0.04}, 0.04),
    ],
)
def test_shear_changes_the_volume_by_an_exponential_decay(name: str, size: dict[str, float], lost: float) -> None:
    test = sheared(name, {**size, f"{name}_strain": 0.2})
    plastic = test.plastic_strain[0, 1:]
    np.testing.assert_allclose(test.volume_strain[0, 1:], lost * (1.0 - np.exp(-plastic / 0.2)), atol=2e-4)
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


def test_loose_soil_gives_way_under_pressure() -> None:
    """p / K up to the pressure of compaction, (V / 10) ln(p / p_c) beyond it."""
    law, young = Law(find_effects(["compaction"])), 5.0e7
    pressures = np.array([1e4, 2e4, 5e4, 1e5])
    values = {"looseness": 0.05, "compaction_pressure": 2e4}
    test = isotropic_compression(law, values, confining=5e3, pressures=pressures, young=young, largest_step=2e-5)
    bulk = young / (3.0 * (1.0 - 0.4))
    expected = (pressures - 5e3) / bulk + 0.005 * np.log(np.maximum(pressures / 2e4, 1.0))
    np.testing.assert_allclose(test.volume_strain[0, 1:], expected, rtol=5e-3)


def test_viscosity_adds_stress_in_proportion_to_the_rate_whichever_way_it_flows() -> None:
    """Bingham's law; sheared back, the stress opposes the flow by as much."""
    test = sheared("viscosity", {"viscosity": 20.0}, [0.05, 0.3, 0.0], strain_rate=30.0)
    expected = friction(ANGLE) * test.p[0, 1:] + 20.0 * 30.0
    np.testing.assert_allclose(test.shear_stress[0, 1:], [1.0, 1.0, -1.0] * expected, rtol=2e-3)


def test_softening_goes_from_peak_to_residual() -> None:
    test = sheared("softening", {"softening_angle": 8.0, "softening_strain": 0.1})
    residual, peak = friction(ANGLE), friction(ANGLE + 8.0)
    plastic = test.plastic_strain[0, 1:]
    np.testing.assert_allclose(ratio(test), residual + (peak - residual) * np.exp(-plastic / 0.1), rtol=3e-3)


@pytest.mark.parametrize("pressure", [300.0, 1000.0, 1.0e5])
def test_envelope_is_a_power_law_of_pressure(pressure: float) -> None:
    values = {"pressure_exponent": 0.1, "pressure_reference": 1000.0}
    test = sheared("pressure_dependence", values, [0.05], pressure, young=500.0 * pressure)
    expected = friction(ANGLE) * 1000.0 * (test.p[0, -1] / 1000.0) ** 0.9
    assert test.shear_stress[0, -1] == pytest.approx(expected, rel=1e-3)


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


@pytest.mark.parametrize(("matching", "degrees"), [(Matching.COMPRESSION, 3.0), (Matching.PLANE_STRAIN, 5.0)])
def test_friction_and_dilation_follow_boltons_index(matching: Matching, degrees: float) -> None:
    """Bolton (1986): phi = phi_c + 3 I_R (5 in plane strain), 0.3 I_R of volume per axial strain; I_R = 5 I_D - 1."""
    effect = library()["critical_state"]
    for density in (0.0, 0.2, 0.5, 0.8, 1.0):
        index = 5.0 * density - 1.0
        _, _, more, less, first, bend = effect.columns(
            Settings(ANGLE, matching=matching), {"relative_density": density, "volume_range": 0.2}
        )
        slope = cone_slope(ANGLE, matching) * (1.0 + more * index / (1.0 + less * index))
        assert slope == pytest.approx(cone_slope(ANGLE + degrees * index, matching), rel=0.01)
        gain = 0.3 * index
        # per shear strain g: g = sqrt(3) (eps_1 - eps_v / 3) in triaxial compression, eps_1 - eps_3 in plane strain
        sheared = math.sqrt(3.0) * (1.0 + gain / 3.0) if matching is Matching.COMPRESSION else 2.0 + gain
        assert first * index / (1.0 + bend * index) == pytest.approx(gain / sheared, abs=1e-9)


@pytest.mark.parametrize("density", [0.0, 0.1, 0.5, 0.9])
def test_shear_brings_any_density_to_the_critical_state(density: float) -> None:
    """At I_R = 0, below 150 kPa at I_D = 0.2, volume stays and friction is the critical one."""
    values = {"friction_angle": ANGLE, "relative_density": density, "volume_range": 0.2}
    law = Law(find_effects(["critical_state"]))
    test = triaxial(law, values, confining=2e4, strains=np.linspace(0.002, 2.0, 100), young=1e8)
    assert -test.volume_strain[0, -1] == pytest.approx(0.2 * (density - 0.2), abs=2e-3)
    phi = math.sin(math.radians(ANGLE))
    assert test.q[0, -1] == pytest.approx(4e4 * phi / (1.0 - phi), rel=0.01)
    peak = math.sin(math.radians(ANGLE + 3.0 * (5.0 * density - 1.0)))
    assert test.q[0].max() == pytest.approx(4e4 * max(peak / (1.0 - peak), phi / (1.0 - phi)), rel=0.03)


@pytest.mark.parametrize(("pressure", "gains"), [(5e5, True), (2e7, False)])
def test_pressure_takes_dilatancy_away(pressure: float, gains: bool) -> None:
    """I_R = 0 at ln p = Q - R / I_D: above it dense sand contracts."""
    options = {"constant_volume": True, "young": 100.0 * pressure}
    test = sheared("critical_state", {"relative_density": 0.8}, [0.02, 0.04], pressure, **options)
    assert (test.p[0, 2] > test.p[0, 1]) == gains


def test_hardening_mobilises_friction_by_a_hyperbola() -> None:
    """g / (0.9 (A + g)) with A for the pressure, all of it from 9 A on; volume lost from Rowe's 9 M / (9 + 3 M) on."""
    values = {"friction_angle": ANGLE, "hardening_strain": 0.02}
    law = Law(find_effects(["hardening"]))
    test = triaxial(law, values, confining=1e5, strains=STRAINS, young=1e8, largest_step=5e-5)
    plastic, p = test.plastic_strain[0], test.p[0]
    share = np.minimum(plastic / (0.9 * (0.02 * np.sqrt(p / 1e5) + plastic)), 1.0)
    slope = cone_slope(ANGLE)
    np.testing.assert_allclose(test.q[0, 1:] / math.sqrt(3.0) / p[1:], slope * share[1:], rtol=0.01)
    elastic = (p - 1e5) / (1e8 / 1.8)
    # Rowe's is per deviatoric strain, q = M p; the shear strain is sqrt(3) times that
    stress_ratio = math.sqrt(3.0) * slope
    rowe = 9.0 * stress_ratio / (9.0 + 3.0 * stress_ratio) / math.sqrt(3.0)
    lost = np.sum(rowe * (1.0 - 0.5 * (share[1:] + share[:-1])) * np.diff(plastic))
    assert test.volume_strain[0, -1] - elastic[-1] == pytest.approx(lost, rel=0.03)


def test_one_friction_angle_in_compression_and_extension_and_matsuoka_nakai_between() -> None:
    """(s1 - s3) / (s1 + s3) = sin phi in both, and I1 I2 / I3 = (9 - sin^2 phi) / (1 - sin^2 phi) in plane strain."""
    law = Law(find_effects(["intermediate_stress"]))
    values = {"friction_angle": ANGLE, "intermediate_share": 1.0}
    sine = math.sin(math.radians(ANGLE))
    for strain in (0.05, -0.05):
        stress = np.sort(triaxial(law, values, confining=PRESSURE, strains=[strain]).stress[0, -1])
        assert (stress[2] - stress[0]) / (stress[2] + stress[0]) == pytest.approx(sine, rel=1e-3)
    plane = drive(
        law, values, np.array([[PRESSURE, 0.0, 0.05, 0.0]]), by_stress=(True, False, False), confining=PRESSURE
    ).stress[0, -1]
    second = plane[0] * plane[1] + plane[1] * plane[2] + plane[2] * plane[0]
    assert plane.sum() * second / plane.prod() == pytest.approx((9.0 - sine**2) / (1.0 - sine**2), rel=1e-3)


def test_another_packing_changes_density_and_hardening_alone() -> None:
    values = {"friction_angle": ANGLE, "relative_density": 0.3, "volume_range": 0.2, "hardening_strain": 0.01}
    dense = at_void_ratio(values, 0.9, 0.75)
    density = 0.3 + math.log(1.9 / 1.75) / 0.2
    assert dense == pytest.approx({**values, "relative_density": density, "hardening_strain": 0.003 / density})
    assert at_void_ratio(dense, 0.75, 0.9) == pytest.approx(values)
    assert at_void_ratio({"friction_angle": ANGLE}, 0.9, 0.75) == {"friction_angle": ANGLE}
    with pytest.raises(CombinationError, match=r"void ratio 0.5: a relative density of 0.30 at 0.9 makes 1.48 of it"):
        at_void_ratio(values, 0.9, 0.5)


def test_stiffness_multiplies_the_moduli() -> None:
    law = Law(find_effects(["stiffness"]))
    test = isotropic_compression(
        law, [{"stiffness_factor": f} for f in (1.0, 4.0)], confining=1e4, pressures=[5e4], young=5e7
    )
    np.testing.assert_allclose(test.volume_strain[:, -1], 4e4 * 3.0 * 0.6 / 5e7 / np.array([1.0, 4.0]), rtol=1e-3)


@pytest.mark.parametrize(
    ("values", "gravity"),
    [
        ({"tilt_x": 10.0}, (9.81 * math.sin(math.radians(10.0)), 0.0, -9.81 * math.cos(math.radians(10.0)))),
        ({"tilt_y": 10.0}, (0.0, 9.81 * math.sin(math.radians(10.0)), -9.81 * math.cos(math.radians(10.0)))),
        (
            {"gravity_factor": 0.165, "tilt_x": -5.0},
            (-0.165 * 9.81 * math.sin(math.radians(5.0)), 0.0, -0.165 * 9.81 * math.cos(math.radians(5.0))),
        ),
    ],
)
def test_tilt_and_gravity_turn_and_scale_the_weight(
    values: dict[str, float], gravity: tuple[float, float, float]
) -> None:
    law = Law(find_effects(["gravity", "tilt"]))
    assert law.settings(Settings(ANGLE), values).gravity == pytest.approx(gravity)


@pytest.mark.parametrize("name", [name for name, effect in library().items() if effect.strength is not None])
def test_off_values_change_nothing(name: str) -> None:
    """At its size's off value, whatever its other parameters are, an effect leaves every stress as it was."""
    plain = triaxial(Law(), {"friction_angle": ANGLE}, confining=PRESSURE, strains=[0.002, 0.03])
    effect = library()[name]
    for extreme in ("lower", "upper"):
        others = {p.name: getattr(p, extreme) for p in effect.parameters[1:] if p.off is None}
        off = triaxial(Law([effect]), {"friction_angle": ANGLE, **others}, confining=PRESSURE, strains=[0.002, 0.03])
        np.testing.assert_allclose(off.stress, plain.stress, rtol=2e-5)


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


def test_a_stone_and_a_layer_are_looked_for_within_the_bed() -> None:
    """A bed of 0.8 x 0.5 x 0.27 m; what the model takes at all stays as it is."""
    measurement = Measurement.load(Path(__file__).parents[2] / "examples" / "plow-dry")
    bounds = {"obstacle_x": (-0.4, 0.4), "obstacle_y": (-0.25, 0.25), "layer_depth": (0.005, 0.27)}
    for name in ("buried_obstacle", "layering"):
        told = {p.name: p for p in library()[name].parameters}
        for p in library()[name].for_measurement(measurement).parameters:
            expected = bounds.get(p.name, (told[p.name].lower, told[p.name].upper))
            assert (p.lower, p.upper) == pytest.approx(expected)
            assert p.check(told[p.name].upper) == told[p.name].upper
