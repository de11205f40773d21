"""The law at a single stress point, driven by prescribed velocity gradients, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from splatsoil.errors import ParameterError
from splatsoil.soil.law import Law, Stress
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.matching import Matching, cone_slope
from splatsoil.soil.settings import Settings

BULK, SHEAR = 2.0e7, 1.0e7
BASE = Settings(friction_angle=35.0)


def drive_through(
    law: Law, values: Mapping[str, float], stages: list[tuple[Any, float]], pressure: float, steps: int
) -> tuple[npt.NDArray[np.float64], float]:
    """Stress tensor (tension positive, Pa) and opening after stages of a velocity gradient and a duration each."""
    update = law.update

    @wp.kernel(module="unique")
    def advance(
        state: wp.array(dtype=float), gradient: wp.mat33, dt: float, steps: int, values: wp.array2d(dtype=float)
    ) -> None:
        stress = Stress()
        stress.normal = wp.vec3(state[0], state[1], state[2])
        stress.shear = wp.vec3(state[3], state[4], state[5])
        stress.elastic = state[6]
        stress.opening = state[7]
        for _ in range(steps):
            stress = update(stress, gradient, BULK, SHEAR, dt, values, 0)
        for k in range(3):
            state[k] = stress.normal[k]
            state[3 + k] = stress.shear[k]
        state[6] = stress.elastic
        state[7] = stress.opening

    state = wp.zeros(8, dtype=float, device="cpu")
    state.assign(np.array([0, 0, 0, 0, 0, 0, -pressure / BULK, 0], dtype=np.float32))
    table = wp.array(law.table(BASE, [values]).astype(np.float32), dtype=float, device="cpu")
    for gradient, duration in stages:
        matrix = wp.mat33(*np.asarray(gradient, dtype=np.float64).reshape(-1))
        wp.launch(advance, dim=1, inputs=[state, matrix, duration / steps, steps, table], device="cpu")
    s = state.numpy().astype(np.float64)
    deviator = np.array([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])
    return deviator + BULK * s[6] * np.eye(3), float(s[7])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rigid_rotation_turns_stress_and_makes_none(axis: int) -> None:
    """A quarter turn about one axis (objectivity of the Jaumann rate) of a stress with all six numbers."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    rate, turn = np.zeros((3, 3)), np.eye(3)
    rate[one, other], rate[other, one] = -math.pi / 2, math.pi / 2
    turn[[one, other]] = turn[[other, one]]
    turn[one] *= -1.0
    squeeze = 1e-5 * np.array([[-2.0, 1.0, -0.5], [1.0, 1.5, 0.7], [-0.5, 0.7, 0.5]])
    before, _ = drive_through(Law(), {"friction_angle": 45.0}, [(squeeze, 1.0)], 1.0e4, 2000)
    after, _ = drive_through(Law(), {"friction_angle": 45.0}, [(squeeze, 1.0), (rate, 1.0)], 1.0e4, 2000)
    np.testing.assert_allclose(before, 2.0 * SHEAR * squeeze - 1.0e4 * np.eye(3), atol=1.0)
    np.testing.assert_allclose(after, turn @ before @ turn.T, atol=2.0)


def test_soil_that_came_apart_bears_no_load_until_it_has_closed() -> None:
    """Opening by 5 % and closing by as much ends at the starting pressure; half-way closed there is none."""
    apart, half, back = (np.diag([r, 0.0, 0.0]) for r in (0.05, -0.025, -0.025))
    law, values = Law(), {"friction_angle": 35.0}
    opened, gap = drive_through(law, values, [(apart, 1.0)], 1.0e3, 500)
    assert np.abs(opened).max() < 1e-3
    assert gap == pytest.approx(0.05 - 1.0e3 / BULK, rel=1e-3)
    halfway, _ = drive_through(law, values, [(apart, 1.0), (half, 1.0)], 1.0e3, 500)
    assert np.abs(halfway).max() < 1e-3
    closed, gap = drive_through(law, values, [(apart, 1.0), (half, 1.0), (back, 1.0)], 1.0e3, 500)
    assert -np.trace(closed) / 3.0 == pytest.approx(1.0e3, rel=0.02)
    assert gap == pytest.approx(0.0, abs=1e-6)


def test_shear_flow_keeps_volume() -> None:
    shear = [[0, 1.0, 0], [0, 0, 0], [0, 0, 0]]
    stress, opening = drive_through(Law(), {"friction_angle": 30.0}, [(shear, 1.0)], 5.0e3, 5000)
    assert -np.trace(stress) / 3.0 == pytest.approx(5.0e3, rel=1e-4)
    assert opening == 0.0


def test_an_effect_that_is_off_costs_nothing() -> None:
    """Effects that do not touch strength leave the very same function; those that do give another."""
    assert Law(find_effects(["tool_friction"])).update is Law().update
    assert Law(find_effects(["cohesion"])).update is not Law().update


@pytest.mark.parametrize(
    ("matching", "slope"),
    [("compression", 0.819), ("extension", 0.556), ("plane_strain", 0.574), ("simple_shear", 0.700)],
)
def test_slopes_of_the_cone_at_35_degrees(matching: str, slope: float) -> None:
    assert cone_slope(35.0, Matching(matching)) == pytest.approx(slope, abs=6e-4)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        *((lambda angle=angle: cone_slope(angle), "friction angle") for angle in (-1.0, 90.0, math.nan)),
        (lambda: Law().settings(BASE, {"cohesion": 100.0}), r"cohesion.*effect is on"),
        (lambda: Law().settings(BASE, {"friction_angle": 80.0}), r"friction_angle: 80 deg lies outside \[20, 55\]"),
        (lambda: find_effects(["cohesiom"]), r"'cohesiom' is unknown, did you mean cohesion\?"),
        (lambda: find_effects(["magic"]), r"'magic' is unknown; known are .*cohesion"),
        (lambda: find_effects(["cohesion", "cohesion"]), "twice"),
    ],
)
def test_unknown_and_absurd_parameters_are_named(wrong: Callable[[], object], says: str) -> None:
    with pytest.raises(ParameterError, match=says):
        wrong()


def test_every_built_in_effect_is_complete() -> None:
    assert len(library()) >= 24
    for name, effect in library().items():
        assert effect.name == name
        assert effect.note and effect.source
        assert effect.size == effect.parameters[0].name
        assert effect.parameters[0].off is not None
        for parameter in effect.parameters:
            assert parameter.meaningful > 0.0
            assert parameter.off is None or parameter.default == parameter.off
            assert parameter.sign == 0 or parameter.off == (parameter.lower if parameter.sign > 0 else parameter.upper)
