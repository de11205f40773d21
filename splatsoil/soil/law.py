"""The soil law: Drucker-Prager elastoplasticity with whatever effects a model has on, built as one Warp function.

Hypoelastic deviator (Jaumann rate), exact return to the cone. The logarithmic volume is the sum of up to three numbers:
the elastic strain, which carries pressure; the opening, by which soil that came apart in tension must close again
before it bears load; and what plastic shear has dilated, in laws with an effect that acts on strength. A pile can
therefore neither gain nor forget volume (cf. the volume correction of Tampubolon et al. 2017, sec. 4.3.4, here without
a decomposition of F).

The flow is non-associated: a plastic shear strain g (engineering measure) lowers sqrt(J2) by G g and gains the volume
b g, which raises the pressure by K b g, so the point that ends on the cone sqrt(J2) = k + a p has
g = (sqrt(J2) - k - a p) / (G + a b K) of the trial stress (de Souza Neto et al. 2008, sec. 8.3). Viscous soil stays
beyond the cone by the viscosity times the plastic rate g / dt (Perzyna 1966; ibid., sec. 11.5), which adds
viscosity / dt to G + a b K.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from splatsoil.errors import ParameterError
from splatsoil.observation import Observation
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
STIFFNESS = wp.constant(8)
TOOL_ADHESION = wp.constant(9)
OBSTACLE = wp.constant(10)
BASE_COLUMNS = 14

# A soil that loses volume in shear must not lose its pressure faster than its shear stress: G + a b K > 0.
LEAST_DILATION = wp.constant(-0.8)


@wp.struct
class Stress:
    """Stress and volume at one stress point.

    Attributes:
        normal: deviator's diagonal (xx, yy, zz) in Pa.
        shear: deviator's off-diagonal (xy, xz, yz) in Pa.
        elastic: elastic logarithmic volume strain; pressure = -K * elastic.
        opening: logarithmic volume opened in tension, >= 0.
        plastic_strain: plastic shear strain so far; kept by laws with history only, like the next two.
        dilated: logarithmic volume gained by plastic shear so far.
        depth: of this soil below the surface at the start, m; constant.
    """

    normal: wp.vec3
    shear: wp.vec3
    elastic: float
    opening: float
    plastic_strain: float
    dilated: float
    depth: float


@wp.func
def base_strength(state: SoilState, values: wp.array2d(dtype=float), row: int) -> Strength:
    """Dry, cohesionless friction."""
    strength = Strength()
    strength.slope = values[row, SLOPE]
    strength.intercept = 0.0
    strength.intercept_per_cohesion = values[row, INTERCEPT_PER_COHESION]
    strength.dilation = 0.0
    strength.mobilised = 1.0
    strength.viscosity = 0.0
    strength.crush_pressure = 0.0
    strength.crush_hardening = 0.0
    return strength


def _chain(previous: Any, effect: Any, column: int) -> Any:
    @wp.func
    def strength(state: SoilState, values: wp.array2d(dtype=float), row: int) -> Strength:
        return effect(previous(state, values, row), state, values, row, wp.static(column))

    return strength


@wp.func
def _lode(normal: wp.vec3, shear: wp.vec3) -> float:
    """Cosine of three times the Lode angle of a deviator (tension positive), 1 in triaxial compression."""
    j2 = 0.5 * wp.dot(normal, normal) + wp.dot(shear, shear)
    j3 = (
        2.0 * shear[0] * shear[1] * shear[2]
        + normal[0] * (normal[1] * normal[2] - shear[2] * shear[2])
        - normal[1] * shear[1] * shear[1]
        - normal[2] * shear[0] * shear[0]
    )
    return wp.clamp(wp.static(-1.5 * 3.0**0.5) * j3 / wp.max(j2 * wp.sqrt(j2), 1.0e-12), -1.0, 1.0)


def _stress_update(strength_of: Any, history: bool) -> Any:
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
        dilation = wp.trace(gradient)
        third = dilation / 3.0
        # the deviator's rate, and the spin, by their six and three numbers: a cell's stress is most of what substeps do
        rate = wp.vec3(gradient[0, 0] - third, gradient[1, 1] - third, gradient[2, 2] - third)
        sheared = 0.5 * wp.vec3(
            gradient[0, 1] + gradient[1, 0], gradient[0, 2] + gradient[2, 0], gradient[1, 2] + gradient[2, 1]
        )
        spin = 0.5 * wp.vec3(
            gradient[0, 1] - gradient[1, 0], gradient[0, 2] - gradient[2, 0], gradient[1, 2] - gradient[2, 1]
        )

        elastic = stress.elastic + dt * dilation
        opening = stress.opening
        if elastic < 0.0 and opening > 0.0:
            closing = wp.min(opening, -elastic)
            opening = opening - closing
            elastic = elastic + closing
        pressure = -bulk * elastic

        d = stress.normal
        o = stress.shear
        # spin * s and its transpose
        xy, xz, yz = spin[0] * o[0], spin[1] * o[1], spin[2] * o[2]
        turned = 2.0 * wp.vec3(xy + xz, yz - xy, -xz - yz)
        twisted = wp.vec3(
            spin[0] * (d[1] - d[0]) + spin[1] * o[2] + spin[2] * o[1],
            spin[1] * (d[2] - d[0]) + spin[0] * o[2] - spin[2] * o[0],
            spin[2] * (d[2] - d[1]) - spin[0] * o[1] - spin[1] * o[0],
        )
        normal = d + dt * (2.0 * shear * rate + turned)
        tangent = o + dt * (2.0 * shear * sheared + twisted)

        state = SoilState()
        state.pressure = pressure
        state.shear_rate = wp.sqrt(2.0 * wp.dot(rate, rate) + 4.0 * wp.dot(sheared, sheared))
        state.opening = opening
        if wp.static(history):
            state.plastic_strain = stress.plastic_strain
            state.dilated = stress.dilated
            state.depth = stress.depth
            state.lode = _lode(normal, tangent)
        strength = strength_of(state, values, row)
        apex = -strength.intercept / wp.max(strength.slope, 1.0e-6)
        if pressure < apex:
            opening = opening + elastic + apex / bulk
            elastic = -apex / bulk
            pressure = apex
        result = Stress()
        slope = strength.slope
        if wp.static(history):
            slope = strength.mobilised * slope
        limit = wp.max(strength.intercept + slope * pressure, 0.0)
        measure = wp.sqrt(0.5 * wp.dot(normal, normal) + wp.dot(tangent, tangent))
        kept = 1.0
        if wp.static(history):
            dilated = stress.dilated
            crush = strength.crush_pressure
            if crush > 0.0 and pressure > crush:
                lost = (pressure - crush) / (bulk + strength.crush_hardening)
                dilated = dilated - lost
                elastic = elastic + lost
                pressure = -bulk * elastic
                limit = strength.intercept + slope * pressure
            slip = 0.0
            if measure > limit:
                gain = 0.0
                if opening <= 0.0:
                    # soil that has come apart is looser than any dilation makes it
                    least = LEAST_DILATION * shear / (bulk * wp.max(slope, 1.0e-6))
                    idle = (strength.slope - slope) / (1.0 + wp.static(3.0**-0.5) * strength.slope)
                    gain = wp.max(strength.dilation - idle, least)
                slip = (measure - limit) / (shear + strength.viscosity / dt + slope * gain * bulk)
                slip = wp.min(slip, measure / shear)
                dilated = dilated + gain * slip
                elastic = elastic - gain * slip
                if -bulk * elastic < apex:
                    opening = opening + elastic + apex / bulk
                    elastic = -apex / bulk
                limit = wp.max(limit + (strength.viscosity / dt + slope * gain * bulk) * slip, 0.0)
                kept = limit / wp.max(measure, 1.0e-12)
            result.plastic_strain = stress.plastic_strain + slip
            result.dilated = dilated
            result.depth = stress.depth
        else:
            if measure > limit:
                kept = limit / wp.max(measure, 1.0e-12)
        result.normal = kept * normal
        result.shear = kept * tangent
        result.elastic = elastic
        result.opening = opening
        return result

    return update


@cache
def _compiled(key: tuple[tuple[Any, int], ...]) -> Any:
    strength_of: Any = base_strength
    for function, column in key:
        strength_of = _chain(strength_of, function, column)
    return _stress_update(strength_of, bool(key))


class Law:
    """The base law with a set of effects on.

    Args:
        effects: to switch on; their order does not matter.

    Raises:
        ParameterError: effects that exclude each other, or two that share a parameter's name.

    Attributes:
        effects: the effects that are on.
        parameters: friction angle, then the effects' parameters.
        update: ``@wp.func`` that advances a :class:`Stress`; equal objects for equal combinations.
        history: whether ``update`` keeps plastic strain and volume and wants the depth: some effect acts on strength.
    """

    def __init__(self, effects: Iterable[Effect] = ()) -> None:
        self.effects: tuple[Effect, ...] = tuple(effects)
        self._refuse_conflicts()
        self.parameters: tuple[Parameter, ...] = (
            FRICTION_ANGLE,
            *(p for effect in self.effects for p in effect.parameters),
        )
        names = [p.name for p in self.parameters]
        repeated = sorted({n for n in names if names.count(n) > 1})
        if repeated:
            raise ParameterError(f"two effects have a parameter named {', '.join(repeated)}; rename one")
        # a chain in one fixed order: the same bits, and one compilation, for every order in which a user names effects
        self._strong = sorted((e for e in self.effects if e.strength is not None), key=lambda e: e.name)
        key: list[tuple[Any, int]] = []
        column = BASE_COLUMNS
        defaults = {p.name: p.default for p in self.parameters}
        for effect in self._strong:
            key.append((effect.strength, column))
            column += len(effect.columns(Settings(FRICTION_ANGLE.default), defaults))
        self.update = _compiled(tuple(key))
        self.history = bool(key)

    def _refuse_conflicts(self) -> None:
        on = {effect.name for effect in self.effects}
        for effect in self.effects:
            for other, reason in effect.conflicts.items():
                if other in on:
                    raise ParameterError(f"effects {effect.name} and {other} cannot both be on: {reason}")

    @property
    def free(self) -> tuple[str, ...]:
        """Parameters that a fit frees unless told otherwise: friction angle, and those of effects with an off value."""
        return (
            FRICTION_ANGLE.name,
            *(p.name for effect in self.effects for p in effect.parameters if p.off is not None),
        )

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """All parameters by name: ``given`` with bounds checked, defaults for the rest.

        Raises:
            ParameterError: an unknown name or a value outside its bounds.
        """
        known = {p.name: p for p in self.parameters}
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise ParameterError(
                f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}"
                " (an effect's parameters exist when the effect is on)"
            )
        return {name: p.check(given.get(name, p.default)) for name, p in known.items()}

    def require_on(self, given: Mapping[str, float]) -> dict[str, float]:
        """The same as :meth:`values`, for a model whose effects must all act.

        Raises:
            ParameterError: also when an effect is left at its off value.
        """
        full = self.values(given)
        for effect in self.effects:
            switches = [p for p in effect.parameters if p.off is not None]
            if switches and all(full[p.name] == p.off for p in switches):
                first = switches[0]
                example = first.upper if first.sign >= 0 else first.lower
                raise ParameterError(
                    f"effect {effect.name!r} is on but all its parameters are at their off values; "
                    f"give it one, for example --set {first.name}={0.5 * (first.off or 0.0) + 0.5 * example:g}"
                )
        return full

    def settings(self, base: Settings, values: Mapping[str, float]) -> Settings:
        """``base`` with the friction angle of ``values`` and every effect applied.

        Raises:
            ParameterError: an unknown name or a value outside its bounds.
        """
        full = self.values(values)
        result = replace(base, friction_angle=full["friction_angle"]) if "friction_angle" in values else base
        for effect in self.effects:
            result = effect.settings(result, full)
        return result

    def observation(self, values: Mapping[str, float]) -> Observation:
        """What the cameras report under ``values``.

        Raises:
            ParameterError: an unknown name or a value outside its bounds.
        """
        full = self.values(values)
        result = Observation()
        for effect in self.effects:
            result = effect.observe(result, full)
        return result

    def table(self, base: Settings, batch: Sequence[Mapping[str, float]]) -> FloatArray:
        """Values (simulations, columns) that the kernels read, one row for each entry of ``batch``.

        Raises:
            ParameterError: an unknown name, a value outside its bounds, or values without meaning together.
        """
        rows = []
        for values in batch:
            s = self.settings(base, values)
            full = self.values(values)
            rows.append(
                [
                    cone_slope(s.friction_angle, s.matching),
                    cone_intercept(s.friction_angle, 1.0, s.matching),
                    s.tool_friction,
                    s.wall_friction,
                    s.floor_friction,
                    *s.gravity,
                    s.stiffness,
                    s.tool_adhesion,
                    *s.obstacle,
                    *(number for effect in self._strong for number in effect.columns(s, full)),
                ]
            )
        return np.array(rows, dtype=np.float64)

    def density(self, depth: FloatArray, values: Mapping[str, float]) -> FloatArray | None:
        """Bulk density (n,) at the start over the nominal one at depths (n,) in m; None when it is 1 everywhere."""
        full = self.values(values)
        result: FloatArray | None = None
        for effect in self.effects:
            if type(effect).density is not Effect.density:
                factor = effect.density(depth, full)
                result = factor if result is None else result * factor
        return result
