"""The same soil packed at another void ratio."""

from __future__ import annotations

import math
from collections.abc import Mapping

from splatsoil.errors import CombinationError, ParameterError
from splatsoil.soil.effects.critical_state import CriticalState

DEFAULT = {p.name: p.default for p in CriticalState.parameters}


def of_limits(void_ratio: float, least: float, most: float) -> dict[str, float]:
    """Parameters of `critical_state` from the void ratio and its limits in index tests (ASTM D4253, D4254).

    Raises:
        ParameterError: limits without meaning.
    """
    if not 0.0 < least < most:
        raise ParameterError(f"void ratio limits {least:g} and {most:g}: give the densest, then the loosest packing's")
    width = math.log((1.0 + most) / (1.0 + least))
    return {"relative_density": math.log((1.0 + most) / (1.0 + void_ratio)) / width, "volume_range": width}


def at_void_ratio(values: Mapping[str, float], before: float, after: float) -> dict[str, float]:
    """Parameters of a soil that was described at one void ratio, at another one.

    Relative density changes by the logarithm of volume over its range. The strain of hardening goes with its inverse,
    because the secant modulus is proportional to relative density (Brinkgreve, Engin & Engin 2010, Proc. 7th Eur. Conf.
    Numer. Methods Geotech. Eng., 137). All else is a property of the grains. Without `critical_state` nothing changes.

    Raises:
        CombinationError: a packing looser than the loosest, or denser than the densest.
    """
    changed = dict(values)
    if "relative_density" not in changed or before == after:
        return changed
    old = changed["relative_density"]
    new = old + math.log((1.0 + before) / (1.0 + after)) / changed.get("volume_range", DEFAULT["volume_range"])
    if not 0.0 <= new <= 1.0:
        raise CombinationError(
            f"void ratio {after:g}: a relative density of {old:.2f} at {before:g} makes {new:.2f} of it, outside [0, 1]"
        )
    changed["relative_density"] = new
    if changed.get("hardening_strain") and new > 0.0:
        changed["hardening_strain"] *= old / new
    return changed
