"""The soil law: Drucker-Prager elastoplasticity with whatever effects a model has on, built as one Warp function.

Hypoelastic deviator (Jaumann rate), exact radial return, no plastic volume change. The volume is kept by two numbers:
the elastic logarithmic strain, which carries pressure, and the opening, by which soil that came apart in tension must
close again before it bears load; a pile can therefore neither gain nor forget volume (cf. the volume correction of
Tampubolon et al. 2017, sec. 4.3.4, here without a decomposition of F).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from splatsoil.errors import ParameterError
from splatsoil.parameters import FloatArray, Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.matching import cone_intercept, cone_slope
from splatsoil.soil.settings import FRICTION_ANGLE, Settings
from splatsoil.soil.strength import SoilState, Strength

# Columns of the table of values (simulations, columns) that every kernel reads; effects' parameters follow.
SLOPE = wp.constant(0)
INTERCEPT_PER_COHESION = wp.constant(1)
TOOL_FRICTION = wp.constant(2)
WALL_FRICTION = wp.constant(3)
FLOOR_FRICTION = wp.constant(4)
GRAVITY = wp.constant(5)
BASE_COLUMNS = 8


@wp.struct
class Stress:
    """Stress and volume at one stress point.

    Attributes:
        normal: deviator's diagonal (xx, yy, zz) in Pa.
        shear: deviator's off-diagonal (xy, xz, yz) in Pa.
        elastic: elastic logarithmic volume strain; pressure = -K * elastic.
        opening: logarithmic volume opened in tension, >= 0.
    """

    normal: wp.vec3
    shear: wp.vec3
    elastic: float
    opening: float


@wp.func
def base_strength(state: SoilState, values: wp.array2d(dtype=float), row: int) -> Strength:
    """Dry, cohesionless friction."""
    strength = Strength()
    strength.slope = values[row, SLOPE]
    strength.intercept = 0.0
    strength.intercept_per_cohesion = values[row, INTERCEPT_PER_COHESION]
    return strength


def _chain(previous: Any, effect: Any, column: int) -> Any:
    @wp.func
    def strength(state: SoilState, values: wp.array2d(dtype=float), row: int) -> Strength:
        return effect(previous(state, values, row), state, values, row, wp.static(column))

    return strength


def _stress_update(strength_of: Any) -> Any:
    @wp.func
    def update(
        stress: Stress,
        gradient: wp.mat33,
        bulk: float,
        shear: float,
        dt: float,
        values: wp.array2d(dtype=float),
        row: int,
    ) -> Stress:
        """Advance ``stress`` by ``dt`` under the velocity gradient; bulk and shear modulus in Pa."""
        rate = 0.5 * (gradient + wp.transpose(gradient))
        spin = 0.5 * (gradient - wp.transpose(gradient))
        dilation = wp.trace(rate)
        deviator = rate - (dilation / 3.0) * wp.identity(n=3, dtype=float)

        elastic = stress.elastic + dt * dilation
        opening = stress.opening
        if elastic < 0.0 and opening > 0.0:
            closing = wp.min(opening, -elastic)
            opening = opening - closing
            elastic = elastic + closing
        pressure = -bulk * elastic

        d = stress.normal
        o = stress.shear
        s = wp.mat33(d[0], o[0], o[1], o[0], d[1], o[2], o[1], o[2], d[2])
        turned = spin * s
        s = s + dt * (2.0 * shear * deviator + turned + wp.transpose(turned))

        state = SoilState()
        state.pressure = pressure
        state.shear_rate = wp.sqrt(2.0 * wp.ddot(deviator, deviator))
        state.opening = opening
        strength = strength_of(state, values, row)
        apex = -strength.intercept / wp.max(strength.slope, 1.0e-6)
        if pressure < apex:
            opening = opening + elastic + apex / bulk
            elastic = -apex / bulk
            pressure = apex
        limit = wp.max(strength.intercept + strength.slope * pressure, 0.0)
        measure = wp.sqrt(0.5 * wp.ddot(s, s))
        if measure > limit:
            s = s * (limit / wp.max(measure, 1.0e-12))

        result = Stress()
        result.normal = wp.vec3(s[0, 0], s[1, 1], s[2, 2])
        result.shear = wp.vec3(s[0, 1], s[0, 2], s[1, 2])
        result.elastic = elastic
        result.opening = opening
        return result

    return update


@cache
def _compiled(key: tuple[tuple[Any, int], ...]) -> Any:
    strength_of: Any = base_strength
    for function, column in key:
        strength_of = _chain(strength_of, function, column)
    return _stress_update(strength_of)


class Law:
    """The base law with a set of effects on.

    Attributes:
        effects: the effects that are on.
        parameters: friction angle, then the effects' parameters.
        update: ``@wp.func`` that advances a :class:`Stress`; equal objects for equal combinations.
    """

    def __init__(self, effects: Iterable[Effect] = ()) -> None:
        self.effects: tuple[Effect, ...] = tuple(effects)
        self.parameters: tuple[Parameter, ...] = (
            FRICTION_ANGLE,
            *(p for effect in self.effects for p in effect.parameters),
        )
        key: list[tuple[Any, int]] = []
        self._strength_parameters: list[str] = []
        for effect in self.effects:
            if effect.strength is not None:
                key.append((effect.strength, BASE_COLUMNS + len(self._strength_parameters)))
                self._strength_parameters.extend(p.name for p in effect.parameters)
        self.update = _compiled(tuple(key))

    def settings(self, base: Settings, values: Mapping[str, float]) -> Settings:
        """``base`` with the friction angle of ``values`` and every effect applied.

        Raises:
            ParameterError: an unknown name or a value outside its bounds.
        """
        known = {p.name: p for p in self.parameters}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ParameterError(
                f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}"
                " (an effect's parameters exist when the effect is on)"
            )
        full = {name: p.check(values.get(name, p.default)) for name, p in known.items()}
        result = Settings(
            friction_angle=full["friction_angle"] if "friction_angle" in values else base.friction_angle,
            gravity=base.gravity,
            tool_friction=base.tool_friction,
            wall_friction=base.wall_friction,
            floor_friction=base.floor_friction,
            matching=base.matching,
        )
        for effect in self.effects:
            result = effect.settings(result, full)
        return result

    def table(self, base: Settings, batch: Sequence[Mapping[str, float]]) -> FloatArray:
        """Values (simulations, columns) that the kernels read, one row for each entry of ``batch``."""
        rows = []
        defaults = {p.name: p.default for p in self.parameters}
        for values in batch:
            s = self.settings(base, values)
            full = {**defaults, **values}
            rows.append(
                [
                    cone_slope(s.friction_angle, s.matching),
                    cone_intercept(s.friction_angle, 1.0, s.matching),
                    s.tool_friction,
                    s.wall_friction,
                    s.floor_friction,
                    *s.gravity,
                    *(full[name] for name in self._strength_parameters),
                ]
            )
        return np.array(rows, dtype=np.float64)
