"""How far apart solvers of the same equations are in what they read a parameter as.

What laboratories call reproducibility (ISO 5725-2): each of them repeats itself better than it agrees with the others.
Soil that has an effect stands and falls otherwise in every solver (docs/numerics.md), none of which is converged, and
nothing in one measurement tells which one soil follows.
"""

from __future__ import annotations

from collections.abc import Iterable

from splatsoil.parameters import Parameter, distance
from splatsoil.soil.effect import Effect

ANGLE = 2.3
"""Degrees: friction angle of soil that has an effect."""
SHARE = 0.22
"""Of what an effect's parameter is away from off, along its scale."""


def between_solvers(parameter: Parameter, value: float, effects: Iterable[Effect]) -> float:
    """Standard deviation of a parameter at a value between solvers, in its unit, of soil that has effects.

    Maximum likelihood over sixteen sealed worlds of an implicit solver with cohesion or viscosity hidden
    (docs/hidden-worlds-before.md, seeds 41 to 44), beyond all that a diagnosis finds by itself; other effects of soil
    are taken to be alike. Soil without an effect is read as well as a diagnosis says, what cameras report doesn't hang
    on a solver, and of what only shapes an effect nothing is known.
    """
    on = tuple(effects)
    reported = {p.name for effect in on if effect.observes for p in effect.parameters}
    if parameter.name in reported or all(effect.observes for effect in on):
        return 0.0
    if parameter.name == "friction_angle":
        return ANGLE
    if parameter.off is None:
        return 0.0
    return SHARE * abs(distance(parameter, value, parameter.off))
