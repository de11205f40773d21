"""How far apart solvers of the same equations are in what they read a parameter as.

What laboratories call reproducibility (ISO 5725-2): each of them repeats itself better than it agrees with the others.
Soil that has an effect stands and falls otherwise in every solver (docs/numerics.md), none of which is converged, and
nothing in one measurement tells which one soil follows.
"""

from __future__ import annotations

from collections.abc import Iterable

from splatsoil.parameters import Parameter, distance
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import FRICTION_ANGLE

ANGLE, PLAIN = 2.3, 0.6
"""Degrees: friction angle of soil that has an effect, and of soil that has none."""
SHARE = 0.22
"""Of what an effect's parameter is away from off, along its scale."""


def between_solvers(parameter: Parameter, value: float, effects: Iterable[Effect]) -> float:
    """Standard deviation of a parameter at a value between solvers, in its unit, of soil that has effects, or none.

    Maximum likelihood over sealed worlds of an implicit solver, beyond all that a diagnosis finds by itself: sixteen
    with cohesion or viscosity hidden (docs/criticism-evidence.md, seeds 41 to 44), to which other effects of soil are
    taken to be alike, and thirteen in which nothing of soil was seen (docs/hidden-worlds.md, seeds 86, 87 and
    93; not the weak layer, whose angle is a mean of two); all before soil gave way to the tool as it does now. What
    cameras report doesn't hang on a solver, and of what only shapes an effect nothing is known.
    """
    on = tuple(effects)
    if parameter.name == FRICTION_ANGLE.name:
        return PLAIN if all(effect.observes for effect in on) else ANGLE
    if parameter.name in {p.name for effect in on if effect.observes for p in effect.parameters}:
        return 0.0
    if parameter.off is None:
        return 0.0
    return SHARE * abs(distance(parameter, value, parameter.off))
